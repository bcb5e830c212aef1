"""Two hundred tables and logs of all forms with random changes: no import has wrong ids, units or protocol.

An import may ask, refuse, or be right. The changes are those in which files differ: names, order and number of columns,
units, delimiters, decimal marks, values for no range, missing cells, ids, order of rows.
"""

import json
import random

import numpy as np
import pytest

from tests.uwblink.importers.test_forms import (
    ROUNDS,
    at_range,
    lec,
    les,
    lines,
    long_rows,
    prints,
    trek,
    wide_rows,
    with_ids,
    with_powers,
)
from tests.uwblink.importers.test_table_forms import HEADER, flights, wrapped, write
from uwblink.errors import ImportTableError
from uwblink.importers import read_source
from uwblink.importers.guess import guess_map
from uwblink.ticks import TICKS_PER_SECOND

TIMES = ("t_s", "time [s]", "timestamp_ms", "stamp", "Zeit", "when", "t")
FROM = ("tag", "src", "tag_id", "Quelle", "initiator", "device", "a", "node_i")
TO = ("anchor", "dst", "to", "Ziel", "responder", "neighbour", "b", "node_j")
RANGES = ("range", "distance", "dist", "Abstand", "d", "value", "Raw_Range", "meas")
UNITS = {"": 1.0, "_m": 1.0, " [mm]": 1000.0, "_cm": 100.0, "?mm": 1000.0, "?cm": 100.0}
FAMILIES = (
    "Distance {}",
    "r_AN{}",
    "A{}",
    "dist_to_anchor_{}",
    "anchor{}_range",
    "d{}",
    "UWB{}",
    "to_{}",
    "ch{}",
    "B{}r",
)


def mutated_long(rng, path):
    unit, time, first, other, name = (rng.choice(list(names)) for names in (UNITS, TIMES, FROM, TO, RANGES))
    header = name + ("" if unit.startswith("?") else unit)
    columns = {"t_s": time, "tag": first, "anchor": other, "range_m": header}
    rows = []
    for row in long_rows():
        row["t_s"] *= 1000.0 if time.endswith("_ms") else 1.0
        row["range_m"] = round(row["range_m"] * UNITS[unit], 4)
        rows.append({columns.get(key, key): value for key, value in row.items()})
    if rng.random() < 0.5:
        rows = [{key: value for key, value in row.items() if key != "gt_m"} for row in rows]
    for extra in rng.sample(["temp", "battery", "rssi", "count", "quality", "x", "error"], rng.randint(0, 3)):
        rows = [row | {extra: -80 - k % 9 if extra == "rssi" else k % 7} for k, row in enumerate(rows)]
    return written(rng, path, rows, header)


def mutated_wide(rng, path):
    unit, name = rng.choice(list(UNITS)), rng.choice(FAMILIES)
    name = name + ("" if unit.startswith("?") else unit)
    return written(rng, path, wide_rows(name, UNITS[unit]), name.format(rng.randrange(4)))


def mutated_stamps(rng, path):
    names = dict(zip(HEADER, rng.choice(STAMPED), strict=True))
    scale = 1e9 / TICKS_PER_SECOND if "ns" in names["tx1"] else 1
    rows = [
        {names[key]: value * scale if key in HEADER[3:9] else value for key, value in row.items()}
        for row in wrapped(flights(120, third=rng.choice(["target", "initiator"])))
    ]
    if rng.random() < 0.3:
        one, two = rng.sample([names[key] for key in HEADER[3:9]], 2)
        rows = [row | {one: row[two], two: row[one]} for row in rows]
    return written(rng, path, rows, names["fpp1"])


POLL = ("poll_tx", "poll_rx", "resp_tx", "resp_rx", "final_tx", "final_rx")
STAMPED = (
    tuple(HEADER),
    ("time", "src", "dst", *POLL, "fp_power_1", "fp_power_2"),
    ("t_s", "initiator", "target", *(f"T{n} [ns]" for n in range(1, 7)), "fpp1", "fpp2"),
    ("t_s", "from", "to", *(f"t{n}" for n in range(1, 7)), "rssi_1", "rssi_2"),
)


def written(rng, path, rows, value):
    """Write rows with changes that any table may have; `value` is a column that may have gaps."""
    if rng.random() < 0.3:
        order = rng.sample(list(rows[0]), len(rows[0]))
        rows = [{key: row[key] for key in order} for row in rows]
    if rng.random() < 0.2:
        missing = rng.choice([-1, 0, 65535, "", "nan", "---", -1.0])
        rows = [row | {value: missing} if rng.random() < 0.1 else row for row in rows]
    if rng.random() < 0.15:
        rows = rng.sample(rows, len(rows))
    if rng.random() < 0.15:
        gone = rng.choice(list(rows[0]))
        rows = [{key: cell for key, cell in row.items() if key != gone} for row in rows]
    if rng.random() < 0.15:
        rows = [*rows, dict.fromkeys(rows[0], "") | {next(iter(rows[0])): "mean", value: 3.3}]
    mark, comma = rng.choice([",", ";", "\t"]), rng.random() < 0.2
    text = (lambda v: str(v).replace(".", ",")) if comma and mark != "," else str
    return write(path.with_suffix(".csv"), rows, mark, text, header=rng.random() > 0.1)


