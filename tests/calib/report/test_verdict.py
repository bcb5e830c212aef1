"""The verdict: what is fit for use, what is not and why, on worlds of which it is known."""

from dataclasses import replace

import numpy as np
import pytest

from calib.calibration.model import Calibration
from calib.doctor.base import Finding
from calib.estimation.fitting import fit
from calib.report import Table, Text
from calib.report.results import Results
from calib.report.verdict import verdict
from tests.calib.synthetic import ranges
from uwblink.ticks import SPEED_OF_LIGHT


@pytest.fixture(scope="module")
def known() -> Calibration:
    return fit(ranges(6000)).calibration


@pytest.fixture(scope="module")
def unseen():
    return replace(ranges(3000, seed=2), source="another flight")


def told(known, unseen, **changes):
    text, table = verdict(Results(calibration=known, **{"tests": [unseen]} | changes))
    assert isinstance(text, Text)
    assert isinstance(table, Table)
    return text, {row[0]: row[1] for row in table.rows}


def test_what_fits_what_it_has_not_seen_is_fit_for_use(known, unseen):
    text, met = told(known, unseen)
    assert text.kind == "good"
    assert text.text.startswith("Fit for use. ")
    assert len(met) == 7, "nothing was localized, and distances were known"
    assert set(met.values()) == {"✓ yes"}


def test_every_criterion_states_its_threshold(known, unseen):
    _, table = verdict(Results(calibration=known, tests=[unseen]))
    assert table.header[-1] == "asked for"
    assert all(row[-1] for row in table.rows)


def test_without_a_test_there_is_a_reservation(known, unseen):
    text, met = told(known, unseen, tests=[], training=[unseen])
    assert text.kind == "doubt"
    assert "not judged on recordings that the fit has not seen" in text.text
    assert met["Was it judged on recordings that the fit has not seen?"] == "! in part"


def test_warnings_and_faults_are_reservations(known, unseen):
    clock = Finding(fault="clock", evidence="it jumps", remedy="leave it out", p_value=0.0)
    text, met = told(known, unseen, warnings=["only 3 s of data"], findings=[("a.uwb", clock)])
    assert text.kind == "doubt"
    assert "2 warnings, below" in text.text
    assert [question for question, how in met.items() if how != "✓ yes"] == ["Is there nothing to warn of?"]


def test_a_delay_that_changed_since_makes_it_unfit(known, unseen):
    # 0.8 ns on tag 3 alone: half of it is 12 cm in all its pairs.
    longer = np.where((unseen.initiator == 3) | (unseen.target == 3), 0.4e-9 * SPEED_OF_LIGHT, 0.0)
    text, met = told(known, replace(unseen, raw_m=unseen.raw_m + longer))
    assert text.kind == "bad"
    assert text.text.startswith("Not fit for use. ")
    assert "-3 keeps a bias of +1" in text.text or "3-7 keeps a bias of +1" in text.text
    assert met["Is no pair left with a bias?"] == "✗ no"


def test_noise_that_grew_since_shows_in_the_intervals(known, unseen):
    noise = np.random.default_rng(3).normal(0, 0.15, len(unseen))
    text, met = told(known, replace(unseen, raw_m=unseen.raw_m + noise))
    assert text.kind == "bad"
    assert met["Does it say rightly how far ranges can be off?"] == "✗ no"


def test_delays_that_the_data_leave_open_make_it_unfit(known, unseen):
    free = replace(known, provenance={**known.provenance, "undetermined": [[1, 2], [3, 7]]})
    text, met = told(free, unseen)
    assert text.kind == "bad"
    assert "tags 1, 2; 3, 7 can shift against each other" in text.text
    assert met["Are the antenna delays known well enough?"] == "✗ no"


def test_powers_that_were_not_fitted_are_a_reservation_and_then_a_reason(known, unseen):
    for share, grade in ((0.12, "! in part"), (0.6, "✗ no")):
        weak = np.arange(len(unseen)) < share * len(unseen)
        strong = replace(
            unseen,
            fpp1_dbm=np.where(weak, -70.0, unseen.fpp1_dbm),
            fpp2_dbm=np.where(weak, -70.0, unseen.fpp2_dbm),
        )
        _, met = told(known, strong)
        assert met["Was the curve fitted at such powers?"] == grade


def test_a_calibration_of_other_boards_does_harm(known, unseen):
    turned = replace(known, delays_ns={tag: -20 * delay for tag, delay in known.delays_ns.items()})
    _, met = told(turned, unseen)
    assert met["Does it make ranges better?"] == "✗ no"
