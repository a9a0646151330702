"""Correlation of maps: known answers, error rates and power of surrogates on smooth maps."""

from functools import cache

import numpy as np
import pytest
from grids import grid_triangles
from scipy import stats
from scipy.ndimage import gaussian_filter

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.agreement.correlation import correlate_maps
from hipsta_bids.types import Mesh

NODES, SIZE = (21, 13), np.array([20.0, 25.0])  # mm
STEP = SIZE / (np.array(NODES) - 1)


@cache
def sheet():
    """A sheet bent as a part of a tube, without stretching."""
    x, y = (np.arange(n) * step for n, step in zip(NODES, STEP, strict=True))
    x, y = np.repeat(x, NODES[1]), np.tile(y, NODES[0])
    radius = 7.0
    points = np.column_stack([radius * np.sin(x / radius), y, radius * np.cos(x / radius)])
    return Mesh(points=points, triangles=grid_triangles(*NODES))


def smooth(random, fwhm, count):
    """Stationary fields (count, points): a part of a larger field, so that edges are no limits."""
    sd = fwhm / np.sqrt(8 * np.log(2)) / STEP
    border = np.ceil(4 * sd).astype(int)
    noise = random.standard_normal((count, *(np.array(NODES) + 2 * border)))
    fields = gaussian_filter(noise, (0, *sd), mode="wrap")
    inner = fields[:, border[0] : -border[0], border[1] : -border[1]]
    return inner.reshape(count, -1)


def test_correlations_are_those_of_scipy():
    first, second = smooth(np.random.default_rng(1), 5.0, 2)
    first[:15], second[40] = np.nan, np.nan
    found = correlate_maps(first, second, sheet(), 100, 0)
    present = np.isfinite(first) & np.isfinite(second)
    assert found["n"] == present.sum() == 273 - 16
    maps = first[present], second[present]
    assert found["pearson"] == pytest.approx(stats.pearsonr(*maps).statistic, rel=1e-9)
    assert found["spearman"] == pytest.approx(stats.spearmanr(*maps).statistic, rel=1e-9)
    assert found == correlate_maps(first, second, sheet(), 100, 0)
    # Shift, scale and sign of a map change no p.
    moved = correlate_maps(3 - 2 * first, second, sheet(), 100, 0)
    assert moved["pearson"] == pytest.approx(-found["pearson"])
    assert moved["pearson_p"] == found["pearson_p"]


def test_smoothness_is_that_of_the_fields():
    for fwhm in (4.0, 6.0):
        maps = smooth(np.random.default_rng(2), fwhm, 60)
        found = [
            correlate_maps(a, b, sheet(), 2, 0) for a, b in zip(maps[::2], maps[1::2], strict=True)
        ]
        width = np.mean([(one["fwhm_first"], one["fwhm_second"]) for one in found])
        # Maps of a few widths vary by less than the field, and steps are of 1 and 2 mm.
        assert width == pytest.approx(fwhm, rel=0.15)


@pytest.mark.parametrize(
    "fwhm",
    [pytest.param(4.0, marks=pytest.mark.long), 8.0, pytest.param(15.0, marks=pytest.mark.long)],
)
def test_independent_maps_seldom_correlate(fwhm):
    """With independent points assumed, half of all pairs have p < 0.05; with surrogates, 5 %."""
    maps = smooth(np.random.default_rng(int(fwhm)), fwhm, 600)
    pairs = list(zip(maps[::2], maps[1::2], strict=True))
    naive = np.mean([stats.pearsonr(*pair).pvalue < 0.05 for pair in pairs])
    found = [correlate_maps(*pair, sheet(), 100, seed) for seed, pair in enumerate(pairs)]
    assert naive > 0.4
    for name in ("pearson_p", "spearman_p"):
        size = np.mean([one[name] <= 0.05 for one in found])
        # Binomial SD .0126; three of them.
        assert 0.012 <= size <= 0.088, name


@pytest.mark.long
def test_maps_with_gaps_keep_the_error_rate():
    random = np.random.default_rng(5)
    maps = smooth(random, 6.0, 600)
    maps[:, random.random(maps.shape[1]) < 0.1] = np.nan
    maps[:, :26] = np.nan
    pairs = zip(maps[::2], maps[1::2], strict=True)
    found = [correlate_maps(*pair, sheet(), 100, seed) for seed, pair in enumerate(pairs)]
    size = np.mean([one["pearson_p"] <= 0.05 for one in found])
    assert 0.012 <= size <= 0.088  # three binomial SDs


def test_a_common_pattern_is_found():
    maps = smooth(np.random.default_rng(6), 4.0, 120)
    unit = (maps - maps.mean(axis=1, keepdims=True)) / maps.std(axis=1, keepdims=True)
    found = [
        correlate_maps(a, 0.7 * a + np.sqrt(0.51) * b, sheet(), 200, 0)["pearson_p"] <= 0.05
        for a, b in zip(unit[::2], unit[1::2], strict=True)
    ]
    assert np.mean(found) > 0.9


@pytest.mark.parametrize(
    ("maps", "said"),
    [
        ((np.zeros(273), np.arange(273.0)), "one value everywhere"),
        ((np.arange(273.0), np.arange(200.0)), "maps of 273 and 200 points"),
        ((np.where(np.arange(273) < 20, np.arange(273.0), np.nan), np.arange(273.0)), "20 points"),
        ((np.where(np.arange(273) % 2, np.arange(273.0), np.nan), np.arange(273.0)), "adjoining"),
    ],
)
def test_maps_that_cannot_be_correlated_are_refused(maps, said):
    with pytest.raises(ModelError, match=said):
        correlate_maps(*maps, sheet(), 100, 0)