def mutated_log(rng, path):
    of = rng.choice([lec, les, at_range, with_ids, with_powers, trek, None])
    if of is None:
        return prints(path.parent)
    noise = rng.sample(["", "dwm> ", "OK", "[boot] v1.2", b"\xff\x00\xfe", "POS,1,2,3,4"], rng.randint(0, 3))
    before = rng.choice(
        [lambda _: "", lambda some: f"{some[0].time_s} ", lambda some: f"2024-05-06 07:08:{some[0].time_s:09.6f} > "]
    )
    cut = rng.random() < 0.3

    def line(some):
        whole = before(some) + of(some)
        return whole[: rng.randrange(len(whole) // 2)] if cut and rng.random() < 0.05 else whole

    return lines(path.with_suffix(".log"), line, noise)


def mutated_json(rng, path):
    name, each = rng.choice(["ranges", "dis_arr", "distances"]), rng.choice(["receptions", "rx", "links"])
    inner = {"a": rng.choice(["anchor", "to", "A", "id"]), "r": rng.choice(["range", "range_m", "R", "distance"])}
    arrays = rng.random() < 0.5
    rows = [
        {"t_s": some[0].time_s, "tag": 7}
        | (
            {name: [r.range_m for r in some]}
            if arrays
            else {each: [{inner["a"]: r.anchor, inner["r"]: r.range_m} for r in some]}
        )
        for some in ROUNDS
    ]
    path = path.with_suffix(".jsonl")
    path.write_text("\n".join(map(json.dumps, rows)) + "\n")
    return path


KNOWN = {(r.anchor, r.range_m) for some in ROUNDS for r in some}
HEXADECIMAL = {"1A2B": 0, "0C0D": 1, "9280": 2, "5431": 3}


def wrong(found, of_stamps):
    """Return the difference of a recording from the planted values; empty if there is none."""
    e, named = found.exchanges, found.meta.get("tag_names", {})
    if of_stamps:
        planted_pairs = {(1, 2), (2, 3), (3, 1)}
        pairs = set(zip(e.initiator.tolist(), e.target.tolist(), strict=True))
        truths = np.array([row["truth"] for row in flights(120)])
        apart = np.abs(e.range_m[:, None] - truths[None, :]).min(axis=1)
        return [] if pairs <= planted_pairs and np.median(apart) < 0.05 else ["pairs or ranges"]
    targets = [named.get(str(n), str(n)) for n in e.target.tolist()]
    numbers = [HEXADECIMAL.get(n, int(n) if n.isdigit() else -1) for n in targets]
    initiators = {named.get(str(n), str(n)) for n in e.initiator.tolist()}
    got = {(a, round(m, 3)) for a, m in zip(numbers, e.range_m.tolist(), strict=True)}
    said = [] if initiators == {"7"} else [f"initiators {sorted(initiators)}"]
    # AT+RANGE has millimetres as decimals of centimetres, so every planted range is exact to a millimetre.
    near = {(a, round(m + d, 3)) for a, m in KNOWN for d in (-0.001, 0, 0.001)}
    said += [] if got <= near else [f"ranges {sorted(got - near)[:5]}"]
    said += [] if e.time_ns.max() < 2e18 and np.ptp(e.time_ns) < 11e9 else [f"times {e.time_ns[:3]}"]
    return said


MAKERS = (mutated_long, mutated_long, mutated_wide, mutated_wide, mutated_stamps, mutated_log, mutated_json)


@pytest.mark.parametrize("seeds", [range(10), pytest.param(range(10, 200), marks=pytest.mark.slow)], ids=str)
def test_no_mutated_file_is_imported_wrongly(tmp_path, seeds):
    outcomes = {"asked": 0, "refused": 0, "right": 0}
    for k in seeds:
        rng = random.Random(k)
        maker = rng.choice(MAKERS)
        folder = tmp_path / str(k)
        folder.mkdir()
        path = maker(rng, folder / "in")
        try:
            guess = guess_map(path)
            if guess.asked or not guess.complete:
                outcomes["asked"] += 1
                continue
            (folder / "map.toml").write_text(guess.text)
            found = read_source(path, importer="csv", map_file=folder / "map.toml")
        except ImportTableError:
            outcomes["refused"] += 1
            continue
        assert not wrong(found, maker is mutated_stamps), (k, path.read_bytes()[:300], guess.text)
        outcomes["right"] += 1
    # Most of these files are understood.
    assert outcomes["right"] >= len(seeds) // 4, outcomes
