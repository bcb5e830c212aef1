"""Colours for all eyes: how far apart they are, seen with and without all cones, and how they stand out."""

import itertools
import re

import numpy as np
import pytest

from uwblink.pages.blocks import CSS
from uwblink.pages.colours import DARK, GRID, INK, MUTED, PALE, SERIES, look

# Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
EYES = {
    "all": np.eye(3),
    "no long cones": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no middle cones": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no short cones": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.119192, 0.9503041]]
)


def linear(colour):
    part = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    t = TO_XYZ @ np.clip(rgb, 0, 1) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(one, two):
    (l1, a1, b1), (l2, a2, b2) = one, two
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360
    turn = (h2 - h1 + 180) % 360 - 180
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    h, lightness, c = (h1 + turn / 2) % 360, (l1 + l2) / 2, (c1 + c2) / 2
    t = (
        1 - 0.17 * np.cos(np.radians(h - 30)) + 0.24 * np.cos(np.radians(2 * h))
        + 0.32 * np.cos(np.radians(3 * h + 6)) - 0.2 * np.cos(np.radians(4 * h - 63))
    )  # fmt: skip
    sl = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    sc, sh = 1 + 0.045 * c, 1 + 0.015 * c * t
    rt = -np.sin(np.radians(60 * np.exp(-(((h - 275) / 25) ** 2)))) * 2 * np.sqrt(c**7 / (c**7 + 25**7))
    return np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rt * dc / sc * dh / sh)


GROUND = {"light": "#ffffff", "dark": "#16181b"}


def contrast(one, two):
    """WCAG 2.2, relative luminance."""
    bright, dim = sorted((float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, two)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize(
    ("one", "two", "apart"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_measure_is_the_published_one(one, two, apart):
    # Sharma, Wu and Dalal 2005, pairs 1, 17 and 34.
    assert ciede2000(one, two) == pytest.approx(apart, abs=1e-4)


@pytest.mark.parametrize("eyes", list(EYES))
@pytest.mark.parametrize("ground", ["light", "dark"])
def test_colours_of_a_kind_are_told_apart(eyes, ground):
    shown = [colour if ground == "light" else DARK[colour] for colour in SERIES]
    seen = [lab(EYES[eyes] @ linear(colour)) for colour in shown]
    apart = {(a, b): ciede2000(seen[a], seen[b]) for a, b in itertools.combinations(range(len(seen)), 2)}
    assert min(apart.values()) >= 15, apart


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_lines_and_words_of_figures_stand_out(ground):
    def shown(colour):
        return colour if ground == "light" else DARK[colour]

    for colour in SERIES:
        assert contrast(shown(colour), GROUND[ground]) >= 3
    for colour in (INK, MUTED):
        assert contrast(shown(colour), GROUND[ground]) >= 4.5
    # What must not stand out still shows.
    assert contrast(shown(GRID), GROUND[ground]) >= 1.3
    assert contrast(shown(PALE), GROUND[ground]) >= 1.8


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_words_of_pages_stand_out(ground):
    light, dark = CSS[: CSS.index("* {")].split("@media screen and (prefers-color-scheme: dark)")
    colours = dict(re.findall(r"(--[a-z-]+):\s*(#[0-9a-f]{3,6})", light if ground == "light" else dark))
    full = {name: c if len(c) == 7 else "#" + "".join(2 * x for x in c[1:]) for name, c in colours.items()}
    assert full["--page"] == GROUND[ground]
    for word in ("--ink", "--quiet", "--link"):
        for under in ("--page", "--soft", "--good", "--doubt", "--bad"):
            assert contrast(full[word], full[under]) >= 4.5, (word, under)


def test_many_are_told_apart_by_more_than_colour():
    found = [look(k) for k in range(40)]
    assert len({(one.colour, one.marker, str(one.dashes)) for one in found}) == 40
    assert len({(one.marker, str(one.dashes)) for one in found[:12]}) == 12, "without any colour"
