"""Maps that are made of a cohort's maps."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import Cohort, asymmetry_maps
from hipsta_bids.stats.arrays import SideMaps


def cohort_of(left, right):
    """Maps of one node; a side has the visits with a value."""
    sides = {}
    for hemi, values in (("L", left), ("R", right)):
        rows = np.array([row for row, value in enumerate(values) if value is not None])
        maps = np.array([values[row] for row in rows], dtype=float).reshape(-1, 1, 1)
        sides[hemi] = SideMaps(
            rows=rows.astype(np.int32),
            maps={"thickness": maps},
            subfield=np.zeros(maps.shape, dtype=np.int8),
            names=("CA1",),
            summary=pd.DataFrame(index=range(len(rows))),
        )
    table = pd.DataFrame(index=[f"sub-{n}" for n in range(len(left))])
    return Cohort(table=table, sides=sides, x=np.zeros(1), y=np.zeros(1), units={})


@pytest.mark.parametrize(
    ("relative", "wanted"), [((), [1, 0, np.nan, 0]), (("thickness",), [2 / 3, 0, np.nan, np.nan])]
)
def test_asymmetry_is_left_minus_right_of_those_who_have_both(relative, wanted):
    cohort = cohort_of([2.0, 1.0, np.nan, 0.0, 1.0], [1.0, 1.0, 1.0, 0.0, None])
    side = asymmetry_maps(cohort, ["thickness"], relative)
    (name,) = side.maps
    np.testing.assert_array_equal(side.rows, [0, 1, 2, 3])
    np.testing.assert_allclose(side.maps[name][:, 0, 0], wanted)


def test_asymmetry_needs_both_sides():
    with pytest.raises(ModelError, match="no participant has both hemispheres"):
        asymmetry_maps(cohort_of([1.0, None], [None, 1.0]), ["thickness"], ())
