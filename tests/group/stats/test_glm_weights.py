"""Weights by uncertainty: against statsmodels, in simulations, and at the command line."""

import json

import numpy as np
import pandas as pd
import pytest
from small_cohorts import place_of, write_dataset
from statsmodels.regression.linear_model import OLS, WLS

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.hemisphere import format_column
from hipsta_bids.group.design.formula import Contrast
from hipsta_bids.group.design.settings import GlmSettings
from hipsta_bids.group.output import write
from hipsta_bids.group.stats import glm
from hipsta_bids.group.stats.glm import LEAST_BETWEEN, fit_points, uncertainty_weights
from hipsta_bids.io import files

SETTINGS = GlmSettings(weights="uncertainty")


def case(seed, subjects=60, points=40, *, between=0.15, effect=0.0, copies=8, ratio=10.0):
    """Maps with a variance between subjects, and errors whose SD is known from a few copies."""
    random = np.random.default_rng(seed)
    matrix = np.column_stack(
        [np.ones(subjects), np.arange(subjects) % 2, random.normal(0, 1, subjects)]
    )
    # The worst is ten times as noisy as the best one, as thick slices beside thin ones.
    true_sd = 0.05 * ratio ** random.uniform(0, 1, (subjects, 1)) * np.ones(points)
    errors = true_sd * np.sqrt(random.chisquare(copies - 1, true_sd.shape) / (copies - 1))
    noise = random.normal(0, between, true_sd.shape) + random.normal(0, true_sd)
    return random, matrix, 2 + effect * matrix[:, 1:2] + noise, errors


def by_hand(y, matrix, sd):
    """The formulas of the documentation, one point, with statsmodels."""
    plain = OLS(y, matrix).fit()
    leverage = plain.get_influence().hat_matrix_diag
    freedom = len(y) - matrix.shape[1]
    between = (np.sum(plain.resid**2) - np.sum(sd**2 * (1 - leverage))) / freedom
    between = max(between, LEAST_BETWEEN * plain.scale)
    weights = 1 / (between + sd**2)
    return WLS(y, matrix, weights=weights / weights.mean()).fit(cov_type="HC3", use_t=True)


@pytest.mark.parametrize("between", [0.15, 0.0], ids=["usual", "errors alone"])
def test_fit_agrees_with_statsmodels(between):
    random, matrix, maps, errors = case(1, between=between)
    maps[random.random(maps.shape) < 0.1] = np.nan
    errors[random.random(maps.shape) < 0.1] = np.nan
    contrasts = [Contrast("group", np.array([[0.0, 1, 0]])), Contrast("both", np.eye(3)[1:])]
    fit = fit_points(maps, matrix, contrasts, SETTINGS, errors)
    for point in range(maps.shape[1]):
        own = np.isfinite(maps[:, point]) & np.isfinite(errors[:, point])
        found = by_hand(maps[own, point], matrix[own], errors[own, point])
        assert fit.n[point] == own.sum()
        # rounding of two orders of summation
        np.testing.assert_allclose(fit.coefficients[:, point], found.params, rtol=1e-9)
        assert fit.sigma[point] == pytest.approx(np.sqrt(found.scale), rel=1e-9)
        t, f = fit.tests
        assert t.statistic[point] == pytest.approx(found.tvalues[1], rel=1e-9)
        assert t.p[point] == pytest.approx(found.pvalues[1], rel=1e-8)
        assert t.df[point] == found.df_resid
        assert f.statistic[point] == pytest.approx(found.f_test(np.eye(3)[1:]).fvalue, rel=1e-9)


def test_equal_errors_are_no_weights():
    _, matrix, maps, errors = case(2)
    contrast = [Contrast("group", np.array([[0.0, 1, 0]]))]
    plain = fit_points(maps, matrix, contrast, GlmSettings(covariance="hc3"))
    same = fit_points(maps, matrix, contrast, SETTINGS, np.full_like(errors, 0.1))
    np.testing.assert_allclose(same.tests[0].statistic, plain.tests[0].statistic, rtol=1e-9)
    np.testing.assert_allclose(same.sigma, plain.sigma, rtol=1e-9)


def test_variance_between_subjects_is_found(monkeypatch):
    """Of many points: the estimate of moments has no bias."""
    _, matrix, maps, errors = case(3, points=4000, copies=1000, ratio=2.0)
    basis = np.linalg.qr(matrix)[0]
    monkeypatch.setattr(glm, "LEAST_BETWEEN", 0.01)
    weights = uncertainty_weights(maps, errors, basis, SETTINGS)
    # of two subjects with known errors: 1 / w = c (t2 + s2)
    a, b = errors[:, 0].argmin(), errors[:, 0].argmax()
    ratio = weights[a] / weights[b]
    between = (errors[b] ** 2 - ratio * errors[a] ** 2) / (ratio - 1)
    assert np.mean(between) == pytest.approx(0.15**2, rel=0.05)


