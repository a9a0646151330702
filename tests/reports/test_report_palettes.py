"""Color maps can be read with each common form of color blindness.

Simulation as in Machado et al. 2009 (https://doi.org/10.1109/TVCG.2009.113), severity 1, of linear
RGB; lightness L* and differences of colors (CIEDE2000) by scikit-image.
"""

from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from skimage.color import deltaE_ciede2000, rgb2lab

from hipsta_bids.reports import display

MATRICES = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
SEQUENTIAL = ("viridis", "viridis_r", "magma", "Reds", "Oranges", display.DESIGN_COLORS)
DIVERGING = (display.EFFECT_COLORS, display.P_COLORS, display.kind_of("any", change=True).colors)
#: L* of 256 8-bit colors is not smooth: colors of one step differ by up to this much in rounding.
ROUNDING = 0.3
#: CIEDE2000 above which colors differ at a glance; 1 is just noticeable. Red and green of one size
#: stay below it in deuteranopia.
DIFFERENT = 10.0
SIZES = (32, 64, 96, 127)


def seen(name, vision):
    """L*a*b* of a color map as it is seen."""
    colors = colormaps[name](np.arange(256))[:, :3]
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ MATRICES[vision].T, 0, 1)
    encoded = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return rgb2lab(encoded)


def test_rows_of_the_matrices_keep_gray():
    for matrix in MATRICES.values():
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=2e-6)  # six digits


@pytest.mark.parametrize("vision", MATRICES)
@pytest.mark.parametrize("name", SEQUENTIAL)
def test_lightness_orders_the_colors_of_amounts(name, vision):
    lightness = seen(name, vision)[:, 0]
    steps = np.diff(lightness) * np.sign(lightness[-1] - lightness[0])
    assert steps.min() > -ROUNDING
    assert abs(lightness[-1] - lightness[0]) > 60  # of 100


@pytest.mark.parametrize("vision", MATRICES)
@pytest.mark.parametrize("name", DIVERGING)
def test_signs_differ_and_lightness_orders_each(name, vision):
    colors = seen(name, vision)
    lightness = colors[:, 0]
    top = int(np.argmax(lightness))
    assert top == pytest.approx(127.5, abs=8)  # zero is the lightest, within 3 % of the map
    assert np.diff(lightness[:top]).min() > -ROUNDING
    assert np.diff(lightness[top:]).max() < ROUNDING
    # Values of one size and either sign, from a quarter of the range on.
    for size in SIZES:
        low, high = colors[127 - size], colors[128 + size]
        assert deltaE_ciede2000(low, high) > DIFFERENT, size


def test_the_check_finds_a_palette_of_red_and_green():
    colors = seen("RdYlGn", "deuteranopia")
    for size in SIZES:
        assert deltaE_ciede2000(colors[127 - size], colors[128 + size]) < DIFFERENT
    assert np.diff(seen("jet", "normal")[:, 0]).min() < -ROUNDING


def test_no_figure_uses_another_color_map():
    """Names of color maps in the code are those that are tested here."""
    names = set(colormaps) - {"gray", "flag", "prism", "cool", "hot", "pink", "copper", "bone"}
    root = display.__file__.rpartition("/reports/")[0]
    text = "\n".join(path.read_text("utf-8") for path in Path(root).rglob("*.py"))
    used = {name for name in names if f'"{name}"' in text}
    assert used <= {*SEQUENTIAL, *DIVERGING}
    assert used >= {"viridis", "magma"}
