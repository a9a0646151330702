"""Visits as categories against R, SAS, exact tests and the likelihood written out."""

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from formulaic import model_matrix
from scipy import optimize, stats

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.repeated.mmrm import fit_visits
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings

DATA = Path(__file__).with_name("fev.tsv")
#: Estimate, SE, degrees of freedom and t of ``RACE + SEX + ARMCD * AVISIT + us(AVISIT | USUBJID)``
#: in the README of R's mmrm 0.3.18, with Satterthwaite's degrees of freedom. The constant and the
#: effect of sex have another reference level here.
README = {
    "race[T.Black]": (1.53050, 0.62448, 168.67),
    "race[T.White]": (5.64357, 0.66561, 157.14),
    "arm[T.TRT]": (3.77423, 1.07415, 145.55),
    "visit[T.2]": (4.83959, 0.80172, 143.88),
    "visit[T.3]": (10.34211, 0.82269, 155.56),
    "visit[T.4]": (15.05390, 1.31281, 138.47),
    "arm[T.TRT]:visit[T.2]": (-0.04193, 1.12932, 138.56),
    "arm[T.TRT]:visit[T.3]": (-0.69369, 1.18765, 158.17),
    "arm[T.TRT]:visit[T.4]": (0.62423, 1.85085, 129.72),
}
#: Value, standard error and t of the same model with weights and visit 4 as reference, by nlme's
#: ``gls`` (``corSymm``, ``varIdent`` and ``varFixed``), in design/R/R_weighted_nlme.txt there.
GLS = {
    "race[T.Black]": (1.20299, 0.6291457, 1.91210),
    "race[T.White]": (5.38075, 0.6707062, 8.02251),
    "arm[T.TRT]": (4.26139, 1.6899825, 2.52156),
    "last[T.1]": (-14.79539, 1.3185677, -11.22081),
    "last[T.2]": (-9.92877, 1.2644282, -7.85238),
    "last[T.3]": (-4.74778, 1.2490235, -3.80119),
    "arm[T.TRT]:last[T.1]": (-0.86518, 1.8915049, -0.45740),
    "arm[T.TRT]:last[T.2]": (-0.84330, 1.8168093, -0.46417),
    "arm[T.TRT]:last[T.3]": (-0.86850, 1.8316066, -0.47418),
}


def settings(freedom="kenward-roger"):
    return LongitudinalSettings(freedom=freedom)


@pytest.fixture(scope="module")
def fev():
    text = {"person": str, "visit": str}
    return pd.read_table(DATA, comment="#", dtype=text)


def fit(fev, formula, freedom, rows=(), root=1.0):
    """Fit one column by name, with further contrasts of several columns."""
    matrix = model_matrix(formula, fev)
    names = list(map(str, matrix.columns))
    unit = np.eye(len(names))
    contrasts = [Contrast(name, row) for name, row in zip(names, unit, strict=True)]
    contrasts += [
        Contrast("+".join(group), unit[[names.index(n) for n in group]]) for group in rows
    ]
    visits = fev["visit"].to_numpy().astype(int) - 1
    people = fev["person"].to_numpy(dtype=np.str_)
    values = fev[["fev1"]].to_numpy() * root
    result = fit_visits(
        values, np.asarray(matrix, float) * root, (people, visits), contrasts, settings(freedom)
    )
    return {test.contrast.name: test for test in result.tests}


def test_same_as_mmrm(fev):
    tests = fit(fev, "race + sex + arm * visit", "satterthwaite")
    for name, (estimate, se, df) in README.items():
        test = tests[name]
        # R ends its search a few 1e-4 of a standard error from the optimum.
        np.testing.assert_allclose(test.estimate[0, 0], estimate, atol=2e-4 * se)
        np.testing.assert_allclose([test.se[0, 0], test.df[0]], [se, df], rtol=1e-4)


