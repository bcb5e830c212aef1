"""Tables of exchanges: values, units, maps, and the first real input."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from tests.shared_data import shared
from uwblink.importers import import_recording
from uwblink.recording.file import Recording
from uwblink.ticks import TICKS_PER_SECOND
from uwblink.twr import raw_range

ROOT = Path(__file__).parents[3]
DS = "time_s,from_id,to_id,tx1,rx1,tx2,rx2,tx3,rx3,fpp1,fpp2,skew1,skew2,gt_range_m\n"
ROW = "0.5,1,2,2334148660,1211574983,1233803316,2356378373,1332123700,2454699099,-87.4977,-87.5239,-3.4971,3.5222,3.0\n"


def imported(tmp_path, text, map_file=None, name="t.csv"):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
    import_recording(path, tmp_path / "o.uwb", map_file=map_file)
    with Recording.open(tmp_path / "o.uwb") as recording:
        return recording.exchanges()


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz"])
def test_default_names_and_every_value(tmp_path, name):
    e = imported(tmp_path, DS + ROW, name=name)
    assert (e.time_ns[0], e.initiator[0], e.target[0], e.protocol[0]) == (500_000_000, 1, 2, "ds")
    assert (e.tx1[0], e.rx3[0]) == (2334148660, 2454699099)
    assert (e.fpp1_dbm[0], e.skew2_ppm[0], e.truth_m[0]) == (-87.4977, 3.5222, 3.0)
    assert e.range_m[0] == pytest.approx(3.0550, abs=1e-4)


def test_columns_in_nanoseconds_by_a_map(tmp_path):
    scale = 1e9 / TICKS_PER_SECOND
    ticks = (1000, 5000, 9000, 13200)
    text = "when,a,b,c,d\n7," + ",".join(f"{t * scale:.9f}" for t in ticks) + "\n"
    (tmp_path / "m.toml").write_text(
        "bits = 40\n[columns]\ntime_s = 'when'\ntx1 = 'a'\nrx1 = 'b'\ntx2 = 'c'\nrx2 = 'd'\n"
        "[units]\nstamps = 'ns'\ntime = 'ms'\n[constants]\nfrom_id = 3\nto_id = 4\n"
    )
    e = imported(tmp_path, text, tmp_path / "m.toml")
    assert [int(getattr(e, n)[0]) for n in ("tx1", "rx1", "tx2", "rx2")] == list(ticks)
    assert (e.bits, e.time_ns[0], e.initiator[0], e.protocol[0]) == (40, 7_000_000, 3, "ss")


def test_pose_columns_become_the_true_distance(tmp_path):
    header = "time_s,from_id,to_id,tx1,rx1,tx2,rx2," + ",".join(
        f"{end}_{axis}_m" for end in ("from", "to") for axis in "xyz"
    )
    e = imported(tmp_path, header + "\n0,1,2,100,200,300,500,0,0,0,3,4,0\n")
    assert e.truth_m[0] == pytest.approx(5.0)


def test_hanyang_comes_in_whole_and_makes_sense(tmp_path):
    source = shared("hanyang_sstwr.csv.gz")
    count = import_recording(source, tmp_path / "h.uwb", map_file=ROOT / "docs" / "maps" / "hanyang.toml")
    assert count == 9876
    with Recording.open(tmp_path / "h.uwb") as recording:
        e = recording.exchanges()
    assert set(e.protocol) == {"ss"}
    assert np.nanmin(e.truth_m) == 2.0
    assert np.nanmax(e.truth_m) == 60.0
    # Uncorrected for skew, the ranges are off by metres, but all by about the same.
    error = raw_range(e) - e.truth_m
    assert np.median(np.abs(error - np.median(error))) < 2.0
