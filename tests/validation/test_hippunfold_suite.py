"""The suite about HippUnfold: two maps are compared, and the suite says where there are none."""

from types import SimpleNamespace

import numpy as np
import pytest

from validation.cases import Refusal
from validation.hippunfold import DRAWN, OWN, _alone_row, _fill, _row, _whole_rows, run

RANDOM = np.random.default_rng(3)
THEIRS = RANDOM.uniform(1.0, 2.0, (41, 21))


def pair(bias=0.0, noise=0.0, edges=0.0):
    ours = THEIRS + bias + noise * RANDOM.normal(size=THEIRS.shape)
    ours[:4] += edges
    return SimpleNamespace(thickness=ours), THEIRS


@pytest.mark.parametrize(
    ("labels", "result", "met"),
    [
        (OWN, pair(bias=0.2, noise=0.05), True),
        (OWN, pair(noise=0.2), False),
        (OWN, pair(edges=1.0), False),
        (DRAWN, pair(bias=0.02, noise=0.2), True),
        (DRAWN, pair(bias=0.04), False),
        (OWN, Refusal(reason="topology", message="a knot"), False),
    ],
)
def test_maps_are_judged(labels, result, met):
    assert _row("01 L", labels, result)["met"] is met


def test_what_is_off_at_the_edges_is_told_apart():
    row = _row("01 L", OWN, pair(noise=0.03, edges=1.0))
    assert row["SD"] > 0.2
    assert row["SD, inner nodes"] == pytest.approx(0.03, abs=0.01)
    assert row["r, inner nodes"] > 0.98
    assert row["variance in outer nodes"] > "60%"


@pytest.mark.parametrize(
    ("noise", "bias", "met"), [(0.03, 0.02, True), (0.2, 0, False), (0, 0.04, False)]
)
def test_the_body_with_the_head_is_judged_beside_the_body_alone(noise, bias, met):
    theirs = THEIRS.ravel()
    ours = theirs + bias + noise * RANDOM.normal(size=theirs.size)
    row = _alone_row("01 L", (ours, theirs, np.full(theirs.size, 0.5)))
    assert row["met"] is met
    assert row["distance, median"] == 0.5


def test_a_person_is_judged_by_correlation_and_known_walls_by_bias_too():
    part = {"all": (THEIRS.ravel() + 0.2, THEIRS.ravel())}
    assert _whole_rows(part, known=False)[0]["met"] is True
    assert _whole_rows(part, known=True)[0]["met"] is False


def test_voxels_in_a_tetrahedron_are_filled():
    codes = np.zeros((8, 8, 8), dtype=np.intp)
    tetra = np.array([[[1.0, 1, 1], [5, 1, 1], [1, 5, 1], [1, 1, 5]]])
    _fill(codes, tetra, np.array([3]))
    i, j, k = np.indices(codes.shape) - 1
    inside = (i >= 0) & (j >= 0) & (k >= 0) & (i + j + k <= 4)
    np.testing.assert_array_equal(codes, np.where(inside, 3, 0))


@pytest.mark.parametrize("beside", [False, True])
def test_without_its_folder_the_suite_says_that_it_was_left_out(tmp_path, beside):
    suite = run(False, tmp_path / "data" if beside else None)
    assert suite.tables == ()
    assert "Left out" in suite.text
