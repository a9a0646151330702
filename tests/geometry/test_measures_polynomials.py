"""Smoothed derivatives: exact on polynomials, and SciPy's everywhere."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.signal import savgol_filter

from hipsta_bids.geometry.measures import differentiate


@pytest.mark.parametrize("times", [0, 1, 2, 3, 4])
def test_polynomials_are_differentiated_exactly(times):
    cubic = Polynomial([0.3, -1.2, 0.05, 0.01])
    nodes = np.arange(21.0)
    found = differentiate(cubic(nodes), 9, 3, times, axis=0)
    # Rounding of values up to 100.
    np.testing.assert_allclose(
        found, cubic.deriv(times)(nodes) if times else cubic(nodes), atol=1e-11
    )


@pytest.mark.parametrize(("window", "degree"), [(3, 1), (5, 4), (9, 3), (21, 3)])
@pytest.mark.parametrize("times", [0, 1, 2])
@pytest.mark.parametrize("axis", [0, 1])
def test_derivatives_are_scipys(window, degree, times, axis):
    values = np.random.default_rng(4).standard_normal((41, 21, 3))
    found = differentiate(values, window, degree, times, axis)
    wanted = savgol_filter(values, window, polyorder=degree, deriv=times, axis=axis)
    # Rounding of sums of at most 21 terms of size one, in SciPy's fits at the ends too.
    np.testing.assert_allclose(found, wanted, atol=1e-11)
