"""The guess of a table's meaning, and the map that states it and works."""

import re

import numpy as np
import pytest

from tests import processes
from tests.shared_data import shared
from tests.uwblink.importers.test_forms import guessed
from tests.uwblink.importers.test_table_forms import (
    HEADER,
    as_messages,
    flights,
    mapped,
    read_rows,
    read_table,
    same,
    stamps,
    wrapped,
    write,
)
from uwblink import errors, import_recording, load
from uwblink.importers.column_map import load_map
from uwblink.importers.guess import guess_map
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.twr import STAMPS

POLL = ("poll_tx", "poll_rx", "resp_tx", "resp_rx", "final_tx", "final_rx")


ENDS = ("timestamp", "Tag ID", "anchor_id")
POWERS = ("fp_power_1", "fpp2")
GERMAN = ("Zeit [s]", "Quelle", "Empfänger", *(f"T_{n} [ns]" for n in HEADER[3:9]), "FP1 [dBm]", "FP2 [dBm]")
AT_DEVICES = ("Datum", "Sender", "Ziel", *POLL, "fp_power_resp (dBm)", "fp_power_init (dBm)")
OF_MESSAGES = ("t_s", "src", "dst", *(f"ts_{n}" for n in POLL), "poll_fp_level", "resp_fp_level")
NS, US = 1e9 / TICKS_PER_SECOND, 1e6 / TICKS_PER_SECOND


@pytest.mark.parametrize(
    ("called", "unit", "third", "decimal"),
    [
        ((*ENDS, *(f"{name}_ticks" for name in POLL), *POWERS), 1, "target", "."),
        ((*ENDS, *(f"T{k}" for k in range(1, 7)), *POWERS), 1, "initiator", "."),
        ((*ENDS, *(f"{n}_raw" for n in HEADER[3:9]), *POWERS), NS, "target", "."),
        *(
            ((*ENDS, *(f"{n} [{us}]" for n in HEADER[3:9]), *POWERS), US, "target", ".")
            for us in ("us", "\u00b5s", "\u03bcs")
        ),
        ((*GERMAN, "Referenz [cm]"), NS, "target", ","),
        ((*AT_DEVICES, "Tape"), 1, "target", "."),
        ((*OF_MESSAGES, "distance_gt_cm"), 1, "target", "."),
    ],
)
def test_guesses_read_tables_with_common_column_names_correctly(tmp_path, called, unit, third, decimal):
    """The last column, if any, is the true distance."""
    rows, names = flights(third=third), dict(zip((*HEADER, "truth"), called, strict=False))
    scale = dict.fromkeys(HEADER[3:9], unit) | {"truth": 100.0 if "cm" in called[-1] else 1.0}
    whole = [short | {"truth": row["truth"]} for short, row in zip(wrapped(rows), rows, strict=True)]
    table = [{name: row[n] * scale.get(n, 1) for n, name in names.items()} for row in whole]
    path = write(tmp_path / "t.csv", table, ";", lambda value: str(value).replace(".", decimal))
    found = guessed(tmp_path, path, {})
    same(found, rows)
    e = found.exchanges
    assert [e.fpp1_dbm.tolist(), e.fpp2_dbm.tolist()] == [[row[name] for row in rows] for name in ("fpp1", "fpp2")]
    assert e.time_ns.tolist() == [round(row["time_s"] * 1e9) for row in rows]
    if "truth" in names:
        assert e.truth_m == pytest.approx([row["truth"] for row in rows])


def test_a_table_of_poses_is_sent_to_the_command_for_poses(tmp_path):
    (tmp_path / "p.csv").write_text("time_s,body,x,y,z,qx,qy,qz,qw\n0,a,1,2,3,0,0,0,1\n1,a,1,2,3,0,0,0,1\n")
    with pytest.raises(errors.ImportTableError, match="uwblink poses"):
        guess_map(tmp_path / "p.csv")


def test_recordings_one_after_the_other_in_a_table_are_noted(tmp_path):
    rows = [f"{k % 10 * 3},1,2,3.{k % 10}" for k in range(20)]
    (tmp_path / "t.csv").write_text("\n".join(["time_s,from_id,to_id,range_m", *rows]) + "\n")
    assert any("by up to 27.0 s: if the clock" in note for note in read_table(tmp_path / "t.csv").meta["notes"])


def test_hostile_names_stay_text(tmp_path):
    names = {"tx1": '"tx1_raw""\n[constants]\nfrom_id = 9 #"'}
    path = write(tmp_path / "t.csv", [{names.get(n, n): row[n] for n in HEADER} for row in wrapped(flights())])
    assert set(load_map(mapped(tmp_path, guess_map(path).text)).constants) == set()


