"""Stated orders of boards: exchanged labels are named, correct ones are not, and ambiguous ones are stated."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.standing import standing_boards
from benchmarks.surveys import orders_of
from calib.surveys.solution import exchanged_boards, is_in_order

pytestmark = pytest.mark.slow

FIVE = standing_boards(4, boards=5, arrangements=5, reflected=0.05, each=20)


def said_with(world, exchange=None):
    """Return the known facts: the line, and the true orders except for exchanged labels (arrangement, one, other)."""
    orders = orders_of(world, None)[0]
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
    assert right.contradictions == ()
    found = calib.survey(FIVE.ranges, known=turned)
    assert found.calibration.delays_ns == pytest.approx(right.calibration.delays_ns, abs=1e-3)


def test_exchanged_labels_are_named_and_ranges_determine_the_order(right):
    order = orders_of(FIVE, None)[0]["3"]
    pair = f"{min(order[:2])} and {max(order[:2])}"
    # Labels that are exchanged in all arrangements are one mistake.
    for wrong, text in (
        ([("3", *order[:2])], f"3: boards {pair} are exchanged: the stated order"),
        ([(str(k), 2, 5) for k in range(1, 6)], "1, 2, 3, 4, 5: boards 2 and 5 "),
    ):
        found = calib.survey(FIVE.ranges, known=said_with(FIVE, wrong), regardless=True)
        assert [one.fault for one in found.contradictions] == ["exchanged labels"]
        assert found.contradictions[0].evidence.startswith(text)
        # Boards are 0.8 m apart, and their positions are known to centimetres.
        chance = found.contradictions[0].p_value
        assert chance is not None
        assert chance < 1e-12
        assert found.calibration.delays_ns == pytest.approx(right.calibration.delays_ns, abs=1e-3)


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
