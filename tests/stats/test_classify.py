"""Logistic models, areas under the curve and separation, against R, statsmodels and simulation."""

import numpy as np
import pytest
from scipy import optimize, special, stats
from sklearn.calibration import calibration_curve
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import RepeatedStratifiedKFold
from statsmodels.discrete.discrete_model import Logit
from statsmodels.tools.numdiff import approx_fprime, approx_hess

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import classify, logistic
from hipsta_bids.stats.classify import (
    calibrate,
    compare_models,
    compare_pairs,
    cross_validate,
    delong,
    roc_curve,
)
from hipsta_bids.stats.logistic import fit_logistic, fit_overlapping_or_firth, is_separated
from hipsta_bids.stats.settings import ClassificationSettings

SETTINGS = ClassificationSettings(repeats=2, folds=5)

MODELS = {
    "infert": ("case", ["age", "parity"], ["spontaneous"]),
    "mtcars_am": ("am", ["wt"], ["hp"]),
}


def r_model(r_data, name):
    outcome, base, added = MODELS[name]
    data = r_data[name.split("_")[0]]
    case = data[outcome] == 1
    columns = [np.ones(len(case)), *(data[column] for column in base)]
    return np.column_stack(columns).astype(float), data[added[0]][:, None].astype(float), case


@pytest.mark.parametrize("name", MODELS)
def test_agrees_with_r(oracle, r_data, name):
    base, added, case = r_model(r_data, name)
    expected = oracle[name]
    found = compare_models(base, added, case, SETTINGS)
    counts = [found.columns[name] for name in ("n", "n_cases", "lr_df")]
    assert counts == [expected["n"], expected["cases"], 1]
    assert not found.columns["separated"]

    def check(value, key):
        np.testing.assert_allclose(value, expected[key], rtol=1e-6)

    check(found.columns["likelihood_ratio"], "LR")
    check(found.columns["p"], "p_LR")
    for number, model in enumerate((found.base, found.full)):
        np.testing.assert_allclose(
            model.fit.coefficients, list(expected[f"coef{number}"].values()), rtol=1e-6
        )
        check(model.fit.log_likelihood, f"logLik{number}")
        check(model.auc.area, f"auc{number}")
        check([model.auc.low, model.auc.high], f"ci{number}")
    check(found.base.auc.se, "se0")
    check(found.full.auc.se, "se1auc")


def test_firth_agrees_with_r(oracle, r_data):
    base, added, case = r_model(r_data, "infert")
    fit = fit_logistic(np.hstack([base, added]), case, firth=True)
    expected = oracle["firth_infert"]
    np.testing.assert_allclose(fit.coefficients, list(expected["coef"].values()), rtol=1e-6)


def simulated(seed=0, n=200, effect=1.0):
    random = np.random.default_rng(seed)
    base = np.column_stack([np.ones(n), random.normal(70, 8, n)])
    added = random.standard_normal((n, 2))
    case = random.random(n) < special.expit(effect * added[:, 0] + 0.05 * (base[:, 1] - 70))
    return base, added, case


@pytest.mark.parametrize("seed", range(3))
def test_maximum_likelihood_agrees_with_statsmodels(seed):
    base, added, case = simulated(seed)
    matrix = np.hstack([base, added])
    fit = fit_logistic(matrix, case, firth=False)
    expected = Logit(case.astype(float), matrix).fit(disp=0, tol=1e-12)
    np.testing.assert_allclose(fit.coefficients, expected.params, rtol=1e-6)
    assert fit.log_likelihood == pytest.approx(expected.llf, rel=1e-10)


