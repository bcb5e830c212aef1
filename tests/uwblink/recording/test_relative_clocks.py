"""Clock skews of planted clocks, by stamps and by carriers."""

import numpy as np
import pytest

from uwblink.recording.summary import clock_skews, skew_summary
from uwblink.twr import Exchanges

TICKS = 128 * 499.2e6
SKEW_PPM = {1: 0.0, 2: 6.0, 3: -2.5}


def exchanges(protocol, sign=1.0, carriers=True, warmer_ppm=0.0):
    """Ranges of 3 m both ways in every pair; a stamp is its true time by its own clock."""
    pairs = np.array([(1, 2), (2, 1), (1, 3), (3, 1), (2, 3), (3, 2)] * 20)
    first, second = pairs.T
    begin = 1e-3 * np.arange(len(pairs))
    fast = np.array([0.0] + [SKEW_PPM[tag] + warmer_ppm * (tag == 3) for tag in (1, 2, 3)])

    def stamp(tag, after):
        return np.rint((begin + after) * (1 + fast[tag] * 1e-6) * TICKS).astype(np.int64)

    t2, t3 = 1e-8, 3e-4
    t4 = t3 + 1e-8
    columns = {"tx1": stamp(first, 0), "rx1": stamp(second, t2), "tx2": stamp(second, t3), "rx2": stamp(first, t4)}
    sender, receiver = (second, first) if protocol == "ds" else (first, second)
    t5 = 2e-3
    columns |= {"tx3": stamp(sender, t5), "rx3": stamp(receiver, t5 + 1e-8)}
    columns = {name: values % 2**32 for name, values in columns.items()}
    relative = fast[second] - fast[first]
    skews = {"skew1_ppm": sign * relative, "skew2_ppm": -sign * relative} if carriers else {}
    return Exchanges.from_arrays(first, second, **columns, **skews, protocol=np.full(len(pairs), protocol))


@pytest.mark.parametrize("protocol", ["ds", "ds-alt"])
def test_both_see_what_was_planted(protocol):
    found = {one.pair: one for one in clock_skews(exchanges(protocol))}
    assert sorted(found) == ["1-2", "1-3", "2-3"]
    for pair, planted in {"1-2": 6.0, "1-3": -2.5, "2-3": -8.5}.items():
        # A tick in two milliseconds is 0.008 ppm.
        assert found[pair].stamps_ppm == pytest.approx(planted, abs=0.01)
        assert found[pair].carrier_ppm == pytest.approx(planted, abs=1e-9)
        assert found[pair].slope == pytest.approx(1, abs=0.01)
        assert found[pair].residual_ppm == pytest.approx(0, abs=1e-9)
        assert found[pair].same_sign is True
    assert skew_summary(list(found.values())) == "carriers over stamps 1.000, residual 0.00 ppm, same sign"


def test_the_other_sign_is_said():
    found = clock_skews(exchanges("ds", sign=-1.0))
    assert [one.same_sign for one in found] == [False] * 3
    assert "OTHER SIGN in 3 of 3 pairs" in skew_summary(found)
    assert "OTHER SIGN" in str(found[0])


def test_nothing_is_said_of_carriers_that_were_not_read():
    (first, *_) = clock_skews(exchanges("ds", carriers=False))
    assert (first.carrier_ppm, first.slope, first.same_sign) == (None, None, None)
    assert str(first) == "pair 1-2: +6.00 ppm by the stamps, drift +0.00, carriers not read"


def test_a_clock_that_drifts_is_told_by_its_pairs():
    drifts = [one.drift_ppm for one in clock_skews([exchanges("ds"), exchanges("ds", warmer_ppm=1.5)])]
    assert drifts == pytest.approx([0.0, 1.5, 1.5], abs=0.01)


def test_single_sided_exchanges_have_none():
    e = exchanges("ds")
    columns = {name: getattr(e, name) for name in ("tx1", "rx1", "tx2", "rx2")}
    assert clock_skews(Exchanges.from_arrays(e.initiator, e.target, **columns)) == []
