"""Forms of files, each made here from its description, guessed, imported, and compared with the planted values.

docs/importing.md lists the forms; each row of `FORMS` is a row there.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import duckdb
import numpy as np
import pytest

from tests.errors import one_line
from tests.processes import ROOT
from tests.uwblink.importers.test_table_forms import as_messages, flights, imported, wrapped, write
from uwblink.errors import ImportTableError
from uwblink.importers import read_source
from uwblink.importers.guess import guess_map
from uwblink.recording.contents import load

AIR_M_PER_NS = 0.299702547
ANCHORS = ("0", "1", "2", "3")
HEXADECIMAL = ("1A2B", "0C0D", "9280", "5431")


@dataclass(frozen=True)
class Range:
    """A planted range of tag 7: time in seconds, id of the anchor, range and distance in metres, power in dBm."""

    time_s: float
    anchor: int
    range_m: float
    truth_m: float
    power_dbm: float


def planted(count=40, seed=3):
    """Return ranges to four anchors at each time, in whole millimetres; the distance to each anchor is constant."""
    random = np.random.default_rng(seed)
    return [
        Range(10 + k / 4, a, float(np.round(2.0 + a + random.normal(0.15, 0.05), 3)), 2.0 + a, -80.0 - a - k % 8)
        for k in range(count)
        for a in range(4)
    ]


PLANT = planted()
ROUNDS = [PLANT[k : k + 4] for k in range(0, len(PLANT), 4)]


def long_rows():
    return [{"t_s": r.time_s, "tag": 7, "anchor": r.anchor, "range_m": r.range_m, "gt_m": r.truth_m} for r in PLANT]


def wide_rows(name, scale=1.0, **more):
    """Return a row per round with a column per anchor; `more` are further columns, by functions of the ranges of a
    round.
    """
    return [
        {"t_s": some[0].time_s, "tag": 7}
        | {name.format(r.anchor): round(r.range_m * scale, 6) for r in some}
        | {key.format(r.anchor): of(r) for key, of in more.items() for r in some}
        for some in ROUNDS
    ]


def lines(path, of, noise=()):
    """Return a log with a line per round, by a function of its ranges, and lines of other kinds between them."""
    text = [line for some in ROUNDS for line in (*noise, of(some))]
    path.write_bytes(b"\r\n".join(line if isinstance(line, bytes) else line.encode() for line in text) + b"\r\n")
    return path


def at_range(some, more=""):
    listed = ",".join([*(f"{100 * r.range_m:.1f}" for r in some), "0", "0", "0", "0"])
    return f"AT+RANGE=tid:7,mask:0F,seq:{int(4 * some[0].time_s)},range:({listed}){more}"


def with_ids(some):
    return at_range(some, ",ancid:(0,1,2,3,-1,-1,-1,-1)")


def with_powers(some):
    return at_range(some, f",rssi:({','.join(f'{r.power_dbm:.2f}' for r in some)},0.00,0.00,0.00,0.00)")


def lec(some):
    parts = "".join(f",AN{k},{HEXADECIMAL[r.anchor]},1.00,{k}.50,0.00,{r.range_m}" for k, r in enumerate(some))
    return f"DIST,4{parts},POS,1.00,2.00,3.00,80"


def les(some):
    parts = " ".join(f"{HEXADECIMAL[r.anchor]}[1.00,2.00,0.00]={r.range_m}" for r in some)
    return f"{parts} le_us=2576 est[6.97,8.17,-1.56,53]"


def trek(some, kind="mc"):
    """The third anchor never answers: its bit is not set, and an old range is in its place."""
    hexadecimal = " ".join(f"{round(1000 * r.range_m) if r.anchor != 2 else 0x999:08x}" for r in some)
    return f"{kind} 0b {hexadecimal} 095f c1 00024bed a7:0"


def monitored(some):
    """Return lines of a serial monitor, each with its time of day."""
    seconds = f"00:00:{some[0].time_s:06.3f}"
    return "\r\n".join(f"{seconds} -> from: {r.anchor} Range: {r.range_m} m RX power: {r.power_dbm} dBm" for r in some)


def prints(folder):
    text = [f"from: {HEXADECIMAL[r.anchor]}\t Range: {r.range_m} m\t RX power: {r.power_dbm:.2f} dBm" for r in PLANT]
    (folder / "serial.log").write_text("\n".join(["DW1000-arduino", *text]) + "\n")
    return folder / "serial.log"


def json_rows(folder, of):
    (folder / "ranges.jsonl").write_text("\n".join(json.dumps(of(some)) for some in ROUNDS) + "\n")
    return folder / "ranges.jsonl"


def named_files(folder, unit, scale):
    """Write a file per anchor, with its distance in the name; without id and distance inside."""
    for a in range(4):
        rows = [{"t_s": r.time_s, "range_m": r.range_m} for r in PLANT if r.anchor == a]
        write(folder / f"tag7_anchor{a}_{(2 + a) * scale:g}{unit}.csv", rows)
    return folder


def parquet(folder):
    source = write(folder / "wide.csv", wide_rows("d{}"))
    with duckdb.connect() as db:
        db.read_csv(str(source)).write_parquet(str(folder / "wide.parquet"))
    source.unlink()
    return folder / "wide.parquet"


def with_columns(columns):
    """Return a function that writes the long table with more columns, by functions of each range."""
    return lambda folder: write(folder / "t.csv", [row | columns(r) for row, r in zip(long_rows(), PLANT, strict=True)])


def registers(r):
    """Return amplitudes for the planted first-path power at 118 symbols, by the formula of the manual."""
    each = (10 ** ((r.power_dbm + 121.74) / 10) * 118**2 / 3) ** 0.5
    total = 10 ** ((r.power_dbm + 3 + 121.74) / 10) * 118**2 / 2**17
    return dict.fromkeys(("FP_AMPL1", "FP_AMPL2", "FP_AMPL3"), each) | {"RXPACC": 118, "CIR_PWR": total}


def late_registers(r):
    each = 4 * (10 ** ((r.power_dbm - 6 * 2 + 121.7) / 10) * 128**2 / 3) ** 0.5
    return dict.fromkeys(("fp_ampl1", "fp_ampl2", "fp_ampl3"), each) | {"rxpacc": 128, "dgc": 2}


def with_sentinels(value):
    rows = long_rows()
    for k in range(5, 160, 10):
        rows.insert(k, rows[k] | {"range_m": value})
    return rows


def by_both():
    """Return each range twice, from the log of the tag and, 2 ms later, from that of the anchor."""
    both = ([row, row | {"tag": row["anchor"], "anchor": 7, "t_s": row["t_s"] + 0.002}] for row in long_rows())
    return renamed({"tag": "src", "anchor": "dst"}, [row for rows in both for row in rows])


def renamed(names, rows=None):
    return [{names.get(key, key): value for key, value in row.items()} for row in rows or long_rows()]


@dataclass(frozen=True)
class Form:
    """A form of files: a function that writes one, answers to the questions of its guess, and data that it lacks."""

    write: Callable[[Path], Path]
    answers: Mapping[str, object] = field(default_factory=dict)
    names: tuple[str, ...] = ANCHORS
    times: bool = True
    truth: bool = False
    powers: str = ""
    noted: str = ""
    kept: Callable[[Range], bool] = lambda _: True


def of(make, *words, **more):
    """Return a function that writes rows to a table in a folder."""
    return lambda folder: write(folder / "t.csv", make(*words, **more))


TAG = {"from_id": 7}
FORMS = {
    "long, plain": Form(of(long_rows), truth=True),
    "wide, `Distance 1`": Form(of(wide_rows, "Distance {}")),
    "wide, `r_AN0`": Form(of(wide_rows, "r_AN{}")),
    "wide in mm, with powers": Form(
        of(wide_rows, "range_{}_mm", 1000, **{"rssi_{}": lambda r: r.power_dbm}), powers="rxp"
    ),
    "wide, with true distances": Form(of(wide_rows, "d{}", **{"gt_{}": lambda r: r.truth_m}), truth=True),
    "wide Parquet": Form(parquet),
    "arrays in JSON lines": Form(
        lambda folder: json_rows(
            folder, lambda some: {"t_s": some[0].time_s, "tag": 7, "dis_arr": [r.range_m for r in some]}
        )
    ),
    "lists of objects in JSON lines": Form(
        lambda folder: json_rows(
            folder,
            lambda some: {
                "t_s": some[0].time_s,
                "tag": 7,
                "receptions": [{"anchor": r.anchor, "range_m": r.range_m, "rssi": r.power_dbm} for r in some],
            },
        ),
        powers="rxp",
    ),
    "no header": Form(
        lambda folder: write(folder / "t.csv", long_rows(), header=False),
        {"time_s": 1, "from_id": 2, "to_id": 3, "range_m": 4},
    ),
    "ids and distance in names of files": Form(lambda folder: named_files(folder, "cm", 100), truth=True),
    "DWM1001 `lec`": Form(
        lambda folder: lines(folder / "uart.log", lec, ["dwm> lec", b"\xff\xfe\x00"]), TAG, HEXADECIMAL, times=False
    ),
    "DWM1001 `les`": Form(lambda folder: lines(folder / "uart.log", les), TAG, HEXADECIMAL, times=False),
    "AT+RANGE": Form(lambda folder: lines(folder / "uart.log", at_range), times=False),
    "AT+RANGE with ids": Form(lambda folder: lines(folder / "uart.txt", with_ids, ["OK"]), times=False),
    "AT+RANGE with powers": Form(lambda folder: lines(folder / "uart.log", with_powers), times=False, powers="rxp"),
    "a log with times": Form(
        lambda folder: lines(folder / "uart.log", lambda some: f"[{some[0].time_s:.3f}] {with_ids(some)}")
    ),
    "Arduino prints": Form(prints, TAG, HEXADECIMAL, times=False, powers="rxp"),
    "Arduino prints with times of day": Form(
        lambda folder: lines(folder / "monitor.txt", monitored), TAG, powers="rxp"
    ),
    "TREK1000": Form(lambda folder: lines(folder / "trek.log", trek), times=False, kept=lambda r: r.anchor != 2),
    "TREK1000, raw and corrected": Form(
        lambda folder: lines(folder / "t.log", lambda some: trek(some, "mr") + "\r\n" + trek(some).replace("00", "01")),
        {"line": "trek-raw"}, times=False, kept=lambda r: r.anchor != 2,
    ),
    "registers of the DW1000": Form(with_columns(registers), {"chip": "dw1000"}, truth=True, powers="fpp"),
    "registers of the DW3000": Form(with_columns(late_registers), {"chip": "dw3000"}, truth=True, powers="fpp"),
    "powers named `RSSI_fp`": Form(with_columns(lambda r: {"RSSI_fp": r.power_dbm}), truth=True, powers="fpp"),
    "-1 for no range": Form(of(with_sentinels, -1), truth=True, noted="16 of 176 rows"),
    "65535 for no range": Form(of(with_sentinels, 65535), truth=True, noted="16 of 176 rows"),
    "raw and filtered ranges": Form(
        of(lambda: [row | {"Filtered_Range": 3.0} for row in renamed({"range_m": "Raw_Range"})]),
        {"range_m": "Raw_Range"}, truth=True,
    ),
    "ranges in mm, true distances in m": Form(
        of(lambda: renamed({"range_m": "range_mm"}, [r | {"range_m": 1000 * r["range_m"]} for r in long_rows()])),
        truth=True,
    ),
    "times of flight in ns": Form(
        of(lambda: renamed({"range_m": "tof_ns"}, [r | {"range_m": r["range_m"] / AIR_M_PER_NS} for r in long_rows()])),
        truth=True,
    ),
    "decimal commas": Form(
        lambda folder: write(folder / "t.csv", long_rows(), ";", text=lambda v: str(v).replace(".", ",")), truth=True
    ),
    "summary rows at the end": Form(
        of(lambda: [*long_rows(), {"t_s": "Mean", "tag": "", "anchor": "", "range_m": 3.65, "gt_m": ""}]),
        truth=True, noted="1 of 161 rows",
    ),
    "out of order": Form(
        of(lambda: np.random.default_rng(1).permutation(long_rows()).tolist()), truth=True, noted="are sorted"
    ),
    "logs of both ends": Form(of(by_both), truth=True, noted="160 of 320 ranges repeat"),
    "ids that are words": Form(
        of(lambda: [row | {"anchor": HEXADECIMAL[row["anchor"]]} for row in long_rows()]), names=HEXADECIMAL, truth=True
    ),
}  # fmt: skip


def proposed(source, map_file, answers):
    """Write the proposed map with answers in place of "?"; without answers, an import asks for them."""
    guess = guess_map(source)
    assert (guess.complete, set(guess.asked)) == (True, set(answers)), guess.text
    map_file.write_text(guess.text)
    if answers:
        with pytest.raises(ImportTableError, match="|".join(answers)):
            read_source(source, importer="csv", map_file=map_file)
    text = guess.text
    for key, answer in answers.items():
        text = text.replace(f'{key} = "?"', f"{key} = {json.dumps(answer)}")
    map_file.write_text(text)
    return map_file


def guessed(tmp_path, source, answers):
    """Import a source by its guess, with answers to its questions."""
    return read_source(source, importer="csv", map_file=proposed(source, tmp_path / "map.toml", answers))


def test_the_page_has_a_row_a_form():
    lines = (ROOT / "docs" / "importing.md").read_text().splitlines()
    rows = [line.split("|")[1].strip() for line in lines if "|" in line]
    assert [row for row in rows if row in FORMS] == list(FORMS)


RARER = (
    "wide, `Distance 1`", "wide, `r_AN0`", "DWM1001 `les`", "AT+RANGE", "AT+RANGE with ids", "Arduino prints",
    "TREK1000", "powers named `RSSI_fp`", "65535 for no range", "times of flight in ns", "decimal commas",
    "logs of both ends", "ids that are words",
)  # fmt: skip
"""Forms whose variants are read in every run, here or by another test of this folder: the same kind of file."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in RARER)) for name in FORMS])
def test_forms_are_imported_by_their_guess(tmp_path, name):
    form = FORMS[name]
    (tmp_path / "in").mkdir()
    found = guessed(tmp_path, form.write(tmp_path / "in"), form.answers)
    e, named = found.exchanges, found.meta.get("tag_names", {})
    expected = [r for r in PLANT if form.kept(r)]
    anchors, rounds = [named.get(str(n), str(n)) for n in e.target.tolist()], len({r.anchor for r in expected})
    times = [round(t * 1e-9, 6) if form.times else k // rounds for k, t in enumerate(e.time_ns.tolist())]
    got = sorted(zip(times, anchors, e.range_m.tolist(), e.truth_m.tolist(), e.fpp2_dbm.tolist(), strict=True))
    order = {some[0].time_s: some[0].time_s if form.times else k for k, some in enumerate(ROUNDS)}
    want = sorted(
        (order[r.time_s], form.names[r.anchor], r.range_m, r.truth_m if form.truth else np.nan,
         r.power_dbm if form.powers else np.nan) for r in expected
    )  # fmt: skip
    assert [row[:2] for row in got] == [row[:2] for row in want]
    # Powers of registers have the precision of a float; a total power replaces a missing first-path power.
    for k, atol in ((2, 6e-4 if "AT" in name else 1e-9), (3, 1e-9), (4, 1e-4)):
        np.testing.assert_allclose([row[k] for row in got], [row[k] for row in want], atol=atol)
    assert {named.get(str(n), str(n)) for n in set(e.initiator.tolist())} == {"7"}
    assert list(e.time_ns) == sorted(e.time_ns)
    notes = " ".join(found.meta["notes"])
    assert (form.noted in notes, "received power is used" in notes) == (True, form.powers == "rxp")
    assert found.meta.get("chip") == form.answers.get("chip")


LONG = "time_s,from_id,to_id,range_m,gt_range_m\n"


@pytest.mark.parametrize("column", ["gt_range_m", pytest.param("fpp1", marks=pytest.mark.slow), "from_x_m"])
def test_words_in_a_column_that_is_not_needed_are_named(tmp_path, column):
    """A column with words in half of its cells or more is refused; fewer are counted; empty ones are missing."""

    def text(cells):
        rows = [f"{k},1,2,{3 + k / 7:.3f},{cell}\n" for k, cell in enumerate(cells)]
        return LONG.replace("gt_range_m", column) + "".join(rows)

    words = text(["wall"] * 30)
    with pytest.raises(
        ImportTableError, match=rf"30 of 30 cells of column '{column}' .* 'wall'|\"wall\"; name another"
    ):
        imported(tmp_path, words)
    notes = imported(tmp_path, text(["wall"] * 5 + [-3.5] * 25)).meta["notes"]
    assert any(f"5 of 30 cells of column '{column}' are no numbers" in note for note in notes)
    assert not imported(tmp_path, text(["nan", "", -3.5] * 10)).meta["notes"]
    if column != "from_x_m":
        assert len(imported(tmp_path, words, 'missing = ["WALL"]').exchanges) == 30


@pytest.mark.parametrize("value", [0, *(pytest.param(v, marks=pytest.mark.slow) for v in (-1, 65535)), 9999.9])
def test_frequent_placeholders_of_ranges_are_refused_until_the_map_states_them(tmp_path, value):
    text = LONG + "".join(f"{k},1,2,{value if k % 5 == 0 else 3 + k / 7},\n" for k in range(60))
    with pytest.raises(ImportTableError, match=rf"20.0% of its numbers are {value}.* missing = \[{value}"):
        imported(tmp_path, text)
    assert len(imported(tmp_path, text, f"missing = [{value}]").exchanges) == 48


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('line = "{from_id} {oops"', "map.toml: line"),
        ('line = "{range_m} {range_m}"', "different places"),
        ('[wide]\nrange_m = "zz{to_id}"', "wide.range_m: no column 'zz{to_id}'"),
        ('[wide]\nrange_m = "zz"', "wide.range_m"),
        ('from_name = "x{from_id}.csv"', "its name does not match 'x{from_id}.csv'"),
        ('each = "rows"', "the key each is for JSON lines"),
        ('[columns]\nrange_m = 4\nfrom_id = "from_id"', "for all their numbers"),
        ("[columns]\nrange_m = 9\nfrom_id = 2\nto_id = 3", "column '9' is missing"),
        ('[columns]\nfpp2 = {f1 = "a", n = "b"}', "columns of f1, f2, f3 and n"),
        ('[columns]\nfpp2 = {c = "time_s", n = "to_id"}', "chip"),
        ('chip = "nrf52"', "allowed: dw1000, dw3000, other"),
        ('missing = "x"', "a list of numbers and words"),
        ('[units]\nskew = "offset"', "allowed: ppm, -ppm"),
        ('[units]\nrange_m = "miles"', "units.range_m"),
        ("bits = 33", "bits: found 33"),
        ("bits = 32.0", "bits: found 32.0"),
        ("bits = true", "bits: found True"),
        ('protocol = ["ds"]', "protocol: found ['ds']"),
        ("layout = {a = 1}", "layout: found {'a': 1}"),
        ('layout = "tall"', "layout: found 'tall'"),
        ("[units]\nstamps = -1.0", "units.stamps"),
        ('[units]\ndistance = "furlong"', "units.distance"),
        ("within_s = 0", "within_s: found 0"),
        ('[ids]\n"a" = 70000', "ids.a: found 70000"),
        ("[antenna_delays]\ntx = 1e9", "antenna_delays.tx"),
        ("[antenna_delays.tags.x]\ntx = 1", "antenna_delays.tags.x"),
        ('[columns]\ntx1 = "nothing"', "column 'nothing' is missing"),
        ('delimiter = "--"', "delimiter: found '--'"),
        ('[columns]\nevil = "tx1"', "columns.evil: unknown key"),
        ('each = "x"', "the key each is for JSON lines, bags and logs"),
        ('[units]\ngt_range_m = "ns"', "units.gt_range_m"),
    ],
)
def test_maps_that_cannot_be_are_refused_with_the_key(tmp_path, text, said):
    with pytest.raises(ImportTableError, match=one_line(said)):
        imported(tmp_path, LONG + "0,1,2,3.25,\n1,1,2,3.5,\n", text)


