"""Every key of files of scenarios, faults and sweeps says what it is, in the schema and so in the reference."""

import pytest

from docs.site.schema import UNITS, described, reference, unit_of
from uwbsim.boards.server import Faults
from uwbsim.scenario.base import BY_UNIT
from uwbsim.scenario.model import Scenario
from uwbsim.sweep.design import SweepFile

SCHEMAS = {model.__name__: model.model_json_schema() for model in (Scenario, Faults, SweepFile)}


@pytest.mark.parametrize("root", SCHEMAS)
def test_every_key_has_a_description(root):
    keys = list(described(SCHEMAS[root]))
    assert len(keys) > 10
    silent = [f"{model}.{key}" for model, key, text in keys if len(text) < 6]
    assert silent == [], "give these Field(description=...)"


@pytest.mark.parametrize("root", SCHEMAS)
def test_the_reference_has_every_key_and_what_it_is(root):
    page = reference(SCHEMAS[root], root)
    for _, key, text in described(SCHEMAS[root]):
        assert f"`{key}`\n: {text}" in page


def test_the_reference_says_unit_default_and_range():
    page = reference(SCHEMAS["Scenario"], "Scenario")
    assert "`rate_hz`\n: Exchanges per second, all pairs together.\n\n  *number; Hz; above 0 to 10⁶; needed*" in page
    assert "*number; ps; from 0 to 10⁶; default `116.0`*" in page
    assert "*3 × number; m; default `[0.0, 0.0, 0.0]`*" in page


def test_every_unit_that_has_a_limit_has_a_name():
    assert [suffix for suffix in BY_UNIT if not any(ours.endswith(suffix) for ours in UNITS)] == []
    assert unit_of("skew_ppm_per_sqrt_s") == "ppm/√s"
    assert unit_of("duration_s") == "s"
    assert unit_of("antenna") == ""
