"""Boards of other firmware that print ranges: imitated on pseudo-terminals, recorded, streamed, corrected."""

import json
import math
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

import calib
import uwblink
from tests.boards import device
from tests.processes import refuse, succeed
from tests.registered import registered
from tests.uwblink.importers.test_table_forms import imported
from uwblink.boards import DIALECTS, Dialect, LivePage, PrintedRange, dialect_of, load_correction
from uwblink.boards.dialects import Printed
from uwblink.boards.ports import Terminal
from uwblink.importers.devices import LINES

# Output of each board for a range of one metre to one device and of two metres to another, from descriptions.
BOTH = "from: 6018\t Range: 1.00 m\t RX power: -78.50 dBm\r\nfrom: 6019\t Range: 2.00 m\t RX power: -80.00 dBm\r\n"
FORMS = {
    "dwm1001-lec": (
        "DIST,2,AN0,D91B,0.0,0.0,0.0,1.00,AN1,4C1A,3.0,0.0,0.0,2.00,POS,1.0,1.0,0.0,90\r\n",
        ("D91B", "4C1A"),
    ),
    "dwm1001-les": (" D91B[0.00,0.00,0.00]=1.00 4C1A[3.00,0.00,0.00]=2.00 le_us=2563\r\n", ("D91B", "4C1A")),
    "at-range": ("AT+RANGE=tid:7,mask:03,seq:9,range:(100,200,0,0,0,0,0,0)\r\n", (0, 1)),
    "arduino": (BOTH, (6018, 6019)),
    "trek-corrected": ("mc 03 000003e8 000007d0 00000bb8 00000000 095f c1 00024bed a7:0\r\n", (0, 1)),
}


@contextmanager
def printing(text, *, asked=b"", banner=""):
    """Serve a board that prints a text 25 times a second after it was asked; yield the name of the port."""
    heard = []

    def step(terminal):
        heard.append(terminal.read())
        if asked in b"".join(heard):
            # In two pieces, like lines of a serial port.
            for piece in (text[:9], text[9:]):
                terminal.write(piece.encode())
                time.sleep(0.01)
        time.sleep(0.02)

    with device(step) as terminal:
        terminal.write(banner.encode())
        yield terminal.name


@pytest.mark.parametrize("name", FORMS)
def test_printed_ranges_are_recorded(tmp_path, name):
    text, devices = FORMS[name]
    start = DIALECTS[name].start
    with printing(text, asked=start, banner="\r\n DWM1001 TWR Real Time Location System\r\n\r\ndwm> \r\n") as port:
        words = ("--dialect", name, "--ids", "40", "--duration", "1.0", "-o", "r.uwb")
        assert "ranges of" in succeed("uwblink", "record", port, *words, cwd=tmp_path).stdout
    found = uwblink.load(tmp_path / "r.uwb")
    e, names = found.exchanges, {tag.tag: tag.body for tag in found.tags}
    called = [names[k] if isinstance(devices[0], str) else k for k in e.target.tolist()]
    # Some lines state who ranged; for the others it is the board at the port.
    own = 7 if name in ("at-range", "trek-corrected") else 40
    told = {*zip(e.initiator.tolist(), called, e.range_m.round(9).tolist(), strict=True)}
    assert told == {(own, devices[0], 1.0), (own, devices[1], 2.0)}
    # The import of the same lines as a log, by another program (DuckDB), gives the same.
    constant = "" if "from_id" in LINES[name]["line"] else "[constants]\nfrom_id = 40\n"
    logged = imported(tmp_path, text * 3, f'line = "{name}"\n{constant}', "board.log").exchanges
    for column in ("initiator", "range_m"):
        assert {*getattr(logged, column).tolist()} == {*getattr(e, column).tolist()}
    assert (len(e) >= 10, found.meta["dialect"]) == (True, name)
    if name == "arduino":
        assert set(e.fpp2_dbm.tolist()) == {-78.5, -80.0}
    # The time is that of the host.
    assert abs(e.time_ns[0] * 1e-9 - time.time()) < 120
    assert np.all(np.diff(e.time_ns) >= 0)


