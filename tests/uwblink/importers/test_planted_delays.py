"""Tables as people have them, written by a world of their own here, fitted to the delays planted in them."""

import csv
import gzip
import io

import numpy as np
import pytest

import calib
from uwblink.importers import import_recording
from uwblink.recording.contents import load

TICKS_A_NS = 128 * 0.4992
AIR_M_A_NS = 0.299702547
DELAYS_NS = {4: 0.31, 7: -0.22, 9: -0.05}
SKEWS = {4: 2.1e-6, 7: -3.4e-6, 9: 0.6e-6}
SIGMA_M = 0.02
# 600 exchanges a pair: 0.02 m / sqrt(600) is 0.003 ns; the split between tags makes it about 0.005 ns.
TOLERANCE_NS = 0.025
STAMPS = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


def world(count=1800, seed=11):
    """Double-sided exchanges as stamps in nanoseconds of clocks that never wrap, with the distances they were over.

    A tag's delay is in the stamps of what it receives: what it takes off there makes its ranges too long by half.
    """
    random = np.random.default_rng(seed)
    tags, rows, now_ns = sorted(DELAYS_NS), [], 5e9
    for k in range(count):
        one, two = [(4, 7), (7, 9), (9, 4)][k % 3]
        now_ns += 1e7
        distance = random.uniform(1, 6)
        flight = distance / AIR_M_A_NS
        noise = random.normal(0, 2 * SIGMA_M / AIR_M_A_NS / np.sqrt(1.5), 2)
        reply, last = random.uniform(3e5, 6e5), random.uniform(1.2e6, 1.4e6)
        at_one = {"tx1": now_ns, "rx2": now_ns + 2 * flight + reply + noise[0]}
        at_two = {"rx1": now_ns + flight, "tx2": now_ns + flight + reply, "tx3": now_ns + flight + reply + last}
        at_one["rx3"] = now_ns + 2 * flight + reply + last
        stamps = {}
        for tag, taken in ((one, at_one), (two, at_two)):
            for name, true_ns in taken.items():
                clock = true_ns * (1 + SKEWS[tag]) + 1e12 * tags.index(tag)
                stamps[name] = clock - (DELAYS_NS[tag] if name.startswith("rx") else 0.0)
        power = random.uniform(-95, -80, 2)
        rows.append(
            {
                "time_s": now_ns * 1e-9, "from_id": one, "to_id": two, **{n: float(stamps[n]) for n in STAMPS},
                "fpp1": float(power[0]), "fpp2": float(power[1]), "gt_range_m": distance,
            }
        )  # fmt: skip
    return rows


def counted(value_ns, bits):
    return round(value_ns * TICKS_A_NS) % 2**bits


def table(rows, delimiter=","):
    text = io.StringIO()
    writer = csv.writer(text, delimiter=delimiter)
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer.writerow(names)
    writer.writerows([[row.get(name, "") for name in names] for row in rows])
    return text.getvalue()


def of_40_bits(rows):
    return table([{**r, **{n: counted(r[n], 40) for n in STAMPS}} for r in rows]), ""


def decimal_comma(rows):
    mine = [
        {n: str(v).replace(".", ",") for n, v in (r | {s: counted(r[s], 32) for s in STAMPS}).items()} for r in rows
    ]
    return table(mine, ";"), ""


def unwrapped_ns(rows):
    return table([{n: repr(v) if isinstance(v, float) else v for n, v in r.items()} for r in rows]), (
        '[units]\nstamps = "ns"\n'
    )


def corrupt(rows):
    """One row in 14 broken in one of five ways: 130 of 1800."""
    lines = table([{**r, **{n: counted(r[n], 32) for n in STAMPS}} for r in rows]).splitlines()
    random = np.random.default_rng(2)
    for k in 1 + random.choice(len(rows), 130, replace=False):
        cells = lines[k].split(",")
        match k % 5:
            case 0:
                cells = cells[:5]
            case 1:
                cells[3 + k % 6] = "garbage"
            case 2:
                cells[3 + k % 6] = str(2**45 + k)
            case 3:
                cells[1] = cells[2]
            case 4:
                cells += ["1", "2"]
        lines[k] = ",".join(cells)
    return "\n".join(lines) + "\n", ""


def messages_of(row, k):
    ends = ((row["from_id"], row["to_id"]), (row["to_id"], row["from_id"]), (row["to_id"], row["from_id"]))
    for n, (sender, receiver) in enumerate(ends, start=1):
        common = {
            "time_s": row["time_s"] + n * 1e-4,
            "seq": k % 256,
            "from_id": sender,
            "to_id": receiver,
            "message": n,
        }
        yield common, {"tx": counted(row[f"tx{n}"], 32), "rx": counted(row[f"rx{n}"], 32)}, row.get(f"fpp{n}", "")


def a_row_a_message(rows):
    found = [c | s | {"fpp": p, "truth": r["gt_range_m"]} for k, r in enumerate(rows) for c, s, p in messages_of(r, k)]
    np.random.default_rng(3).shuffle(found)
    return table(found), 'within_s = 0.005\n[columns]\nsequence = "seq"\ngt_range_m = "truth"\n'


def a_row_a_stamp(rows):
    """As two devices log it, each its own stamps, one log after the other; two stamps got lost."""
    found = []
    for k, row in enumerate(rows):
        for common, stamps, power in messages_of(row, k):
            found.append(common | {"what": "TX", "stamp": stamps["tx"], "truth": row["gt_range_m"]})
            found.append(common | {"what": "RX", "stamp": stamps["rx"], "fpp": power, "truth": row["gt_range_m"]})
    del found[100], found[2000]
    found.sort(key=lambda line: line["from_id" if line["what"] == "TX" else "to_id"])
    return table(found), (
        'layout = "stamps"\nwithin_s = 0.005\n[columns]\nsequence = "seq"\nevent = "what"\ngt_range_m = "truth"\n'
    )


FORMS = {
    "40 bits": (of_40_bits, 0),
    "decimal comma": (decimal_comma, 0),
    "unwrapped ns": (unwrapped_ns, 0),
    "corrupt rows": (corrupt, 130),
    "a row a message": (a_row_a_message, 0),
    "a row a stamp": (a_row_a_stamp, 2),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_is_fitted_to_the_delays_planted_in_it(tmp_path, form):
    write, unusable = FORMS[form]
    rows = world()
    text, how = write(rows)
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(text.encode(), 1))
    (tmp_path / "map.toml").write_text(how)
    count = import_recording(tmp_path / "t.csv.gz", tmp_path / "t.uwb", map_file=tmp_path / "map.toml")
    assert count == len(rows) - unusable
    assert load(tmp_path / "t.uwb").exchanges.bits == (40 if form == "40 bits" else 32)
    found = calib.fit(tmp_path / "t.uwb").calibration.delays_ns
    assert found == pytest.approx(DELAYS_NS, abs=TOLERANCE_NS)
