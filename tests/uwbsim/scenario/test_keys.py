"""Keys of files of scenarios, faults and sweeps: limits, overrides, descriptions, and the schema that is printed."""

import json

import pytest

from docs.site.schema import UNITS, described, reference, unit_of
from tests import processes
from uwbsim.boards.server import FaultsFile
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import BY_UNIT, check_limits
from uwbsim.scenario.loading import load
from uwbsim.scenario.model import Scenario
from uwbsim.sweep.design import SweepFile

SCHEMAS = {model.__name__: model.model_json_schema() for model in (Scenario, FaultsFile, SweepFile)}


@pytest.mark.parametrize(
    ("override", "fragment"),
    [
        ("run.duration_s=1e16", r"run\.duration_s: found 1e\+16, at most 1e\+07 is allowed \(time"),
        ("tags.0.tx_power_db=1e16", r"tags\[0\]\.tx_power_db: found 1e\+16, at most 500"),
        ("tags.0.lever_arm_m=[1e200, 0, 0]", r"tags\[0\]\.lever_arm_m: found 1e\+200, at most 1e\+06"),
        ("tags.0.ramp_ppm_per_s=-1e9", r"tags\[0\]\.ramp_ppm_per_s: found -1e\+09, at most 10000 .*crystal"),
        ("bodies.0.motion.speed_mps=1e16", r"motion\.speed_mps: found 1e\+16, at most 10000 is allowed \("),
        ("tags.9.skew_ppm=1", "index"),
        ("tags.x.skew_ppm=1", "index"),
        ("ranging.rate_hz.deep=1", "rate_hz"),
        ("=1", "key.path=value"),
        ("ranging.speed=1", "unknown key"),
    ],
)
def test_values_beyond_limits_and_keys_that_lead_nowhere_are_named(override, fragment):
    with pytest.raises(ScenarioError, match=fragment):
        load("noiseless", [override])


@pytest.mark.parametrize("value", [10**400, -2e6, (0.0, 2e6), ((0.0, 1.0), (2e6, 3.0)), (1.0, 10**400)])
def test_numbers_are_limited_however_deep_and_nothing_else_is(value):
    for passes in (True, "1e99", None, (), ((), ()), 10**5, (1.0, 2.0)):
        check_limits("length_m", passes)
    with pytest.raises(ValueError, match="length_m: found"):
        check_limits("length_m", value)


def test_overrides_reach_any_depth_and_any_type():
    multipath = "radio.multipath={probability=0.5, mean_excess_m=1}"
    s = load("noiseless", ["ranging.rate_hz=50", "tags.1.skew_ppm=-3.5", "ranging.protocol=ss", multipath], seed=9)
    assert (s.ranging.rate_hz, s.tags[1].skew_ppm, s.ranging.protocol, s.run.seed) == (50, -3.5, "ss", 9)
    assert s.radio.multipath.probability == 0.5


def test_the_printed_schema_names_every_section_and_limit():
    schema = json.loads(processes.run("uwbsim", "schema").stdout)
    assert {"run", "ranging", "radio", "bodies", "tags", "mocap"} <= set(schema["properties"])
    assert (schema["type"], schema["additionalProperties"]) == ("object", False)
    motion = schema["$defs"]["RandomFlight"]["properties"]["speed_mps"]
    assert (motion["exclusiveMinimum"], motion["maximum"]) == (0, 10_000)


@pytest.mark.parametrize("root", SCHEMAS)
def test_every_key_has_a_description_and_the_reference_has_it(root):
    keys, page = list(described(SCHEMAS[root])), reference(SCHEMAS[root], root)
    assert len(keys) > 10
    assert [f"{model}.{key}" for model, key, text in keys if len(text) < 6] == [], "give these Field(description=...)"
    assert [key for _, key, text in keys if f"`{key}`\n: {text}" not in page] == []


def test_the_reference_says_unit_default_and_range():
    page = reference(SCHEMAS["Scenario"], "Scenario")
    rate = "Exchanges per second, all pairs together; frames of all tags with plan broadcast."
    assert f"`rate_hz`\n: {rate}\n\n  *number; Hz; above 0 to 10⁶; needed*" in page
    assert "*number; ps; from 0 to 10⁶; default `116.0`*" in page
    assert "*3 × number; m; default `[0.0, 0.0, 0.0]`*" in page
    assert [suffix for suffix in BY_UNIT if not any(ours.endswith(suffix) for ours in UNITS)] == []
    assert [unit_of(key) for key in ("skew_ppm_per_sqrt_s", "duration_s", "antenna")] == ["ppm/√s", "s", ""]
