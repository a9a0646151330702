"""Point-wise linear models against R, exact answers, and one fit per point."""

import numpy as np
import pytest
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_measures, fit_points
from hipsta_bids.stats.limits import f_limits, t_limits
from hipsta_bids.stats.settings import GlmSettings

SETTINGS = GlmSettings()
HC3 = GlmSettings(covariance="hc3")


def single(columns):
    """One contrast per coefficient."""
    return [Contrast(f"b{i}", np.eye(columns)[i]) for i in range(columns)]


def tooth(r_data):
    data = r_data["ToothGrowth"]
    ones = np.ones(len(data["len"]))
    return data["len"], np.column_stack([ones, data["supp"] == "VC", data["dose"]])


def mtcars(r_data):
    data = r_data["mtcars"]
    ones = np.ones(len(data["mpg"]))
    six, eight = data["cyl"] == 6, data["cyl"] == 8
    return data["mpg"], np.column_stack([ones, six, eight, data["wt"], data["am"]])


@pytest.mark.parametrize(("name", "make"), [("lm_tooth", tooth), ("lm_mtcars", mtcars)])
def test_agrees_with_r(oracle, r_data, name, make):
    y, matrix = make(r_data)
    expected = oracle[name]
    fit = fit_points(y[:, None], matrix, single(matrix.shape[1]), SETTINGS)
    robust = fit_points(y[:, None], matrix, single(matrix.shape[1]), HC3)
    df = expected["df"]

    def check(values, key):
        np.testing.assert_allclose(values, list(expected[key].values()), rtol=1e-6)

    check(fit.coefficients[:, 0], "coef")
    check([test.statistic[0] for test in fit.tests], "t")
    check([test.p[0] for test in fit.tests], "p")
    check([test.statistic[0] for test in robust.tests], "t_HC3")
    check([test.p[0] for test in robust.tests], "p_HC3")
    assert fit.sigma[0] == pytest.approx(expected["sigma"], rel=1e-6)
    assert {test.df[0] for test in fit.tests} == {df}
    reach = stats.t.ppf(0.975, df) * np.array([test.se[0, 0] for test in fit.tests])
    limits = np.array([[row["2.5 %"], row["97.5 %"]] for row in expected["ci"]])
    np.testing.assert_allclose(
        np.column_stack([fit.coefficients[:, 0] - reach, fit.coefficients[:, 0] + reach]),
        limits,
        rtol=1e-6,
    )


def test_f_test_agrees_with_r(oracle, r_data):
    y, matrix = mtcars(r_data)
    cyl = Contrast("cyl", np.eye(5)[1:3])
    (test,) = fit_points(y[:, None], matrix, [cyl], SETTINGS).tests
    assert test.kind == "F"
    assert test.statistic[0] == pytest.approx(oracle["lm_mtcars_F_cyl"]["F"], rel=1e-6)
    assert test.p[0] == pytest.approx(oracle["lm_mtcars_F_cyl"]["p"], rel=1e-6)
    assert np.isnan(test.cohen_d[0])


def test_cohens_d_agrees_with_r(oracle, r_data):
    data = r_data["ToothGrowth"]
    matrix = np.column_stack([np.ones(60), data["supp"] == "OJ"])
    (test,) = fit_points(data["len"][:, None], matrix, single(2)[1:], SETTINGS).tests
    (expected,) = oracle["cohend_tooth"]
    assert test.cohen_d[0] == pytest.approx(expected["Cohens_d"], rel=1e-6)
    # R looks for the limits by a search that stops some 1e-8 short of the root.
    assert test.cohen_d_limits[0, 0] == pytest.approx(expected["CI_low"], abs=1e-7)
    assert test.cohen_d_limits[1, 0] == pytest.approx(expected["CI_high"], rel=1e-6)


def random_case(seed=0, subjects=60, points=40):
    random = np.random.default_rng(seed)
    matrix = np.column_stack(
        [np.ones(subjects), np.arange(subjects) % 2, random.normal(70, 8, subjects)]
    )
    return random, matrix, random.normal(2, 0.3, (subjects, points))


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SETTINGS, HC3], ids=["ordinary", "hc3"])
def test_missing_values_give_the_fit_of_those_present(settings):
    random, matrix, maps = random_case()
    maps[random.random(maps.shape) < 0.2] = np.nan
    contrasts = [*single(3), Contrast("both", np.eye(3)[1:])]
    fit = fit_points(maps, matrix, contrasts, settings)
    for point in range(maps.shape[1]):
        present = np.isfinite(maps[:, point])
        alone = fit_points(maps[present, point, None], matrix[present], contrasts, settings)
        assert fit.n[point] == present.sum()
        for test, one in zip(fit.tests, alone.tests, strict=True):
            for name in ("statistic", "p", "df", "cohen_d", "eta_squared"):
                # rounding of two orders of summation
                np.testing.assert_allclose(
                    getattr(test, name)[point], getattr(one, name)[0], rtol=1e-9, equal_nan=True
                )


