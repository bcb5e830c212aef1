"""Recordings that lack something: every command that needs it says what, and ends with status 1 or 2 as it should."""

from dataclasses import replace

import numpy as np
import pytest

import calib
import uwbsim
from tests import processes
from uwblink import Contents, Exchanges, Poses
from uwblink.errors import ImportTableError
from uwblink.importers.guess import guess_map

COUNT = 900


def saved(path, **changes):
    flight = calib.sample_flight(COUNT)
    tags = changes.pop("tags", flight.tags)
    exchanges = replace(flight.exchanges, **changes)
    Contents(exchanges=exchanges, poses=flight.poses, tags=tags).save(path)
    return path


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    path = tmp_path_factory.mktemp("known") / "c.json"
    calib.fit(calib.sample_flight(COUNT)).save(path)
    return path


def run(*words):
    done = processes.run(*words)
    return done.returncode, done.stderr


def without_power():
    return {"fpp1_dbm": np.full(COUNT, np.nan), "fpp2_dbm": np.full(COUNT, np.nan)}


def test_a_twin_of_a_recording_without_tags_is_what_data_cannot_answer(tmp_path, known):
    path = saved(tmp_path / "f.uwb", tags=[])
    status, told = run("uwbsim", "twin", path, "-c", known, "-o", tmp_path / "t.toml")
    assert (status, told) == (
        1,
        f"error: {path}: does not say on which body tag 1, 2, 3 sits; give tags with 'uwblink poses --tags'\n",
    )


def test_nothing_is_tracked_without_times(tmp_path, known):
    path = saved(tmp_path / "f.uwb", time_ns=np.zeros(COUNT, np.int64))
    status, told = run("calib", "localize", path, "-c", known)
    assert status == 1
    assert "all of its 900 ranges have the same time" in told


def test_what_needs_powers_says_so_and_recommends_nothing_that_it_lacks(tmp_path, known):
    path = saved(tmp_path / "f.uwb", **without_power())
    assert [f.fault for f in calib.examine(path)] == ["no powers"]
    (finding,) = calib.examine(path)
    assert finding.evidence == "0 % of the exchanges have a first-path power"
    status, told = run("calib", "localize", path, "-c", known)
    assert status == 1
    assert told.endswith("no power; a calibration without a curve needs none: `calib fit --delays-only` makes one\n")
    assert calib.fit(path, delays_only=True).calibration.delays_ns


def test_half_with_powers_is_enough():
    flight = calib.sample_flight(COUNT)
    one_end = replace(flight.exchanges, fpp2_dbm=np.full(COUNT, np.nan))
    assert "no powers" not in {f.fault for f in calib.examine(replace(flight, exchanges=one_end))}


@pytest.mark.parametrize("share", [0.01, 1.0])
def test_a_tag_that_ranges_with_itself_is_named_and_left_out(share, tmp_path, known):
    target = calib.sample_flight(COUNT).exchanges.target.copy()
    rows = np.arange(int(share * COUNT))
    target[rows] = calib.sample_flight(COUNT).exchanges.initiator[rows]
    path = saved(tmp_path / "f.uwb", target=target)
    assert "a tag with itself" in {f.fault for f in calib.examine(path)}
    if share == 1:
        with pytest.raises(calib.UnanswerableError, match="a tag with itself; look at from_id and to_id"):
            calib.fit(path)
    else:
        assert calib.load_ranges(path).excluded == {"a tag with itself": len(rows)}


def test_a_twin_does_without_exchanges_of_a_tag_with_itself(tmp_path):
    flight = uwbsim.simulate(uwbsim.load("icra2023/test1", {"run.duration_s": 5.0}))
    target = flight.exchanges.target.copy()
    target[::50] = flight.exchanges.initiator[::50]
    mixed = Contents(
        exchanges=replace(flight.exchanges, target=target), poses=flight.poses, tags=flight.tags, faults=flight.faults
    )
    calib.fit(flight).save(tmp_path / "k.json")
    with_itself, whole = (uwbsim.twin(data, tmp_path / "k.json").found for data in (mixed, flight))
    assert with_itself["exchanges"] == whole["exchanges"] - len(target[::50])
    # Two in a hundred fewer say the same to a few per cent.
    assert with_itself["receive_noise_ps"] == pytest.approx(whole["receive_noise_ps"], rel=0.1)


def test_delays_of_all_tags_and_no_curve_blame_the_calibration(known):
    with pytest.raises(calib.BadInputError, match="`delays_from`: it has the delays of all tags"):
        calib.fit(calib.sample_flight(COUNT), delays_from=known, delays_only=True)
    with pytest.raises(calib.BadInputError, match="`fixed_ns`: every tag is pinned"):
        calib.fit(calib.sample_flight(COUNT), fixed_ns={1: 0.0, 2: 0.0, 3: 0.0}, delays_only=True)


def test_a_recording_is_no_table_to_guess_at(tmp_path):
    with pytest.raises(ImportTableError, match="is a recording already"):
        guess_map(saved(tmp_path / "f.uwb"))


def test_nothing_is_something_to_begin_with():
    assert len(Poses.from_arrays([], [], [])) == 0
    assert len(Poses.from_arrays([], "drone", np.zeros((0, 3)))) == 0
    assert len(Exchanges.from_arrays([], [], tx1=[], rx1=[], tx2=[], rx2=[])) == 0