def test_a_map_of_lines_serves_as_for_logs_and_a_stream_is_corrected(tmp_path):
    keys = 'line = "{from_id}->{to_id}: {range_m} ({rxp2})"\n[units]\ndistance = "cm"\n'
    assert set(imported(tmp_path, "1->2: 150 (-80.5)\n" * 5, keys, "board.log").exchanges.range_m.tolist()) == {1.5}
    calibrated(tmp_path, 1, 2)
    with printing("1->2: 150 (-80.5)\n") as port:
        words = ("--dialect", "map.toml", "-c", "c.json", "--duration", "1.0")
        done = succeed("uwblink", "stream", port, *words, cwd=tmp_path)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) >= 5
    assert {(row["initiator"], row["target"], row["range_m"]) for row in rows} == {(1, 2, 1.5)}
    assert [row["corrected_m"] for row in rows] == pytest.approx([1.25] * len(rows), abs=1e-6)


def test_maps_have_the_same_effect_for_boards_and_logs(tmp_path):
    """Units of a position, a constant initiator, numbers of ids, values without a range, and the sign of powers."""
    keys = 'line = "{to_id} {range_mm} {rxp2}"\nmissing = [65535]\n[units]\npower = "-dBm"\n[constants]\nfrom_id = 9\n'
    lines = "left 1500 80.5\n7 2500 81.5\n7 65535 99.0\n"
    logged = imported(tmp_path, lines, f'{keys}[ids]\nleft = 40\n"7" = 41\n', "board.log").exchanges
    with printing(lines) as port:
        words = ("--dialect", "map.toml", "--duration", "1.0", "-o", "r.uwb")
        succeed("uwblink", "record", port, *words, cwd=tmp_path)
    recorded = uwblink.load(tmp_path / "r.uwb").exchanges
    for x in (logged, recorded):
        told = {*zip(x.initiator.tolist(), x.target.tolist(), x.range_m.round(6).tolist(), strict=True)}
        assert told == {(9, 40, 1.5), (9, 41, 2.5)}
    assert set(recorded.fpp2_dbm.tolist()) == {-80.5, -81.5}
    (tmp_path / "by_register.toml").write_text(
        'line = "{to_id} {range_m} {a} {b} {c} {n}"\nchip = "dw1000"\n[columns]\n'
        'fpp2 = { f1 = "a", f2 = "b", f3 = "c", n = "n" }\n'
    )
    # DW1000 User Manual, 4.7.1: 10 log10((F1^2 + F2^2 + F3^2) / N^2) - A, A = 121.74 dB at 64 MHz.
    (one,) = dialect_of(str(tmp_path / "by_register.toml")).parse(["65535 1.25 9000 8000 7000 118", "noise"])
    power_dbm = 10 * math.log10((9000**2 + 8000**2 + 7000**2) / 118**2) - 121.74
    assert (one.from_id, one.to_id, one.range_m) == (None, 65535, 1.25)
    assert one.power_dbm == pytest.approx(power_dbm)
    for text, error, said in (
        ('line = "{from_id} {range_m}"\n', uwblink.errors.ImportTableError, "to_id"),
        ('[columns]\nrange_m = "d"\n', uwblink.errors.ArgumentError, "line"),
    ):
        (tmp_path / "wrong.toml").write_text(text)
        with pytest.raises(error, match=said):
            dialect_of(str(tmp_path / "wrong.toml"))


@pytest.mark.parametrize(
    ("text", "words", "naming"),
    [
        ("hello 1\r\n" * 20, "--dialect arduino", ["{port}", "no range in", "hello 1", "dialect"]),
        ("hello 1\r\n" * 20, "--dialect nonsense", ["--dialect", "dwm1001-lec"]),
        ("hello 1\r\n" * 20, "--dialect arduino --pairs all", ["--pairs", "--dialect"]),
        ("hello 1\r\n" * 20, "--dialect arduino --ids 1,2", ["1 ports, but 2 ids"]),
        # It is the only device that answers: of others, what was recorded would be kept.
        (BOTH.splitlines(keepends=True)[0], "--dialect arduino --ids 6018", ["{port}", "6018", "own id", "--ids"]),
        ("", "--dialect arduino --duration 0.3", ["no range was printed"]),
    ],
)
def test_another_form_ends_with_a_line_and_no_file(tmp_path, text, words, naming):
    with printing(text) as port:
        naming = [part.format(port=port) for part in naming]
        refuse(
            "uwblink", "record", port, "--duration", "30", "-o", "r.uwb", *words.split(), cwd=tmp_path, naming=naming
        )
    assert not list(tmp_path.iterdir())


