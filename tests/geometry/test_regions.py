"""Regions drawn on the sheet: counts, areas, means."""

import numpy as np
import pytest

from hipsta_bids.geometry.sampling import Regions, summarize_regions
from hipsta_bids.types import Sheet


def flat():
    """A flat sheet of 5 x 4 nodes, 2 x 3 mm apart; one column is not valid."""
    x, y, z = np.meshgrid(2.0 * np.arange(5), 3.0 * np.arange(4), [0, 1, 2.0], indexing="ij")
    valid = np.ones((5, 4), bool)
    valid[1, 1] = False
    return Sheet(points=np.stack([x, y, z], axis=-1), valid=valid)


def regions():
    member = np.zeros((3, 5, 4), bool)
    member[0, 1:3, 1:3] = True
    member[1] = True
    member[2, 1, 1] = True
    return Regions(names=("middle", "all", "filled"), member=member)


def test_counts_and_areas():
    found = summarize_regions(regions(), flat(), {}, {})
    assert found.n_points.tolist() == [4, 20, 1]
    assert found.n_valid.tolist() == [3, 19, 0]
    # Four quarters of 6 mm2 each round inner nodes; 8 x 9 mm in all.
    assert found.area.tolist() == [24, 72, 6]


def test_moments_are_those_of_valid_and_known_points():
    values = np.arange(20.0).reshape(5, 4)
    values[2, 2] = np.nan
    found = summarize_regions(regions(), flat(), {"f": values}, {})
    kept = values[[1, 2], [2, 1]]
    assert found.mean["f"][0] == pytest.approx(kept.mean())
    assert found.sd["f"][0] == pytest.approx(kept.std(ddof=1))
    assert np.isnan([found.mean["f"][2], found.sd["f"][2]]).all()


def test_labels_are_summed_up_by_the_most_frequent():
    labels = np.full((5, 4), 3.0)
    labels[1:3, 1:3] = [[9, 11], [11, 4]]
    found = summarize_regions(regions(), flat(), {}, {"f": labels})
    assert found.mode["f"][:2].tolist() == [11, 3]
    assert np.isnan(found.mode["f"][2])


def test_labels_that_are_all_missing_have_no_mode():
    found = summarize_regions(regions(), flat(), {}, {"f": np.full((5, 4), np.nan)})
    assert np.isnan(found.mode["f"]).all()
