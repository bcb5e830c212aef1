"""Panels leave room for what they are labelled with, and no more; many alike share what they can."""

import json
import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from uwblink.pages.figures import drawn, label, legend, sheet, style
from uwblink.pages.figures_alike import dots, many_alike
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


def alike(count=5, x=(0.0, 240.0), y=(-20.0, 80.0)):
    return many_alike(7.16, [f"panel {k}" for k in range(count)], 3, height_in=1.0, x=x, y=y)


def as_axes(count, x, y):
    """The same panels as matplotlib's axes, numbers at all of them."""
    figure = alike(count, x, y)
    other = Figure(figsize=figure.get_size_inches())
    for panel in figure.panels:
        (left, right), (low, high) = panel.across, panel.up
        axes = other.add_axes((left, low, right - left, high - low))
        axes.set(xlim=x, ylim=y)
    other.draw_without_rendering()
    return other


def numbers(figure):
    return [text for text in figure.texts if "panel" not in text.get_text()]


def written(figure, side):
    """The numbers of one side, by how they are aligned."""
    aligned = "center" if side == "x" else "right"
    return [text for text in numbers(figure) if text.get_ha() == aligned]


def test_panels_alike_have_numbers_at_the_edges_alone():
    with style():
        figure = alike()
    below = [text.get_text() for text in written(figure, "x")]
    assert below == 3 * [f"{v}" for v in (0, 50, 100, 150, 200)], "the third has none below it, so they are its own"
    assert [text.get_text() for text in written(figure, "y")] == 2 * ["0", "50"]
    # Those of the third are higher than those of the others by a row.
    heights = [text.get_position()[1] for text in written(figure, "x")]
    assert heights[0] == heights[4] == figure.panels[2].up[0]
    assert heights[5] == heights[14] == figure.panels[3].up[0] < heights[0]


@pytest.mark.parametrize(
    ("x", "y"), [((0.0, 240.0), (-20.0, 80.0)), ((-0.3, 6.3), (-1.3, 0.4)), ((-1500.0, 31500.0), (-3.2e3, 9e3))]
)
def test_panels_alike_look_as_matplotlib_draws_them(x, y):
    with style():
        ours, theirs = alike(6, x, y), as_axes(6, x, y)
        renderer = RendererAgg(1, 1, ours.dpi)
        edges = {"x": theirs.axes[3].xaxis, "y": theirs.axes[0].yaxis}
        for side, axis in edges.items():
            wanted = [text for text in axis.get_ticklabels() if text.get_window_extent(renderer).width]
            low, high = axis.get_view_interval()
            wanted = [text for text in wanted if low <= text.get_position()["xy".index(side)] <= high]
            found = written(ours, side)[: len(wanted)]
            assert [text.get_text() for text in found] == [text.get_text() for text in wanted]
            for text, other in zip(found, wanted, strict=True):
                np.testing.assert_allclose(
                    text.get_window_extent(renderer).extents, other.get_window_extent(renderer).extents, atol=0.5
                )
                assert text.get_size() == other.get_size()
                assert text.get_color() == other.get_color()


def test_points_are_where_their_panel_shows_them():
    figure, other = alike(), as_axes(5, (0.0, 240.0), (-20.0, 80.0))
    x, y = np.array([0.0, 100.0, 240.0, 100.0, -1.0]), np.array([-20.0, 3.0, 80.0, 81.0, 0.0])
    for panel, axes in zip(figure.panels, other.axes, strict=True):
        pixels = axes.transData.transform(np.column_stack([x, y]))
        wanted = other.transFigure.inverted().transform(pixels)
        found = panel.on_figure(x, y)
        np.testing.assert_allclose(found[:3], wanted[:3], atol=1e-12)
        assert np.isnan(found[3:]).all(), "outside its panel nothing is drawn"


def test_the_grid_of_panels_alike_lies_on_their_ticks():
    with style():
        figure = alike(6)
    grid = next(one for one in figure.artists if one.get_zorder() == -2)
    lines = np.column_stack(grid.get_data()).reshape(-1, 3, 2)
    assert np.isnan(lines[:, 2]).all(), "lines are apart"
    wanted = figure.panels[4].on_figure(np.array([100.0, 100.0]), np.array([-20.0, 80.0]))
    assert any(np.allclose(line[:2], wanted) for line in lines)
    assert len(lines) == 6 * (5 + 2)


def test_a_page_is_told_where_panels_alike_are():
    panels = json.loads(re.search(r"<dc:description>(.*?)</dc:description>", svg_of(alike(2)))[1])
    assert [panel["x"] for panel in panels] == 2 * [[0.0, 240.0]]
    assert [panel["y"] for panel in panels] == 2 * [[-20.0, 80.0]]
    first, second = (panel["box"] for panel in panels)
    assert first[0] < first[2] < second[0] < second[2] < 72 * 7.16
    assert first[1] == second[1] < first[3] == second[3] < 72 * 1.6
    assert panels[0]["names"] == ["time (s)", ""]


def svg_of(figure):
    figure.supxlabel("time (s)")
    return drawn(lambda _: figure, 7.16, ["svg"])["svg"].decode()


def test_a_cloud_is_a_dot_a_point_in_few_strokes():
    rng = np.random.default_rng(3)
    places = rng.uniform(0.1, 0.9, (500, 2))
    places[::10] = np.nan
    with style():
        figure = Figure(figsize=(5.0, 2.0))
        dots(figure, places, size_pt=1.65, color="#0072b2", alpha=0.6)
    text = svg_of(figure)
    cloud = re.findall(r'<path d="((?:M [\d.]+ [\d.]+ \nL [\d.]+ [\d.]+ \n)+)"', text)
    found = np.array([[float(v) for v in pair] for part in cloud for pair in re.findall(r"M ([\d.]+) ([\d.]+)", part)])
    wanted = places[np.isfinite(places[:, 0])] * [360, 144]
    wanted[:, 1] = 144 - wanted[:, 1]
    assert len(cloud) <= 8
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(wanted, axis=0), atol=0.0051)
    assert text.count("stroke-linecap: round") >= len(cloud)


def test_a_dot_is_as_large_and_dark_as_matplotlibs_marker():
    with style():
        figures = [Figure(figsize=(1.0, 1.0), dpi=400) for _ in range(2)]
        dots(figures[0], np.array([[0.5, 0.5]]), size_pt=1.65, color="#0072b2", alpha=0.64)
        figures[1].add_artist(
            Line2D([0.5], [0.5], ls="", marker=".", ms=1.3, color="#0072b2", alpha=0.6,
                   transform=figures[1].transFigure))  # fmt: skip
        ink = []
        for figure in figures:
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            ink.append(np.asarray(canvas.buffer_rgba())[..., 3].astype(float))
    # A marker's face and rim lie upon each other in its middle, which is darker there.
    assert ink[0].max() == round(255 * 0.64)
    assert ink[0].sum() == pytest.approx(ink[1].sum(), rel=0.02)
    assert np.count_nonzero(ink[0]) == pytest.approx(np.count_nonzero(ink[1]), rel=0.1)


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