def test_a_board_that_is_unplugged_keeps_what_was_recorded(tmp_path):
    terminal = Terminal()

    def print_and_go():
        while not (tmp_path / "r.uwb").exists():
            terminal.write(b"from: 5 Range: 1.50 m RX power: -80 dBm\r\n")
            time.sleep(0.1)
        time.sleep(0.5)
        terminal.unplug()

    threading.Thread(target=print_and_go, daemon=True).start()
    words = ("--dialect", "arduino", "--duration", "20", "-o", "r.uwb")
    assert "gone" in refuse("uwblink", "record", terminal.name, *words, cwd=tmp_path)
    found = uwblink.load(tmp_path / "r.uwb")
    assert set(found.exchanges.range_m.tolist()) == {1.5}
    assert {tag.tag: tag.body for tag in found.tags} == {1: "tag1", 5: "tag5"}


def test_dialects_come_by_entry_points_and_words_get_ids():
    def parse(lines):
        cells = (line.partition("=") for line in lines)
        return [PrintedRange(to_id=who, range_m=float(far)) for who, _, far in cells if far]

    mine, seen = Dialect("mine", "A form of my own.", parse), Printed()
    with registered(DIALECTS, mine), printing("alpha=1.0\nbeta=2.0\nbad line\n") as port:
        batches = uwblink.boards.printed_ranges([port], dialect_of("mine"), ids=[1], duration_s=1.0, seen=seen)
        found = [turn for turns in batches for turn in turns]
    # Words have ids after that of the board, in the order of their appearance.
    assert sorted(seen.numbers.values()) == [1, 2, 3]
    named = {number: name for name, number in seen.numbers.items()}
    assert {(named[turn.pair[1]], turn.report.range_m) for turn in found} == {("alpha", 1.0), ("beta", 2.0)}
    with pytest.raises(uwblink.errors.ArgumentError, match="parse"):
        DIALECTS.register(Dialect("bad", "No function.", None))  # type: ignore[arg-type]


def calibrated(folder, initiator, target):
    """Write a calibration that subtracts 25 cm from ranges of a pair."""
    own = calib.Ranges.from_arrays(
        np.tile([1.25, 2.25, 3.25], 40),
        initiator=initiator,
        target=target,
        truth_m=np.tile([1.0, 2.0, 3.0], 40),
        time_ns=np.arange(120) * 10**8,
    )
    calib.fit(own, constants="pair", delays_only=True).save(folder / "c.json")
    return folder / "c.json"


def test_the_page_shows_printed_ranges_and_their_corrections(tmp_path):
    correct = load_correction(calibrated(tmp_path, 40, 6018))
    one, other = BOTH.splitlines(keepends=True)
    with printing(one) as port, LivePage(tmp_path / "r.uwb", correct=correct) as page:
        done = uwblink.boards.record_printed(
            [port], tmp_path / "r.uwb", dialect_of("arduino"), ids=[40], duration_s=1.0, watch=page.watch,
            listeners=[page],
        )  # fmt: skip
        body = page.body()
    assert f"{done.exchanges} ranges of 2 devices" in str(done)
    for text in ("40&nbsp;&rarr;&nbsp;6018", "<td>1.000</td><td>0.750</td>", 'polyline class="corrected"'):
        assert text in body
    # There is no share of successful exchanges, because failed ones are not printed.
    assert "%" not in body
    said = pytest.raises(uwblink.errors.PlanError, match="6019")
    with printing(other) as port, LivePage(tmp_path / "s.uwb", correct=correct) as page, said:
        uwblink.boards.record_printed(
            [port], tmp_path / "s.uwb", dialect_of("arduino"), ids=[40], duration_s=30, watch=page.watch,
            listeners=[page],
        )  # fmt: skip


@pytest.mark.slow
def test_a_stream_is_recorded_as_well_and_the_command_serves_the_page(tmp_path):
    calibrated(tmp_path, 40, 6018)
    with printing(BOTH.splitlines(keepends=True)[0]) as port:
        words = ("--dialect", "arduino", "--ids", "40", "-c", "c.json", "--duration", "1.0", "-o")
        streamed = succeed("uwblink", "stream", port, *words, "s.uwb", cwd=tmp_path)
        recorded = succeed("uwblink", "record", port, *words, "r.uwb", "--live", cwd=tmp_path)
    rows = [json.loads(line) for line in streamed.stdout.splitlines()]
    assert len(uwblink.load(tmp_path / "s.uwb").exchanges) == len(rows) >= 5
    assert [row["corrected_m"] for row in rows] == pytest.approx([0.75] * len(rows))
    assert "live page: http://127.0.0.1:" in recorded.stderr
    assert set(uwblink.load(tmp_path / "r.uwb").exchanges.range_m.tolist()) == {1.0}