def test_same_as_gls_of_nlme(fev):
    """Rows times the root of their weight have variances without weights."""
    last = pd.Categorical(fev["visit"], categories=["4", "1", "2", "3"])
    root = np.sqrt(fev[["weight"]].to_numpy())
    tests = fit(fev.assign(last=last), "race + sex + arm * last", "satterthwaite", root=root)
    for name, (estimate, se, t) in GLS.items():
        test = tests[name]
        # optim ends a few 1e-4 of a standard error from the optimum, with a larger loss.
        np.testing.assert_allclose(test.estimate[0, 0], estimate, atol=2e-4 * se)
        np.testing.assert_allclose(test.se[0, 0], se, rtol=1.5e-4)
        np.testing.assert_allclose(test.statistic[0], t, atol=1e-3)


def test_same_as_mixed_of_sas(fev):
    # design/SAS of R's mmrm: F 36.92 with 166 degrees of freedom; without columns 42.8338, 0.3509.
    test = fit(
        fev, "race + sex + arm * visit", "satterthwaite", [["race[T.Black]", "race[T.White]"]]
    )
    joint = test["race[T.Black]+race[T.White]"]
    np.testing.assert_allclose(joint.statistic[0], 36.92, rtol=3e-4)  # rounded, and the search
    assert round(joint.df[0]) == 166
    mean = fit(fev, "1", "satterthwaite")["Intercept"]
    np.testing.assert_allclose(mean.estimate[0, 0], 42.8338, rtol=1e-4)
    np.testing.assert_allclose(mean.se[0, 0], 0.3509, rtol=1e-4)
    assert round(mean.df[0]) == 171
    # Kenward and Roger; tests/testthat/test-kenwardroger.R compares with 1e-3, too.
    arm = fit(fev, "arm", "kenward-roger")["arm[T.TRT]"]
    np.testing.assert_allclose(arm.se[0, 0], 0.66124382270307, rtol=1e-4)
    np.testing.assert_allclose(arm.df[0], 160.733266403768, rtol=3e-4)


def written_out(fev, formula, weights):  # noqa: PLR0915 -- one long formula
    """Estimate, Kenward-Roger's and Satterthwaite's tests from whole matrices and differences."""
    matrix = np.asarray(model_matrix(formula, fev), float)
    visits = fev["visit"].to_numpy().astype(int) - 1
    people = pd.factorize(fev["person"])[0]
    y, same = fev["fev1"].to_numpy(), people[:, None] == people
    count = visits.max() + 1
    entries = np.triu_indices(count)
    units = []
    for a, b in zip(*entries, strict=True):
        unit = np.zeros((count, count))
        unit[a, b] = unit[b, a] = 1
        units.append(unit[np.ix_(visits, visits)] * same)

    def whole(theta):
        return np.tensordot(theta, units, 1)

    def terms(theta):
        inverse = np.linalg.inv(whole(theta))
        spread = np.linalg.inv(matrix.T @ inverse @ matrix)
        return inverse, spread, spread @ matrix.T @ inverse @ y

    def loss(theta):
        sign, size = np.linalg.slogdet(whole(theta))
        if sign <= 0 or np.linalg.eigvalsh(full(theta))[0] <= 0:
            return np.inf
        inverse, spread, beta = terms(theta)
        left = y - matrix @ beta
        return size - np.linalg.slogdet(spread)[1] + left @ inverse @ left

    def full(theta):
        result = np.zeros((count, count))
        result[entries] = theta
        return result + np.triu(result, 1).T

    def slope(theta):
        inverse, spread, _ = terms(theta)
        p = inverse - inverse @ matrix @ spread @ matrix.T @ inverse
        left = p @ y
        return np.array([np.sum(p * unit) - left @ unit @ left for unit in units])

    start = full(np.zeros(len(units))) + np.eye(count) * y.var()
    found = optimize.minimize(
        loss, start[entries], jac=slope, method="BFGS", options={"gtol": 1e-6}
    )
    theta = found.x
    steps = 1e-4 * np.abs(theta).mean() * np.eye(len(theta))
    hessian = np.array([(slope(theta + s) - slope(theta - s)) / (2 * s.max()) for s in steps])
    w = 2 * np.linalg.inv(hessian)
    inverse, spread, beta = terms(theta)
    changes = [(terms(theta + s)[1] - terms(theta - s)[1]) / (2 * s.max()) for s in steps]
    rows = np.atleast_2d(weights)
    f = rows @ spread @ rows.T
    p = [-matrix.T @ inverse @ u @ inverse @ matrix for u in units]
    adjusted = spread.copy()
    for i, j in product(range(len(units)), repeat=2):
        q = matrix.T @ inverse @ units[i] @ inverse @ units[j] @ inverse @ matrix
        adjusted += 2 * w[i, j] * spread @ (q - p[i] @ spread @ p[j]) @ spread
    theta_matrix = rows.T @ np.linalg.inv(f) @ rows
    tp = [theta_matrix @ spread @ one @ spread for one in p]
    a1 = sum(w[i, j] * np.trace(tp[i]) * np.trace(tp[j]) for i, j in np.ndindex(w.shape))
    a2 = sum(w[i, j] * np.trace(tp[i] @ tp[j]) for i, j in np.ndindex(w.shape))
    k = len(rows)
    b, g = (a1 + 6 * a2) / (2 * k), ((k + 1) * a1 - (k + 4) * a2) / ((k + 2) * a2)
    c = np.array([g, k - g, k + 2 - g]) / (3 * k + 2 * (1 - g))
    mean = 1 / (1 - a2 / k)
    v = 2 / k * (1 + c[0] * b) / (1 - c[1] * b) ** 2 / (1 - c[2] * b)
    m = 4 + (k + 2) / (k * v / (2 * mean**2) - 1)
    scale = m / (mean * (m - 2))
    estimate = rows @ beta
    wald = estimate @ np.linalg.solve(rows @ adjusted @ rows.T, estimate) / k
    gradient = np.array([rows[0] @ one @ rows[0] for one in changes])
    return {
        "estimate": estimate,
        "se": np.sqrt(np.diag(f)),
        "df": 2 * f[0, 0] ** 2 / (gradient @ w @ gradient),
        "adjusted_se": np.sqrt(np.diag(rows @ adjusted @ rows.T)),
        "f": scale * wald,
        "m": m,
    }


