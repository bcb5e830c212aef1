"""The command line names options instead of parameters, and derives the options of a fit from its settings."""

import copy
import json
import operator
import re
from dataclasses import fields
from functools import reduce

import numpy as np
import pytest

import calib
from calib.calibration.power_curves import ALPHA_DBM, LIFTS
from calib.cli.shared import with_flags
from calib.estimator import optimize
from calib.settings import FitSettings, read_distances
from tests import processes
from tests.calib.plain_tables import DELAYS_NS, Plan, bias_m, write
from tests.calib.trajectories.sines import flight
from uwblink import Contents, KnownDistance, load


def test_other_text_is_not_changed():
    assert (
        with_flags("a `Path` and -0.5, `minimum_norm` and `fixed_ns`") == "a `Path` and -0.5, --minimum-norm and --fix"
    )


def test_settings_have_the_choices_of_the_curves():
    assert {one.name: set(one.metadata.get("names", ())) for one in fields(FitSettings)}["lift"] == set(LIFTS)
    assert FitSettings().alpha_dbm == ALPHA_DBM


def test_settings_and_keywords_make_the_same_fit():
    flight = calib.sample_flight()
    by_name = calib.fit(flight, loss="huber", fixed_ns={1: -0.3}).calibration
    assert calib.fit(flight, FitSettings(loss="huber"), fixed_ns={1: -0.3}).calibration == by_name
    assert by_name.provenance["settings"] == {"loss": "huber", "fixed_ns": {"1": -0.3}}
    assert "settings" not in calib.fit(flight).calibration.provenance
    with pytest.raises(TypeError, match="los"):
        calib.fit(flight, los="huber")


def test_a_fit_repeats_its_settings(tmp_path):
    fit = "fit f.uwb -o c.json --loss huber --fix 1=-0.3"
    for line in ("sample -o f.uwb -n 300", fit, "apply f.uwb -c c.json -o d.uwb"):
        assert "before it converged" not in run(tmp_path, f"calib {line}").stderr
    assert "settings: loss = huber, fixed_ns = {'1': -0.3}" in run(tmp_path, "calib show c.json").stdout


# `calib fit --truth ranges`, as entered by a user.


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path, flown = tmp_path_factory.mktemp("flight") / "f.uwb", flight(seconds=5.0)
    Contents(exchanges=flown.exchanges, poses=flown.poses, tags=flown.tags).save(path)
    return path


@pytest.mark.slow
def test_known_positions_at_the_start_are_enough(recording, tmp_path):
    words = ("--truth", "ranges", "--poses-until", 4, "-o", tmp_path / "c.json")
    assert processes.succeed("calib", "fit", recording, *words).stdout.count(" delay ") == 6
    written = json.loads((tmp_path / "c.json").read_text())["provenance"]
    assert (written["truth"], written["exchanges"] <= len(load(recording).exchanges)) == ("ranges", True)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("11-12=3.06", KnownDistance(11, 12, 3.06, 0.01)),
        (" 1 - 3 = 1.5 +- .005 @ desk", KnownDistance(1, 3, 1.5, 0.005, "desk")),
        ("1-3=2±0.02@2..8", KnownDistance(1, 3, 2.0, 0.02, "2..8")),
    ],
)
def test_distances_are_read_from_options(text, found):
    assert read_distances([text]) == (found,)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--truth", "tape"), "--truth: found 'tape', allowed: recorded, ranges"),
        (("--poses-until", "6"), "--poses-until: can only be used if --truth is ranges"),
        (("--truth", "ranges", "--loss", "huber"), "--loss: can only be used with known distances"),
        (("--truth", "ranges", "--trim-static"), "--trim-static: can only be used with known distances"),
        (("--truth", "ranges", "--anchors", "lost"), "--anchors: found 'lost', allowed: given, sought"),
        (("--truth", "ranges", "--distance", "1:3=2"), "--distance: found '1:3=2', expected TAG-TAG=METRES"),
        (("--truth", "ranges", "--distance", "1-9=2"), "--distance: found tag 9, the tags that range are 1, 2, 3"),
        (("--truth", "ranges", "--heights", "guess"), "--heights: found 'guess', allowed: used, ignored"),
    ],
)
def test_contradicting_options_are_refused(recording, tmp_path, words, said):
    processes.refuse("calib", "fit", recording, *words, "-o", tmp_path / "c.json", naming=[said])
    assert not (tmp_path / "c.json").exists()


