"""Correction of fitted maps: which maps are one family, cut-offs, blocks, what is refused."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import glm, inference
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.exchangeability import Visits
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.settings import DesignSettings, GlmSettings, MultiplicitySettings

N, SHAPE = 24, (4, 3)
TABLE = pd.DataFrame({"group": np.resize(["A", "B"], N), "age": np.arange(N) % 7.0})
TABLE["site"] = np.repeat([10, 9, 8], N // 3)


def model_of(table, formula="group + age", contrasts=()):
    """A linear model of the rows of a table."""
    spec = parse_model(model_from_shortcut(formula, list(contrasts), "m"))
    return glm.RowModel(build_design(table, spec, DesignSettings(), {}), GlmSettings())


MODEL = model_of(TABLE)
RULES = MultiplicitySettings(method="permutation-max", permutations=60, scope="map")
MAX, ENHANCED = "permutation-max", "permutation-tfce"


def side_of(seed, difference=0.0):
    """Two measures at twelve points; group B is larger at the first four."""
    values = np.random.default_rng(seed).standard_normal((2, N, *SHAPE))
    values[:, 1::2, 0] += difference
    maps = dict(zip(("thickness", "mean_curvature"), values, strict=True))
    return SideMaps(
        rows=np.arange(N),
        maps=maps,
        subfield=np.zeros((N, *SHAPE), dtype=np.int8),
        names=("CA1",),
        summary=pd.DataFrame(index=range(N)),
    )


@pytest.fixture(scope="module")
def fitted():
    return {hemi: glm.fit_maps(hemi, side_of(n, 1.6), MODEL) for n, hemi in enumerate("LR")}


def p_of(fitted, key):
    (p,) = (
        t.p for t in fitted[key.hemi].fits[key.measure].tests if t.contrast.name == key.contrast
    )
    return p


@pytest.mark.parametrize(("scope", "count"), [("map", 12), ("hemispheres", 24), ("all", 48)])
@pytest.mark.parametrize("method", ["fdr2", MAX, ENHANCED])
def test_tests_of_a_family_are_counted_and_cut_together(fitted, scope, count, method):
    rules = RULES.changed(method=method, scope=scope)
    results = inference.correct(fitted, MODEL, TABLE, rules)
    assert len(results) == 8
    assert {result.n_tests for result in results.values()} == {count}
    for family in inference.families(results, scope):
        assert len(family) == count // 12
        p, adjusted, rejected = (
            np.concatenate(values)
            for values in zip(
                *(
                    (p_of(fitted, key), results[key].adjusted, results[key].rejected)
                    for key in family
                ),
                strict=True,
            )
        )
        cutoffs = {results[key].cutoff for key in family}
        if method == "fdr2":
            expected = inference.control_fdr(p, rules.alpha)
            np.testing.assert_array_equal(adjusted, expected.adjusted)
            assert cutoffs == {expected.cutoff}
            continue
        np.testing.assert_array_equal(rejected, adjusted <= rules.alpha)
        assert (adjusted * 60).round(9).tolist() == np.round(adjusted * 60).tolist()
        if method == MAX:
            (cutoff,) = cutoffs
            assert cutoff == pytest.approx(p[rejected].max() if rejected.any() else p.min() / 10)
            order = np.argsort(p)  # of one family with one df the smallest p is the largest t
            assert (np.diff(adjusted[order]) >= 0).all()
    if method == ENHANCED:
        assert np.isnan([result.cutoff for result in results.values()]).all()
    groups = [key for key in results if key.contrast == "A-B"]
    assert sum(results[key].rejected[:3].sum() for key in groups) >= 2
    assert not any(results[key].rejected[3:].any() for key in results if key.contrast == "age")


def test_the_family_is_that_of_permute(fitted):
    rules = RULES.changed(scope="hemispheres")
    results = inference.correct(fitted, MODEL, TABLE, rules)
    (contrast,) = (c for c in MODEL.design.contrasts if c.name == "A-B")
    edges = inference.edges_of(fitted["L"].maps, rules.neighbors)
    parts = [
        inference.PermutationPart(side.values("thickness"), MODEL.design.matrix, side.rows, edges)
        for side in fitted.values()
    ]
    for hemi, expected in zip(
        "LR", inference.permute(parts, contrast, settings=rules), strict=True
    ):
        result = results[inference.MapKey("thickness", "A-B", hemi)]
        np.testing.assert_array_equal(result.adjusted, expected.p_max)


def test_points_without_an_ordinary_test_are_no_tests_and_progress_reaches_the_end(fitted):
    fit = fitted["L"].fits["thickness"]
    p = fit.tests[0].p.copy()
    p[[1, 5]] = np.nan
    fits = {"thickness": replace(fit, tests=(replace(fit.tests[0], p=p), fit.tests[1]))}
    side, steps = {"L": replace(fitted["L"], fits=fits)}, []
    results = inference.correct(
        side, MODEL, TABLE, RULES, report=lambda done, of: steps.append((done, of))
    )
    first = results[inference.MapKey("thickness", "A-B", "L")]
    assert np.flatnonzero(np.isnan(first.adjusted)).tolist() == [1, 5]
    assert first.n_tests == 10
    assert not first.rejected[[1, 5]].any()
    assert steps == [(0, 120), (50, 120), (60, 120), (110, 120)]
    whole = inference.correct({"L": fitted["L"]}, MODEL, TABLE, RULES)
    kept = np.isfinite(first.adjusted)
    np.testing.assert_array_equal(
        first.adjusted[kept], whole[inference.MapKey("thickness", "A-B", "L")].adjusted[kept]
    )


def test_points_where_the_model_cannot_be_fitted_are_missing_when_permuted():
    side = side_of(3)
    side.maps["thickness"][4:, 2, 1] = np.nan
    results = inference.correct({"L": glm.fit_maps("L", side, MODEL)}, MODEL, TABLE, RULES)
    adjusted = results[inference.MapKey("thickness", "A-B", "L")].adjusted
    assert np.flatnonzero(np.isnan(adjusted)).tolist() == [7]


@pytest.mark.parametrize("method", ["fdr2", MAX, ENHANCED])
def test_measures_together_are_permuted_with_any_method(fitted, method):
    key, rules = inference.MapKey("joint", "A-B", "L"), RULES.changed(method=method)
    contrasts = {c.name: c for c in MODEL.design.contrasts}
    together = {key: {m: (fitted["L"], m) for m in ("thickness", "mean_curvature")}}
    results = inference.correct_joint(together, contrasts, MODEL, TABLE, rules, combine="fisher")
    test, result = results[key]
    np.testing.assert_array_equal(
        result.adjusted, test.p_enhanced if method == ENHANCED else test.p_max
    )
    assert np.isnan(test.p_enhanced).all() == (method != ENHANCED)
    if method != ENHANCED:  # cut-offs are of the permuted p of points
        p = test.p_uncorrected
        assert result.rejected.any()
        assert result.cutoff == p[result.rejected].max()


def test_one_sided_tests_need_the_level_itself():
    model = model_of(TABLE, "group", ["group[B]-group[A] > 0"])
    side = glm.fit_maps("L", side_of(0, 3.0), model)
    side.maps.maps["thickness"][1::2] += 0.9  # most points differ: two stages are lenient
    side = glm.fit_maps("L", side.maps, model)
    ((key, result),) = (
        pair
        for pair in inference.correct(
            {"L": side}, model, TABLE, RULES.changed(method="fdr2")
        ).items()
        if pair[0].measure == "thickness"
    )
    p = p_of({"L": side}, key)
    plain = inference.control_fdr(p, 0.05)
    np.testing.assert_array_equal(result.adjusted, np.maximum(plain.adjusted, p))
    assert (p[result.rejected] <= 0.05).all()
    with pytest.raises(
        ModelError, match=r"one-sided tests are not permuted.*fdr2, without --joint"
    ):
        inference.check_permutations(
            RULES.changed(method="fdr2"),
            GlmSettings(),
            model.design.contrasts,
            further={"--joint": True},
        )
    inference.check_permutations(
        RULES.changed(method="fdr2"), GlmSettings(covariance="hc3"), model.design.contrasts
    )
    with pytest.raises(ModelError, match="one-sided tests are not permuted"):
        inference.check_permutations(RULES, GlmSettings(), model.design.contrasts)
    with pytest.raises(ModelError, match="assume equal variances"):
        inference.check_permutations(RULES, GlmSettings(covariance="hc3"), [])
    inference.check_permutations(RULES, GlmSettings(), MODEL.design.contrasts)


def test_blocks_are_those_of_the_rows_of_the_design():
    assert inference.row_blocks(MODEL, TABLE, RULES) is None
    rules = RULES.changed(blocks="site")
    blocks = inference.row_blocks(MODEL, TABLE, rules)
    assert blocks.tolist() == np.repeat([0, 2, 1], 8).tolist()  # in the order of texts
    shorter = TABLE.assign(age=TABLE.age.where(TABLE.index > 7))
    model = model_of(shorter)
    assert inference.row_blocks(model, shorter, rules).tolist() == np.repeat([1, 0], 8).tolist()
    gaps = TABLE.assign(site=TABLE.site.where(TABLE.index != 5))
    with pytest.raises(ModelError, match="column 'site' of --blocks is missing for 5"):
        inference.row_blocks(MODEL, gaps, rules)
    with pytest.raises(ModelError, match="'nothing'"):
        inference.row_blocks(MODEL, TABLE, RULES.changed(blocks="nothing"))


def test_participants_stay_in_their_block():
    class Repeated(glm.RowModel):
        @property
        def visits(self):
            return Visits(people=np.arange(N) // 2)

    model, rules = Repeated(MODEL.design, MODEL.settings), RULES.changed(blocks="site")
    assert len(inference.row_blocks(model, TABLE, rules)) == N
    moved = TABLE.assign(site=np.where(TABLE.index == 3, 10**3, TABLE.site))
    with pytest.raises(ModelError, match="'site' of --blocks changes between visits"):
        inference.row_blocks(model, moved, rules)


def test_blocks_limit_what_is_shuffled(fitted):
    by_group = TABLE.assign(site=TABLE.group)
    with pytest.raises(ModelError, match="A-B does not vary inside the blocks"):
        inference.correct(fitted, MODEL, by_group, RULES.changed(blocks="site"))
    free, inside = (
        inference.correct(fitted, MODEL, TABLE, RULES.changed(blocks=name))
        for name in (RULES.blocks, "site")
    )
    key = inference.MapKey("thickness", "A-B", "R")
    assert (free[key].adjusted != inside[key].adjusted).any()
