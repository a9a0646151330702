"""Figures of sample sizes: what the title says of arms and of points without a number."""

import numpy as np
import pytest

from hipsta_bids.extensions.trials.figures import size_rows


def tables(per_arm, n, **columns):
    return {"L": {"per_arm": np.array(per_arm), "n": np.array(n), **columns}}


@pytest.mark.parametrize(
    ("per_arm", "n", "ending"),
    [
        ([20.0, np.nan], [16, 16], " (gray: more than 10,000)"),
        ([20.0, np.nan], [16, 0], ""),  # nobody has a value there
        ([20.0, 30.0], [16, 16], ""),
    ],
)
def test_gray_is_explained_where_no_number_is_enough(per_arm, n, ending):
    (row,) = size_rows(tables(per_arm, n), "thickness", "mm")
    assert row.title == f"Participants per arm{ending}"


def test_the_smaller_arm_is_named_where_arms_differ():
    (row,) = size_rows(tables([20.0], [16], larger_arm=np.array([40.0])), "thickness", "mm")
    assert row.title == "Participants of the smaller arm"
    assert row.label == "participants of the smaller arm,\nthickness"


def test_nothing_is_drawn_without_any_number():
    assert list(size_rows(tables([np.nan], [16]), "thickness", "mm")) == []