@pytest.mark.parametrize("size", [1, 3])
def test_same_as_the_likelihood_written_out(fev, size):
    formula = "arm * visit"
    some = fev[fev["person"].astype(int) <= 60]
    names = list(map(str, model_matrix(formula, some).columns))
    group = ["arm[T.TRT]:visit[T.4]", "arm[T.TRT]", "visit[T.2]"][:size]
    rows = np.eye(len(names))[[names.index(name) for name in group]]
    truth = written_out(some, formula, rows)
    plain = fit(some, formula, "satterthwaite", [group] if size > 1 else ())
    robust = fit(some, formula, "kenward-roger", [group] if size > 1 else ())
    name = "+".join(group)
    # The search of SciPy ends at a slope of 1e-6; derivatives there are differences.
    near = {"rtol": 1e-5}
    np.testing.assert_allclose(robust[name].estimate[:, 0], truth["estimate"], **near)
    np.testing.assert_allclose(plain[name].se[:, 0], truth["se"], **near)
    if size == 1:
        np.testing.assert_allclose(plain[name].df[0], truth["df"], **near)
        np.testing.assert_allclose(robust[name].df[0], truth["df"], **near)
        np.testing.assert_allclose(robust[name].se[0], truth["adjusted_se"], **near)
        np.testing.assert_allclose(robust[name].statistic[0] ** 2, truth["f"], **near)
    else:
        np.testing.assert_allclose(robust[name].statistic[0], truth["f"], **near)
        np.testing.assert_allclose(robust[name].df[0], truth["m"], **near)


