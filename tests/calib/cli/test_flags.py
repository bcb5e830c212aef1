"""The command line names options instead of parameters, and derives the options of a fit from its settings."""

import json
import operator
from dataclasses import fields

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
from uwblink import Contents, KnownDistance, Recording


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
    flight, made = tmp_path / "f.uwb", tmp_path / "c.json"
    for line in (
        ["sample", "-o", flight, "-n", 300],
        ["fit", flight, "-o", made, "--loss", "huber", "--fix", "1=-0.3"],
        ["apply", flight, "-c", made, "-o", tmp_path / "d.uwb"],
    ):
        assert "before it converged" not in processes.succeed("calib", *line).stderr
    assert "settings: loss = huber, fixed_ns = {'1': -0.3}" in processes.run("calib", "show", made).stdout


# `calib fit --truth ranges`, as entered by a user.


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "f.uwb"
    flown = flight(seconds=5.0)
    Contents(exchanges=flown.exchanges, poses=flown.poses, tags=flown.tags).save(path)
    return path


@pytest.mark.slow
def test_known_positions_at_the_start_are_enough(recording, tmp_path):
    words = ("--truth", "ranges", "--poses-until", 4, "-o", tmp_path / "c.json")
    assert processes.succeed("calib", "fit", recording, *words).stdout.count(" delay ") == 6
    written = json.loads((tmp_path / "c.json").read_text())
    assert written["provenance"]["truth"] == "ranges"
    with Recording.open(recording) as opened:
        assert written["provenance"]["exchanges"] <= len(opened.exchanges())


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
    place = tmp_path_factory.mktemp("ranges")
    write(place / "ranges.csv", Plan(bias=bias_m))
    processes.succeed("uwblink", "import", "csv", place / "ranges.csv", "-o", place / "ranges.uwb")
    return place


@pytest.fixture(scope="module")
def fitted(folder):
    """Return the output of the command that writes c.json."""
    return processes.succeed("calib", "fit", folder / "ranges.uwb", "-o", folder / "c.json")


@pytest.mark.slow
def test_import_curve_localization(folder, fitted):
    assert "ranges without stamps" in fitted.stderr
    written = json.loads((folder / "c.json").read_text())
    middle = sum(written["delays_ns"][str(tag)] - delay for tag, delay in DELAYS_NS.items()) / len(DELAYS_NS)
    for tag, delay in DELAYS_NS.items():
        # Delays are stated for a curve that is zero at -82 dBm, so all are shifted equally.
        assert written["delays_ns"][str(tag)] - middle == pytest.approx(delay, abs=0.05)
    assert any("ranges without stamps" in warning for warning in written["provenance"]["warnings"])
    assert "ranges without stamps" in processes.succeed("calib", "show", folder / "c.json").stdout
    (folder / "part.csv").write_text("\n".join((folder / "ranges.csv").read_text().splitlines()[:2000]) + "\n")
    processes.succeed("uwblink", "import", "csv", folder / "part.csv", "-o", folder / "part.uwb")
    words = ("calib", "localize", folder / "part.uwb", "-c", folder / "c.json", "--seeds", 1, "--json")
    located = json.loads(processes.succeed(*words).stdout)
    assert located["summary"]["rmse_m"]["calibrated"] < 0.7 * located["summary"]["rmse_m"]["raw"]
    processes.succeed(
        "calib", "apply", folder / "ranges.uwb", "-c", folder / "c.json", "--to", "csv", "-o", folder / "out"
    )
    corrected = np.genfromtxt(folder / "out" / "corrected.csv", delimiter=",", names=True, dtype=None, encoding=None)
    assert np.mean(corrected["sigma_m"]) == pytest.approx(0.04, rel=0.15)
    judged = json.loads(
        processes.succeed("calib", "evaluate", folder / "ranges.uwb", "-c", folder / "c.json", "--json").stdout
    )
    # The planted noise is 4 cm.
    assert judged["overall"]["full"]["robust_std_m"] == pytest.approx(0.041, abs=0.004)


@pytest.mark.usefixtures("fitted")
def test_constants_of_pairs_by_commands(folder):
    done = processes.succeed(
        "calib", "fit", folder / "ranges.uwb", "-o", folder / "p.json", "--constants", "pair", "--delays-only"
    )
    assert "pair    1-11" in done.stdout
    assert "delays only" in done.stderr
    assert "constants of 12 pairs" in processes.succeed("calib", "show", folder / "p.json").stdout
    assert (
        "between pairs" in processes.succeed("calib", "evaluate", folder / "ranges.uwb", "-c", folder / "p.json").stdout
    )
    processes.succeed(
        "calib", "fit", folder / "ranges.uwb", "-o", folder / "q.json", "--delays-from", folder / "c.json"
    )
    shown = processes.succeed("calib", "show", folder / "q.json").stdout
    assert "fitted: curve only" in shown
    assert "warning: curve only" in shown


