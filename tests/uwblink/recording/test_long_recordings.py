"""A recording that is read some rows at a time says what it says as a whole, wherever the pieces begin and end."""

from typing import Any

import numpy as np
import pytest

from uwblink import Contents, Exchanges, Recording
from uwblink.recording.summary import clock_skews

COUNT = 700


def exchanges(seed):
    """Double-sided exchanges of three boards, 5 ms apart, whose clocks run by different rates."""
    rng = np.random.default_rng(seed)
    pairs = np.array([(1, 2), (2, 1), (1, 3), (3, 2)])[rng.integers(0, 4, COUNT)]
    start = rng.integers(0, 2**32, COUNT)
    third = 98_000_000 + (300 * pairs[:, 1]).astype(np.int64)
    stamps = {"tx1": start, "rx1": start + 500, "tx2": start + 20_000_500, "rx2": start + 20_001_000}
    stamps |= {"tx3": start + 20_000_500 + third, "rx3": start + 20_001_000 + 98_000_000}
    told: dict[str, Any] = {name: stamp % 2**32 for name, stamp in stamps.items()}
    return Exchanges.from_arrays(
        *pairs.T,
        time_ns=np.sort(rng.integers(0, COUNT * 5_000_000, COUNT)),
        skew1_ppm=rng.normal(3, 0.1, COUNT),
        skew2_ppm=rng.normal(-3, 0.1, COUNT),
        **told,
    )


@pytest.fixture
def written(tmp_path):
    def write(x, **more):
        Contents(exchanges=x, **more).save(tmp_path / "r.uwb", force=True)
        return tmp_path / "r.uwb"

    return write


@pytest.mark.parametrize("rows", [37, 699, 700, 5000])
def test_blocks_of_any_size_are_all_exchanges_in_their_order(written, rows):
    whole = exchanges(1)
    with Recording.open(written(whole)) as recording:
        parts = list(recording.exchange_blocks(rows))
    assert max(map(len, parts)) <= rows
    for name, column in whole.to_dict().items():
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), column)


def test_clocks_of_pairs_are_the_same_from_blocks(written):
    whole = exchanges(4)
    with Recording.open(written(whole)) as recording:
        assert clock_skews(recording.exchange_blocks(33)) == clock_skews(whole)


def test_a_recording_without_exchanges_has_no_stretches(tmp_path):
    with Recording.create(tmp_path / "empty.uwb") as recording:
        assert recording.dividing_times("exchanges", 50) == []
    with Recording.open(tmp_path / "empty.uwb") as recording:
        assert recording.show().span_s == 0.0
