"""The summary of a recording by `uwblink show`."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import calib
import uwblink
from tests.boards import bench_scenario, record_bench
from tests.uwblink.recording.test_file import random_exchanges
from uwblink.boards.listeners import ReportCheck
from uwblink.cli.commands import print_summary
from uwblink.recording.schema import Fault
from uwblink.recording.summary import (
    clock_skews,
    differences,
    failures_by_pair,
    single_reports,
    skew_summary,
    summarize,
)
from uwblink.twr import COLUMNS, STAMPS
from uwblink.wire.messages import RangeReport, TargetRangeReport
from uwbsim import VirtualPorts


@pytest.fixture
def summary(tmp_path):
    with uwblink.Recording.create(tmp_path / "f.uwb", meta={"note": "[bold]x[/] \x1b[31m", "scenario": "long"}) as r:
        r.append_exchanges(random_exchanges(50))
        r.append_tags([uwblink.Tag(3, "b", (0.1, 0.2, 0.3))])
        r.append("faults", [Fault(9, "1", "time-out", "no answer"), Fault(10, "1", "time-out", "")])
    with uwblink.Recording.open(tmp_path / "f.uwb") as r:
        return r.show()


def test_counts_add_up(summary):
    by_pair, by_protocol = sum(p.exchanges for p in summary.pairs), sum(summary.protocols.values())
    assert (summary.counts["exchanges"], by_pair, by_protocol, summary.faults) == (50, 50, 50, {"time-out": 2})
    assert summary.to_dict()["tags"] == [{"tag": 3, "body": "b", "lever_arm_m": [0.1, 0.2, 0.3]}]


def test_printed_text_from_a_file_cannot_format_or_steer_the_terminal(summary):
    out = io.StringIO()
    print_summary(summary, Console(file=out, width=100, force_terminal=True, color_system=None))
    assert ("[bold]x[/]" in out.getvalue(), "\x1b[31m" in out.getvalue()) == (True, False)


def test_a_summary_fits_on_a_screen_and_cannot_steer_it(tmp_path):
    tags = [uwblink.Tag(k, "\x1b[31m" + "b" * 200, (0.0, 0.0, 0.0)) for k in range(40)]
    faults = [Fault(k, "1", f"kind {k}" * 10, "", 1, 2) for k in range(40)]
    uwblink.Contents(exchanges=random_exchanges(500), tags=tags, faults=faults).save(tmp_path / "\x1b[2J.uwb")
    with uwblink.Recording.open(tmp_path / "\x1b[2J.uwb") as r:
        summary = r.show()
    text, html = str(summary), summary._repr_html_()
    lines = text.splitlines()
    assert (len(lines) <= 24, max(map(len, lines)) <= 79, "500 exchanges in" in lines[0]) == (True, True, True), text
    assert ("\x1b" in text + html, repr(summary) == text, "<td>" in html) == (False, True, True)


def test_failures_are_counted_by_the_ends_of_the_exchange_whatever_the_text_says():
    faults = [
        Fault(1, "7", "time-out", "anything at all", 7, 8),
        Fault(2, "7", "failed exchange", "nothing of the kind", 7, 8),
        Fault(3, "8", "failed exchange", "", 8, 7),
        Fault(4, "9", "garbage", "9 ranged with 8: message 1 lost; ranging with 8 failed"),
    ]
    assert failures_by_pair(faults) == {(7, 8): 2, (8, 7): 1}


# Clock skews of planted clocks, by stamps and by carriers.


TICKS = 128 * 499.2e6
SKEW_PPM = {1: 0.0, 2: 6.0, 3: -2.5}


def ranged(protocol, sign=1.0, carriers=True, warmer_ppm=0.0):
    """Return ranges of 3 m in both directions in every pair; a stamp is its true time by its own clock."""
    pairs = np.array([(1, 2), (2, 1), (1, 3), (3, 1), (2, 3), (3, 2)] * 20)
    first, second = pairs.T
    begin = 1e-3 * np.arange(len(pairs))
    fast = np.array([0.0] + [SKEW_PPM[tag] + warmer_ppm * (tag == 3) for tag in (1, 2, 3)])

    def stamp(tag, after):
        return np.rint((begin + after) * (1 + fast[tag] * 1e-6) * TICKS).astype(np.int64)

    ends = [first, second, second, first, *((second, first) if protocol == "ds" else (first, second))]
    after_s = (0, 1e-8, 3e-4, 3e-4 + 1e-8, 2e-3, 2e-3 + 1e-8)
    columns = {name: stamp(tag, after) % 2**32 for name, tag, after in zip(STAMPS, ends, after_s, strict=True)}
    relative = fast[second] - fast[first]
    skews = {"skew1_ppm": sign * relative, "skew2_ppm": -sign * relative} if carriers else {}
    return uwblink.Exchanges.from_arrays(first, second, **columns, **skews, protocol=np.full(len(pairs), protocol))


@pytest.mark.parametrize(
    ("protocol", "sign", "said"),
    [
        ("ds", 1, "carriers over stamps 1.000, residual 0.00 ppm, same sign"),
        ("ds-alt", 1, "carriers over stamps 1.000, residual 0.00 ppm, same sign"),
        ("ds", -1, "OTHER SIGN in 3 of 3 pairs"),
    ],
)
def test_stamps_and_carriers_give_the_planted_skews(protocol, sign, said):
    found = {one.pair: one for one in clock_skews(ranged(protocol, sign))}
    assert sorted(found) == ["1-2", "1-3", "2-3"]
    for pair, planted in {"1-2": 6.0, "1-3": -2.5, "2-3": -8.5}.items():
        one = found[pair]
        # A tick in two milliseconds is 0.008 ppm.
        assert (one.stamps_ppm, one.slope) == pytest.approx((planted, sign), abs=0.01)
        assert (one.carrier_ppm, one.residual_ppm) == pytest.approx((sign * planted, 0), abs=1e-9)
        assert one.same_sign is (sign == 1)
    assert said in skew_summary(list(found.values()))


def test_carriers_without_readings_are_left_out():
    (first, *_) = clock_skews(ranged("ds", carriers=False))
    assert (first.carrier_ppm, first.slope, first.same_sign) == (None, None, None)
    assert str(first) == "pair 1-2: +6.00 ppm by the stamps, drift +0.00, carriers not read"


def test_drifting_clocks_appear_in_their_pairs():
    drifts = [one.drift_ppm for one in clock_skews([ranged("ds"), ranged("ds", warmer_ppm=1.5)])]
    assert drifts == pytest.approx([0.0, 1.5, 1.5], abs=0.01)


def test_single_sided_exchanges_have_no_skews():
    e = ranged("ds")
    columns = {name: getattr(e, name) for name in ("tx1", "rx1", "tx2", "rx2")}
    assert clock_skews(uwblink.Exchanges.from_arrays(e.initiator, e.target, **columns)) == []


# An exchange is counted once, whoever reported it.


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The same 2.5 seconds of three boards, with and without reports of targets."""
    folder = tmp_path_factory.mktemp("reports")
    for name, target_reports in (("both", True), ("one", False)):
        plan = uwblink.RangingPlan(rate_hz=60.0, target_reports=target_reports)
        lossy = VirtualPorts(bench_scenario(), lost_share=0.1)
        record_bench(folder / f"{name}.board.uwb", plan, lossy, duration_s=2.5)
        exchanges = uwblink.load(folder / f"{name}.board.uwb").exchanges
        assert len(exchanges) > 100
        measured = replace(exchanges, truth_m=np.full(len(exchanges), 3.0))
        rewritten(folder / f"{name}.board.uwb", folder / f"{name}.uwb", measured)
    return folder


