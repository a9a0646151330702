"""What each part of the method does, as a table."""

import pytest

from validation import ablation, cases, continuity


def movement(**changes):
    return continuity.Movement(
        **{
            "same_xy": 0.02,
            "same_place": 0.01,
            "correlation": 1.0,
            "mean": 0.0,
            "far_off": 0.0,
            "accepted": True,
            "reasons": (),
            "choices": (),
        }
        | changes
    )


def test_the_table_has_a_row_per_variant():
    results = {}
    for name in ablation.VARIANTS:
        results[name, "phantoms"] = [(0.01, 0.03), (0.03, 0.05)]
        results[name, "small"] = [movement(), movement(same_xy=0.1)]
        results[name, "edges"] = [movement(far_off=0.2), cases.Refusal(reason="r", message="m")]
        results[name, "revised"] = [(0.9, 0.1, True), (0.8, 0.3, False)]
    rows = ablation._variants(results).rows
    assert [row["variant"] for row in rows] == list(ablation.VARIANTS)
    for row in rows:
        assert row["phantoms, bias"] == 0.02
        assert row["small changes, RMS largest"] == 0.1
        assert row["edges, silent"] == row["refused"] == row["status differs"] == 1
        assert abs(row["two labelings, r"] - 0.85) < 1e-12


@pytest.mark.long
def test_x_of_the_volume_differs_on_a_phantom():
    spec = ablation.PHANTOMS[3]
    case = cases.Case(spec=spec, voxel_size=(0.4,) * 3)
    errors = [
        ablation.measure_error(
            ablation.Drawing(case=case, settings=ablation.Settings().changed(**changes))
        )
        for name, changes in ablation.VARIANTS.items()
        if name in ("default", "x of the volume")
    ]
    assert errors[0] != errors[1]
    assert all(abs(bias) < 0.05 and sd < 0.1 for bias, sd in errors)