def test_the_public_table_of_single_sided_ranges(tmp_path):
    guess = guess_map(shared("hanyang_sstwr.csv.gz"))
    assert (guess.complete, guess.asked) == (True, ("from_id",))
    found = load_map(mapped(tmp_path, guess.text.replace('from_id = "?"', "from_id = 1")))
    assert (found.protocol, found.bits, found.layout) == ("ss", 32, "exchanges")
    assert [found.columns[n] for n in ("tx1", "rx1", "tx2", "rx2")] == [f"{name}_ticks" for name in POLL[:4]]
    assert (found.columns["fpp2"], found.columns["gt_range_m"]) == ("fpp_dbm", "gt_range_m")
    assert (found.columns["time_s"], found.columns["range_m"]) == ("host_t_s", "device_range_m")


@pytest.mark.parametrize(
    ("event", "words", "clock"),
    [
        ("event", ("tx", "rx"), "ticks"),
        ("direction", ("Sent", "Received"), "device_timestamp"),
        pytest.param("event", ("tx", "rx"), "stamp", marks=pytest.mark.slow),
    ],
)
def test_tables_with_a_row_per_stamp_are_read(tmp_path, event, words, clock):
    rows = flights()
    lines = []
    for row in as_messages(wrapped(rows)):
        head = {"timestamp": row["time_s"], "src": row["from_id"], "dst": row["to_id"], "msg_no": row["message"]}
        lines += [
            head | {clock: row[n], event: word, "seq": row["seq"]} for n, word in zip(("tx", "rx"), words, strict=True)
        ]
    e = guessed(tmp_path, write(tmp_path / "t.csv", lines), {}).exchanges
    found = load_map(tmp_path / "map.toml")
    assert (found.layout, found.columns["stamp"], found.columns["time_s"]) == ("stamps", clock, "timestamp")
    expected = sorted(rows, key=lambda row: row["tx1"] % 2**32)
    assert stamps(e[e.tx1.argsort()]) == [[row[n] % 2**32 for n in HEADER[3:9]] for row in expected]


@pytest.mark.parametrize(
    ("mine", "other"),
    [
        ("tag_{}", "anchor_{}"),
        ("{}", "anchor_pos_{}_m"),
        ("x_tag", "x_anchor"),
        ("{}1", "{}2"),
        ("gt_robot_{}", "p2{}"),
    ],
)
def test_tables_with_positions_and_ranges_are_read(tmp_path, mine, other):
    def called(form, axis):
        return form.format(axis) if "{}" in form else form.replace("x_", f"{axis}_")

    rows = []
    for k in range(30):
        row = {"t_s": k, "tag_id": 1, "anchor_id": 2, "range": (9 + k * k) ** 0.5 + 0.25}
        row |= {called(mine, axis): v for axis, v in zip("xyz", (k, 0, 1), strict=True)}
        rows.append(row | {called(other, axis): v for axis, v in zip("xyz", (0, 3, 1), strict=True)})
    guess = guess_map(write(tmp_path / "t.csv", rows))
    found = load_map(mapped(tmp_path, guess.text)).columns
    ends = {f"{end}_{axis}_m": called(form, axis) for end, form in (("from", mine), ("to", other)) for axis in "xyz"}
    assert (guess.complete, {name: found[name] for name in ends}) == (True, ends)
    if mine == "tag_{}":
        e = read_table(tmp_path / "t.csv", tmp_path / "map.toml").exchanges
        assert e.range_m - e.truth_m == pytest.approx(0.25)


def test_incomplete_positions_are_not_used_and_noted(tmp_path):
    places = dict.fromkeys(("tag_x", "tag_y", "tag_z", "anchor_x", "anchor_y"), 1.5)
    rows = [{"t_s": k, "src": 1, "dst": 2, "range_m": 3.25, **places} for k in range(30)]
    assert not len(guessed(tmp_path, write(tmp_path / "t.csv", rows), {}).poses)
    assert "missing: to_z_m" in (tmp_path / "map.toml").read_text()


def test_zero_third_intervals_give_no_numpy_warning(tmp_path):
    """Some ranges are infinite; as in commands, a warning of NumPy would be an error."""
    rows = [row | ({"tx3": row["tx2"]} if k % 2 else {}) for k, row in enumerate(wrapped(flights()))]
    assert "tx3" in guess_map(write(tmp_path / "t.csv", rows, ",")).text


