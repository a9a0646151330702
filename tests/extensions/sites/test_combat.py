"""ComBat against its published formulas, and what it has to leave and to take."""

import numpy as np
import pytest
from statsmodels.regression.mixed_linear_model import MixedLM

from hipsta_bids.extensions.sites import combat
from hipsta_bids.extensions.sites.combat import Visits, extend_effects, fit_effects, harmonize
from hipsta_bids.stats.settings import LongitudinalSettings

SETTINGS = LongitudinalSettings()
SHIFTS, SCALES = np.array([0.4, -0.3, 0.1, 0.0]), np.array([1.4, 0.7, 1.0, 1.1])


@pytest.fixture(autouse=True)
def _to_the_end(monkeypatch):
    """Estimate to rounding, as the published formulas are compared with."""
    monkeypatch.setattr(combat, "POSTERIOR_TOLERANCE", 1e-13)
    monkeypatch.setattr(combat, "POSTERIOR_STEPS", 1000)


def cohort(n=160, points=12, visits=1, seed=0):
    """Values with a group, an age, and effects of four sites; a participant's rows are together."""
    random = np.random.default_rng(seed)
    person = np.repeat(np.arange(n), visits)
    site = np.repeat(random.integers(0, 4, n), visits)
    group = np.repeat(random.random(n) < 0.2 + 0.2 * site[::visits], visits)
    age = np.repeat(random.normal(70, 6, n), visits) + np.tile(np.arange(visits), n)
    columns = np.column_stack([group, age]).astype(float)
    own = np.repeat(random.normal(0, 0.3, (n, points)), visits, axis=0) if visits > 1 else 0
    values = 2 - 0.2 * columns[:, :1] - 0.01 * columns[:, 1:] + own
    local = random.normal(0, 0.1, (4, points))
    values = values + SHIFTS[site][:, None] + local[site]
    values += SCALES[site][:, None] * random.normal(0, 0.3, (len(site), points))
    return values, Visits(site=site, columns=columns, participant=person if visits > 1 else None)


def pooled_by_loops(standard, site):
    """Empirical Bayes of Johnson et al. (2007), one site and one point after the other."""
    result = np.empty_like(standard)
    for one in np.unique(site):
        own = standard[site == one]
        n = len(own)
        means, variances = own.mean(axis=0), own.var(axis=0, ddof=1)
        prior_mean, prior_variance = means.mean(), means.var(ddof=1)
        m, s2 = variances.mean(), variances.var(ddof=1)
        shape, rate = (2 * s2 + m**2) / s2, (m * s2 + m**3) / s2
        for point in range(own.shape[1]):
            shift, variance = means[point], variances[point]
            for _ in range(1000):
                shift = (n * prior_variance * means[point] + variance * prior_mean) / (
                    n * prior_variance + variance
                )
                squares = np.sum((own[:, point] - shift) ** 2)
                variance = (rate + squares / 2) / (n / 2 + shape - 1)
            result[site == one, point] = (own[:, point] - shift) / np.sqrt(variance)
    return result


def combat_by_loops(values, site, columns):
    """Fortin et al. (2018), from the formulas of the paper."""
    member = (site[:, None] == np.unique(site)).astype(float)
    design = np.hstack([member, columns])
    result = np.empty_like(values)
    standard, expected, spread = (np.empty_like(values) for _ in range(3))
    for point in range(values.shape[1]):
        found = np.linalg.lstsq(design, values[:, point], rcond=None)[0]
        grand = member.mean(axis=0) @ found[: member.shape[1]]
        sd = np.sqrt(np.mean((values[:, point] - design @ found) ** 2))
        expected[:, point] = grand + columns @ found[member.shape[1] :]
        spread[:, point] = sd
        standard[:, point] = (values[:, point] - expected[:, point]) / sd
    result[:] = pooled_by_loops(standard, site) * spread + expected
    return result


def longitudinal_by_loops(values, site, columns, person):
    """Beer et al. (2020) with the root mean square of residuals, by models of statsmodels."""
    sites = np.unique(site)
    dummies = (site[:, None] == sites[1:]).astype(float)
    design = np.column_stack([np.ones(len(site)), dummies, columns - columns.mean(axis=0)])
    counts = np.array([(site == one).sum() for one in sites])
    expected, spread, standard = (np.empty_like(values) for _ in range(3))
    for point in range(values.shape[1]):
        fit = MixedLM(values[:, point], design, person).fit(reml=True)
        batch = np.concatenate([[0.0], fit.fe_params[1 : len(sites)]])
        batch = (batch - counts @ batch / len(site))[site]
        residual = values[:, point] - fit.fittedvalues
        sd = np.sqrt(np.mean((residual - residual.mean()) ** 2))
        expected[:, point] = fit.fittedvalues - batch
        standard[:, point] = (residual + batch) / sd
        spread[:, point] = sd
    return pooled_by_loops(standard, site) * spread + expected


def test_agrees_with_the_formulas_of_the_papers():
    values, visits = cohort()
    effects, _ = fit_effects(values, visits, 4, SETTINGS, pooled=True)
    reference = combat_by_loops(values, visits.site, visits.columns)
    np.testing.assert_allclose(harmonize(values, visits, effects), reference, atol=1e-10)


