"""Tags that read powers unlike the others: found by what differs between the ends of a link, and what it does said."""

import re
from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.checks import limits
from calib.checks.limits import power_levels_db, unlike_powers
from tests.calib.synthetic import DELAYS_NS, ranges

SENT_DB, READ_DB = {2: -3.0}, {3: 2.0}
NOBODY: dict[int, float] = {}


def world(sent=NOBODY, read=NOBODY, noise_db=0.0, **more):
    """Errors follow the powers that arrive; what is recorded is what tags read of them."""
    rng = np.random.default_rng(3)
    r = ranges(**({"n": 6000} | more))
    # One way there and back: both powers lose the same.
    r = replace(r, fpp2_dbm=r.fpp1_dbm, raw_m=r.raw_m + bent(r.fpp1_dbm) - lifted_bent(r))

    def gain(table, tags):
        return np.array([table.get(tag, 0.0) for tag in range(8)])[tags]

    fpp1 = r.fpp1_dbm + gain(sent, r.initiator) + gain(read, r.target) + noise_db * rng.normal(size=len(r))
    fpp2 = r.fpp2_dbm + gain(sent, r.target) + gain(read, r.initiator) + noise_db * rng.normal(size=len(r))
    return replace(r, fpp1_dbm=fpp1, fpp2_dbm=fpp2)


def bent(power_dbm):
    """A curve of 12 mm a decibel."""
    return -0.012 * (power_dbm + 87)


def lifted_bent(r):
    from tests.calib.synthetic import bias_m

    return bias_m(np.mean(10 ** ((np.stack([r.fpp1_dbm, r.fpp2_dbm]) + 82) / 10), axis=0))


def test_levels_are_exact_without_noise_and_as_near_as_they_say_with_it():
    exact, noisy = (power_levels_db(world(SENT_DB, READ_DB, noise_db=noise)) for noise in (0.0, 1.0))
    # What a tag sends more weakly looks like what it reads higher.
    for tag, expected in {1: 0, 2: 3, 3: 2, 7: 0}.items():
        assert exact[tag][0] == pytest.approx(expected, abs=1e-9)
        level, std = noisy[tag]
        assert 0.005 < std < 0.05
        assert level == pytest.approx(expected, abs=5 * std)


def test_ranges_without_powers_have_no_levels():
    r = world()
    bare = replace(r, fpp2_dbm=np.full(len(r), np.nan))
    assert power_levels_db(bare) == {}
    assert not [*unlike_powers(bare, calib.fit(r).calibration)]


def test_a_tag_that_reads_too_high_is_named_with_what_its_delay_holds():
    result = calib.fit(world(read=READ_DB, noise_db=0.3, tail=0.0, noise_m=0.02))
    (said,) = [warning for warning in result.warnings if "stand apart" in warning]
    assert said.startswith("powers of tag 3 (+2.0 dB) stand apart")
    held_ps = float(re.search(r"up to (\d+) ps", said)[1])
    away = np.array([result.calibration.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()])
    # A shift common to all is the curve's constant, so the others are the reference; a fifth for how the curve bends.
    of_three = abs(away[2] - np.mean(np.delete(away, 2)))
    assert 1e3 * of_three == pytest.approx(held_ps, rel=0.2)
    assert held_ps > 50


def test_tags_alike_are_not_named(monkeypatch):
    sure = calib.fit(world(noise_db=1.0, tail=0.0, noise_m=0.02))
    assert not [warning for warning in sure.warnings if "stand apart" in warning]
    # A curve so flat that nothing of it would matter is not what these are to show.
    monkeypatch.setattr(limits, "SMALLEST_NS", 0.0)
    surest = replace(sure.calibration, delays_std_ns=dict.fromkeys(DELAYS_NS, 1e-4))
    for seed in range(12):
        # Levels that differ by chance, by as much as would matter to delays that are known so well.
        few = world(noise_db=4.0, n=240, seed=seed)
        assert not [*unlike_powers(few, surest)]
    # Surely apart, and no more than boards of a kind are.
    near = world(read={3: 0.45}, noise_db=0.1)
    assert not [*unlike_powers(near, surest)]
    assert [*unlike_powers(world(read={3: 0.7}, noise_db=0.1), surest)]
