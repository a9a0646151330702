"""Quality numbers of both sides."""

from types import SimpleNamespace

import pytest

from hipsta_bids.reports.cells import FILTERS
from hipsta_bids.reports.participant import _quality_numbers


@pytest.mark.parametrize(("lengths", "marked"), [((16.0, 18.0), False), ((12.0, 18.0), True)])
def test_bodies_of_both_sides_of_quite_different_length_are_marked(lengths, marked):
    measured = [
        SimpleNamespace(
            side=side,
            summary={"thickness_mean": 2.0},
            metrics={"body_length_mm": length, "anterior_end_uncertainty_mm": 1.0},
        )
        for side, length in zip(("left", "right"), lengths, strict=True)
    ]

    def row(*sides):
        cohort = SimpleNamespace(settings={})
        series = SimpleNamespace(measured=list(sides), cohort=cohort, whole=False)
        rows = _quality_numbers(series)["rows"]
        return {usual["title"]: (usual, values) for usual, values in rows}.get(
            "Difference of these distances"
        )

    usual, values = row(*measured)
    difference = lengths[0] - lengths[1]
    texts = [FILTERS["quality"](value, usual) for value in values]
    assert texts == [f"{difference:g} mm", f"{-difference:g} mm"]
    assert [usual["low"] <= value <= usual["high"] for value in values] == [not marked] * 2
    assert FILTERS["usual_range"](usual) == f"{usual['low']:g} mm to {usual['high']:g} mm"
    assert row(measured[0]) is None  # there is nothing to compare
