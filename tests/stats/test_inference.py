"""False discovery rates against published and R values, brute force, and simulation."""

import numpy as np
import pytest
from scipy import stats

from hipsta_bids.stats.inference import control_fdr

#: Example of Benjamini and Hochberg (1995), used again in the paper of 2006.
P = np.concatenate(
    [
        [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459],
        [0.324, 0.4262, 0.5719, 0.6528, 0.759, 1.0],
    ]
)


def test_one_sided_tests_survive_at_their_own_level_only():
    """Two stages estimate that nearly all hypotheses are false, and reject what has a large p."""
    p = np.append(np.full(99, 1e-4), 0.4)
    found = control_fdr(p, 0.05)
    assert found.rejected.all()
    assert found.lenient
    strict = found.at_least(p)
    np.testing.assert_array_equal(strict.rejected, p <= 0.05)
    assert strict.cutoff == 1e-4
    assert strict.adjusted[-1] == 0.4
    np.testing.assert_array_equal(strict.adjusted[:-1], found.adjusted[:-1].clip(1e-4))
    assert not strict.lenient


def test_published_example():
    found = control_fdr(P, 0.05)
    assert found.rejected.sum() == 8  # Benjamini, Krieger, Yekutieli 2006, section 6
    assert found.cutoff == 0.0344
    assert not found.lenient
    assert control_fdr(P, 0.05, "bh").rejected.sum() == 4


def test_adjusted_values_agree_with_reference(oracle):
    expected = oracle["fdr2"]
    p = np.array(expected["p"])
    found = control_fdr(p, 0.05)
    np.testing.assert_allclose(found.adjusted, expected["pFDR2_alpha05"], rtol=1e-6)
    assert found.cutoff == expected["lme_pth"]
    assert found.rejected.sum() == expected["n_reject"]


@pytest.mark.parametrize("level", [0.05, 0.1])
@pytest.mark.parametrize("name", ["a", "bky"])
def test_vectors_agree_with_reference(oracle, name, level):
    vector = oracle["fdr2"]["ref_vectors"][name]
    p, expected = np.array(vector["p"]), vector[f"a{level}"]
    found = control_fdr(p, level)
    np.testing.assert_allclose(control_fdr(p, level, "bh").adjusted, vector["BH"], rtol=1e-6)
    assert found.cutoff == pytest.approx(expected["pth"], rel=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(found.rejected) + 1, expected["det"])


def by_brute_force(p, alpha):
    """The procedure as the paper words it."""
    m, order = len(p), np.sort(p)

    def rejects(level, count):
        below = np.flatnonzero(order <= np.arange(1, m + 1) * level / count)
        return order[below[-1]] if len(below) else -1.0

    rate = alpha / (1 + alpha)
    first = (p <= rejects(rate, m)).sum()
    if first in {0, m}:
        return np.full(m, first == m)
    return p <= rejects(rate * m / (m - first), m)


@pytest.mark.parametrize("seed", range(8))
def test_rejections_are_those_of_the_published_procedure(seed):
    random = np.random.default_rng(seed)
    p = np.concatenate([random.beta(0.1, 3, 6 * seed), random.random(30)])
    for alpha in (0.003, 0.02, 0.05, 0.1, 0.3, 0.8):
        np.testing.assert_array_equal(control_fdr(p, alpha).rejected, by_brute_force(p, alpha))


def test_missing_tests_do_not_count():
    p = np.full((5, 6), np.nan)
    p.flat[3:18] = P
    found = control_fdr(p, 0.05)
    assert found.n_tests == 15
    np.testing.assert_array_equal(found.adjusted.flat[3:18], control_fdr(P, 0.05).adjusted)
    assert np.isnan(found.adjusted.flat[18:]).all()
    assert not found.rejected.flat[18:].any()
    none = control_fdr(np.full(4, np.nan), 0.05)
    assert np.isnan(none.cutoff)
    assert none.n_tests == 0


def test_widespread_effects_are_called_lenient():
    p = np.concatenate([np.full(90, 1e-6), np.linspace(0.04, 0.2, 10)])
    found = control_fdr(p, 0.05)
    assert found.cutoff > 0.05
    assert found.lenient


def test_false_discovery_rate_is_kept_and_power_gained():
    random = np.random.default_rng(0)
    shares, hits = [], {"two": 0, "one": 0}
    for _ in range(400):
        z = random.standard_normal(200)
        z[:80] += 3
        p = 2 * stats.norm.sf(abs(z))
        two, one = control_fdr(p, 0.05).rejected, control_fdr(p, 0.05, "bh").rejected
        shares.append(two[80:].sum() / max(two.sum(), 1))
        hits["two"] += two[:80].sum()
        hits["one"] += one[:80].sum()
    assert np.mean(shares) < 0.05 + 3 * np.std(shares) / 20  # three standard errors
    assert hits["two"] > hits["one"]
