"""Ids of 16 bits, as on other boards, from a scenario to corrected ranges; only the project's boards have 8 bits."""

import re
from typing import Any

import numpy as np
import pytest

import calib
import uwblink
from tests.processes import ROOT, refuse, succeed

LARGEST = 65535


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A flight without noise whose tags 1 to 6 have the ids 65535 to 65530."""
    folder = tmp_path_factory.mktemp("ids")
    text = re.sub(
        r"^id = (\d)$",
        lambda m: f"id = {LARGEST + 1 - int(m[1])}",
        (ROOT / "scenarios/noiseless.toml").read_text(),
        flags=re.M,
    )
    (folder / "s.toml").write_text(text.replace("duration_s = 60.0", "duration_s = 4.0"))
    succeed("uwbsim", "run", "s.toml", "-o", "flight.uwb", cwd=folder)
    return folder


@pytest.mark.slow
def test_large_ids_work_in_flights_fits_and_corrections(folder):
    ids = {*range(LARGEST - 5, LARGEST + 1)}
    for line, told in (
        ("calib fit flight.uwb -o c.json", ""),
        ("calib doctor flight.uwb", str(LARGEST)),
        ("calib evaluate flight.uwb -c c.json", str(LARGEST)),
        ("calib localize flight.uwb -c c.json", ""),
        ("calib apply flight.uwb -c c.json --to csv -o tables", ""),
        ("uwblink import exported tables -o again.uwb", ""),
    ):
        assert told in succeed(*line.split(), cwd=folder).stdout
    assert calib.load_calibration(folder / "c.json").delays_ns.keys() == ids
    again = uwblink.load(folder / "again.uwb").exchanges
    assert {*again.initiator.tolist(), *again.target.tolist()} == ids
    streamed = succeed("uwblink", "stream", "flight.uwb", "-c", "c.json", "--speed", "inf", "--quiet", cwd=folder)
    assert streamed.stderr.startswith(f"{len(again)} ranges")


def test_large_ids_work_for_other_boards_only(folder):
    stamps: Any = dict.fromkeys(("tx1", "rx1", "tx2", "rx2"), np.zeros(40, dtype=np.int64))
    exchanges = uwblink.Exchanges.from_arrays(300, LARGEST, time_ns=np.arange(40) * 10**8, range_m=5.1, **stamps)
    uwblink.Contents(exchanges=exchanges).save(folder / "bare.uwb")
    places = {300: [0.0, 0.0, 0.0], LARGEST: [3.0, 4.0, 0.0]}
    anchors = "".join(f"[[anchors]]\nid = {tag}\nposition_m = {place}\n" for tag, place in places.items())
    (folder / "anchors.toml").write_text(anchors)
    succeed("uwblink", "poses", "bare.uwb", "--tags", "anchors.toml", cwd=folder)
    assert np.unique(uwblink.load(folder / "bare.uwb").poses.body).tolist() == ["anchor300", f"anchor{LARGEST}"]
    (folder / "too_large.toml").write_text("[[anchors]]\nid = 65536\nposition_m = [0.0, 0.0, 0.0]\n")
    refuse("uwblink", "poses", "bare.uwb", "--tags", "too_large.toml", cwd=folder, naming=["anchors[0].id", "65535"])
    refuse("uwbsim", "serve", "s.toml", cwd=folder, naming=["tags", "id 6553", "0 to 254"])
    with pytest.raises(uwblink.errors.PlanError, match="pairs"):
        uwblink.RangingPlan(pairs=((1, 255),))
    assert uwblink.RangingPlan(pairs=((1, 254),)).pairs == ((1, 254),)
