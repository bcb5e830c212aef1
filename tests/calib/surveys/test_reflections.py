"""Reflected pairs: the search compared with explicit likelihoods, and planted reflections."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.special import betaln, ndtr

import calib
from benchmarks import standing, surveys
from calib.surveys.network import Case
from calib.surveys.recordings import read_surveys
from calib.surveys.reflections import Marks
from calib.surveys.solution import exchanged_boards, first_start, is_in_order
from calib.surveys.survey import network_of
from tests.calib.synthetic import largest_score

pytestmark = pytest.mark.slow

PAIR_M, CURVE_M = 0.02, 0.03


@pytest.fixture(scope="module")
def linear():
    """Return marks of three arrangements on a line, none set, and a function for the explicit likelihood of marks."""
    world = standing.standing_boards(11, boards=4, arrangements=3, reflected=0.12)
    knowledge = calib.Knowledge(shape="line")
    network = network_of(read_surveys(world.ranges, knowledge), knowledge, {}, curve=False)
    x, free, rows = first_start(network), network.layout.free(), len(network.means.range_m)
    left, jacobian = network.linear(x)
    prior, slopes = network.priors(CURVE_M).precision()[np.ix_(free, free)], jacobian[:, free]
    spread, seen = slopes @ np.linalg.inv(prior) @ slopes.T, left + slopes @ (x - network.layout.start())[free]

    def deviance(hit):
        own, count = network.means.std_m**2 + PAIR_M**2 + 0.25**2 * hit, hit.sum()
        share = betaln(1 + count, 30 + rows - count) - betaln(1, 30)
        covariance, away = np.diag(own) + spread, seen - 0.3 * hit
        back = np.linalg.inv(covariance)
        # No detour is shorter than the direct path, except for a gross error in a hundred.
        detour, std = 0.3 + 0.25**2 * (back @ away)[hit], np.sqrt(0.25**2 - 0.25**4 * np.diag(back)[hit])
        longer = np.log((ndtr(detour / std) + 0.01) / (ndtr(0.3 / 0.25) + 0.01)).sum()
        return np.linalg.slogdet(covariance)[1] + away @ np.linalg.solve(covariance, away) - 2 * share - 2 * longer

    return Marks.at(network, x, Case(np.zeros(rows, dtype=bool), PAIR_M, CURVE_M)), deviance


def test_the_search_and_the_weights_are_those_of_the_likelihood_written_out(linear):
    none, deviance = linear
    marks = none.search()
    assert marks.any()
    here = deviance(marks)
    # No change of two rows is more likely.
    for rows in [*combinations(range(len(marks)), 1), *combinations(range(len(marks)), 2)]:
        other = marks.copy()
        other[list(rows)] ^= True
        assert deviance(other) > here - 1e-3
    found, weight = none.window()
    assert len(weight) > 3
    value = np.array([deviance(marks) for marks in found])
    expected = np.exp(-0.5 * (value - value.min()))
    # The explicit covariance has numbers from 1e-4 to 1e6.
    assert weight == pytest.approx(expected / expected.sum(), rel=5e-3)


def reflected(world, arrangement, first, second, longer_m):
    """Return what one pair of an arrangement of a world is longer, for each range."""
    r = world.ranges
    there = (r.time_ns >= 70e9 * arrangement) & (r.time_ns < 70e9 * (arrangement + 1) - 5e9)
    hit = there & np.isin(r.initiator, (first, second)) & np.isin(r.target, (first, second))
    assert hit.sum() == 60
    return longer_m * hit


def test_planted_reflections_are_named_and_delays_are_as_good_as_without():
    world = standing.standing_boards(21, boards=5, arrangements=7)
    planted = {(0, 1, 3): 0.35, (2, 2, 5): 0.2, (3, 1, 4): 0.5, (3, 2, 3): 0.25, (6, 4, 5): 0.3}
    longer = sum(reflected(world, *where, much) for where, much in planted.items())
    result = calib.survey(replace(world.ranges, raw_m=world.ranges.raw_m + longer), known="line")
    clean = calib.survey(world.ranges, known="line")
    likely = [one for one in result.reflected if one.chance > 0.5]
    assert {(int(one.arrangement) - 1, one.first, one.second): one.longer_m for one in likely} == pytest.approx(
        planted, abs=0.12
    )
    assert result.contradictions == ()
    assert [one.fault for one in result.findings].count("reflections of a pair") >= len(planted)
    assert max((one.chance for one in clean.reflected), default=0) <= 0.5
    for tag, delay in world.delays_ns.items():
        (found, std), (other, other_std) = (
            (one.calibration.delays_ns[tag], one.calibration.delays_std_ns[tag]) for one in (result, clean)
        )
        # 5 of 70 rows have no weight: intervals are slightly wider, and errors equal.
        assert abs(found - delay) / 3 < std < 1.5 * other_std
        assert abs(found - other) < 0.08
    assert len(result.calibration.provenance["reflected"]) == len(result.reflected)


def test_reflections_do_not_shorten_ranges():
    """Two ranges 40 cm too short explain these as well as reflections do, with one delay 1.4 ns off."""
    world = standing.standing_boards(1034, boards=5, arrangements=8, reflected=0.1)
    found = calib.survey(world.ranges, known="line")
    assert all(one.longer_m > -0.1 for one in found.reflected)
    assert largest_score(found, world.delays_ns) < 3


def test_ambiguous_reflections_are_stated_and_widen_intervals():
    world = standing.standing_boards(5, boards=3, arrangements=6, pair_error_m=0.01)
    longer = reflected(world, 1, 1, 2, 0.4)
    result = calib.survey(replace(world.ranges, raw_m=world.ranges.raw_m + longer), known="line")
    # For three boards on a line, any of the three ranges may be the wrong one, too long or too short.
    assert len([(one.first, one.second) for one in result.reflected if one.arrangement == "2"]) > 1
    assert any(text.startswith("may also be reflected: ") for text in result.warnings)
    clean = calib.survey(world.ranges, known="line").calibration
    for tag, delay in result.calibration.delays_ns.items():
        least = max(abs(delay - world.delays_ns[tag]) / 3, clean.delays_std_ns[tag])
        assert result.calibration.delays_std_ns[tag] > least


# Stated orders of boards: exchanged labels are named, correct ones are not, and ambiguous ones are stated.


FIVE = standing.standing_boards(4, boards=5, arrangements=5, reflected=0.05, each=20)


def said_with(world, exchange=None):
    """Return the known facts: the line, and the true orders except for exchanged labels (arrangement, one, other)."""
    orders = surveys.orders_of(world, None)[0]
    for name, one, other in exchange or ():
        swap = {one: other, other: one}
        orders[name] = tuple(swap.get(tag, tag) for tag in orders[name])
    return calib.Knowledge(shape="line", orders=orders)


@pytest.fixture(scope="module")
def right():
    """The survey with the correct orders."""
    return calib.survey(FIVE.ranges, known=said_with(FIVE))


def test_correct_orders_from_either_end_have_no_finding(right):
    known = said_with(FIVE)
    turned = replace(known, orders={name: order[::-1] for name, order in known.orders.items()})
    found = calib.survey(FIVE.ranges, known=turned)
    assert right.contradictions == found.contradictions == ()
    assert found.calibration.delays_ns == pytest.approx(right.calibration.delays_ns, abs=1e-3)


def test_exchanged_labels_are_named_and_ranges_determine_the_order(right):
    order = surveys.orders_of(FIVE, None)[0]["3"]
    pair = f"{min(order[:2])} and {max(order[:2])}"
    # Labels that are exchanged in all arrangements are one mistake.
    for wrong, text in (
        ([("3", *order[:2])], f"3: boards {pair} are exchanged: the stated order"),
        ([(str(k), 2, 5) for k in range(1, 6)], "1, 2, 3, 4, 5: boards 2 and 5 "),
    ):
        result = calib.survey(FIVE.ranges, known=said_with(FIVE, wrong), regardless=True)
        (found,) = result.contradictions
        assert found.fault == "exchanged labels"
        assert found.evidence.startswith(text)
        # Boards are 0.8 m apart, and their positions are known to centimetres.
        assert found.p_value == pytest.approx(0, abs=1e-12)
        assert result.calibration.delays_ns == pytest.approx(right.calibration.delays_ns, abs=1e-3)


def test_an_exchange_that_is_another_one_from_the_other_end_names_both():
    places = np.array([0.0, 1.0, 2.0, 3.0])
    assert exchanged_boards((1, 3, 2, 4), places) == set()
    assert exchanged_boards((1, 3, 2, 4), places[[0, 2, 1, 3]]) == {(2, 3), (1, 4)}
    assert exchanged_boards((1, 3, 2, 4), places[[1, 0, 2, 3]]) == {(1, 3)}
    # Boards nearer than 10 cm may have either order.
    ways = ([0.0, 1.0, 0.95, 2.0], [2.0, 0.95, 1.0, 0.0], [0.0, 1.0, 0.85, 2.0])
    assert [is_in_order(np.array(coordinates)) for coordinates in ways] == [True, True, False]


@pytest.mark.parametrize("orders", [{"1": (1, 2, 9)}, {"1": (1, 2, 2)}, {"Z": (1, 2)}])
def test_orders_of_boards_that_are_not_there_are_refused(orders):
    with pytest.raises(calib.BadInputError, match=r"order of boards|an unknown arrangement"):
        calib.survey(FIVE.ranges, known=calib.Knowledge(shape="line", orders=orders))
