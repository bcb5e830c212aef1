"""The generated reference: every key that a reader of files knows, every command and option, every offered name."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import typer

import calib
import uwblink
import uwbsim
from calib.calibration.document import CALIBRATION_KEYS as CALIBRATION
from calib.calibration.patterns import Pattern, TemperatureSlope
from docs.site import commands, doors, file_keys
from uwblink.boards import ranging_plan
from uwblink.importers import column_map
from uwblink.text_files import heads

ROOT = Path(__file__).parents[1]


def test_files_that_pages_name_exist():
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
    named = {(page.name, name) for page in pages for name in re.findall(r"`([^`\s]+)`", page.read_text("utf-8"))}
    folders = tuple(f"{folder}/" for folder in ("calib", "uwblink", "uwbsim", "tests", "benchmarks", "docs", ".ci"))
    files = {row for row in named if row[1].startswith(folders) and not set("*<{") & set(row[1])}
    assert len(files) > 30
    assert [row for row in sorted(files) if not any((ROOT / (row[1] + end)).exists() for end in ("", ".py"))] == []


@pytest.mark.parametrize("keys", [column_map.MAP_KEYS, ranging_plan.PLAN_KEYS], ids=["map", "plan"])
def test_the_reference_of_a_file_has_every_key_that_its_reader_knows(keys):
    entries = [line for line in file_keys.reference(keys).splitlines() if line.startswith("`")]
    assert entries == [f"`{key.name}`" for key in keys]
    assert all(key.kind and key.default and len(key.meaning) > 10 for key in keys)


def test_a_map_knows_the_tables_that_its_reference_has():
    assert set(heads(column_map.MAP_KEYS)) == {
        *("layout", "bits", "counter", "protocol", "delimiter", "decimal", "within_s", "each", "topics"),
        *("line", "from_name", "missing", "chip", "prf", "wide"),
        *("columns", "units", "constants", "ids", "antenna_delays"),
    }


def flat(table, above=""):
    """Yield every key of a JSON document with dots; names that users or data choose are in capitals."""
    free = dict.fromkeys(("delays_ns", "delays_std_ns", "antenna_delays"), "TAG") | {"provenance": "KEY"}
    free |= {"groups": "NAME", "errors.features": "NAME", "errors.pairs": "PAIR", "pair_offsets": "PAIR"}
    for key, value in table.items():
        dotted = f"{above}.{free.get(above, key)}".strip(".")
        if isinstance(value, dict) and dotted != "provenance.KEY" and value:
            yield from flat(value, dotted)
        elif value != {}:
            yield dotted


def test_the_reference_of_calibrations_has_every_key_of_files_and_no_other():
    flight = calib.sample_flight()
    ranges = calib.load_ranges(flight)
    rising = np.random.default_rng(1).poisson(2.0, (len(ranges), 2)).astype(np.float32)
    groups = {"front": [1, 2], "back": [3]}
    fits = [calib.fit(flight, **settings).calibration for settings in ({}, {"groups": groups}, {"constants": "pair"})]
    fits += [dataclasses.replace(one, power_at="reception") for one in fits]
    matrix = ((0.0,) * 8,) * 8
    patterns = (Pattern((1,), matrix[0], matrix[0], matrix, 0.0),)
    slopes = (TemperatureSlope((1,), 0.002, 0.0, 20.0, (10.0, 30.0)),)
    fits += [dataclasses.replace(fits[0], patterns=patterns, temperatures=slopes)]
    for some in (ranges[ranges.initiator == 1], dataclasses.replace(ranges, features=rising)):
        fits += [calib.fit(some).calibration]
    found = {key for one in fits for key in flat(json.loads(one.to_json()))}
    assert found == {key.name for key in CALIBRATION}


@pytest.mark.parametrize("package", [uwblink, uwbsim, calib], ids=lambda p: p.__name__)
def test_every_offered_name_is_in_the_reference(package):
    assert f".. automodule:: {package.__name__}\n   :members:" in doors.reference(package.__name__)
    assert all(
        (getattr(package, name).__doc__ or "").strip() for name in package.__all__ if callable(getattr(package, name))
    )


def test_results_of_public_functions_are_in_the_reference():
    page = doors.reference("calib")
    names = ("calib.evaluation.statistics.Stats", "calib.calibration.model.Uncertainty", "calib.findings.Finding")
    assert [name for name in names if name not in page] == []


@pytest.mark.parametrize("package", [uwblink, uwbsim, calib], ids=lambda p: p.__name__)
def test_the_pages_of_commands_have_every_option(package):
    app = __import__(f"{package.__name__}.cli.commands", fromlist=["app"]).app
    every = list(commands.leaves(typer.main.get_command(app), (package.__name__,)))
    if not hasattr(every[0][1].params[0], "type_descriptor"):
        pytest.skip("this typer does not say what type an option has; the pages are made with the locked one")
    page = commands.reference(app, package.__name__)
    assert len(every) > 8
    for words, command in every:
        section = page.split(f"## `{' '.join(words)}`\n")[1].split("\n## ")[0]
        flags = [flag for p in command.params if p.name != "help" for flag in p.opts if flag.startswith("-")]
        assert [flag for flag in flags if f"`{flag}`" not in section] == [], words
        assert "```sh" in section, words


def test_aliases_of_types_are_shown_by_their_names():
    event = ("app", "function", "calib.x", len, None, "(a: TypeAliasForwardRef('Floats') | None = None)", None)
    assert doors.plain_aliases(*event) == ("(a: Floats | None = None)", None)
    other = (*event[:5], "(a: ~calib.data.ranges.Ranges, b: dict = <factory>)", "~calib.Fit")
    assert doors.plain_aliases(*other) == ("(a: Ranges, b: dict = ...)", "Fit")
