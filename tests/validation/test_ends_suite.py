"""The suite of ends: copies of bodies, and oblique end planes."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.geometry import ends as geometry_ends
from hipsta_bids.settings import Settings
from validation import ends
from validation.cases import Refusal, measure_body
from validation.ends import ENDS, FOUND, KEPT, Found, Job, find_ends

JOB = Job(body=ends.PHANTOMS[0], copies=((0.4, 0.5, 0.0), (2.0, 0.0, 8.0)))


def rows_about(table, what):
    return {row["what"]: row for row in table.rows if what in row["what"]}


def test_ends_of_a_phantom_are_found_where_its_labels_have_them():
    found = find_ends(JOB)
    assert found.refused == 0
    assert np.abs(found.copies[:, :2]).max() < 1.0  # half a slice
    assert (found.copies[:, 2:] > 0).all()
    rows = rows_about(ends._places_table({JOB: found}), "end")
    assert all(rows[f"{end} end"]["met"] for end in ENDS)
    # Oblique sections that are left in lie behind the posterior end.
    assert found.own[KEPT][0] < found.own[FOUND][0]


@pytest.mark.long
def test_ends_in_a_wrong_place_miss_the_target(monkeypatch):
    right = geometry_ends.find_ends

    def wrong(*arguments):
        found = right(*arguments)
        return {
            **found,
            "posterior": found["posterior"]._replace(level=found["posterior"].level + 1),
        }

    monkeypatch.setattr(geometry_ends, "find_ends", wrong)
    rows = rows_about(ends._places_table({JOB: find_ends(JOB)}), "end")
    assert rows["posterior end"]["met"] is False
    assert float(rows["posterior end"]["mean"]) == pytest.approx(1.0, abs=0.4)
    assert rows["anterior end"]["met"] is True


def found_at(posterior, anterior, refused=0):
    copies = np.column_stack([posterior, anterior, np.full((len(posterior), 2), 0.1)])
    own = {FOUND: (0.1, -0.2), KEPT: (-0.2, -0.2)}
    return Found(copies=copies, refused=refused, own=own)


@pytest.mark.parametrize(
    ("result", "met"),
    [
        (found_at([0.0, 0.2, 0.4], [0.1, 0.0, 0.2]), True),
        (found_at([0.0, 0.6, 1.2], [0.0, 0.6, 1.2]), False),  # ends
        (found_at([0.0, 0.3, 0.6], [0.5, 0.2, -0.1]), False),  # length
        (found_at([0.0, 0.2, 0.4], [0.1, 0.0, 0.2], refused=1), False),
        (Refusal(reason="no-body", message="none"), False),
    ],
)
def test_spreads_are_judged(result, met):
    table = ends._copies_table({JOB: result})
    assert table.rows[-1]["met"] is met
    if isinstance(result, Found):
        spread = result.copies[:, 0].std(ddof=1)
        assert table.rows[0]["SD, posterior"] == pytest.approx(spread)
        # Slices of 0.4 and 2 mm.
        assert table.rows[0]["by slices alone"] == pytest.approx(np.sqrt(4.16 / 24))


@pytest.mark.long
def test_rows_at_oblique_planes_meet_the_target_and_miss_it_where_the_mesh_ends_there(monkeypatch):
    case = replace(ends.OBLIQUE[0], length=14.0), 35.0, "thickness"
    right = ends.measure_oblique(case)
    up_to_the_planes = Settings().changed(grid={"beyond": 0.0})
    monkeypatch.setattr(
        ends.cases,
        "measure_body",
        lambda volume, hemi: measure_body(volume, hemi, up_to_the_planes),
    )
    rows = ends._oblique_table([case, case], [right, ends.measure_oblique(case)]).rows
    assert [row["met"] for row in rows] == [True, False]


def test_refused_planes_miss_the_target_and_are_explained():
    case = ends.OBLIQUE[0], 35.0, "width"
    table = ends._oblique_table([case], [Refusal(reason="topology", message="a knot")])
    assert table.rows[0]["met"] is False
    assert "35° about the width: topology: a knot" in table.notes


@pytest.mark.long
def test_a_short_run_says_what_was_left_out(monkeypatch):
    monkeypatch.setattr(
        ends.cases, "run_cases", lambda work, group, **_: [work(one) for one in group]
    )
    suite = ends.run(False)
    assert "Real labels were left out" in suite.text
    assert [table.missed for table in suite.tables] == [0, 0, 0]
    assert all(table.targets for table in suite.tables)
