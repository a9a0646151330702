"""Participants of known norms."""

import numpy as np
import pytest

from hipsta_bids.extensions.norms.centiles import People, from_normal


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