# A table of ranges with powers and positions but no stamps, with robots and anchors: import, curve, localization.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """ranges.uwb and part.uwb, with the first two thirds of its ranges, and one.uwb, with those of one pair."""
    place = tmp_path_factory.mktemp("ranges")
    head, *rows = write(place / "ranges.csv", Plan(bias=bias_m)).read_text().splitlines()
    pair = [row for row in rows if sorted(row.split(",")[1:3], key=int) == ["1", "11"]]
    for name, kept in (("ranges", rows), ("part", rows[:2000]), ("one", pair)):
        (place / f"{name}.csv").write_text("\n".join([head, *kept, ""]))
        processes.succeed("uwblink", "import", "csv", f"{name}.csv", "-o", f"{name}.uwb", cwd=place)
    return place


@pytest.fixture(scope="module")
def fitted(folder):
    """Return the output of the command that writes c.json."""
    return run(folder, "calib fit ranges.uwb -o c.json")


def run(folder, line):
    return processes.succeed(*line.split(), cwd=folder)


@pytest.mark.slow
def test_import_curve_localization(folder, fitted):
    assert "ranges without stamps" in fitted.stderr
    written = json.loads((folder / "c.json").read_text())
    shift = np.array([written["delays_ns"][str(tag)] - delay for tag, delay in DELAYS_NS.items()])
    # Delays are stated for a curve that is zero at -82 dBm, so all are shifted equally.
    assert shift == pytest.approx(np.full(len(written["delays_ns"]), shift.mean()), abs=0.05)
    assert any("ranges without stamps" in warning for warning in written["provenance"]["warnings"])
    assert "ranges without stamps" in run(folder, "calib show c.json").stdout
    located = json.loads(run(folder, "calib localize part.uwb -c c.json --seeds 1 --json").stdout)["summary"]["rmse_m"]
    assert located["calibrated"] < 0.7 * located["raw"]
    run(folder, "calib apply ranges.uwb -c c.json --to csv -o out")
    corrected = np.genfromtxt(folder / "out" / "corrected.csv", delimiter=",", names=True, dtype=None, encoding=None)
    assert np.mean(corrected["sigma_m"]) == pytest.approx(0.04, rel=0.15)
    judged = json.loads(run(folder, "calib evaluate ranges.uwb -c c.json --json").stdout)
    # The planted noise is 4 cm.
    assert judged["overall"]["full"]["robust_std_m"] == pytest.approx(0.041, abs=0.004)


@pytest.mark.usefixtures("fitted")
def test_constants_of_pairs_by_commands(folder):
    done = run(folder, "calib fit ranges.uwb -o p.json --constants pair --delays-only")
    assert "delays only" in done.stderr
    run(folder, "calib fit ranges.uwb -o q.json --delays-from c.json")
    for text, said in (
        (done.stdout, "pair    1-11"),
        (run(folder, "calib show p.json").stdout, "constants of 12 pairs"),
        (run(folder, "calib evaluate ranges.uwb -c p.json").stdout, "between pairs"),
        (run(folder, "calib show q.json").stdout, r"(?s)fitted: curve only.*warning: curve only"),
    ):
        assert re.search(said, text)


def test_one_pair_is_evaluated_without_a_number_between_pairs(folder):
    run(folder, "calib fit one.uwb -o one.json --constants pair --delays-only")
    told = run(folder, "calib evaluate one.uwb -c one.json").stdout
    assert ["are within pairs" in told, "nan" in told] == [True, False]