def rewritten(source, output, exchanges):
    with uwblink.Recording.open(source) as recording:
        recording.copy(output, replacing={"exchanges": exchanges})


@pytest.fixture(scope="module")
def exchanges(both):
    return uwblink.load(both / "both.uwb").exchanges


def test_show_calibration_and_doctor_count_each_exchange_once(both, exchanges):
    count = len(set(zip(exchanges.tx1.tolist(), exchanges.rx2.tolist(), strict=True)))
    with uwblink.Recording.open(both / "both.uwb") as recording:
        summary = summarize(recording)
        failed = sum("failed" in fault.kind for fault in recording.faults())
    assert summary.counts["exchanges"] == sum(p.exchanges for p in summary.pairs) == count
    assert sum(p.failed for p in summary.pairs) == failed > 0
    assert summary.reported_twice == len(exchanges) - count > 75
    assert summary.contradictory == 0
    assert len(calib.load_ranges(both / "both.uwb")) == count
    assert not any("contradicting" in finding.fault for finding in calib.examine(both / "both.uwb"))
    kept = single_reports(exchanges).exchanges
    assert np.all(kept.reporter == kept.initiator), "every target's report follows one of the initiator's"
    one = uwblink.load(both / "one.uwb").exchanges
    assert single_reports(one).exchanges is one


