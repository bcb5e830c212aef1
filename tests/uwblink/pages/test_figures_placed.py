"""Panels leave room for what they are labelled with, and no more; many alike share what they can."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure

from uwblink.pages.figures import drawn, label, legend, sheet, style
from uwblink.pages.figures_alike import many_alike, on_figure, share_axes
from uwblink.pages.figures_placed import PAD_IN


def filled(figure, panels, reach, texts):
    """Panels over a reach, a legend of some lines, and an axis above each; ticks of small ones have more digits."""
    for axes in panels:
        for k in range(texts):
            axes.plot([0, reach], [-reach, reach], label=f"line {k} of a long name")
        label(axes, "lifted power", "bias (cm)")
        axes.secondary_xaxis("top").set_xlabel("first-path power")
    legend(figure)
    return figure


def boxes(figure):
    renderer = RendererAgg(1, 1, figure.dpi)
    return [axes.get_tightbbox(renderer, for_layout_only=True) for axes in figure.axes], figure.bbox


@pytest.mark.parametrize(("width_in", "count"), [(3.5, 1), (7.16, 1), (3.5, 2), (7.16, 2), (7.16, 3)])
@pytest.mark.parametrize("reach", [1.4, 13.0, 1e5])
def test_labels_are_on_the_figure_and_none_is_over_another(width_in, count, reach):
    with style():
        figure, panels = sheet(width_in, count, height_in=2.2)
        filled(figure, panels, reach, 7).draw_without_rendering()
        found, page = boxes(figure)
        above = figure.legends[0].get_window_extent()
    # Half a pixel, of 100 an inch. Of the pad, 4 of them, numbers that stand out at the right may take a half.
    for k, box in enumerate(found):
        assert box.x0 >= page.x0 - 0.5
        assert box.y0 >= page.y0 - 0.5
        assert box.x1 <= page.x1 + 0.5
        assert box.y1 <= above.y0 + 0.5
        assert all(box.x1 <= other.x0 or box.x0 >= other.x1 or box.y0 >= other.y1 or box.y1 <= other.y0
                   for other in found[:k])  # fmt: skip
    assert min(box.x0 for box in found) == pytest.approx(100 * PAD_IN, abs=0.5), "no room is left over"
    assert max(box.x1 for box in found) == pytest.approx(page.x1 - 100 * PAD_IN, abs=2)


def test_panels_are_where_matplotlib_places_them():
    with style():
        figure, panels = sheet(7.16, 2)
        filled(figure, panels, 3.0, 3).draw_without_rendering()
        other = Figure(figsize=(7.16, figure.get_figheight()), layout="constrained")
        filled(other, list(other.subplots(1, 2)), 3.0, 3).draw_without_rendering()
    for ours, theirs in zip(figure.axes, other.axes, strict=True):
        np.testing.assert_allclose(ours.get_position().bounds, theirs.get_position().bounds, atol=0.004)


def test_bars_of_colours_have_their_room():
    with style():
        figure, (left, right) = sheet(7.16, 2)
        for axes in (left, right):
            label(axes, "x", "y")
        figure.colorbar(left.imshow([[0.0, 1000.0]], aspect="auto"), ax=left, label="seconds")
        figure.draw_without_rendering()
        found, page = boxes(figure)
        bar = found[2]
    assert found[0].x1 <= bar.x0
    assert bar.x1 <= found[1].x0
    assert page.x0 <= found[0].x0
    assert found[1].x1 <= page.x1


def alike(count=5):
    figure, panels = many_alike(7.16, [f"panel {k}" for k in range(count)], 3, height_in=1.0)
    share_axes(figure, panels, 3, (0.0, 240.0), (-20.0, 80.0))
    return figure, panels


def test_panels_alike_have_numbers_at_the_edges_alone():
    with style():
        figure, panels = alike()
        figure.draw_without_rendering()
        below = [[text.get_text() for text in panel.get_xticklabels()] for panel in panels]
        left = [[text.get_text() for text in panel.get_yticklabels()] for panel in panels]
    # The third has none below it, so the numbers of its column are its own.
    assert [bool(texts) for texts in below] == [False, False, True, True, True]
    assert [bool(texts) for texts in left] == [True, False, False, True, False]
    assert below[2] == below[3] == [f"{v}" for v in (0, 50, 100, 150, 200)]


def test_points_are_where_their_panel_shows_them():
    figure, panels = alike()
    x, y = np.array([0.0, 100.0, 240.0, 100.0, -1.0]), np.array([-20.0, 3.0, 80.0, 81.0, 0.0])
    for panel in panels:
        pixels = panel.transData.transform(np.column_stack([x, y]))
        wanted = figure.transFigure.inverted().transform(pixels)
        found = on_figure(panel, x, y)
        np.testing.assert_allclose(found[:3], wanted[:3], atol=1e-12)
        assert np.isnan(found[3:]).all(), "outside its panel nothing is drawn"


def test_the_grid_of_panels_alike_lies_on_their_ticks():
    figure, panels = alike(6)
    lines = next(one for one in figure.artists if one.get_zorder() == -2).get_segments()
    wanted = on_figure(panels[4], np.array([100.0, 100.0]), np.array([-20.0, 80.0]))
    assert any(np.allclose(line, wanted) for line in lines)


def test_garbage_is_collected_after_a_drawing_as_before():
    import gc

    def draw(width_in):
        assert not gc.isenabled()
        return sheet(width_in / share)[0]

    share = 1
    assert gc.isenabled()
    drawn(draw, 3.5, ["svg"])
    assert gc.isenabled()
    share = 0
    with pytest.raises(ZeroDivisionError):
        drawn(draw, 3.5, ["svg"])
    assert gc.isenabled()
