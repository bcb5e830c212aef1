"""`calib fit --truth ranges`, as one types it."""

import json

import pytest

from calib.settings import read_distances
from tests import processes
from tests.calib.trajectories.sines import flight
from uwblink import Contents, KnownDistance
from uwblink.recording.file import Recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "f.uwb"
    flown = flight(seconds=14.0)
    Contents(exchanges=flown.exchanges, poses=flown.poses, tags=flown.tags).save(path)
    return path


def test_a_known_start_is_enough(recording, tmp_path):
    words = ("--truth", "ranges", "--poses-until", 6, "-o", tmp_path / "c.json")
    done = processes.succeed("calib", "fit", recording, *words)
    assert done.stdout.count(" delay ") == 6
    written = json.loads((tmp_path / "c.json").read_text())
    assert written["provenance"]["truth"] == "ranges"
    with Recording.open(recording) as opened:
        assert written["provenance"]["exchanges"] <= len(opened.exchanges())


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("11-12=3.06", KnownDistance(11, 12, 3.06, 0.01)),
        (" 1 - 3 = 1.5 +- .005 @ desk", KnownDistance(1, 3, 1.5, 0.005, "desk")),
        ("1-3=2±0.02@2..8", KnownDistance(1, 3, 2.0, 0.02, "2..8")),
    ],
)
def test_a_distance_is_read_as_one_types_it(text, found):
    assert read_distances([text]) == (found,)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--truth", "tape"), "--truth: found 'tape', allowed: recorded, ranges"),
        (("--poses-until", "6"), "--poses-until: goes with a fit whose --truth is ranges"),
        (("--truth", "ranges", "--loss", "huber"), "--loss: goes with known distances only"),
        (("--truth", "ranges", "--trim-static"), "--trim-static: goes with known distances only"),
        (("--truth", "ranges", "--anchors", "lost"), "--anchors: found 'lost', allowed: given, sought"),
        (("--truth", "ranges", "--distance", "1:3=2"), "--distance: found '1:3=2', expected TAG-TAG=METRES"),
        (("--truth", "ranges", "--distance", "1-9=2"), "--distance: found tag 9, the tags that range are 1, 2, 3"),
        (("--truth", "ranges", "--heights", "guess"), "--heights: found 'guess', allowed: used, ignored"),
    ],
)
def test_what_does_not_go_together_is_one_line(recording, tmp_path, words, said):
    processes.refuse("calib", "fit", recording, *words, "-o", tmp_path / "c.json", naming=[said])
    assert not (tmp_path / "c.json").exists()
