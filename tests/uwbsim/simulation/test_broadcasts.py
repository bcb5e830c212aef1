"""Tags that broadcast in turn and tags that only listen: geometry, planted delays, and loops over frames."""

import json

import numpy as np
import pytest

import uwbsim
from tests import processes
from tests.errors import one_line
from uwblink import load, raw_range
from uwblink.receptions import Receptions, exchanges_in
from uwblink.recording.distances import distances_m
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S, elapsed
from uwblink.twr import intervals

PLACES = {1: (0.0, 0.0, 0.5), 2: (5.0, 0.3, 0.0), 3: (1.0, 6.0, 1.0), 4: (4.5, 5.5, 2.0), 9: (2.0, 2.5, 1.5)}
DELAYS = {1: 0.5, 2: -0.31, 3: 0.12, 4: -0.07, 9: 0.8}
SKEWS = {1: 3.0, 2: -8.0, 3: 11.0, 4: -1.0, 9: 5.0}
QUIET = {"rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0, "quantize": False, "power_noise_db": 0.0}
PS = 1e-12


def world(duration_s=4.0, rate_hz=200.0, places=PLACES, tags=None, radio=None, motion=None, **ranging):
    """Return a scenario of four tags that broadcast, and of tag 9, which listens."""
    motions = {k: {"model": "static", "position_m": place} for k, place in places.items()} | (motion or {})
    return {
        "run": {"seed": 4, "duration_s": duration_s},
        "ranging": {"plan": "broadcast", "rate_hz": rate_hz, "sync_error_ms": 0.0} | ranging,
        "radio": QUIET | (radio or {}),
        "bodies": [{"name": str(k), "motion": motion} for k, motion in motions.items()],
        "tags": [
            {"id": k, "body": str(k), "delay_ns": DELAYS[k], "skew_ppm": SKEWS[k], "passive": k == 9} | (tags or {})
            for k in places
        ],
    }


def table(flown):
    """Return the receptions of a flight, or of a recording."""
    return Receptions(**flown.receptions)


def apart_s(a, b):
    return float(np.linalg.norm(np.subtract(PLACES[a], PLACES[b]))) / SPEED_OF_LIGHT


def by_pair(*columns):
    ends = np.column_stack(columns)
    return [(*row, np.flatnonzero((ends == row).all(axis=1))) for row in np.unique(ends, axis=0).tolist()]


@pytest.fixture(scope="module")
def still():
    # A counter of 17.2 s that wraps 0.2 s after the start, and others that do not.
    return uwbsim.simulate(world(tags={"clock_offset_s": 17.0}))


def test_ranges_are_the_distances_less_the_planted_delays(still):
    """Six stamps of a range are rounded to 15.65 ps: single ranges are within 30 ps, means of 200 within 1.5 ps."""
    e = still.exchanges
    pairs = by_pair(e.initiator, e.target)
    assert {tuple(sorted(pair[:2])) for pair in pairs} == {(a, b) for a in range(1, 5) for b in range(a + 1, 5)}
    for i, j, rows in pairs:
        errors = raw_range(e)[rows] / SPEED_OF_LIGHT - (apart_s(i, j) - (DELAYS[i] + DELAYS[j]) * 1e-9 / 2)
        assert np.abs(errors).max() < 30 * PS
        assert abs(errors.mean()) < 1.5 * PS
        assert still.truth_m[rows] == pytest.approx(apart_s(i, j) * SPEED_OF_LIGHT, abs=1e-9)


def test_noise_is_of_the_stamps_and_the_departure_is_one_for_all(still):
    """Transmit noise alone is common to all listeners: their differences have only rounding errors, 4.5 ps each."""
    r = table(uwbsim.simulate(world(radio={"tx_noise_ps": 500.0}, tags={"skew_ppm": 0.0})))
    first = r[(r.sender == 1) & (r.listener == 2)], r[(r.sender == 1) & (r.listener == 9)]
    late = [elapsed(one.rx, one.tx, 40) * TICK_S for one in first]
    assert np.std(late[0] - late[0].mean()) == pytest.approx(500 * PS, rel=0.2)
    assert np.std(late[0] - late[1]) < 10 * PS


def test_moving_tags_range_as_their_poses_say():
    """K contains the Doppler shift, so a reply extrapolates the distance: d(1), and d(2) minus its change over the
    reply.
    """
    box = {"box_min_m": [1.0, 1.0, 0.4], "box_max_m": [4.0, 5.0, 2.4], "speed_mps": 1.5}
    flight = uwbsim.simulate(world(motion={2: {"model": "random-flight"} | box}, tags={"delay_ns": 0.0}))
    e, spans = flight.exchanges, intervals(flight.exchanges)
    frames_ns = np.rint(e.time_ns + np.cumsum([0 * spans.dt41, spans.dt41, spans.dt53], axis=0) * 1e9 * TICK_S)
    d = [distances_m(flight.poses, flight.tags, e.initiator, e.target, at.astype(np.int64)) for at in frames_ns]
    # Poses every 10 ms with accelerations of 10 m/s^2 are interpolated to 0.1 mm, stamps rounded to 30 ps or 9 mm.
    errors = raw_range(e) - (d[0] + d[1] - (d[2] - d[1]) / spans.dt53 * spans.dt32) / 2
    assert np.abs(errors).max() < 0.01
    assert abs(errors.mean()) < 0.0005
    assert np.abs(flight.truth_m - d[0]).max() < 0.0005


def test_frames_that_overlap_are_lost_as_powers_and_times_say():
    """By loops over all pairs of frames: the first of two is received if it is 3 dB stronger, none while sending."""
    crowded = world(rate_hz=1000.0, sync_error_ms=0.5, duration_s=2.0, radio={"capture_db": 3.0})
    calm, found = (uwbsim.simulate(crowded, contention=contention) for contention in (False, True))
    every, received = table(calm), table(found)
    assert len(every) == 2000 * 4
    begin = dict(zip(every.frame.tolist(), every.time_ns.tolist(), strict=True))
    sender = dict(zip(every.frame.tolist(), every.sender.tolist(), strict=True))
    power = {(f, k): p for f, k, p in zip(every.frame.tolist(), every.listener.tolist(), every.fpp_dbm, strict=True)}
    # Preamble and delimiter of 136 symbols, header of 21, and 35 bytes with 48 bits of parity.
    lasts_ns = 136 * 508 / 0.4992 + 21 * 512 / 0.4992 + (8 * 35 + 48) * 64 / 0.4992
    lost = set()
    for f in range(2000):
        for other in range(max(f - 12, 0), min(f + 13, 2000)):
            if other != f and abs(begin[f] - begin[other]) < lasts_ns:
                lost |= {
                    (f, k)
                    for k in PLACES.keys() - {sender[f]}
                    if k == sender[other] or power[f, k] < power[other, k] + 3.0 or begin[f] > begin[other]
                }
    assert 500 < len(lost) == len(found.faults) < 3000
    assert power.keys() - set(zip(received.frame.tolist(), received.listener.tolist(), strict=True)) == lost
    assert {fault.kind for fault in found.faults} == {"collision", "receiver busy"}
    assert found.faults[0].detail.endswith(("frame collision", "frame receiver busy"))


def test_boards_out_of_range_receive_no_frames_and_have_no_ranges():
    far = uwbsim.simulate(world(places=PLACES | {4: (900.0, 0.0, 0.0)}))
    r = table(far)
    assert 4 not in [*r.sender, *r.listener]
    assert {fault.kind for fault in far.faults} == {"lost frame"}
    assert len(far.faults) == 800 * 4 - len(r) == 200 * 4 + 3 * 200
    assert {4, 9}.isdisjoint(far.exchanges.initiator.tolist() + far.exchanges.target.tolist())


def test_the_recording_holds_receptions_and_the_exchanges_that_they_make(tmp_path):
    out = tmp_path / "tdoa.uwb"
    words = ("--set", "run.duration_s=2", "--set", "radio.bias=none")
    processes.succeed("uwbsim", "run", "tdoa", "-o", out, *words)
    held = load(out)
    assert held.meta["timestamp_bits"] == held.exchanges.bits == 40
    assert held.counts()["receptions"] == 2 * 200 * 9
    again, overheard = exchanges_in(table(held))
    assert again.rx3.tolist() == held.exchanges.rx3.tolist()
    assert len(overheard["rx3"]) == len(held.overheard["rx3"]) > 0
    ranged = held.exchanges.initiator.tolist() + held.exchanges.target.tolist()
    assert {10, 11} <= set(held.overheard["listener"].tolist()) - set(ranged)
    # Seven pairs of 49 ranges with 85 ps of noise, half of a delay each, determine it to 10 ps; four of these.
    fitted = processes.succeed("calib", "fit", out, "-o", tmp_path / "c.json", "--delays-only", "--json")
    found = json.loads(fitted.stdout)["delays_ns"]
    planted = held.meta["planted"]["delays_ns"]
    assert (len(found), found) == (8, pytest.approx({tag: planted[tag] for tag in found}, abs=0.04))


def test_a_preview_counts_frames():
    found = uwbsim.preview(world())
    assert (found.exchanges, found.rate_hz) == (800, 200.0)
    assert "800 broadcasts planned among 16 pairs" in str(found)
    assert found.air_share == pytest.approx(200 * 201.99e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("scenario", "words"),
    [
        (world(protocol="ss"), ["ranging.protocol", "'ss'", "'ds'"]),
        (world(pairs=[(1, 2)]), ["ranging.pairs", "between-bodies"]),
        (world(get_cir=True), ["ranging.get_cir"]),
        (world(rate_hz=5000.0), ["ranging.rate_hz: found 5000", "frames of 4 tags"]),
        # One sender.
        (world() | {"tags": [dict(tag, passive=tag["id"] != 1) for tag in world()["tags"]]}, ["ranging.pairs"]),
    ],
)
def test_what_broadcasts_cannot_have_is_refused_by_key(scenario, words):
    with pytest.raises(uwbsim.ScenarioError, match=one_line(*words)):
        uwbsim.load(scenario)