def test_one_pair_is_evaluated_without_a_number_between_pairs(folder):
    head, *rows = (folder / "ranges.csv").read_text().splitlines()
    kept = [row for row in rows if sorted(row.split(",")[1:3], key=int) == ["1", "11"]]
    (folder / "one.csv").write_text("\n".join([head, *kept]) + "\n")
    processes.succeed("uwblink", "import", "csv", folder / "one.csv", "-o", folder / "one.uwb")
    processes.succeed(
        "calib", "fit", folder / "one.uwb", "-o", folder / "one.json", "--constants", "pair", "--delays-only"
    )
    told = processes.succeed("calib", "evaluate", folder / "one.uwb", "-c", folder / "one.json").stdout
    assert "are within pairs" in told
    assert "nan" not in told


# A fit that stopped before it converged is marked as such wherever its calibration is used, and exits with status 1.


@pytest.fixture
def stopped_flight(tmp_path):
    calib.sample_flight().save(tmp_path / "flight.uwb")
    return tmp_path / "flight.uwb"


@pytest.fixture
def stopped(stopped_flight, monkeypatch, tmp_path):
    monkeypatch.setattr(optimize, "MOST_STEPS", 2)
    return processes.run("calib", "fit", stopped_flight, "-o", tmp_path / "c.json"), tmp_path / "c.json"


def test_stopped_fits_are_marked_and_have_status_1(stopped, stopped_flight, tmp_path):
    done, path = stopped
    assert "stopped after" in done.stdout
    assert "before it converged" in done.stderr
    assert "NOT CONVERGED" in repr(calib.load_calibration(path))
    as_json = processes.run("calib", "fit", stopped_flight, "-o", tmp_path / "d.json", "--json")
    assert (done.returncode, as_json.returncode) == (1, 1)
    for text in (path.read_text(), as_json.stdout):
        assert json.loads(text)["provenance"]["converged"] is False


def test_commands_warn_of_stopped_fits(stopped, stopped_flight, tmp_path):
    path = stopped[1]
    for words in (
        ("apply", stopped_flight, "-c", path, "-o", tmp_path / "corrected.uwb"),
        ("evaluate", stopped_flight, "-c", path),
        ("export", path, "--to", "csv"),
        ("compare", path, path),
    ):
        assert "stopped before it converged" in processes.succeed("calib", *words).stderr, words[0]
    assert "NOT CONVERGED" in processes.succeed("calib", "show", path).stdout


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
    processes.succeed("calib", "sample", "-o", tmp_path / "a.uwb", "-n", "900")
    changed = json.loads(json.dumps(document))
    table = changed["provenance"]
    for key in entry[:-1]:
        table = operator.getitem(table, key)
    table[entry[-1]] = value
    (tmp_path / "c.json").write_text(json.dumps(changed))
    page = tmp_path / "r.html"
    judged = processes.run("calib", "evaluate", tmp_path / "a.uwb", "-c", tmp_path / "c.json", "--report", page)
    shown = processes.run("calib", "show", tmp_path / "c.json")
    for done in (judged, shown):
        assert "Traceback" not in done.stderr
        assert done.returncode in (0, 2)
        if done.returncode:
            assert "its provenance is not as uwbcal writes it" in " ".join(done.stderr.split())
    assert page.exists() == (judged.returncode == 0)


def test_calibrations_of_version_0_2_are_read_by_the_old_names_of_keys(document):
    older = {"geometry": "rests_on", "undetermined_text": "left_open"}
    provenance = {older.get(key, key): value for key, value in document["provenance"].items()}
    assert "rests_on" in provenance
    known = calib.Calibration.from_json(json.dumps(document | {"provenance": provenance}))
    assert known == calib.Calibration.from_json(json.dumps(document))


def test_flat_curves_are_shown_at_one_power(document):
    text = repr(calib.Calibration.from_json(json.dumps(document)))
    (line,) = [line for line in text.splitlines() if line.startswith("  lifted power")]
    assert len(line.removeprefix("  lifted power").split()) == 1