@pytest.mark.parametrize("third", [True, False])
def test_messages_that_are_counted_from_zero(tmp_path, third):
    rows = flights()
    table = [row | {"message": row["message"] - 1} for row in as_messages(wrapped(rows))]
    e = guessed(
        tmp_path, write(tmp_path / "t.csv", [row for row in table if third or row["message"] < 2]), {}
    ).exchanges
    names, expected = HEADER[3 : 9 if third else 7], sorted(rows, key=lambda row: row["tx1"] % 2**32)
    found = [row[: len(names)] for row in stamps(e[e.tx1.argsort()])]
    assert found == [[row[n] % 2**32 for n in names] for row in expected]


@pytest.mark.parametrize(
    ("ids", "todo"),
    [({"src": 1, "dst": 2}, "check it"), ({"src": 1}, "set to_id in it"), ({}, "set from_id and to_id")],
)
def test_the_command_prints_the_next_steps(tmp_path, ids, todo):
    write(tmp_path / "my log.csv", [{"t_s": k, **ids, "range_m": 3.0} for k in range(30)])
    said = processes.run("uwblink", "import", "guess", "my log.csv", "-o", "map.toml", cwd=tmp_path).stdout
    assert said.startswith(f"map.toml: {todo}")
    assert said.endswith(", then uwblink import csv 'my log.csv' --map map.toml -o 'my log'.uwb\n")


def test_words_for_ids_are_noted_with_their_numbers(tmp_path):
    rows = [{"t_s": k, "src": chr(65 + k % 13), "dst": chr(66 + k % 13), "range_m": 3.0} for k in range(60)]
    (note,) = guessed(tmp_path, write(tmp_path / "t.csv", rows), {}).meta["notes"]
    text = "14 ids are words or too large, and were numbered: A = 1, B = 2,.*, L = 12 and 2 more; .*"
    assert re.fullmatch(text, note)


@pytest.mark.parametrize(
    "ends",
    [
        ("tag_a", "tag_b"),
        ("node_i", "node_j"),
        ("TagA", "TagB"),
        ("id_0", "id_1"),
        ("node_id_1", "node_id_2"),
        ("robot 1 id", "robot 2 id"),
        ("MAC_1", "MAC_2"),
    ],
)
def test_equal_names_of_initiators_and_targets_differ(tmp_path, ends):
    """Twelve pairs remain twelve: each end has its own column."""
    pairs = [(one, two) for one in range(1, 5) for two in range(1, 5) if one != two]
    rows = [{"t_s": k, **dict(zip(ends, pairs[k % 12], strict=True)), "range_m": 3 + k / 7} for k in range(60)]
    guess = guess_map(write(tmp_path / "t.csv", rows))
    found = load_map(mapped(tmp_path, guess.text)).columns
    assert (guess.complete, guess.asked, found["from_id"], found["to_id"]) == (True, (), *ends)


@pytest.mark.parametrize(
    ("row", "asked", "answer"),
    [
        ({"t_s": 0.5, "range_m": 3.01}, "from_id", '"?"'),
        ({"t": 1, "src": 1, "dst": 2, "range_m": 3.01}, "time", "ms"),
        ({"t_s": 0.5, "src": 1, "dst": 2, "range": 1500}, "distance", "mm"),
        ({"t_s": 0.5, "src": 1, "dst": 2, "range": 1500.25}, "distance", "mm"),
        ({"t_s": 0.5, "src": 1, "dst": 2, "range_m": 3.01, "rssi": 84}, "power", "-dBm"),
    ],
)
def test_missing_information_is_asked_for(tmp_path, row, asked, answer):
    """The guessed map imports nothing, nor does one without the line; one with an answer does."""
    rows = [{n: v + k if n in ("t", "range", "t_s") else v for n, v in row.items()} for k in range(40)]
    text = guess_map(write(tmp_path / "t.csv", rows)).text
    assert f'{asked} = "?"' in text
    with pytest.raises(errors.ImportTableError, match=asked):
        read_rows(tmp_path, rows, text)
    if answer == '"?"':
        return
    if asked != "time":
        with pytest.raises(errors.ImportTableError, match=f"units.{asked}"):
            read_rows(tmp_path, rows, text.replace(f'{asked} = "?"', "#"))
    found = read_rows(tmp_path, rows, text.replace(f'{asked} = "?"', f'{asked} = "{answer}"'))
    assert found.exchanges.time_ns[1] - found.exchanges.time_ns[0] == (10**6 if asked == "time" else 10**9)
    if asked == "distance":
        assert found.exchanges.range_m[0] == pytest.approx(1.5, abs=0.001)
    if asked == "power":
        assert set(found.powers["rxp2_dbm"]) == {-84.0}


