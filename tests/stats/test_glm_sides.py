"""Models of the maps of one side: which rows, points and covariates they have."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import arrays, glm
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.settings import DesignSettings, GlmSettings


def side_of(rows, values):
    """Maps of thickness (sheets, x, y) of some rows of a table; all points are of one subfield."""
    subfield, summary = np.zeros(values.shape, dtype=np.int8), pd.DataFrame(index=range(len(rows)))
    maps = {"thickness": values}
    return SideMaps(rows=rows, maps=maps, subfield=subfield, names=("CA1",), summary=summary)


def model(formula="group + age", n=16, covariance="ordinary"):
    """Row 2 lacks the age; groups of eight."""
    random = np.random.default_rng(0)
    ages = np.where(np.arange(n) == 2, np.nan, random.normal(70, 5, n))
    table = pd.DataFrame({"group": np.resize(["A", "B"], n), "age": ages})
    spec = parse_model(model_from_shortcut(formula, [], "m"))
    design = build_design(table, spec, DesignSettings(), {})
    return glm.RowModel(design, GlmSettings(covariance=covariance))


def test_rows_that_have_maps_and_variables_are_fitted():
    rows = np.array([0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 14, 15])  # of 16
    values = np.random.default_rng(1).standard_normal((14, 3, 2))
    values[0, 1, 1] = np.nan
    first = side_of(rows, np.random.default_rng(2).standard_normal((14, 3, 2)))
    linear, side = model(), replace(side_of(rows, values), first=first)
    found = glm.fit_maps("L", side, linear)
    used = rows != 2
    np.testing.assert_array_equal(rows[found.used], rows[used])
    np.testing.assert_array_equal(linear.design.rows[found.rows], rows[used])
    flat, before = (part.maps["thickness"][used].reshape(13, 6) for part in (side, first))
    np.testing.assert_array_equal(found.values("thickness"), flat)
    np.testing.assert_array_equal(
        np.vstack([*found.parts("thickness", np.arange(13) > 4)]), flat[5:]
    )
    matrix, contrasts = linear.design.matrix[found.rows], linear.design.contrasts
    expected = glm.fit_points(flat, matrix, contrasts, GlmSettings(), before[None])
    np.testing.assert_allclose(found.fits["thickness"].sigma, expected.sigma, rtol=1e-9)
    assert found.fits["thickness"].n.tolist() == [13, 13, 13, 12, 13, 13]
    assert [test.contrast.name for test in found.fits["thickness"].tests] == ["A-B", "age"]
    assert glm.fit_maps("L", side, linear, contrasts=()).fits["thickness"].tests == ()
    assert found.covariates is None
    whole = replace(side, first=None, covariates={"x": first.maps["thickness"]})
    found = glm.fit_maps("L", whole, linear)
    np.testing.assert_array_equal(found.covariates[0], before)
    np.testing.assert_allclose(found.fits["thickness"].sigma, expected.sigma, rtol=1e-9)
    assert glm.points_of(side).values("thickness").shape == (14, 6)


def test_points_where_a_level_has_few_values_are_missing():
    linear = model("group", n=8)
    values = np.ones((8, 3))
    values[[1, 3], 1] = np.nan  # two of B are left
    values[[0], 2] = np.nan  # three of A
    kept = np.isfinite(glm.without_small_levels(values, linear, np.arange(8)))
    assert kept.sum(axis=0).tolist() == [8, 0, 7]
    plain = glm.RowModel(replace(linear.design, members=None), linear.settings)
    assert np.isfinite(glm.without_small_levels(values, plain, np.arange(8))).sum() == 21


def test_sides_without_any_test_are_refused():
    nothing = side_of(np.arange(16), np.full((16, 2, 2), np.nan))
    with pytest.raises(ModelError, match="hemisphere L: no point of the thickness maps has"):
        glm.fit_maps("L", nothing, model())
    values = np.random.default_rng(0).standard_normal((16, 2, 1))
    alone = np.where(np.arange(16) == 5, 1.0, 0.0)[:, None, None] * np.ones((1, 2, 1))
    side = replace(side_of(np.arange(16), values), covariates={"x": alone})
    assert np.isfinite(glm.fit_maps("R", side, model()).fits["thickness"].sigma).all()
    with pytest.raises(ModelError, match="hemisphere R: a coefficient depends on one participant"):
        glm.fit_maps("R", side, model(covariance="hc3"))


def test_the_mean_is_tested_first_unless_a_contrast_is_the_mean():
    design = model("group", n=8).design
    names = [contrast.name for contrast in glm.with_mean(design)]
    assert names == ["mean", "A-B"]
    np.testing.assert_allclose(glm.with_mean(design)[0].weights, [[1, 0.5]])
    for other in (Contrast("all", [1, 0.5]), Contrast("mean", [1, 1]), Contrast("mean", [0, 0, 1])):
        matching = replace(design, contrasts=(other,))
        assert glm.with_mean(matching) == (other,)
    for other in (Contrast("a", [1, 1]), Contrast("zz", [1, 0.5, 0]), Contrast("b", np.eye(2))):
        assert len(glm.with_mean(replace(design, contrasts=(other,)))) == 2


def test_small_things_of_points(monkeypatch):
    labels = np.array([[0, 1, -1, 2], [1, 1, -1, 2], [0, 2, -1, 0]], dtype=np.int8)
    assert glm.most_frequent(labels, 3).tolist() == [0, 1, -1, 2]
    assert glm.most_frequent(labels, 0).tolist() == [-1] * 4
    monkeypatch.setattr(glm, "_CHUNK", 60)
    parts = [np.arange(7)[part].tolist() for part in glm.chunks((10, 7), 2)]
    assert parts == [[0, 1, 2], [3, 4, 5], [6]]
    assert len(list(glm.chunks((100, 2), 2))) == 2
    assert len(list(glm.chunks((10, 0), 2))) == 1
    values = np.random.default_rng(0).standard_normal((9, 2))
    tests = [Contrast("t", np.eye(2)[1]), Contrast("F", np.eye(2))]
    matrix = np.column_stack([np.ones(9), np.arange(9.0)])
    t, f = glm.fit_points(values, matrix, tests, GlmSettings(min_residual_df=7)).tests
    assert (t.kind, f.kind) == ("t", "F")
    np.testing.assert_array_equal([t.effect, f.effect], [t.cohen_d, f.eta_squared])
    (few,) = glm.fit_points(values, matrix, tests[:1], GlmSettings(min_residual_df=8)).tests
    assert np.isnan(few.p).all()
    with pytest.raises(ModelError, match=r"maps of shape \(9,\) do not fit"):
        glm.check_design(values[:, 0], matrix, tests)


def test_known_cells_of_parts_are_described_as_those_of_the_table():
    table = np.random.default_rng(0).normal(
        [5.0, -300.0, 0.1, 0.0, 7.0], [1, 2, 1e-3, 1, 1], (9, 5)
    )
    table[[0, 4, 8], 0] = np.nan
    table[:6, 1] = np.nan  # none in the first part
    table[:, 3] = np.nan
    table[1:, 4] = np.nan  # a single value
    known, mean, spread = arrays.describe_known([table[:5], table[5:6], table[6:]])
    np.testing.assert_array_equal(known, np.isfinite(table))
    np.testing.assert_allclose(mean[[0, 1, 2, 4]], np.nanmean(table[:, [0, 1, 2, 4]], axis=0))
    np.testing.assert_allclose(spread[:3], np.nanstd(table[:, :3], axis=0, ddof=1), rtol=1e-9)
    assert np.isnan([mean[3], spread[3], spread[4]]).all()
    np.testing.assert_allclose(arrays.mean_of_known(table[:, :3], 1), np.nanmean(table[:, :3], 1))
