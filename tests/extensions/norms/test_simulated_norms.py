"""Centiles of simulated populations."""

import numpy as np

from hipsta_bids.extensions.norms import centiles as norms_module
from hipsta_bids.extensions.norms.settings import NormSettings
from validation import norms as suite


def test_shape_makes_centiles_hold_that_do_not_without_it(monkeypatch):
    skewed = suite.POPULATIONS[2]
    found = {}
    for level in (0.05, 1e-300):
        monkeypatch.setattr(norms_module, "SHAPE_LEVEL", level)
        shares = dict(suite.calibrate(skewed, 24, NormSettings()))["known sites"].mean(axis=1)
        found[level] = 100 * np.abs(shares - suite.LEVELS).max()
    assert found[0.05] < suite.MAX_ERROR < found[1e-300]