DRAWN = np.random.default_rng(0).random((60, 4))


@pytest.mark.parametrize(
    ("rows", "complete", "asked", "said"),
    [
        ([{"tx1": 1, "rx1": 2, "tx2": 3, "colour": 4}] * 3, False, ("from_id", "to_id"), '# not used: "colour"'),
        (
            [{"ticks": k, "event": ("tx", "rx")[k % 2], "src": 1, "dst": 2, "msg": "red"} for k in range(40)],
            False,
            ("stamps",),
            "# a column of numbers is still needed: message",
        ),
        (
            [{"t_s": k, "src": 1, "dst": 2, "range_cm": 300 + k, "gt_m": 3.0} for k in range(30)],
            True,
            (),
            'range_m = "cm"  # by the column\'s name\ngt_range_m = "m"',
        ),
        (
            [{"src": 1, "dst": 2, "tx1": a, "rx1": b, "tx2": c, "rx2": d} for a, b, c, d in DRAWN],
            True,
            ("protocol", "stamps"),
            "",
        ),
        (
            [{"src": 1, "dst": 2, "msg": 1 + k % 2, "tx": 0.5 * k, "rx": 0.7 * k} for k in range(60)],
            True,
            ("stamps",),
            "",
        ),
        ([{"src": 1, "dst": 2, "rx": 3, "wert": 3.1}] * 30, False, ("range_m",), '# not used: "rx", "wert"'),
        (
            [{"Sender": 1, "Empfänger": 2, "Abstand gemessen": 3.1, "Referenz": 3.0, "RX dBm": -80}] * 30,
            True,
            (),
            'rxp2 = "RX dBm"\ngt_range_m = "Referenz"\nrange_m = "Abstand gemessen"',
        ),
    ],
    ids=["nothing", "words", "units", "drawn", "messages", "no ranges", "German"],
)
def test_missing_columns_are_named_and_not_invented(tmp_path, rows, complete, asked, said):
    guess = guess_map(write(tmp_path / "t.csv", rows))
    assert (guess.complete, guess.asked) == (complete, asked)
    assert said in guess.text


def test_stamps_that_are_no_numbers_are_refused_with_the_file(tmp_path):
    write(tmp_path / "s.csv", [dict(zip(["from_id", "to_id", *STAMPS[:4]], [1, 2, *"abcd"], strict=True))])
    with pytest.raises(errors.ImportTableError, match=r"s\.csv: its stamps are no numbers"):
        guess_map(tmp_path / "s.csv")


def test_third_stamps_of_the_initiator_in_exchanged_columns_are_not_those_of_the_target(tmp_path):
    """Exchanged columns look like a clock whose rate follows the range; every range would be plausible and wrong."""
    random = np.random.default_rng(4)
    noisy = [
        {n: v + int(random.integers(-6, 7)) if n in HEADER[3:9] else v for n, v in row.items()}
        for row in wrapped(flights(120, third="initiator"))
    ]
    exchanged = [row | {"tx3": row["rx3"], "rx3": row["tx3"]} for row in noisy]
    assert "protocol" in guess_map(write(tmp_path / "exchanged.csv", exchanged)).asked
    # Stamps of the target, with a clock that is 20 ppm off, and of the initiator in their columns are read as usual.
    skewed = [
        {n: (round(v * (1 + 20e-6)) if n in ("rx1", "tx2", "tx3") else v) for n, v in row.items()}
        for row in flights(120, third="target")
    ]
    assert 'protocol = "ds"' in guess_map(write(tmp_path / "plain.csv", wrapped(skewed))).text
    assert 'protocol = "ds-alt"' in guess_map(write(tmp_path / "alternative.csv", noisy)).text


OWN = {"time_s": "time_s", "at_id": "tag", "from_id": "anchor_a", "to_id": "anchor_b", "difference_m": "difference_m"}