@pytest.mark.parametrize("settings", [SETTINGS, HC3], ids=["ordinary", "hc3"])
def test_fit_agrees_with_statsmodels(settings):
    """All that is reported: of t and F, with values missing at random, and where none can be."""
    random, matrix, maps = random_case(7)
    maps[random.random(maps.shape) < 0.2] = np.nan
    maps[matrix[:, 1] == 1, 1] = np.nan  # a whole group
    maps[5:, 2] = np.nan  # 5 subjects, 3 columns
    maps[:, 3] = 2.0  # no variance
    maps[1, 4] = 2.5
    maps[3::2, 4] = np.nan  # one subject of a group is left: no HC3
    contrasts = [*single(3), Contrast("both", np.eye(3)[1:])]
    ours = fit_points(maps, matrix, contrasts, settings)
    library = fit_measures(maps, matrix, contrasts, settings)
    np.testing.assert_array_equal(ours.n, library.n)
    assert np.isfinite(library.tests[1].p).sum() == maps.shape[1] - 3 - (settings is HC3)
    # Rounding of two ways to solve the equations; limits are roots that are found by bisection.
    np.testing.assert_allclose(ours.coefficients, library.coefficients, rtol=1e-9)
    np.testing.assert_allclose(ours.sigma, library.sigma, rtol=1e-9)
    for one, other in zip(ours.tests, library.tests, strict=True):
        assert one.contrast is other.contrast
        for name in ("statistic", "p", "df", "estimate", "se", "cohen_d", "eta_squared"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=1e-9, err_msg=name
            )
        for name in ("cohen_d_limits", "eta_squared_limits"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), rtol=1e-7, atol=1e-12, err_msg=name
            )


def test_effect_sizes_of_a_small_sample_by_hand():
    """Groups (1, 2, 3) and (4, 6, 8): difference 4, pooled variance 5/2, t = 4 / sqrt(5/3)."""
    y = np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0])[:, None]
    matrix = np.column_stack([np.ones(6), np.repeat([0.0, 1.0], 3)])
    contrasts = [Contrast("t", np.eye(2)[1]), Contrast("F", np.eye(2))]
    settings = GlmSettings(confidence=0.9)
    for fit in (fit_points, fit_measures):
        t, f = fit(y, matrix, contrasts, settings).tests
        assert t.statistic[0] == pytest.approx(4 / np.sqrt(5 / 3), rel=1e-12)
        assert t.cohen_d[0] == pytest.approx(4 / np.sqrt(5 / 2), rel=1e-12)
        assert t.eta_squared[0] == pytest.approx(24 / 34, rel=1e-12)  # of 34, 24 lie between
        # The limits are those of t and of F, in units of d and of eta squared.
        low, high = t.cohen_d_limits[:, 0] / np.sqrt(2 / 3)
        assert stats.nct.cdf(t.statistic[0], 4, low) == pytest.approx(0.95, abs=1e-9)
        assert stats.nct.cdf(t.statistic[0], 4, high) == pytest.approx(0.05, abs=1e-9)
        # Sum of squares of both means around zero: 3 (2^2 + 6^2) = 120, of the rest 10.
        assert f.statistic[0] == pytest.approx(120 / 2 / (10 / 4), rel=1e-12)
        assert f.eta_squared[0] == pytest.approx(120 / 130, rel=1e-12)
        assert np.isnan([f.cohen_d[0], *f.cohen_d_limits[:, 0]]).all()
        for test, df1, statistic in ((t, 1, 9.6), (f, 2, 24.0)):
            eta = test.eta_squared_limits[:, 0]
            for limit, share in zip(4 * eta / (1 - eta), (0.95, 0.05), strict=True):
                chance = stats.ncf.cdf(statistic, df1, 4, limit)
                assert chance == pytest.approx(share, abs=1e-9)


def test_two_groups_give_students_t_and_hc3_gives_the_definition():
    _, _, maps = random_case(1)
    matrix = np.column_stack([np.ones(60), np.repeat([0.0, 1.0], [25, 35])])
    (test,) = fit_points(maps, matrix, single(2)[1:], SETTINGS).tests
    expected = stats.ttest_ind(maps[25:], maps[:25])
    np.testing.assert_allclose(test.statistic, expected.statistic, rtol=1e-10)
    np.testing.assert_allclose(test.p, expected.pvalue, rtol=1e-10)
    (robust,) = fit_points(maps, matrix, single(2)[1:], HC3).tests
    # With two groups the leverage is 1/n, so HC3 is a sum of squares over (n - 1)^2.
    variance = sum(len(g) * g.var(axis=0) / (len(g) - 1) ** 2 for g in (maps[:25], maps[25:]))
    np.testing.assert_allclose(robust.se[0], np.sqrt(variance), rtol=1e-10)