def test_faults_of_logs_and_wide_tables_have_the_line_of_the_file(tmp_path):
    text = "boot\n\n" + "".join(
        f"from: {k % 3 + 1} Range: {'x' if k == 7 else 2 + k / 9:.5} m\r\nidle\n" for k in range(30)
    )
    found = imported(tmp_path, text, 'line = "from: {to_id} Range: {range_m} m"\n[constants]\nfrom_id = 9\n', "a.log")
    assert [fault.detail for fault in found.faults] == ["row 17, column 'range_m': found 'x', expected a finite number"]
    wide = "when,r1,r2,r3\n" + "".join(f"{'soon' if k == 4 else k},{1 + k / 7},{2 + k / 9},\n" for k in range(30))
    map_text = '[columns]\ntime_s = "when"\n[wide]\nrange_m = "r{to_id}"\n[constants]\nfrom_id = 9\n'
    found = imported(tmp_path, wide, map_text)
    details = [fault.detail.split(",")[0] for fault in found.faults]
    assert (details, set(found.exchanges.target)) == (["row 6", "row 6"], {1, 2})


def test_skews_of_registers_and_the_sign_of_both_chips(tmp_path):
    text = "time_s,from_id,to_id,range_m,skew2\n" + "".join(f"{k},1,2,{3 + k / 7},{100 + k}\n" for k in range(30))
    for chip, unit, ppm in (
        ("dw1000", "integrator-5", 998.4e6 / 2 / 1024 / 131072 / 6489.6),
        ("dw3000", "offset", 1e6 / 2**26),
        ("dw3000", "-offset", -1e6 / 2**26),
    ):
        found = imported(tmp_path, text, f'chip = "{chip}"\n[units]\nskew = "{unit}"\n').exchanges
        np.testing.assert_allclose(found.skew2_ppm, (100 + np.arange(30)) * ppm)