@pytest.mark.parametrize(
    ("header", "named", "units"),
    [
        ("time_s,tag,anchor_a,anchor_b,difference_m", OWN, {}),
        ("time_s,tag,anchor_a,anchor_b,tdoa_ns", OWN | {"difference_m": "tdoa_ns"}, {"difference_m": "ns"}),
        (
            "t_tdoa,idA,idB,tdoa_meas,t_imu,acc_x,acc_y,acc_z",
            {"time_s": "t_tdoa", "from_id": "idA", "to_id": "idB", "difference_m": "tdoa_meas"},
            {},
        ),
        ("time,from_id,to_id,distanceDiff", {"time_s": "time", "difference_m": "distanceDiff"}, {}),
        ("time_s,tag,anchor_plus,anchor_minus,tdoa_m", {"from_id": "anchor_minus", "to_id": "anchor_plus"}, {}),
    ],
)
def test_differences_of_arrival_without_stamps_are_read(tmp_path, header, named, units):
    """Tables with the columns of the public set UTIL, and others; the assumed sign is stated."""
    cells = {"tag": "9", "anchor_a": "1", "idA": "1", "from_id": "1", "anchor_b": "2", "idB": "2", "to_id": "2"}
    cells |= {"anchor_minus": "1", "anchor_plus": "2"}
    rows = "".join(
        ",".join(cells.get(name, f"{1.37 + k / 50:.2f}") for name in header.split(",")) + "\n" for k in range(30)
    )
    (tmp_path / "d.csv").write_text(f"{header}\n{rows}")
    guess = guess_map(tmp_path / "d.csv")
    assert guess.asked == (() if "tag" in header else ("at_id",))
    assert "distance from at_id to to_id minus that to from_id" in guess.text
    found_map = load_map(mapped(tmp_path, guess.text.replace('at_id = "?"', "at_id = 9")))
    assert (found_map.layout, {ours: found_map.columns[ours] for ours in named}) == ("differences", named)
    assert {key: unit for key, unit in found_map.units.items() if key in found_map.columns} == units
    words = ("uwblink", "import", "csv", "d.csv", "--map", "map.toml", "-o", "d.uwb")
    said = processes.succeed(*words, cwd=tmp_path).stdout
    for text in ("0 exchanges, 30 differences", "distance from at_id to to_id minus that to from_id"):
        assert text in said
    found = load(tmp_path / "d.uwb").differences
    assert [found[name].tolist() for name in ("minus", "plus", "listener")] == [[1] * 30, [2] * 30, [9] * 30]
    scale = 0.299702547 if units else 1.0
    assert found["difference_m"] == pytest.approx(scale * (1.37 + np.arange(30) / 50), rel=1e-9)


def test_logs_of_the_loco_deck_have_a_column_per_pair(tmp_path):
    rows = "".join(f"{10 * k},{0.11 + k / 50:.2f},,{-0.13 - k / 50:.2f}\n" for k in range(30))
    (tmp_path / "d.csv").write_text(f"Timestamp,tdoa.d7-0,tdoa.d0-1,tdoa.d1-2\n{rows}")
    text = guess_map(tmp_path / "d.csv").text
    assert 'difference_m = "tdoa.d{from_id}-{to_id}"' in text
    map_file = mapped(tmp_path, text.replace('at_id = "?"', "at_id = 9").replace('time = "?"', 'time = "ms"'))
    import_recording(tmp_path / "d.csv", tmp_path / "d.uwb", map_file=map_file)
    found = load(tmp_path / "d.uwb").differences
    assert [found[name][:4].tolist() for name in ("minus", "plus")] == [[7, 1, 7, 1], [0, 2, 0, 2]]
    assert found["difference_m"][:4].tolist() == [0.11, -0.13, 0.13, -0.15]
    assert found["time_ns"][2] == 10_000_000


@pytest.mark.parametrize(
    ("change", "naming"),
    [
        (lambda row: row | {"difference_m": "nan"}, ["row 2", "'difference_m'", "'nan'", "finite"]),
        (lambda row: row | {"difference_m": row["difference_m"] / 3e8}, ["'difference_m'", "metres", "units."]),
        (lambda row: row | {"difference_m": row["difference_m"] * 1e3}, ["'difference_m'", "units."]),
        (lambda row: row | {"at_id": row["to_id"]}, ["row 2", "'at_id'", "another tag"]),
        (lambda row: {n: v for n, v in row.items() if n != "at_id"}, ["'at_id'", "missing"]),
    ],
)
def test_wrong_differences_are_refused(tmp_path, change, naming):
    row = {"time_s": 0.0, "from_id": 1, "to_id": 2, "at_id": 9}
    rows = [row | {"time_s": k / 100, "difference_m": 1.003 + 0.017 * k} for k in range(40)]
    write(tmp_path / "d.csv", [change(one) for one in rows])
    processes.refuse("uwblink", "import", "csv", "d.csv", "-o", "d.uwb", cwd=tmp_path, naming=["d.csv", *naming])
    assert not (tmp_path / "d.uwb").exists()