def test_target_reports_replace_missing_initiator_reports(exchanges):
    first = np.argmax(exchanges.reporter == exchanges.target)
    twin = (exchanges.tx1 == exchanges.tx1[first]) & (exchanges.reporter == exchanges.initiator)
    found = single_reports(exchanges[~twin])
    assert len(found.exchanges) == len(single_reports(exchanges).exchanges)
    assert np.count_nonzero(found.exchanges.reporter == found.exchanges.target) == 1


@pytest.mark.parametrize("name", ["range_m", "tx1", "tx2", "rx3", "skew2_ppm"])
def test_differences_of_reports_are_found_in_all_columns(exchanges, name):
    row = np.flatnonzero(exchanges.reporter == exchanges.target)[7]
    column = getattr(exchanges, name) + (np.arange(len(exchanges)) == row)
    changed = replace(exchanges, **{name: column})
    ((first, second),) = single_reports(changed).differing
    said = [f"{name} {column[first]} and {column[row]}"]
    assert (second, differences(changed, first, second)) == (row, said)


def test_equal_stamps_of_another_time_are_another_exchange(exchanges):
    once = single_reports(exchanges).exchanges
    later = replace(once, reporter=once.target, time_ns=once.time_ns + 70_000_000)
    columns: dict[str, Any] = {n: np.concatenate([getattr(once, n), getattr(later, n)]) for n in COLUMNS}
    assert single_reports(replace(once, **columns)).repeated == 0


def test_the_doctor_names_reports_that_contradict_each_other(both, exchanges, tmp_path):
    path = tmp_path / "f.uwb"
    wrong = (exchanges.reporter == exchanges.target) & (exchanges.initiator == 1)
    rewritten(both / "both.uwb", path, replace(exchanges, range_m=exchanges.range_m + wrong))
    with uwblink.Recording.open(path) as recording:
        assert recording.show().contradictory == np.count_nonzero(wrong)
    assert "the first: range_m" in next(f for f in calib.examine(path) if f.fault == "contradicting reports").evidence


REPORT = RangeReport(2, 3.0, 100, 200, 300, 400, 500, 600, -80.0, -81.0, 1.0, -1.0)


def as_target(report, **changes):
    return TargetRangeReport(**{n: getattr(report, n) for n in RangeReport.FIELDS} | {"neighbour": 1} | changes)


def test_a_recorder_compares_the_two_reports_as_they_come():
    check = ReportCheck()
    told = "boards 1 and 2 report one exchange of 1 with 2 differently: range_m 3.0 and 3.5, rx3 600 and 601"
    # The report of a lost exchange is not compared with that of the next one.
    later = RangeReport(2, 3.1, 107, 207, 307, 407, 507, 607, -80.0, -81.0, 1.0, -1.0)
    for board, report, expected in (
        (1, REPORT, None),
        (2, as_target(REPORT), None),
        (1, REPORT, None),
        (2, as_target(REPORT, range_m=3.5, rx3=601), told),
        (1, REPORT, None),
        (2, as_target(later), None),
        (1, later, None),
    ):
        assert check.add(board, report) == expected
