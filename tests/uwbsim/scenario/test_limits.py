"""Numbers of a scenario that no physics has."""

from pathlib import Path

import pytest

from uwbsim import Scenario
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import check_limits, limit_of
from uwbsim.scenario.loading import load

NOISELESS = (Path(__file__).parents[3] / "scenarios" / "noiseless.toml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("duration_s = 60.0", "duration_s = 1e16", "run.duration_s: found 1e+16, at most 1e+07"),
        ("lever_arm_m = [", "tx_power_db = 1e16\nlever_arm_m = [", "tags[0].tx_power_db: found 1e+16, at most 500"),
        ("lever_arm_m = [", "lever_arm_m = [1e200, 0, 0] #", "tags[0].lever_arm_m: found 1e+200, at most 1e+06"),
        ("lever_arm_m = [", "ramp_ppm_per_s = -1e9\nlever_arm_m = [", "tags[0].ramp_ppm_per_s: found -1e+09"),
        ("speed_mps = 0.5", "speed_mps = 1e16", "motion.speed_mps: found 1e+16, at most 10000 is allowed ("),
    ],
)
def test_it_is_named_with_its_limit(tmp_path, old, new, where):
    assert old in NOISELESS
    path = tmp_path / "s.toml"
    path.write_text(NOISELESS.replace(old, new, 1))
    with pytest.raises(ScenarioError) as caught:
        load(path)
    assert where in str(caught.value)


def test_the_longest_unit_counts():
    assert limit_of("ramp_ppm_per_s").reason.startswith("a crystal")
    assert limit_of("duration_s").reason.startswith("time")
    assert limit_of("acceleration_mps2").most > limit_of("speed_mps").most


@pytest.mark.parametrize("value", [True, "1e99", None, (), ((), ()), 10**5, (1.0, 2.0)])
def test_what_is_no_number_or_within_passes(value):
    check_limits("length_m", value)


@pytest.mark.parametrize("value", [10**400, -2e6, (0.0, 2e6), ((0.0, 1.0), (2e6, 3.0)), (1.0, 10**400)])
def test_what_is_beyond_does_not_however_deep(value):
    with pytest.raises(ValueError, match="length_m: found"):
        check_limits("length_m", value)


def test_the_schema_says_them():
    motion = Scenario.model_json_schema()["$defs"]["RandomFlight"]["properties"]["speed_mps"]
    assert motion["exclusiveMinimum"] == 0
    assert motion["maximum"] == 10_000
