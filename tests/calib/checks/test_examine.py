"""Each fault is planted in a flight, and the doctor finds it and nothing else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.checks.columns import VACUUM_OVER_AIR
from calib.checks.examine import examine
from uwblink.recording.schema import Fault
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.twr import STAMPS, board_range
from uwbsim import Simulated, simulate
from uwbsim.scenario.loading import load

SCENARIOS = Path(__file__).parents[3] / "scenarios"


@pytest.fixture(scope="module")
def flight() -> Simulated:
    return simulate(load(SCENARIOS / "icra2023" / "test1.toml", ["run.duration_s=40"]))


def faults(simulated, tmp_path):
    simulated.save(tmp_path / "f.uwb", force=True)
    return [finding.fault for finding in examine(tmp_path / "f.uwb")]


def with_exchanges(flight, **columns):
    return replace(flight, exchanges=replace(flight.exchanges, **columns))


def arms(flight, change):
    return replace(flight, tags=[replace(t, lever_arm_m=change(t)) for t in flight.tags])


def unit_slip(f):
    ns = {n: np.rint(getattr(f.exchanges, n) * 1e9 / TICKS_PER_SECOND).astype(np.int64) for n in STAMPS}
    return with_exchanges(f, **ns)


def too_wide(f):
    e = f.exchanges
    return replace(f, exchanges=replace(e, bits=40), meta=f.meta | {"timestamp_bits": 40})


def no_third(f):
    none = np.zeros(len(f.exchanges), dtype=np.int64)
    return with_exchanges(f, tx3=none, rx3=none)


def roles(f):
    e = f.exchanges
    return with_exchanges(
        f, initiator=e.target, target=e.initiator, fpp1_dbm=e.fpp2_dbm, fpp2_dbm=e.fpp1_dbm, skew1_ppm=e.skew2_ppm,
        skew2_ppm=e.skew1_ppm,
    )  # fmt: skip


def swapped_ids(f):
    other = {1: 2, 2: 1}
    by_tag = {t.tag: t.lever_arm_m for t in f.tags}
    return arms(f, lambda t: by_tag[other.get(t.tag, t.tag)])


def turned_arms(f):
    return arms(f, lambda t: tuple(-v for v in t.lever_arm_m) if t.body == "ifo002" else t.lever_arm_m)


def wxyz(f):
    return replace(f, poses=replace(f.poses, quaternion=f.poses.quaternion[:, [3, 0, 1, 2]]))


def late_poses(f):
    return replace(f, poses=replace(f.poses, time_ns=f.poses.time_ns + 400_000_000))


def vacuum(f):
    return with_exchanges(f, range_m=f.exchanges.range_m * VACUUM_OVER_AIR)


def moved(f):
    e = f.exchanges
    late = (e.time_ns > 20_000_000_000) & ((e.initiator == 4) | (e.target == 4))
    sign = np.where(e.initiator == 4, 1, 0)
    # 2 ns at the one end: the initiator's receptions come later, or the target's reply seems shorter.
    ticks = round(2e-9 * TICKS_PER_SECOND)
    mask = 2**32 - 1
    rx2 = np.where(late & (sign == 1), (e.rx2 + ticks) & mask, e.rx2)
    rx3 = np.where(late & (sign == 1), (e.rx3 + ticks) & mask, e.rx3)
    rx1 = np.where(late & (sign == 0), (e.rx1 + ticks) & mask, e.rx1)
    changed = replace(e, rx1=rx1, rx2=rx2, rx3=rx3)
    return replace(f, exchanges=replace(changed, range_m=board_range(changed)))


def corrupted(f):
    rng = np.random.default_rng(1)
    hit = rng.random(len(f.exchanges)) < 0.01
    return with_exchanges(f, rx2=np.where(hit, rng.integers(0, 2**32, len(hit)), f.exchanges.rx2))


def one_pair(f):
    e = f.exchanges
    return replace(f, exchanges=e[(e.initiator == 1) & (e.target == 3)])


def dead(f):
    e = f.exchanges
    keep = (e.initiator != 6) & (e.target != 6)
    failed = [
        Fault(int(t), "1", "lost frame", "message 1 below sensitivity", initiator=1, target=6) for t in e.time_ns[~keep]
    ]
    return replace(f, exchanges=e[keep], faults=failed)


@pytest.mark.parametrize(
    ("plant", "fault"),
    [
        (lambda f: f, None),
        (unit_slip, "unit slip"),
        (too_wide, "timestamp width"),
        (no_third, "single-sided data taken for double-sided"),
        (roles, "swapped roles"),
        (swapped_ids, "swapped tag ids"),
        (turned_arms, "lever arm sign"),
        (wxyz, "wxyz quaternion"),
        (late_poses, "pose time offset"),
        (vacuum, "speed of light in vacuum"),
        (moved, "delay changed mid-flight"),
        (corrupted, "corrupted exchanges"),
        (one_pair, "too few pairs"),
        (dead, "dead or deaf tag"),
        (lambda f: replace(f, poses=replace(f.poses, time_ns=f.poses.time_ns + 10**14)), "no true distances"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_fault_is_found_and_nothing_else(flight, tmp_path, plant, fault):
    assert faults(plant(flight), tmp_path) == ([fault] if fault else [])


STILL = [
    f'bodies.{k}.motion={{ model = "static", position_m = {place} }}'
    for k, place in enumerate(([-1.5, -1.5, 1.0], [1.5, -1.0, 1.2], [0.0, 1.6, 0.9]))
]


@pytest.mark.parametrize(
    ("fault", "settings"),
    [
        ("skew in single-sided ranges", ["ranging.protocol=ss", "run.duration_s=30"]),
        ("reflections", ["radio.multipath.share=0.5", "run.duration_s=30"]),
        ("static data", ["run.duration_s=20", *STILL]),
        (
            "power confounded with distance",
            ["radio.antenna=isotropic", "radio.shadowing_db=0", "radio.power_noise_db=0.05", "run.duration_s=30"],
        ),
    ],
)
def test_faults_that_a_scenario_plants_and_nothing_else(tmp_path, fault, settings):
    assert faults(simulate(load(SCENARIOS / "icra2023/test1.toml", settings)), tmp_path) == [fault]


def test_two_boards_on_a_bench_are_too_few_and_too_still(tmp_path):
    scenario = load(SCENARIOS / "two_boards_on_a_bench/bench.toml", ["run.duration_s=20"])
    assert faults(simulate(scenario), tmp_path) == ["too few pairs", "static data"]


def test_the_offset_is_estimated(flight, tmp_path):
    late_poses(flight).save(tmp_path / "f.uwb", force=True)
    (finding,) = examine(tmp_path / "f.uwb")
    assert float(finding.remedy.split()[-1]) == pytest.approx(-0.4, abs=0.02)


def test_power_and_distance_are_not_confounded_outdoors(tmp_path):
    """Two boards on tripods, 2 to 60 m apart: distance explains 82 % of the power, and leaves enough."""
    from tests.shared_data import ROOT, shared
    from uwblink.importers import import_recording

    table = shared("hanyang_sstwr.csv.gz")
    import_recording(table, tmp_path / "h.uwb", map_file=ROOT / "docs" / "maps" / "hanyang.toml")
    # A pole and a tripod do not move, so what is reflected is so for as long as they stand.
    assert {f.fault for f in examine(tmp_path / "h.uwb")} == {
        "too few pairs",
        "single-sided without carrier readings",
        "reflections that last",
    }