def test_firth_maximizes_the_penalized_likelihood():
    base, added, case = simulated(3, n=30)
    matrix = np.hstack([base[:, :1], added])

    def loss(beta):
        chance = special.expit(matrix @ beta)
        information = matrix.T @ (matrix * (chance * (1 - chance))[:, None])
        margin = np.where(case, 1, -1) * (matrix @ beta)
        return -special.log_expit(margin).sum() - 0.5 * np.linalg.slogdet(information)[1]

    best = optimize.minimize(loss, np.zeros(3), method="BFGS", options={"gtol": 1e-8})
    fit = fit_logistic(matrix, case, firth=True)
    np.testing.assert_allclose(fit.coefficients, best.x, atol=1e-5)  # numerical gradients
    assert fit.log_likelihood == pytest.approx(-best.fun, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("many", [1, 24000])
def test_firth_of_a_two_by_two_table_adds_half_to_each_cell(many, monkeypatch):
    """The penalized estimates of a saturated model are the log odds with 1/2 added.

    Of many rows, the last steps promise less than the rounding of the likelihood; there are no
    more steps for that (14 at either size).
    """
    counts = {(0, 0): 7 * many, (0, 1): 3 * many, (1, 0): 4, (1, 1): 0}
    rows = [(x, y) for (x, y), count in counts.items() for _ in range(count)]
    x, y = np.array(rows).T
    matrix = np.column_stack([np.ones(len(x)), x])
    assert is_separated(matrix, y == 1)
    monkeypatch.setattr(logistic, "FIRTH_STEPS", 16)
    fit = fit_logistic(matrix, y == 1, firth=True)
    first, second = np.log((3 * many + 0.5) / (7 * many + 0.5)), np.log(0.5 / 4.5)
    np.testing.assert_allclose(fit.coefficients, [first, second - first], rtol=1e-6)


def test_separation_is_found_exactly():
    x = np.arange(10.0)
    matrix = np.column_stack([np.ones(10), x])
    assert is_separated(matrix, x > 4)
    overlapping = x > 4
    overlapping[[4, 5]] = [True, False]
    assert not is_separated(matrix, overlapping)
    touching = np.column_stack([np.ones(10), np.clip(x, 4, 5)])  # quasi-complete
    mixed = x > 4
    mixed[0] = True
    assert is_separated(touching, mixed)
    tiny = np.column_stack([np.ones(10), 1e-9 * x])
    assert is_separated(tiny, x > 4)
    assert not is_separated(tiny, overlapping)


def test_separated_groups_get_finite_answers_and_are_told():
    base, added, _ = simulated(4, n=40)
    case = added[:, 0] > 0.1
    found = compare_models(base, added, case, SETTINGS)
    assert found.columns["separated"]
    assert found.full.fit.firth
    assert np.isfinite(found.full.fit.coefficients).all()
    assert found.columns["p"] < 1e-6
    assert found.full.auc.area == 1.0
    with pytest.raises(ModelError, match="separated"):
        fit_logistic(np.hstack([base, added]), case, firth=False)


@pytest.mark.slow
def test_likelihood_ratio_does_not_depend_on_units_and_keeps_its_size():
    p = []
    quick = SETTINGS.changed(folds=2, repeats=1)
    for seed in range(60):
        base, added, case = simulated(seed, n=80, effect=0.0)
        p.append(compare_models(base, added, case, quick).columns["p"])
    assert stats.kstest(p, "uniform").pvalue > 0.01  # one in a hundred by chance; the seed is fixed
    for separate in (False, True):
        outcome = added[:, 0] > 0 if separate else case
        one = compare_models(base, added, outcome, quick)
        other = compare_models(base * [1, 1e4], added * 1e-3, outcome, quick)
        ratio = other.columns["likelihood_ratio"]
        assert one.columns["likelihood_ratio"] == pytest.approx(ratio, rel=1e-6, abs=1e-8)


def test_area_counts_pairs():
    random = np.random.default_rng(0)
    score, case = random.integers(0, 6, 40).astype(float), np.arange(40) < 15
    pairs = np.sign(score[case][:, None] - score[~case][None])
    found = delong(score, case, 0.95)
    assert found.area == pytest.approx((pairs + 1).mean() / 2, rel=1e-12)
    assert found.low < found.area < found.high
    assert delong(case.astype(float), case, 0.95).high == 1.0


def test_delong_interval_covers():
    random = np.random.default_rng(1)
    case = np.arange(80) < 30
    truth = stats.norm.cdf(1 / np.sqrt(2))  # binormal, one SD apart
    inside = 0
    for _ in range(600):
        area = delong(random.standard_normal(80) + case, case, 0.95)
        inside += area.low < truth < area.high
    # The interval is asymptotic: 1 % is allowed for that, and three binomial SDs of .009.
    assert inside / 600 == pytest.approx(0.95, abs=0.037)


def test_cross_validation_does_not_reward_noise():
    random = np.random.default_rng(2)
    case = np.arange(60) % 2 == 0
    matrix = np.column_stack([np.ones(60), random.standard_normal((60, 8))])
    validated, *_ = cross_validate(matrix, case, SETTINGS.changed(repeats=10))
    fit = fit_logistic(matrix, case, firth=False)
    assert delong(matrix @ fit.coefficients, case, 0.95).area > 0.65  # optimistic
    assert validated < 0.6
    repeated, *_ = cross_validate(matrix, case, SETTINGS.changed(repeats=10))
    assert validated == repeated


def test_cross_validation_survives_a_level_that_a_fold_lacks():
    base, added, case = simulated(5, n=60)
    rare = np.zeros(60)
    rare[[3, 7]] = 1.0
    matrix = np.column_stack([base, added, rare])
    assert np.isfinite(cross_validate(matrix, case, SETTINGS.changed(repeats=5))[0])


def test_groups_of_calibration_are_quantiles():
    """Where the size of the sample allows groups of one size, scikit-learn makes the same."""
    random = np.random.default_rng(8)
    score = random.normal(0, 1.5, 400)
    case = random.random(400) < special.expit(score)
    found = calibrate(score, case, SETTINGS)
    chance = special.expit(score)
    observed, predicted = calibration_curve(case, chance, n_bins=10, strategy="quantile")
    np.testing.assert_allclose(found.predicted, predicted, rtol=1e-12)
    np.testing.assert_allclose(found.observed, observed, rtol=1e-12)
    assert found.brier == pytest.approx(np.mean((chance - case) ** 2), rel=1e-12)


def test_calibration_is_not_judged_where_a_group_is_small():
    """One member less than the setting in either group leaves the Brier score alone."""
    random = np.random.default_rng(8)
    score = random.normal(0, 1.5, 400)
    case = np.arange(400) < 99
    for cases in (case, ~case):
        found = calibrate(score, cases, SETTINGS)
        assert not found.judged
        assert np.isnan([found.slope, found.intercept]).all()
        assert found.brier == pytest.approx(np.mean((special.expit(score) - cases) ** 2))
    assert calibrate(score, np.arange(400) < 100, SETTINGS).judged


def test_curve_steps_at_each_score():
    score = np.array([1.0, 2.0, 2.0, 3.0, 0.0])
    case = np.array([False, True, False, True, True])
    wrong, right = roc_curve(score, case)
    np.testing.assert_allclose(wrong, [0, 0, 1 / 2, 1, 1], rtol=1e-12)
    np.testing.assert_allclose(right, [0, 1 / 3, 2 / 3, 2 / 3, 1], rtol=1e-12)
    assert delong(score, case, 0.95).area == 3.5 / 6  # 2 > 1, 2 = 2, 3 > 1, 3 > 2 of six pairs


@pytest.mark.slow
def test_firth_is_used_where_and_only_where_groups_are_separated():
    """Small samples, near separation and beyond; the linear program decides."""
    random = np.random.default_rng(9)
    separated = []
    for _ in range(80):
        matrix = np.column_stack([np.ones(12), random.standard_normal((12, 2))])
        case = random.random(12) < special.expit(4 * matrix[:, 1])
        if 1 < case.sum() < 11:
            separated.append(is_separated(matrix, case))
            assert fit_overlapping_or_firth(matrix, case).firth == separated[-1]
    assert 20 < sum(separated) < len(separated) - 10


def test_calibration_of_right_and_of_exaggerated_chances():
    random = np.random.default_rng(6)
    score = random.normal(0, 1.5, 4000)
    case = random.random(4000) < special.expit(score)
    right = calibrate(score, case, SETTINGS)
    # Standard errors of slope and intercept are .04.
    assert right.slope == pytest.approx(1, abs=0.12)
    assert right.intercept == pytest.approx(0, abs=0.12)
    np.testing.assert_allclose(right.predicted, right.observed, atol=0.1)  # 3 SDs of 400
    extreme = calibrate(2 * score + 1, case, SETTINGS)
    assert extreme.slope == pytest.approx(right.slope / 2, rel=1e-6)
    assert extreme.intercept < -0.5
    assert extreme.brier > right.brier


def test_refuses_what_cannot_be_compared():
    base, added, case = simulated(7, n=40)
    only = np.arange(40) == 0
    cases = {
        "values are missing": (base, np.where(added > 2, np.nan, added), case),
        "not independent": (base, base[:, 1:] * 3, case),
        "smaller group has 1 subjects": (base, added, only),
    }
    classify._check(base, np.arange(40) < 2)  # two are enough
    for message, arguments in cases.items():
        with pytest.raises(ModelError, match=message):
            compare_models(*arguments, SETTINGS)


PAIRS = ClassificationSettings(folds=3, repeats=1)
ORDER = ["CU", "MCI", "DAT"]


def three_groups():
    random = np.random.default_rng(0)
    groups = np.array(ORDER)[np.arange(120) % 3]
    rank = np.arange(120) % 3
    volume = 2.0 - 0.3 * rank + 0.4 * random.standard_normal(120)
    thickness = 1.8 - 0.2 * rank + 0.2 * random.standard_normal(120)
    return groups, volume[:, None], thickness[:, None]


def test_each_pair_is_the_comparison_of_its_subjects():
    groups, volume, thickness = three_groups()
    volume[[0, 4]] = np.nan
    thickness[[0, 5]] = np.nan
    found = compare_pairs(groups, volume, thickness, PAIRS, order=ORDER)
    assert list(found) == [("CU", "MCI"), ("CU", "DAT"), ("MCI", "DAT")]
    assert [one.columns["n_incomplete"] for one in found.values()] == [2, 2, 2]
    used = np.isin(groups, ["CU", "DAT"]) & np.isfinite(volume + thickness)[:, 0]
    base = np.column_stack([np.ones(used.sum()), volume[used]])
    alone = compare_models(base, thickness[used], groups[used] == "DAT", PAIRS)
    apart = found["CU", "DAT"]
    ratio = alone.columns["likelihood_ratio"]
    assert apart.columns["likelihood_ratio"] == pytest.approx(ratio, rel=1e-9)
    assert apart.columns["n"] == used.sum()
    assert apart.columns["n_cases"] == (groups[used] == "DAT").sum()
    # Groups two steps apart are easier to tell than neighbors.
    areas = [one.full.auc.area for one in found.values()]
    assert areas[1] > max(areas[0], areas[2])
    assert apart.full.fit.coefficients[2] < 0  # cases are thinner


def test_names_the_pair_that_cannot_be_compared():
    groups, volume, thickness = three_groups()
    thickness[groups == "DAT"] = np.nan
    with pytest.raises(ModelError, match="CU against DAT"):
        compare_pairs(groups, volume, thickness, PAIRS, order=ORDER)
    with pytest.raises(ModelError, match="no participant is in group SCD"):
        compare_pairs(groups, volume, thickness, PAIRS, order=["CU", "SCD"])


def test_separated_groups_are_compared_alike_by_years_of_any_era():
    year = np.arange(30.0)[:, None] % 15
    groups = np.where(np.arange(30) < 15, "CU", "DAT")
    year[15:] += 15
    added = np.random.default_rng(0).standard_normal((30, 1))
    early, late = (
        compare_pairs(groups, year + start, added, PAIRS, order=["CU", "DAT"])["CU", "DAT"].columns
        for start in (0, 2000)
    )
    assert late["separated"]
    assert late["likelihood_ratio"] == pytest.approx(early["likelihood_ratio"], rel=1e-6)


def test_firth_converges_where_groups_hardly_do_not_overlap():
    """Steps by the information alone take more than 2000 in some of these training sets."""
    controls = (8.75, 8.76, 9.3, 9.34, 9.44, 9.71, 9.72, 9.73, 10.06, 10.11, 10.14, 10.25)
    cases = (10.29, 10.41, 10.57, 11.17, 11.27, 11.31, 11.41, 11.53, 11.55, 11.56, 11.84, 11.93)
    values = np.array([*controls, 10.64, 11.2, *cases, 11.97])
    case = np.arange(len(values)) >= len(controls) + 2
    matrix = np.column_stack([np.ones(len(values)), values])
    area, *_ = cross_validate(matrix, case, ClassificationSettings())
    assert area == pytest.approx(0.96, abs=0.02)


@pytest.mark.parametrize("effect", [0.5, 2.5, 8.0])  # of the last, all folds are separated
def test_folds_fitted_at_once_are_those_fitted_one_by_one(effect, monkeypatch):
    random = np.random.default_rng(4)
    case = np.arange(60) % 2 == 0
    matrix = np.column_stack([np.ones(60), random.normal(0, 1, (60, 2)) + effect * case[:, None]])
    settings = ClassificationSettings(repeats=2, folds=5)
    score, areas = np.zeros(60), []
    splits = RepeatedStratifiedKFold(n_splits=5, n_repeats=2, random_state=settings.seed)
    for train, test in splits.split(matrix, case):
        fit = fit_overlapping_or_firth(matrix[train], case[train])
        log_odds = matrix[test] @ fit.coefficients
        score[test] += log_odds / 2
        areas.append(roc_auc_score(case[test], log_odds))
    means = np.mean(np.reshape(areas, (2, 5)), axis=1)
    for chunk in (classify._CHUNK, 1):
        monkeypatch.setattr(classify, "_CHUNK", chunk)
        area, spread, found = cross_validate(matrix, case, settings)
        np.testing.assert_allclose(found, score, atol=1e-9)
        assert (area, spread) == pytest.approx((means.mean(), means.std(ddof=1)), abs=1e-12)
    area, spread, _ = cross_validate(matrix, case, settings.changed(repeats=1))
    assert np.isnan(spread)


def test_long_curves_are_thinned():
    random = np.random.default_rng(0)
    score, case = random.normal(size=4000), random.random(4000) < 0.4
    wrong, right = roc_curve(score + case, case)
    assert len(wrong) == 1001
    assert (wrong[0], right[0], wrong[-1], right[-1]) == (0, 0, 1, 1)
    assert np.trapezoid(right, wrong) == pytest.approx(
        delong(score + case, case, 0.95).area, abs=1e-3
    )


@pytest.mark.parametrize("score", [0.0, 2.0, -3.0])
def test_predictions_that_are_all_the_same_are_shifted_to_the_share_of_cases(score):
    found = calibrate(np.full(1000, score), np.arange(1000) < 100, SETTINGS)
    assert found.intercept == pytest.approx(np.log(1 / 9) - score)
    assert np.isnan(found.slope)


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("free", [[True, True, True], [True, False, True]])
def test_steps_of_firths_method_are_newtons_and_bounded(free, bent):
    """By the information, or by second derivatives; none of a coefficient exceeds 5."""
    base, added, case = simulated(1, n=40)
    matrix, free = np.column_stack([base[:, :1], added]), np.array(free)
    weights = np.array([np.ones(40), np.arange(40) % 4 > 0])
    likelihood = logistic._Penalized(matrix, case)
    for reach in (0.3, 4.5):
        betas = reach * np.array([[1.0, -0.5, 0.2], [-0.6, 0.4, -0.8]]) * free
        step, promised = likelihood.step(weights, betas, free, bent=bent)
        for number, (own, beta) in enumerate(zip(weights, betas, strict=True)):

            def value(part, own=own):
                return likelihood.value(own[None], (np.eye(3)[free].T @ part)[None])[0]

            at = beta[free]
            slope = approx_fprime(at, value, centered=True)
            chance = special.expit(matrix @ beta)
            information = (matrix.T * own * chance * (1 - chance)) @ matrix
            bend = information[free][:, free]
            if bent:  # uphill along each main direction in units of the information
                root = np.linalg.inv(np.linalg.cholesky(bend)).T
                size, turned = np.linalg.eigh(-root.T @ approx_hess(at, value) @ root)
                newton = root @ turned @ ((turned.T @ root.T @ slope) / np.abs(size))
            else:
                newton = np.linalg.solve(bend, slope)
            share = min(1.0, 5 / np.abs(newton).max())
            np.testing.assert_allclose(step[number][free], share * newton, rtol=2e-3, atol=1e-5)
            assert promised[number] == pytest.approx(share * newton @ slope, rel=2e-3)
        assert (step[:, ~free] == 0).all()
    assert bent or np.abs(step).max() == pytest.approx(5)