def test_f_of_one_degree_of_freedom_is_t_squared():
    _, matrix, maps = random_case(2)
    fit = fit_points(maps, matrix, [Contrast("x", np.eye(3)[1])], SETTINGS)
    t = fit.tests[0].statistic
    np.testing.assert_allclose(fit.tests[0].eta_squared, t**2 / (t**2 + 57), rtol=1e-12)


def test_result_depends_neither_on_units_nor_on_how_points_are_batched(monkeypatch):
    random, matrix, maps = random_case(3)
    maps[random.random(maps.shape) < 0.1] = np.nan
    whole = fit_points(maps, matrix, single(3), SETTINGS)
    monkeypatch.setattr("hipsta_bids.stats.glm._CHUNK", 500)
    scaled = fit_points(maps * 1e3, matrix * [1, 1, 1e4], single(3), SETTINGS)
    for one, other in zip(whole.tests[1:], scaled.tests[1:], strict=True):
        np.testing.assert_allclose(one.statistic, other.statistic, rtol=1e-8)  # rounding


def test_points_that_cannot_be_fitted_are_missing_alone():
    _, matrix, maps = random_case(4)
    maps[:, 0] = np.nan
    maps[matrix[:, 1] == 1, 1] = np.nan  # a whole group
    maps[5:, 2] = np.nan  # 5 subjects, 3 columns
    maps[:, 3] = 2.0  # no variance
    fit = fit_points(maps, matrix, [*single(3), Contrast("F", np.eye(3)[1:])], SETTINGS)
    for test in fit.tests:
        assert np.isnan(test.p[:4]).all()
        assert np.isfinite(test.p[4:]).all()
    assert np.isnan(fit.sigma[:4]).all()


@pytest.mark.slow
def test_planted_effect_is_recovered_with_honest_limits():
    """Limits of d, of eta squared and p-values keep their promised rates."""
    random = np.random.default_rng(5)
    matrix = np.column_stack([np.ones(50), np.repeat([0.0, 1.0], 25)])
    points, truth = 4000, 0.8
    maps = random.standard_normal((50, points)) + truth * matrix[:, 1:]
    (test,) = fit_points(maps, matrix, single(2)[1:], SETTINGS).tests
    inside = (test.cohen_d_limits[0] < truth) & (truth < test.cohen_d_limits[1])
    # Coverage .95 with a binomial SD of .0034; three of them.
    assert inside.mean() == pytest.approx(0.95, abs=0.0105)
    center = truth**2 * 12.5  # non-centrality: d^2 n1 n2 / (n1 + n2)
    eta = center / (center + 48)
    low, high = test.eta_squared_limits
    assert ((low < eta) & (eta < high)).mean() == pytest.approx(0.95, abs=0.0105)


def test_limits_are_roots_of_the_distributions():
    t = np.array([-40.0, -3.0, 0.0, 0.4, 7.0, 25.0, np.nan])
    df = np.full(len(t), 300.0)
    low, high = t_limits(t, df, 0.95)
    valid = slice(0, -1)
    np.testing.assert_allclose(stats.nct.cdf(t, df, low)[valid], 0.975, atol=1e-10)
    np.testing.assert_allclose(stats.nct.cdf(t, df, high)[valid], 0.025, atol=1e-10)
    assert np.isnan(low[-1])
    f = np.array([0.01, 0.5, 4.0, 60.0, np.nan])
    low, high = f_limits(f, 2, np.full(len(f), 300.0), 0.9)
    np.testing.assert_array_equal(low[:2], 0.0)  # F.cdf(0.5; 2, 300) < 0.95
    np.testing.assert_allclose(stats.ncf.cdf(f[2:4], 2, 300, low[2:4]), 0.95, atol=1e-10)
    np.testing.assert_allclose(stats.ncf.cdf(f[1:4], 2, 300, high[1:4]), 0.05, atol=1e-10)
    assert high[0] == 0.0
    assert np.isnan(low[-1])
    assert np.isnan(high[-1])
    large, df = np.array([9e3, 9e4]), np.array([40.0, 1500.0])  # beyond SciPy's inverse
    low, high = f_limits(large, 2, df, 0.9)
    np.testing.assert_allclose(stats.ncf.cdf(large, 2, df, low), 0.95, atol=1e-8)
    np.testing.assert_allclose(stats.ncf.cdf(large, 2, df, high), 0.05, atol=1e-8)
    assert (low > 1e4).all()


def test_refuses_what_cannot_be_fitted():
    _, matrix, maps = random_case(6)
    cases = {
        "both need as many rows": (maps[:-1], matrix, single(3)),
        "not independent": (maps, matrix[:, [0, 1, 1]], single(3)),
        "has 2 weights": (maps, matrix, single(2)),
        "has missing values": (maps, np.where(matrix == matrix[3, 2], np.nan, matrix), single(3)),
    }
    for message, case in cases.items():
        with pytest.raises(ModelError, match=message):
            fit_points(*case, SETTINGS)
    with pytest.raises(ModelError, match="redundant"):
        Contrast("twice", np.array([[0.0, 1.0], [0.0, 2.0]]))