def trials(seed, people=30, visits=3, points=5, missing=0.0):
    """Complete trials of two arms of unlike size without effects, each point one of its own."""
    random = np.random.default_rng(seed)
    root = np.linalg.cholesky(0.7 + np.diag(np.linspace(0.3, 1.0, visits)))
    values = random.standard_normal((people, points, visits)) @ root.T
    values = values.transpose(0, 2, 1).reshape(people * visits, points)
    values[random.random(values.shape) < missing] = np.nan
    names, numbers = np.repeat(np.arange(people), visits), np.tile(np.arange(visits), people)
    arm = (names % 3 == 0).astype(float)
    at = np.eye(visits)[numbers]
    matrix = np.hstack([at, at * arm[:, None]])
    return values, matrix, names, numbers


def test_complete_visits_are_exact():
    """Means of a visit are tested by Student's t, and all visits together by Hotelling's T2."""
    values, matrix, names, numbers = trials(1)
    people, visits = names.max() + 1, numbers.max() + 1
    rows = np.eye(2 * visits)[visits:]
    contrasts = [Contrast("last", rows[-1:]), Contrast("all", rows)]
    for freedom in ("satterthwaite", "kenward-roger"):
        last, joint = fit_visits(
            values, matrix, (names, numbers), contrasts, settings(freedom)
        ).tests
        for point in range(values.shape[1]):
            table = values[:, point].reshape(people, visits)
            arm = matrix[::visits, visits].astype(bool)
            exact = stats.ttest_ind(table[arm, -1], table[~arm, -1])
            # The search ends where a step changes the likelihood by less than 1e-11.
            near = {"rtol": 1e-6}
            np.testing.assert_allclose(last.statistic[point], exact.statistic, **near)
            np.testing.assert_allclose([last.df[point], last.p[point]], [people - 2, exact.pvalue])
            if freedom == "kenward-roger":
                difference = table[arm].mean(axis=0) - table[~arm].mean(axis=0)
                pooled = sum(np.cov(table[one].T) * (one.sum() - 1) for one in (arm, ~arm))
                t2 = difference @ np.linalg.solve(pooled / (people - 2), difference)
                t2 *= arm.sum() * (~arm).sum() / people
                f = t2 * (people - visits - 1) / (visits * (people - 2))
                np.testing.assert_allclose(joint.statistic[point], f, **near)
                np.testing.assert_allclose(joint.df[point], people - visits - 1, **near)