# A fit that stopped before it converged is marked as such wherever its calibration is used, and exits with status 1.


@pytest.fixture
def stopped(monkeypatch, tmp_path):
    """Return the output of a command that stops before it converges and writes c.json."""
    calib.sample_flight().save(tmp_path / "f.uwb")
    monkeypatch.setattr(optimize, "MOST_STEPS", 2)
    return processes.run("calib", "fit", "f.uwb", "-o", "c.json", cwd=tmp_path)


def test_stopped_fits_are_marked_and_have_status_1(stopped, tmp_path):
    as_json = processes.run("calib", "fit", "f.uwb", "-o", "d.json", "--json", cwd=tmp_path)
    assert (stopped.returncode, as_json.returncode) == (1, 1)
    assert "stopped after" in stopped.stdout
    assert "before it converged" in stopped.stderr
    assert "NOT CONVERGED" in repr(calib.load_calibration(tmp_path / "c.json"))
    for text in ((tmp_path / "c.json").read_text(), as_json.stdout):
        assert json.loads(text)["provenance"]["converged"] is False


@pytest.mark.usefixtures("stopped")
def test_commands_warn_of_stopped_fits(tmp_path):
    lines = ("apply f.uwb -c c.json -o corrected.uwb", "evaluate f.uwb -c c.json", "export c.json --to csv")
    for line in (*lines, "compare c.json c.json"):
        assert "stopped before it converged" in run(tmp_path, f"calib {line}").stderr, line
    assert "NOT CONVERGED" in run(tmp_path, "calib show c.json").stdout


# Calibrations whose provenance is damaged: one line and status 2, or everything that does not need the entry.


@pytest.fixture(scope="module")
def document():
    """The document of a survey of the tags of the sample."""
    return json.loads(calib.survey(calib.sample_arrangements(), known="line").calibration.to_json())


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        (("geometry",), None),
        (("geometry", "freedom"), "many"),
        (("geometry", "arrangements"), 3),
        (("pairs",), None),
        (("warnings",), 3),
        (("findings",), [1, "x"]),
        (("findings",), 3),
        (("reflected",), [{"chance": "high"}]),
        (("surveyed",), [{"name": 1}]),
        (("undetermined",), [3]),
        (("second_best",), "none"),
    ],
    ids=str,
)
def test_a_damaged_entry_is_one_line_where_it_is_used(document, tmp_path, entry, value):
    calib.sample_flight().save(tmp_path / "a.uwb")
    changed, (*outer, last) = copy.deepcopy(document), entry
    reduce(operator.getitem, outer, changed["provenance"])[last] = value
    (tmp_path / "c.json").write_text(json.dumps(changed))
    judged, shown = (
        processes.run("calib", *words.split(), cwd=tmp_path)
        for words in ("evaluate a.uwb -c c.json --report r.html", "show c.json")
    )
    for done in (judged, shown):
        assert "Traceback" not in done.stderr
        assert done.returncode in (0, 2)
        assert not done.returncode or "its provenance is not as uwbcal writes it" in " ".join(done.stderr.split())
    assert (tmp_path / "r.html").exists() == (judged.returncode == 0)


def test_calibrations_of_version_0_2_are_read_by_the_old_names_of_keys(document):
    older = {"geometry": "rests_on", "undetermined_text": "left_open"}
    provenance = {older.get(key, key): value for key, value in document["provenance"].items()}
    assert "rests_on" in provenance
    old, new = (
        calib.Calibration.from_json(json.dumps(one)) for one in (document | {"provenance": provenance}, document)
    )
    assert old == new


def test_flat_curves_are_shown_at_one_power(document):
    text = repr(calib.Calibration.from_json(json.dumps(document)))
    assert re.findall(r"(?m)^  lifted power +\S+$", text)