def test_powers_that_no_chip_reports_are_refused(tmp_path):
    text = "time_s,from_id,to_id,range_m,fpp2\n" + "".join(f"{k},1,2,{3 + k / 7},{-12 - k % 5}\n" for k in range(30))
    map_text = 'chip = "dw1000"\n[units]\npower = "dBm"\n'
    with pytest.raises(ImportTableError, match=r"'fpp2': the median power is -14"):
        imported(tmp_path, text, map_text)
    assert len(imported(tmp_path, text, map_text.replace("dw1000", "other")).exchanges) == 30


def test_positions_have_units(tmp_path):
    text = "".join(f"[{500 * k}] AN {k % 3}: {2000 + 7 * k} mm\n" for k in range(30))
    map_text = 'line = "[{time_ms}] AN {to_id}: {range_mm} mm"\nfrom_name = "tag{from_id}_{gt_range_cm}cm.log"\n'
    found = imported(tmp_path, text, map_text, "tag7_250cm.log").exchanges
    assert found.range_m == pytest.approx([2 + 0.007 * k for k in range(30)])
    assert found.time_ns.tolist() == [k * 500_000_000 for k in range(30)]
    assert (set(found.initiator), set(found.truth_m)) == ({7}, {2.5})


@pytest.mark.parametrize("third", ["initiator", "target"])
def test_messages_as_words_with_ids_in_names_of_files(tmp_path, third):
    """A file per pair; rows have POLL, RESP and FINAL (or REPORT), and no ids."""
    words = ("POLL", "RESP", "FINAL" if third == "initiator" else "REPORT")
    rows = flights(60, third=third)
    (tmp_path / "in").mkdir()
    for pair in ((1, 2), (2, 3), (3, 1)):
        own = as_messages(wrapped([row for row in rows if (row["from_id"], row["to_id"]) == pair]), third)
        own = [
            {"message": words[row["message"] - 1], **{n: row[n] for n in ("time_s", "tx", "rx", "fpp")}} for row in own
        ]
        write(tmp_path / "in" / f"tag{pair[0]}_to{pair[1]}.csv", own)
    e = guessed(tmp_path, tmp_path / "in", {}).exchanges
    expected = sorted((row["time_s"], row["from_id"], row["to_id"], row["truth"]) for row in rows)
    assert list(zip(e.initiator.tolist(), e.target.tolist(), strict=True)) == [row[1:3] for row in expected]
    np.testing.assert_allclose(e.range_m, [row[3] for row in expected], atol=1e-9)


