"""Pairs of tags, the delays that they determine, and the number of ranges from which a group has a curve."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import yaml

import calib
from calib.cli.calibrating import delay_lines
from calib.estimator.range_model import MIN_RANGES_OF_GROUP as FEWEST
from tests.calib.synthetic import DELAYS_NS, bias_m, ranges
from uwblink.ticks import SPEED_OF_LIGHT


@pytest.mark.parametrize(
    ("pairs", "splits"),
    [
        ([(1, 2)], (((1,), (2,)),)),
        ([(1, 2), (1, 3), (1, 7)], (((1,), (2, 3, 7)),)),
        ([(1, 3), (1, 7), (2, 3), (2, 7)], (((1, 2), (3, 7)),)),
        ([(1, 2), (3, 7)], (((1,), (2,)), ((3,), (7,)))),
        ([(1, 2), (1, 3), (2, 3), (3, 7)], ()),
    ],
)
def test_sides_that_pairs_leave_undetermined_are_named(pairs, splits):
    found = calib.fit(among(ranges(1200), pairs))
    assert found.calibration.undetermined_splits == splits
    assert ("only ranges between" in " ".join(found.warnings[:1])) == bool(splits)
    split = [tag for sides in splits for tags in sides for tag in tags]
    assert [tag for tag, std in found.calibration.delays_std_ns.items() if np.isinf(std)] == sorted(split)


def test_ranges_between_two_sides_are_corrected_and_others_refused_by_name():
    everything, judged = ranges(8000, noise_m=0.03), ranges(6000, noise_m=0.03, seed=2)
    known = calib.fit(among(everything, ACROSS)).calibration
    # By the definition of synthetic ranges: half of both delays, and the curve at the reference power.
    for pair, one in known.pair_constants.items():
        planted = bias_m(1.0) - 0.5e-9 * SPEED_OF_LIGHT * sum(DELAYS_NS[tag] for tag in pair)
        assert abs(one.offset_m - planted) < 3 * one.std_m < 0.02
    across = among(judged, ACROSS)
    found = calib.evaluate(across, known).overall
    assert abs(found.full.median_m) < 0.01
    assert found.inside_95 == pytest.approx(0.95, abs=0.04)
    said = r"ranges of 1-2, 3-7: only ranges between tags 1, 2 and tags 3, 7 are"
    with pytest.warns(calib.errors.LeftOutWarning, match=said) as caught:
        left = calib.evaluate(judged, known)
    assert f"{len(judged) - len(across)} of {len(judged)} ranges are left out" in str(caught[0].message)
    assert left.overall == found

    assert "pair     1-3  ranges" in "\n".join(delay_lines(known))
    yaml_text = yaml.safe_load(calib.export(known, "ros-yaml"))["uwb_calibration"]
    assert yaml_text["undetermined_splits"] == [[[1, 2], [3, 7]]]
    assert "tx_antenna_delay" not in str(yaml_text["tags"])
    for use, words in (
        (lambda: known.apply(judged), said),
        (lambda: calib.evaluate(among(judged, [(1, 2)]), known), "ranges of 1-2: "),
        (lambda: calib.export(known, "registers"), "`to`: the data do not determine the delay of tag 1, 2, 3, 7"),
    ):
        with pytest.raises(calib.BadInputError, match=words):
            use()


@pytest.mark.parametrize("pairs", [[(1, 2)], [(1, 3), (1, 7), (2, 3), (2, 7)]], ids=["a pair", "sides"])
def test_curves_fitted_after_delays_leave_the_same_sides_undetermined(pairs):
    some = among(ranges(4000, noise_m=0.03), pairs)
    together, after = (calib.fit(some, sequential=sequential).calibration for sequential in (False, True))
    assert after.undetermined_splits == together.undetermined_splits
    apart = after.apply(some).corrected_m - together.apply(some).corrected_m
    assert np.sqrt(np.mean(apart**2)) < 0.005


def test_calibrations_of_two_sides_are_compared_by_what_they_determine():
    """A fit to all pairs determines each delay, one to pairs between two sides only their sums."""
    whole = calib.fit(ranges(8000)).calibration
    part = calib.fit(among(ranges(8000, seed=2), ACROSS)).calibration
    found = calib.compare(whole, part)
    # Four delays minus a common shift and the split.
    assert (found.same, found.degrees) == (True, 2)
    assert not calib.compare(whole, replace(part, delays_ns=part.delays_ns | {3: part.delays_ns[3] + 0.4})).same
    shifted = {1: 0.5, 2: 0.5, 3: -0.5, 7: -0.5}
    split = replace(part, delays_ns={tag: delay + shifted[tag] for tag, delay in part.delays_ns.items()})
    assert calib.compare(whole, split).chi_square == pytest.approx(found.chi_square, abs=1e-6)
    # Of a single pair, only the ranges can be compared.
    alone = calib.fit(among(ranges(3000), [(1, 2)])).calibration
    pair = calib.compare(whole, alone)
    assert (pair.verdict, pair.degrees, abs(pair.offset_m) < 0.02) == ("unknown", 0, True)
    # With the smallest delays, both get the same share of the sum (K is one to a part in 10^5).
    assert alone.delays_ns[1] == pytest.approx(alone.delays_ns[2], abs=1e-5)
    assert '"1": null' in alone.to_json()


def test_a_tag_joins_the_side_opposite_to_its_partners():
    r = ranges(9000)
    known = calib.fit(among(r, [(1, 3), (2, 3)])).calibration
    added = calib.add_tag(among(r, [(1, 7), (2, 7)]), known, 7).calibration
    assert added.undetermined_splits == (((1, 2), (3, 7)),)
    assert np.isinf(added.delays_std_ns[7])
    found, whole = (one.pair_constants for one in (added, calib.fit(among(r, ACROSS)).calibration))
    assert {pair: found[pair].offset_m for pair in whole} == pytest.approx(
        {pair: one.offset_m for pair, one in whole.items()}, abs=0.005
    )
    with pytest.raises(calib.UnanswerableError, match="tag 7 ranges with tags of several sides of the calibration"):
        calib.add_tag(r, known, 7)
    with pytest.raises(calib.BadInputError, match="`delays_from`: only ranges between tags 1, 2 and tag 3"):
        calib.fit(r, delays_from=known)


ACROSS = [(1, 3), (1, 7), (2, 3), (2, 7)]


def among(r, pairs):
    """Return the ranges of some pairs."""
    return r[[pair in pairs for pair in zip(r.initiator, r.target, strict=True)]]


@pytest.mark.parametrize("loss", ["mixture", "cauchy"])
def test_delays_of_bipartite_pairs_are_the_smallest(loss):
    """Variable clock skews, as on real boards, must not determine the free direction, to a hundred nanoseconds."""
    r = among(ranges(8000), ACROSS)
    skew = np.random.default_rng(2).normal(0, 1e-6, len(r))
    delays = calib.fit(replace(r, weight_target=0.5 * (1 + skew)), loss=loss).calibration.delays_ns
    assert delays[1] + delays[2] == pytest.approx(delays[3] + delays[7], abs=0.01)


@pytest.mark.parametrize("count", [FEWEST - 1, FEWEST])
def test_a_group_has_a_curve_from_the_fewest_ranges_on(count):
    r = ranges(3000)
    rare = (r.initiator != 7) & (r.target != 7)
    rare[np.flatnonzero(~rare)[:count]] = True
    enough = nullcontext() if count == FEWEST else pytest.raises(calib.UnanswerableError, match="group 'b'")
    with enough:
        found = calib.fit(r[rare], groups={"a": (1, 2, 3), "b": (7,)}, loss="cauchy").calibration
        assert set(found.groups) == {"a", "b"}
