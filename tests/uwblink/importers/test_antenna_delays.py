"""Stamps of devices with and without antenna delays in them, and of protocols that need more than stamps."""

import numpy as np
import pytest

from tests.uwblink.importers.test_table_forms import AIR, HEADER, TICKS, flights, mapped, read_table, wrapped, write
from uwblink.errors import ImportTableError
from uwblink.importers.guess import guess_map

PROGRAMMED = 16_436
"""Ticks of each direction, as the boards have them; a device without them stamps its transmissions so much earlier."""


def undelayed(rows, tags=(1, 2, 3), delay=PROGRAMMED):
    """The same exchanges as devices stamp them into which nothing was programmed: sent early, received late."""
    found = []
    for row in rows:
        ends = {"i": row["from_id"] in tags, "t": row["to_id"] in tags}
        late = {"tx1": -ends["i"], "rx2": ends["i"], "rx3": ends["i"], "rx1": ends["t"], "tx2": -ends["t"]}
        late["tx3"] = -ends["t"]
        found.append(row | {name: row[name] + sign * delay for name, sign in late.items()})
    return found


def table(tmp_path, rows):
    truths = [{"gt_range_m": row["truth"]} for row in rows]
    return write(tmp_path / "t.csv", [row | truth for row, truth in zip(wrapped(rows), truths, strict=True)])


ZEROS = "[antenna_delays]\ntx = 0\nrx = 0\n"


@pytest.mark.parametrize("said", ["", ZEROS, "protocol = 'ds'\nbits = 32\n" + ZEROS])
def test_devices_without_antenna_delays_are_read_beside_true_distances(tmp_path, said):
    rows = undelayed(flights())
    found = read_table(table(tmp_path, rows), mapped(tmp_path, said))
    assert set(found.exchanges.protocol) == {"ds"}
    assert found.meta["configured_antenna_delay_ticks"] == {"tx": 0, "rx": 0}
    longer = found.exchanges.range_m - found.exchanges.truth_m
    assert longer == pytest.approx(2 * PROGRAMMED * AIR / TICKS, abs=1e-6)
    assert len(found.meta["notes"]) == (not said)


def test_a_guess_says_that_nothing_was_programmed(tmp_path):
    path = table(tmp_path, undelayed(flights()))
    mapped(tmp_path, guess_map(path).text)
    assert read_table(path, tmp_path / "map.toml").meta["configured_antenna_delay_ticks"] == {"tx": 0, "rx": 0}
    found = read_table(path, mapped(tmp_path, guess_map(table(tmp_path, flights())).text))
    assert found.meta["configured_antenna_delay_ticks"] == {"tx": PROGRAMMED, "rx": PROGRAMMED}


def test_one_device_without_antenna_delays(tmp_path):
    """Ranges to it are 77 m longer, which the map explains."""
    path = table(tmp_path, undelayed(flights(), tags=(2,)))
    said = f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n[antenna_delays.tags.2]\ntx = 0\nrx = 0\n"
    found = read_table(path, mapped(tmp_path, said))
    assert set(found.exchanges.protocol) == {"ds"}
    assert not found.meta["notes"]
    assert found.meta["configured_antenna_delay_ticks_by_tag"] == {"2": {"tx": 0, "rx": 0}}


def test_what_a_map_says_of_antenna_delays_is_not_overruled(tmp_path):
    path = table(tmp_path, undelayed(flights()))
    with pytest.raises(ImportTableError, match="antenna_delays"):
        read_table(path, mapped(tmp_path, f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n"))


def test_single_sided_ranges_with_the_carriers_skew(tmp_path):
    """Clocks 20 ppm apart, of which the skew tells; replies of 3 ms make 9 m of it."""
    table, reply = [], round(3e-3 * TICKS)
    for row, skew in zip(flights(), np.random.default_rng(0).normal(20, 1, 60), strict=True):
        # The initiator's clock counts the reply longer by the skew, which is that of the target's clock beside it.
        there_and_back = 2 * round(row["truth"] / AIR * TICKS)
        late = {"tx2": row["rx1"] + reply, "rx2": row["tx1"] + there_and_back + round(reply * (1 + skew * 1e-6))}
        short = {name: (row | late)[name] % 2**32 for name in HEADER[3:7]}
        ends = {name: row[name] for name in HEADER[:3]}
        table.append({**ends, **short, "skew2": skew, "gt_range_m": row["truth"]})
    path = write(tmp_path / "t.csv", table)
    found = read_table(path, mapped(tmp_path, 'protocol = "ss-cfo"\n')).exchanges
    assert set(found.protocol) == {"ss-cfo"}
    assert found.range_m == pytest.approx(found.truth_m, abs=0.01)