def test_one_visit_with_a_baseline_is_the_linear_model():
    random = np.random.default_rng(3)
    people, points = 25, 4
    first = random.standard_normal((people, points))
    values = first + random.standard_normal((people, points))
    values[3, 1] = first[4, 2] = np.nan
    matrix = np.column_stack([np.ones(people), np.arange(people) % 2])
    contrasts = [Contrast("arm", [0.0, 1.0])]
    names = np.arange(people)
    adjusted = fit_visits(
        values, matrix, (names, np.zeros(people, int)), contrasts, settings(), baseline=first
    )
    expected = fit_points(values, matrix, contrasts, GlmSettings(), first[None])
    for name in ("estimate", "se", "statistic", "df", "p", "cohen_d"):
        ours, other = getattr(adjusted.tests[0], name), getattr(expected.tests[0], name)
        np.testing.assert_allclose(ours, other, rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(adjusted.sigma, expected.sigma, rtol=1e-7)


def test_baseline_and_equal_arms_agree():
    """Of complete data both give the difference of arms that is adjusted by regression."""
    values, matrix, names, numbers = trials(5, people=60)
    visits = numbers.max() + 1
    arm = matrix[:, visits:].sum(axis=1)
    at = np.eye(visits)[numbers]
    equal = np.hstack([at, at[:, 1:] * arm[:, None]])  # no difference at the first visit
    later = numbers > 0
    first = np.repeat(values[~later], visits - 1, axis=0)
    adjusted = np.hstack([at[later, 1:], at[later, 1:] * arm[later, None]])
    contrast = [Contrast("last", [0.0] * (2 * visits - 2) + [1.0])]
    clda = fit_visits(values, equal, (names, numbers), contrast, settings()).tests[0]
    contrast = [Contrast("last", [0.0] * (2 * visits - 3) + [1.0])]
    mmrm = fit_visits(
        values[later],
        adjusted,
        (names[later], numbers[later] - 1),
        contrast,
        settings(),
        baseline=first,
    ).tests[0]
    ancova = fit_points(
        values[numbers == visits - 1],
        np.column_stack([np.ones(60), arm[numbers == 0]]),
        [Contrast("arm", [0.0, 1.0])],
        GlmSettings(),
        values[~later][None],
    ).tests[0]
    np.testing.assert_allclose(mmrm.estimate, ancova.estimate, rtol=1e-6)
    # One regresses on the baseline within arms, the other knows that arms are alike there.
    np.testing.assert_allclose(clda.estimate, ancova.estimate, atol=0.03 * ancova.se.max())
    assert clda.se.mean() < 1.02 * ancova.se.mean()


@pytest.mark.parametrize("kind", ["mmrm", "clda"])
def test_size_of_end_points(kind):
    """As :func:`test_size`, with the baseline as a covariate, or with equal arms there."""
    values, matrix, names, numbers = trials(13, 40, 4, 3000)
    values[np.random.default_rng(1).random(values.shape) * (numbers > 0)[:, None] > 0.9] = np.nan
    if kind == "clda":
        baseline = None
        matrix = np.delete(matrix, 4, axis=1)
    else:
        later = numbers > 0
        baseline = np.repeat(values[~later], 3, axis=0)
        matrix = np.delete(matrix[later], [0, 4], axis=1)
        values, names, numbers = values[later], names[later], numbers[later] - 1
    contrasts = [Contrast("last", np.eye(matrix.shape[1])[-1])]
    (test,) = fit_visits(
        values, matrix, (names, numbers), contrasts, settings(), baseline=baseline
    ).tests
    assert np.isfinite(test.p).all()
    assert abs(np.mean(test.p < 0.05) - 0.05) < 0.01


@pytest.mark.parametrize("missing", [0.0, 0.1])
@pytest.mark.parametrize(("people", "visits"), [(40, 4), (20, 3)])
def test_size(people, visits, missing):
    """Tests of nothing have p below 0.05 in 5 % of 3000 trials; the SE of this is 0.4 %."""
    values, matrix, names, numbers = trials(11, people, visits, 3000, missing)
    rows = np.eye(2 * visits)[visits:]
    contrasts = [Contrast("last", rows[-1:]), Contrast("all", rows)]
    result = fit_visits(values, matrix, (names, numbers), contrasts, settings())
    assert np.isfinite(result.sigma).mean() > 0.99
    for test in result.tests:
        assert abs(np.mean(test.p[np.isfinite(test.p)] < 0.05) - 0.05) < 0.01


def test_points_without_a_covariance_are_missing():
    values, matrix, names, numbers = trials(2)
    values[:, 0] = 1.0
    values[numbers == 1, 1] = np.nan
    contrasts = [Contrast("last", np.eye(6)[-1])]
    result = fit_visits(values, matrix, (names, numbers), contrasts, settings())
    assert np.isnan(result.sigma[:2]).all()
    assert np.isfinite(result.sigma[2:]).all()
    test = result.tests[0]
    assert (np.isnan(test.p) == np.isnan(result.sigma)).all()
    assert result.n.tolist() == [90, 60, 90, 90, 90]


def test_other_points_do_not_matter():
    values, matrix, names, numbers = trials(4, points=3, missing=0.15)
    contrasts = [Contrast("last", np.eye(6)[-1])]
    whole = fit_visits(values, matrix, (names, numbers), contrasts, settings())
    order = np.random.default_rng(0).permutation(len(values))
    alone = fit_visits(
        values[order, 1:2], matrix[order], (names[order], numbers[order]), contrasts, settings()
    )
    # Sums in another order.
    np.testing.assert_allclose(alone.tests[0].p, whole.tests[0].p[1:2], rtol=1e-7)
    assert alone.n[0] == np.isfinite(values[:, 1]).sum()


def test_too_many_visits_are_refused():
    values, matrix, names, numbers = trials(4, visits=9)
    with pytest.raises(ModelError, match="9 visits have too many covariances"):
        fit_visits(values, matrix, (names, numbers), [], settings())
