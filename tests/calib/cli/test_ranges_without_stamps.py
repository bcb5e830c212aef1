"""A table of ranges with power and places, no stamps, robots and anchors: import, curve, localization, by commands."""

import json

import numpy as np
import pytest

from tests.calib.plain_tables import DELAYS_NS, Plan, bias_m, write
from tests.processes import succeed as run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("ranges")
    write(place / "ranges.csv", Plan(bias=bias_m))
    run("uwblink", "import", "csv", place / "ranges.csv", "-o", place / "ranges.uwb")
    return place


def test_import_curve_localization(folder):
    done = run("calib", "fit", folder / "ranges.uwb", "-o", folder / "c.json")
    assert "ranges without stamps" in done.stderr
    written = json.loads((folder / "c.json").read_text())
    middle = sum(written["delays_ns"][str(tag)] - delay for tag, delay in DELAYS_NS.items()) / len(DELAYS_NS)
    for tag, delay in DELAYS_NS.items():
        # Delays are stated for a curve that is zero at -82 dBm, so all are moved alike.
        assert written["delays_ns"][str(tag)] - middle == pytest.approx(delay, abs=0.05)
    assert any("ranges without stamps" in warning for warning in written["provenance"]["warnings"])
    assert "ranges without stamps" in run("calib", "show", folder / "c.json").stdout
    located = json.loads(run("calib", "localize", folder / "ranges.uwb", "-c", folder / "c.json", "--json").stdout)
    assert located["summary"]["rmse_m"]["calibrated"] < 0.7 * located["summary"]["rmse_m"]["raw"]
    run("calib", "apply", folder / "ranges.uwb", "-c", folder / "c.json", "--to", "csv", "-o", folder / "out")
    corrected = np.genfromtxt(folder / "out" / "corrected.csv", delimiter=",", names=True, dtype=None, encoding=None)
    assert np.mean(corrected["sigma_m"]) == pytest.approx(0.04, rel=0.15)
    judged = json.loads(run("calib", "evaluate", folder / "ranges.uwb", "-c", folder / "c.json", "--json").stdout)
    # The planted noise is 4 cm.
    assert judged["overall"]["full"]["robust_std_m"] == pytest.approx(0.041, abs=0.004)


def test_constants_of_pairs_by_commands(folder):
    done = run("calib", "fit", folder / "ranges.uwb", "-o", folder / "p.json", "--constants", "pair", "--delays-only")
    assert "pair    1-11" in done.stdout
    assert "delays only" in done.stderr
    assert "constants of 12 pairs" in run("calib", "show", folder / "p.json").stdout
    run("calib", "fit", folder / "ranges.uwb", "-o", folder / "q.json", "--delays-from", folder / "c.json")
    shown = run("calib", "show", folder / "q.json").stdout
    assert "fitted: curve only" in shown
    assert "warning: curve only" in shown


def test_one_pair_is_evaluated_without_a_number_between_pairs(folder):
    head, *rows = (folder / "ranges.csv").read_text().splitlines()
    kept = [row for row in rows if sorted(row.split(",")[1:3], key=int) == ["1", "11"]]
    (folder / "one.csv").write_text("\n".join([head, *kept]) + "\n")
    run("uwblink", "import", "csv", folder / "one.csv", "-o", folder / "one.uwb")
    run("calib", "fit", folder / "one.uwb", "-o", folder / "one.json", "--constants", "pair", "--delays-only")
    told = run("calib", "evaluate", folder / "one.uwb", "-c", folder / "one.json").stdout
    assert "are within pairs" in told
    assert "nan" not in told
    assert "between pairs" in run("calib", "evaluate", folder / "ranges.uwb", "-c", folder / "p.json").stdout