def test_repeated_sessions_agree_with_the_formulas_of_the_paper():
    values, visits = cohort(n=60, points=5, visits=3)
    effects, _ = fit_effects(values, visits, 4, SETTINGS, pooled=True)
    reference = longitudinal_by_loops(values, visits.site, visits.columns, visits.participant)
    # statsmodels' optimum is good to some 1e-6 of a variance.
    np.testing.assert_allclose(harmonize(values, visits, effects), reference, atol=2e-6)


def test_without_effects_of_sites_values_stay():
    """Each site's mean and SD are taken for what they are: chance, which shrinks with its size."""
    random = np.random.default_rng(3)
    site = np.repeat(np.arange(2), 4000)
    visits = Visits(site=site, columns=np.empty((8000, 0)), participant=None)
    values = random.normal(2.0, 0.3, (8000, 20))
    effects, _ = fit_effects(values, visits, 2, SETTINGS, pooled=True)
    changed = harmonize(values, visits, effects) - values
    assert np.abs(changed).max() < 0.3 * 0.15
    person = np.arange(8000) // 2
    repeated = Visits(site=site, columns=visits.columns, participant=person)
    effects, _ = fit_effects(values, repeated, 2, SETTINGS, pooled=True)
    changed = harmonize(values, repeated, effects) - values
    assert np.abs(changed).max() < 0.3 * 0.15


def test_unpooled_sites_have_the_same_mean_and_sd_of_residuals():
    values, visits = cohort()
    effects, moments = fit_effects(values, visits, 4, SETTINGS, pooled=False)
    assert np.ptp(moments.mean, axis=0).min() > 0.5
    again = fit_effects(harmonize(values, visits, effects), visits, 4, SETTINGS, pooled=False)[1]
    np.testing.assert_allclose(moments.after(effects).mean, 0, atol=1e-12)
    np.testing.assert_allclose(moments.after(effects).sd, 1, atol=1e-12)
    # Residuals are those of another fit now, as slopes change a little where scales did.
    np.testing.assert_allclose(again.sd / again.sd.mean(axis=0), 1, atol=0.03)


def test_missing_values_are_left_out_point_by_point():
    values, visits = cohort()
    holes = values.copy()
    holes[5:30, 2] = np.nan  # of all sites
    holes[visits.site == 1, 3] = np.nan  # a site that lacks a point
    holes[:, 4] = np.nan
    effects, _ = fit_effects(holes, visits, 4, SETTINGS, pooled=True)
    found = harmonize(holes, visits, effects)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(holes))
    # Unpooled, a point does not know of others.
    whole, _ = fit_effects(values, visits, 4, SETTINGS, pooled=False)
    parts, _ = fit_effects(holes, visits, 4, SETTINGS, pooled=False)
    apart = harmonize(holes, visits, parts)
    np.testing.assert_allclose(apart[:, :2], harmonize(values, visits, whole)[:, :2], rtol=1e-12)
    kept = np.isfinite(holes[:, 2])
    alone = fit_effects(
        values[kept, 2:3], visits.take(np.flatnonzero(kept)), 4, SETTINGS, pooled=False
    )
    np.testing.assert_allclose(
        apart[kept, 2],
        harmonize(values[kept, 2:3], visits.take(np.flatnonzero(kept)), alone[0])[:, 0],
        rtol=1e-12,
    )


@pytest.mark.parametrize("visits_each", [1, 2])
def test_new_people_of_known_sites_are_treated_alike(visits_each):
    values, visits = cohort(n=200, visits=visits_each)
    old, new = np.arange(0, 200), np.arange(200, len(values))
    if visits_each == 1:
        old, new = np.arange(0, 150), np.arange(150, 200)
    effects, _ = fit_effects(values[old], visits.take(old), 4, SETTINGS, pooled=True)
    everyone = harmonize(values, visits, effects)
    wide, _ = extend_effects(effects, values[new], visits.take(new), pooled=True)
    np.testing.assert_allclose(
        harmonize(values[new], visits.take(new), wide), everyone[new], rtol=1e-12
    )


def test_a_new_site_gets_the_scale_of_the_old_ones():
    values, visits = cohort(n=400)
    old, new = np.flatnonzero(visits.site != 3), np.flatnonzero(visits.site == 3)
    moved = values.copy()
    moved[new] = 2 * moved[new] + 1
    effects, _ = fit_effects(values[old], visits.take(old), 3, SETTINGS, pooled=True)
    wide, moments = extend_effects(effects, moved[new], visits.take(new), pooled=True)
    np.testing.assert_array_equal(wide.shift[:3], effects.shift)
    found = harmonize(moved[new], visits.take(new), wide)
    residual = (found - effects.mean - visits.columns[new] @ effects.slopes) / effects.sd
    assert np.abs(residual.mean()) < 0.02
    assert residual.std(axis=0).mean() == pytest.approx(1, abs=0.03)
    assert moments.sd[3].mean() > 1.9
