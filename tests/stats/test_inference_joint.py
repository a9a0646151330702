"""Several measures together: combined evidence, synchronized permutations."""

import numpy as np
import pytest
from scipy import stats

from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.inference import PermutationPart, combine_evidence, permute
from hipsta_bids.stats.settings import GlmSettings, MultiplicitySettings

SHEET = (6, 4)
HOW = MultiplicitySettings(method="permutation-tfce", permutations=300)
GROUP = Contrast("group", np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("how", ["fisher", "tippett"])
def test_evidence_is_that_of_scipy(how):
    p = np.random.default_rng(0).uniform(0, 0.3, (3, 50))
    expected = stats.norm.isf(stats.combine_pvalues(p, method=how, axis=0).pvalue / 2)
    np.testing.assert_allclose(combine_evidence(p, how), expected, rtol=1e-9)


@pytest.mark.parametrize("how", ["fisher", "tippett"])
def test_evidence_of_extreme_and_missing_p_values(how):
    z = combine_evidence(np.array([[0.0, 1.0, np.nan, 1e-200], [0.0, 1.0, 0.1, 0.5]]), how)
    assert np.isfinite(z[[0, 3]]).all()
    assert z[0] >= z[3] > 20
    assert z[1] == pytest.approx(0, abs=1e-7)
    assert np.isnan(z[2])


def case(seed=0, subjects=30):
    random = np.random.default_rng(seed)
    matrix = np.column_stack(
        [np.ones(subjects), np.arange(subjects) % 2, random.normal(70, 5, subjects)]
    )
    maps = random.standard_normal((2, subjects, 24)) - 0.8 * matrix[:, 1:2]
    return matrix, [
        PermutationPart(own, matrix, np.arange(subjects), sheet_edges(*SHEET)) for own in maps
    ]


@pytest.mark.parametrize("contrast", [GROUP, Contrast("both", np.eye(3)[1:])])
def test_a_measure_with_itself_has_its_own_p(contrast):
    """Evidence rises with t, so that every permutation has the same rank."""
    _, (part, _) = case()
    (alone,) = permute([part], contrast, settings=HOW)
    for how in ("fisher", "tippett"):
        (twice,) = permute([[part, part]], contrast, settings=HOW, combine=how)
        np.testing.assert_array_equal(twice.p_uncorrected, alone.p_uncorrected)
        np.testing.assert_array_equal(twice.p_max, alone.p_max)


def test_evidence_of_a_part_is_that_of_its_t_tests():
    matrix, parts = case(1)
    parts[0].maps[3, 7] = np.nan  # other degrees of freedom
    (found,) = permute([parts], GROUP, settings=HOW, combine="fisher")
    p = [fit_points(one.maps, matrix, [GROUP], GlmSettings()).tests[0].p for one in parts]
    keep = np.arange(24) != 7
    np.testing.assert_allclose(
        found.statistic[keep], combine_evidence(np.array(p), "fisher")[keep], rtol=1e-9
    )
    assert found.p_max.min() < 0.05
