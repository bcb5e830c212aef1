"""Scenario files: overrides, and the schema that is printed."""

import json
from pathlib import Path

import pytest

from tests import processes
from uwbsim.errors import ScenarioError
from uwbsim.scenario.loading import load

ROOT = Path(__file__).parents[3]
NOISELESS = ROOT / "scenarios" / "noiseless.toml"


def test_overrides_reach_any_depth_and_any_type():
    s = load(
        NOISELESS,
        [
            "ranging.rate_hz=50",
            "tags.1.skew_ppm=-3.5",
            "ranging.protocol=ss",
            "radio.multipath={probability=0.5, mean_excess_m=1}",
        ],
        seed=9,
    )
    assert (s.ranging.rate_hz, s.tags[1].skew_ppm, s.ranging.protocol, s.run.seed) == (50, -3.5, "ss", 9)
    assert s.radio.multipath is not None
    assert s.radio.multipath.probability == 0.5


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("tags.9.skew_ppm=1", "index"),
        ("tags.x.skew_ppm=1", "index"),
        ("ranging.rate_hz.deep=1", "rate_hz"),
        ("=1", "key.path=value"),
        ("ranging.speed=1", "unknown key"),
    ],
)
def test_overrides_that_lead_nowhere(text, fragment):
    with pytest.raises(ScenarioError, match=fragment):
        load(NOISELESS, [text])


def test_schema_is_json_schema_and_names_every_section():
    done = processes.run("uwbsim", "schema")
    schema = json.loads(done.stdout)
    assert schema["type"] == "object"
    assert {"run", "ranging", "radio", "bodies", "tags", "mocap"} <= set(schema["properties"])
    assert schema["additionalProperties"] is False
