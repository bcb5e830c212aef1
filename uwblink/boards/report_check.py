"""While recording: whether initiator and target say the same of an exchange that both report."""

from __future__ import annotations

from uwblink.boards.listeners import Pair
from uwblink.twr import STAMPS
from uwblink.wire.messages import RangeReport, TargetRangeReport


class ReportCheck:
    """Compares each report with the last one of its pair from the other end."""

    def __init__(self) -> None:
        """Know no report yet."""
        self._last: dict[Pair, tuple[int, RangeReport]] = {}

    def add(self, board: int, report: RangeReport) -> str | None:
        """Take in a board's report; returns what it says otherwise than the other end's, None where nothing."""
        mine = isinstance(report, TargetRangeReport)
        pair = (report.neighbour, board) if mine else (board, report.neighbour)
        before = self._last.pop(pair, None)
        if before is None or before[0] == board or not _of_one_exchange(before[1], report):
            self._last[pair] = board, report
            return None
        names = [n for n in RangeReport.FIELDS if n != "neighbour" and getattr(before[1], n) != getattr(report, n)]
        if not names:
            return None
        told = ", ".join(f"{n} {getattr(before[1], n)} and {getattr(report, n)}" for n in names)
        return f"boards {before[0]} and {board} report one exchange of {pair[0]} with {pair[1]} differently: {told}"


def _of_one_exchange(one: RangeReport, other: RangeReport) -> bool:
    """Two reports of different exchanges have no stamp in common, but by chance."""
    return any(getattr(one, name) == getattr(other, name) != 0 for name in STAMPS)