def rates(effect):
    """Share of p <= .05, with weights and without, over cohorts of their own SDs."""
    contrast = [Contrast("group", np.array([[0.0, 1, 0]]))]
    found = []
    for seed in range(60):
        _, matrix, maps, errors = case(100 + seed, points=100, effect=effect)
        fits = (
            fit_points(maps, matrix, contrast, SETTINGS, errors),
            fit_points(maps, matrix, contrast, GlmSettings()),
        )
        found.append([np.mean(fit.tests[0].p <= 0.05) for fit in fits])
    return np.mean(found, axis=0)


def test_simulated_errors_are_kept_and_power_gained():
    """60 cohorts: a rate of .05 is known to .004 (one standard error, over cohorts)."""
    weighted, plain = rates(0.0)
    assert 0.03 < weighted < 0.06  # HC3 is a little cautious
    assert plain == pytest.approx(0.05, abs=0.012)
    weighted, plain = rates(0.12)
    assert weighted > plain + 0.05


def test_wrong_scale_of_all_errors_keeps_the_level():
    contrast = [Contrast("group", np.array([[0.0, 1, 0]]))]
    for factor in (0.5, 2.0):
        p = []
        for seed in range(40):
            _, matrix, maps, errors = case(300 + seed, points=200)
            p.append(fit_points(maps, matrix, contrast, SETTINGS, factor * errors).tests[0].p)
        assert 0.03 < np.mean(np.array(p) <= 0.05) < 0.06  # with ordinary ones .075 if too large


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Sheets with SDs; those of the first five participants are large."""
    data, out = write_dataset(tmp_path_factory.mktemp("weights"))
    for record in sorted(out.rglob("*_desc-qc_metrics.json")):
        subject, hemi = (record.name.split(key)[1].split("_")[0] for key in ("sub-", "hemi-"))
        place = place_of(out, subject, hemi)
        sheet = pd.read_csv(place.path("sheet"), sep="\t")
        sd = np.full(len(sheet), 0.5 if int(subject) <= 5 else 0.05)
        columns = ["x", "y", "thickness_sd", "curvature_sd"]
        cells = [*(map(str, sheet[c]) for c in "xy"), format_column(sd, 4), format_column(sd, 5)]
        files.write_tsv(place.path("uncertainty"), columns, zip(*cells, strict=True))
    return data, out


def group(dataset, quick, monkeypatch, *options):
    data, out = dataset
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))
    command = [str(data), str(out), "group", *quick, "--align", "none"]
    return main([*command, "--formula", "thickness ~ group", *options])


def test_maps_are_weighted_at_the_command_line(dataset, quick, monkeypatch):
    for name, options in (("plain", []), ("weighted", ["--weights", "uncertainty"])):
        assert group(dataset, quick, monkeypatch, "--name", name, *options) == 0
    folder = dataset[1] / "group"
    plain, weighted = (
        pd.read_csv(folder / name / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv", sep="\t")
        for name in ("plain", "weighted")
    )
    sheets = [
        pd.read_csv(place_of(dataset[1], f"{i + 1:02d}", "L").path("sheet"), sep="\t").thickness
        for i in range(30)
    ]
    people = pd.read_csv(dataset[0] / "participants.tsv", sep="\t")
    matrix = np.column_stack([np.ones(30), people.group == "CN"])
    sd = np.where(np.arange(30) < 5, 0.5, 0.05)
    found = by_hand(np.array([s[7] for s in sheets]), matrix, sd)
    assert weighted.statistic[7] == pytest.approx(found.tvalues[1], rel=1e-3)  # digits in tables
    assert abs(plain.statistic[7] - weighted.statistic[7]) > 0.01
    methods = (folder / "weighted" / "methods.md").read_text()
    assert "weighted least squares" in methods
    assert "weighted least squares" not in (folder / "plain" / "methods.md").read_text()
    settings = json.loads((folder / "weighted" / "analysis.json").read_text())["settings"]
    assert settings["glm"]["weights"] == "uncertainty"


@pytest.mark.parametrize(
    "other",
    [
        ["--correction", "permutation-max"],
        ["--asymmetry"],
        ["--normative", "group=CN"],
    ],
)
def test_weights_do_not_go_with_what_has_no_rule_for_them(
    dataset, quick, monkeypatch, capsys, other
):
    assert group(dataset, quick, monkeypatch, "--weights", "uncertainty", *other) == 65
    assert "--weights uncertainty: not together with" in capsys.readouterr().err


def test_a_hemisphere_without_sds_is_named(dataset, quick, monkeypatch, capsys):
    path = place_of(dataset[1], "07", "R").path("uncertainty")
    aside = path.rename(path.with_suffix(".aside"))
    try:
        assert group(dataset, quick, monkeypatch, "--weights", "uncertainty") == 65
    finally:
        aside.rename(path)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "1 of 60 hemispheres have no SD maps (sub-07_hemi-R)" in lines[0]
    assert "--uncertainty 8" in lines[0]