def test_a_time_of_flight_without_a_unit_is_asked_for(tmp_path):
    rows = [{"t_s": r.time_s, "tag": 7, "anchor": r.anchor, "ToF": r.range_m / AIR_M_PER_NS} for r in PLANT]
    found = guessed(tmp_path, write(tmp_path / "t.csv", rows), {"range_m": "ns"})
    assert found.exchanges.range_m == pytest.approx([r.range_m for r in PLANT])


def test_the_quality_of_secure_training_sequences_is_kept(tmp_path):
    """By exchange and by message; fits do not use it."""
    rows = [row | {"sts_qual": 60 + k % 5} for k, row in enumerate(long_rows())]
    found = guessed(tmp_path, write(tmp_path / "t.csv", rows), {})
    assert found.quality["sts2"].tolist() == [row["sts_qual"] for row in rows]
    assert np.isnan(found.quality["sts1"]).all()
    found.save(tmp_path / "r.uwb")
    assert load(tmp_path / "r.uwb").quality["sts2"].tolist() == found.quality["sts2"].tolist()
    messages = [row | {"sts_quality": 50 + row["message"]} for row in as_messages(wrapped(flights(40)))]
    found = guessed(tmp_path, write(tmp_path / "messages.csv", messages), {})
    assert {*zip(found.quality["sts1"].tolist(), found.quality["sts2"].tolist(), strict=True)} == {(51.0, 52.0)}
