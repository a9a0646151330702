"""Norms against libraries and known truth: spline, mean and SD, shape, sites, files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import integrate, interpolate, optimize, stats

from hipsta_bids.errors import ModelError
from hipsta_bids.group.design.settings import NormSettings
from hipsta_bids.group.output.saved import NormsFile, load_norms, save_norms
from hipsta_bids.group.stats import norms as norms_module
from hipsta_bids.group.stats.norms import People, age_columns, fit_norms, from_normal, to_normal
from validation import norms as suite

SETTINGS = NormSettings()
KNOTS = np.array([20.0, 35, 50, 70, 90])
SHAPES = np.array([[0.0, 0.8, -2.0, 0.3], [0.0, 0.0, -0.4, 0.5]])


@pytest.fixture(scope="module")
def cohort():
    """Five points of two sites; the SD grows with age, values are skewed."""
    random = np.random.default_rng(3)
    site = np.repeat([0, 1], [70, 50])
    age, sex = random.uniform(20, 90, 120), (np.arange(120) % 2).astype(float)
    shape = np.array([[0.5] * 5, [0.0] * 5])
    own = from_normal(random.standard_normal((120, 5)), shape)
    sd = 0.1 * np.exp(0.01 * (age - 20)) * np.array([1.0, 1.5])[site]
    values = (2 - 0.01 * age + 0.1 * sex + 0.2 * site)[:, None] + sd[:, None] * own
    return values, People(age=age, sex=sex[:, None], site=site)


def test_spline_has_every_natural_cubic_spline_of_its_knots():
    spline = interpolate.CubicSpline(KNOTS, [1.0, 3, -2, 0, 5], bc_type="natural")
    age = np.linspace(20, 90, 200)
    columns = np.column_stack([np.ones(200), age_columns(age, KNOTS)])
    assert columns.shape[1] == len(KNOTS)
    left = spline(age) - columns @ np.linalg.lstsq(columns, spline(age), rcond=None)[0]
    np.testing.assert_allclose(left, 0, atol=1e-10)


def test_distributions_have_mean_zero_and_sd_one_and_an_inverse():
    z = np.linspace(-3, 3, 13)[:, None] * np.ones(4)
    np.testing.assert_allclose(to_normal(from_normal(z, SHAPES), SHAPES), z, atol=1e-9)
    for shape in SHAPES.T[:, :, None]:
        moments = [
            integrate.quad(
                lambda z, k=k, s=shape: (
                    from_normal(np.array([[z]]), s)[0, 0] ** k * stats.norm.pdf(z)
                ),
                -12,
                12,
            )[0]
            for k in (1, 2)
        ]
        np.testing.assert_allclose(moments, [0, 1], atol=1e-7)


def test_mean_and_sd_are_those_of_statsmodels(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    mean, sd = norms.expected(people)
    mean = mean + norms.shift[people.site]
    sd = sd * norms.scale[people.site]
    member = np.eye(2)[people.site]
    design = np.column_stack([member, age_columns(people.age, KNOTS), people.sex])
    kept = 1 - np.sum(np.linalg.qr(design)[0] ** 2, axis=1)
    spread = np.column_stack([member, people.age])
    for point in range(5):
        weighted = sm.WLS(values[:, point], design, weights=sd[:, point] ** -2).fit()
        np.testing.assert_allclose(mean[:, point], weighted.fittedvalues, atol=1e-5)
        square = weighted.resid**2 / kept
        gamma = sm.GLM(square, spread, sm.families.Gamma(sm.families.links.Log())).fit()
        np.testing.assert_allclose(sd[:, point], np.sqrt(gamma.fittedvalues), rtol=1e-3)


def test_shape_is_the_most_likely_one_and_only_where_it_is_needed(monkeypatch):
    random = np.random.default_rng(1)
    n = 400
    people = People(age=random.uniform(20, 90, n), sex=np.zeros((n, 0)), site=np.zeros(n, int))
    shape = np.array([[0.6, 0.0], [-0.1, 0.0]])
    values = from_normal(random.standard_normal((n, 2)), shape)
    monkeypatch.setattr(norms_module, "SHAPE_LEVEL", 1e-3)
    norms = fit_norms(values, people, 1, KNOTS, SETTINGS)
    assert norms.shape[:, 1].tolist() == [0, 0]
    mean, sd = norms.expected(people)
    rest = ((values - mean) / sd)[:, 0]

    def loss(shape):
        shape = np.asarray(shape)[:, None]
        step = 1e-5
        up, down = (to_normal(rest[:, None] + s * step, shape) for s in (1, -1))
        slope = (up - down)[:, 0] / (2 * step)
        return -np.sum(stats.norm.logpdf(to_normal(rest[:, None], shape)[:, 0]) + np.log(slope))

    best = optimize.minimize(loss, [0.1, 0.1], method="Nelder-Mead", options={"fatol": 1e-7})
    np.testing.assert_allclose(norms.shape[:, 0], best.x, atol=0.01)


def test_missing_values_stay_local(cohort):
    values, people = cohort
    holes = values.copy()
    holes[people.site == 1, 1] = np.nan  # a site without values at a point
    holes[:, 2] = 1.0  # constant
    holes[:5, 3] = np.nan
    whole, norms = (fit_norms(one, people, 2, KNOTS, SETTINGS) for one in (values, holes))
    np.testing.assert_allclose(norms.mean[:, [0, 4]], whole.mean[:, [0, 4]], rtol=1e-6)
    assert np.isnan(norms.shift[1, 1])
    assert np.isfinite(norms.score(values, people)[people.site == 0, 1]).all()
    assert np.isnan(norms.score(values, people)[people.site == 1, 1]).all()
    assert np.isnan(norms.mean[:, 2]).all()
    fewer = fit_norms(values[5:, [3]], people.take(slice(5, None)), 2, KNOTS, SETTINGS)
    # Leverages are those of all people.
    np.testing.assert_allclose(norms.shift[:, 3], fewer.shift[:, 0], atol=0.01)
    assert norms.n[:, 3].tolist() == [65, 50]


def test_a_new_site_takes_its_shift_and_scale_from_controls(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    same = replace(people, site=people.site + 2)  # as if nobody knew these sites
    moved = norms.extended(values, same, 4, 25)
    np.testing.assert_allclose(moved.shift[2:], norms.shift, atol=0.01)
    np.testing.assert_allclose(moved.scale[2:], norms.scale, rtol=0.04)
    np.testing.assert_array_equal(moved.mean, norms.mean)
    # A site is known from its controls only: Student's distribution.
    mean, sd = moved.expected(same)
    r = (values - mean - moved.shift[same.site]) / (sd * moved.scale[same.site])
    n = np.array([0, 0, 70, 50])[same.site][:, None]
    wider = np.sqrt(1 + 1 / n + 5 / 240)  # five columns of age and sex
    p = stats.t.cdf(to_normal(r, moved.shape) / wider, n - 1)
    np.testing.assert_allclose(stats.norm.cdf(moved.score(values, same)), p, atol=1e-12)
    few = norms.extended(values[:80], same.take(slice(0, 80)), 4, 25)
    assert np.isnan(few.shift[3]).all()


def test_centiles_and_the_average_site_go_with_scores(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    low, middle, high = norms.centiles(people, (0.05, 0.5, 0.95))
    assert (low < middle).all()
    assert (middle < high).all()
    average = norms.average_site(values, people)
    z = norms.score(values, people)
    inside = np.abs(z - stats.norm.ppf(0.05)) > 0.05
    np.testing.assert_array_equal((average < low)[inside], (z < stats.norm.ppf(0.05))[inside])


def test_shape_makes_centiles_hold_that_do_not_without_it(monkeypatch):
    skewed = suite.POPULATIONS[2]
    found = {}
    for level in (0.05, 1e-300):
        monkeypatch.setattr(norms_module, "SHAPE_LEVEL", level)
        shares = dict(suite.calibrate(skewed, 24, SETTINGS))["known sites"].mean(axis=1)
        found[level] = 100 * np.abs(shares - suite.LEVELS).max()
    assert found[0.05] < suite.MAX_ERROR < found[1e-300]


@pytest.fixture
def written(cohort, tmp_path):
    values, people = cohort
    norms = {("L", "thickness"): fit_norms(values, people, 2, KNOTS, SETTINGS)}
    file = NormsFile(
        description="norms", format=1, hash="", version="1", versions=["1"], seg="demo",
        region="body", settings_hash="0", registration={}, template=None, x=[0.0], y=[0.0],
        age="age", sex="sex", site="site", knots=KNOTS.tolist(), sexes=["F", "M"],
        sites={"A": 70, "B": 50}, participants=120, norms={},
    )  # fmt: skip
    save_norms(tmp_path / "norms.json", file, norms)
    return tmp_path / "norms.json", norms


def test_files_give_the_same_scores(written, cohort):
    path, norms = written
    file, read = load_norms(path)
    assert file.sites == {"A": 70, "B": 50}
    key = "L", "thickness"
    np.testing.assert_allclose(read[key].score(*cohort), norms[key].score(*cohort), atol=1e-6)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda c: c.update(participants=7), "changed after it was written"),
        (lambda c: c.update(format=2), "format"),
        (lambda c: c.update(code="import os"), "code"),
        (lambda c: c.update(Hemispheres={}), r"norms \(it is a template of registration\)"),
        (lambda c: c["norms"]["L"]["thickness"]["shift"].pop(), "do not fit each other"),
        (lambda c: c["norms"]["L"]["thickness"]["mean"][0].pop(), "do not fit each other"),
        (
            lambda c: c["norms"]["L"]["thickness"]["scale"][0].__setitem__(0, -1.0),
            "has to be above 0",
        ),
        (lambda c: c.update(knots=[3.0, 2.0, 1.0]), "ascend"),
        (lambda c: c.update(seg="\x1b[31m"), "control characters"),
    ],
)
def test_damaged_files_are_refused_in_one_line(written, edit, said):
    path, _ = written
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ModelError, match=said) as error:
        load_norms(path)
    assert "\n" not in str(error.value)
