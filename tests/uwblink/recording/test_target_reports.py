"""One exchange is one exchange, whoever reported it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import calib
import uwblink
from calib.checks.examine import examine
from tests.boards import bench_scenario
from uwblink.boards.listeners import ReportCheck
from uwblink.recording.file import Recording
from uwblink.recording.summary import differences, single_reports, summarize
from uwblink.twr import COLUMNS
from uwblink.wire.messages import RangeReport, TargetRangeReport
from uwbsim.boards.virtual_board import VirtualPorts


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The same five seconds of three boards, targets reporting too, and not."""
    folder = tmp_path_factory.mktemp("reports")
    for name, target_reports in (("both", True), ("one", False)):
        ports = VirtualPorts(bench_scenario(), lost_share=0.1)
        plan = uwblink.RangingPlan(rate_hz=60.0, target_reports=target_reports)
        uwblink.record(ports.names.values(), folder / f"{name}.board.uwb", plan, duration_s=5.0, using=ports)
        exchanges = exchanges_of(folder / f"{name}.board.uwb")
        assert len(exchanges) > 200
        measured = replace(exchanges, truth_m=np.full(len(exchanges), 3.0))
        rewritten(folder / f"{name}.board.uwb", folder / f"{name}.uwb", measured)
    return folder


def rewritten(source, output, exchanges):
    with Recording.open(source) as recording:
        recording.copy(output, replacing={"exchanges": exchanges})


def exchanges_of(path):
    with Recording.open(path) as recording:
        return recording.exchanges()


def joined(one, two):
    columns: dict[str, Any] = {n: np.concatenate([getattr(one, n), getattr(two, n)]) for n in COLUMNS}
    return replace(one, **columns)


def test_each_exchange_is_left_once(both):
    exchanges = exchanges_of(both / "both.uwb")
    found = single_reports(exchanges)
    stamps = set(zip(exchanges.tx1.tolist(), exchanges.rx2.tolist(), strict=True))
    assert len(found.exchanges) == len(stamps)
    assert found.repeated == len(exchanges) - len(stamps) > 150
    assert len(found.differing) == 0
    mine = found.exchanges.reporter == found.exchanges.initiator
    assert mine.all(), "every target's report follows one of the initiator's"
    one = exchanges_of(both / "one.uwb")
    assert single_reports(one).exchanges is one


def test_a_target_s_report_stands_where_the_initiator_s_is_missing(both):
    exchanges = exchanges_of(both / "both.uwb")
    by_target = np.flatnonzero(exchanges.reporter == exchanges.target)
    first = by_target[0]
    twin = np.flatnonzero((exchanges.tx1 == exchanges.tx1[first]) & (exchanges.reporter == exchanges.initiator))[0]
    kept = np.ones(len(exchanges), dtype=bool)
    kept[twin] = False
    found = single_reports(exchanges[kept])
    assert len(found.exchanges) == len(single_reports(exchanges).exchanges)
    assert np.count_nonzero(found.exchanges.reporter == found.exchanges.target) == 1


@pytest.mark.parametrize("name", ["range_m", "tx1", "rx3", "skew2_ppm"])
def test_a_difference_is_found_whichever_number_it_is_in(both, name):
    exchanges = exchanges_of(both / "both.uwb")
    row = np.flatnonzero(exchanges.reporter == exchanges.target)[7]
    column = getattr(exchanges, name).copy()
    column[row] += 1
    found = single_reports(replace(exchanges, **{name: column}))
    assert len(found.differing) == 1
    assert found.differing[0, 1] == row
    (told,) = differences(replace(exchanges, **{name: column}), *found.differing[0])
    assert told == f"{name} {column[found.differing[0, 0]]} and {column[row]}"


def test_equal_stamps_of_another_time_are_another_exchange(both):
    exchanges = single_reports(exchanges_of(both / "both.uwb")).exchanges
    later = replace(exchanges, reporter=exchanges.target, time_ns=exchanges.time_ns + 70_000_000)
    found = single_reports(joined(exchanges, later))
    assert found.repeated == 0


def test_show_calibration_and_doctor_count_it_once(both):
    with Recording.open(both / "both.uwb") as recording:
        summary = summarize(recording)
        exchanges = single_reports(recording.exchanges()).exchanges
        failed = sum("failed" in fault.kind for fault in recording.faults())
    assert summary.counts["exchanges"] == sum(p.exchanges for p in summary.pairs) == len(exchanges)
    assert sum(p.failed for p in summary.pairs) == failed > 0
    assert summary.reported_twice > 150
    assert summary.contradictory == 0
    assert len(calib.load_ranges(both / "both.uwb")) == len(exchanges)
    assert not any("contradicting" in finding.fault for finding in examine(both / "both.uwb"))


def test_the_doctor_names_reports_that_contradict_each_other(both, tmp_path):
    path = tmp_path / "f.uwb"
    exchanges = exchanges_of(both / "both.uwb")
    wrong = (exchanges.reporter == exchanges.target) & (exchanges.initiator == 1)
    rewritten(both / "both.uwb", path, replace(exchanges, range_m=exchanges.range_m + wrong))
    with Recording.open(path) as recording:
        assert recording.show().contradictory == np.count_nonzero(wrong)
    finding = next(f for f in examine(path) if f.fault == "contradicting reports")
    assert "the first: range_m" in finding.evidence


REPORT = RangeReport(2, 3.0, 100, 200, 300, 400, 500, 600, -80.0, -81.0, 1.0, -1.0)


def as_target(report, **changes):
    values = {n: getattr(report, n) for n in RangeReport.FIELDS} | {"neighbour": 1} | changes
    return TargetRangeReport(**values)


def test_a_recorder_compares_the_two_reports_as_they_come():
    check = ReportCheck()
    assert check.add(1, REPORT) is None
    assert check.add(2, as_target(REPORT)) is None
    assert check.add(1, REPORT) is None
    told = check.add(2, as_target(REPORT, range_m=3.5, rx3=601))
    assert told == "boards 1 and 2 report one exchange of 1 with 2 differently: range_m 3.0 and 3.5, rx3 600 and 601"
    # The report of one that was lost is not compared with that of the next.
    later = RangeReport(2, 3.1, 107, 207, 307, 407, 507, 607, -80.0, -81.0, 1.0, -1.0)
    assert check.add(1, REPORT) is None
    assert check.add(2, as_target(later)) is None
    assert check.add(1, later) is None
