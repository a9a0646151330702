"""The suite of the surrogate: what is compared, and what its table says."""

import numpy as np
import pytest

from hipsta_bids.phantom import PhantomSpec
from validation import surrogate
from validation.cases import Refusal
from validation.report import render
from validation.surrogate import Compared

SHORT = PhantomSpec(kind="arc", thickness=2.0, variation=0.3, length=8.0)


def compared(*, noise=0.0, problems=()):
    """Three slices in which the surrogate is 0.1 mm more than half of the mesh."""
    x = np.tile(np.linspace(0.05, 0.95, 41), (3, 1))
    mesh = 2 + 0.5 * np.sin(6 * x)
    wave = noise * np.cos(40 * x)
    return Compared(
        fraction=x,
        surrogate=0.5 * mesh + 0.1 + wave,
        mesh=mesh,
        truth=mesh,
        equidistant=tuple((row, row) for row in x),
        problems=problems,
    )


def run_with(monkeypatch, results, *, full=False):
    monkeypatch.setattr(surrogate.cases, "run_cases", lambda _, bodies: results[: len(bodies)])
    return surrogate.run(full)


def row_of(suite, number=0):
    (table,) = suite.tables
    return table.rows[number]


def test_the_table_has_the_line_that_was_put_in(monkeypatch):
    row = row_of(run_with(monkeypatch, [compared()]))
    assert row["r"] == pytest.approx(1)
    assert row["slope"] == row["slope on truth"] == pytest.approx(0.5)
    assert row["met"] is True
    assert row["slices"] == "3 slices"


def test_a_low_correlation_is_missed(monkeypatch):
    suite = run_with(monkeypatch, [compared(noise=0.5, problems=("no-medial-axis",))])
    assert row_of(suite)["met"] is False
    assert row_of(suite)["slices"] == "no-medial-axis"


def test_a_refused_phantom_is_missed(monkeypatch):
    results = [compared(), *[Refusal(reason="too-thin", message="thin")] * 4]
    row = row_of(run_with(monkeypatch, results, full=True), 1)
    assert (row["slices"], row.get("r"), row["met"]) == ("too-thin", None, False)


def test_it_is_drawn(monkeypatch):
    (picture,) = run_with(monkeypatch, [compared()]).pictures
    assert render(picture)[:8] == b"\x89PNG\r\n\x1a\n"


def test_nothing_is_drawn_where_all_is_refused(monkeypatch):
    results = [Refusal(reason="too-thin", message="thin")]
    assert not run_with(monkeypatch, results).pictures


def test_a_phantom_is_measured_in_both_ways():
    found = surrogate.compare_body(SHORT)
    assert found.surrogate.shape == found.mesh.shape == found.truth.shape == (3, 41)
    assert not found.problems
    known = np.isfinite(found.mesh) & np.isfinite(found.truth)
    assert known.mean() > 0.9
    # Both have 2 mm, more or less 30 %; the surrogate falls short by up to a quarter of a voxel.
    assert abs((found.mesh - found.truth)[known].mean()) < 0.05
    assert -0.1 < (found.surrogate - found.truth)[known].mean() < 0.02
