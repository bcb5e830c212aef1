"""How long errors last: series with known autocorrelation."""

import numpy as np
import pytest

from calib.estimator.time_blocks import TimeBlocks, persistence, time_blocks


def blocks(count, seconds):
    return TimeBlocks(number=np.arange(count), bounds=np.array([0, count]), seconds=seconds)


def walk(keep, share, rng, blocks=800, columns=4):
    """Noise of which a share remembers itself, with the factor that it puts on the variance of a mean."""
    memory = np.zeros((blocks, columns))
    memory[0] = rng.normal(size=columns)
    for k in range(1, blocks):
        memory[k] = keep * memory[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=columns)
    series = np.sqrt(share) * memory + np.sqrt(1 - share) * rng.normal(size=(blocks, columns))
    return series - series.mean(axis=0), 1 + 2 * share * keep / (1 - keep)


@pytest.mark.parametrize(("keep", "share"), [(0.0, 0.0), (0.5, 1.0), (0.9, 0.5), (0.95, 1.0)])
def test_the_factor_is_that_of_the_autocorrelation(keep, share):
    rng = np.random.default_rng(1)
    found, planted = [], 1.0
    for _ in range(20):
        series, planted = walk(keep, share, rng)
        found.append(persistence(series, blocks(800, 240.0), 4).factor)
    # Twenty draws know a factor of 40 to a tenth; where hardly twenty stretches are left it is rather too large.
    assert 0.85 * planted < np.exp(np.mean(np.log(found))) < 1.4 * planted


def test_a_short_recording_has_few_degrees_of_freedom():
    rng = np.random.default_rng(2)
    few = persistence(walk(0.95, 1.0, rng, blocks=120)[0], blocks(120, 12.0), 3)
    many = persistence(walk(0.6, 1.0, rng, blocks=1000)[0], blocks(1000, 100.0), 3)
    assert few.freedom < many.freedom
    assert few.quantile95 > many.quantile95 > 1.95
    assert few.stretches < 20 < many.stretches


def test_blocks_are_short_and_leave_gaps_out():
    time = np.concatenate([np.arange(0, 10, 0.01), np.arange(1000, 1010, 0.01)]) * 1e9
    found = time_blocks(time.astype(np.int64), np.zeros(len(time), dtype=np.int32))
    assert set(np.diff(found.number).tolist()) <= {0, 1}
    assert found.number[999] < found.number[1000]
    assert found.seconds == pytest.approx(19.98)
    # Blocks of a tenth of a second, however long the gap is.
    assert 199 <= found.count <= 202
