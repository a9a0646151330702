"""The group suite says what is met by its targets; the simulation is tested elsewhere."""

import pytest

from validation import group
from validation.__main__ import build_parser

GOOD = {
    "FDR": 0.02,
    "core power": 0.8,
    "peak error, nodes": 1.0,
    "null cohorts with findings": 0.03,
}
BAD = GOOD | {"FDR": 0.67, "peak error, nodes": 2.0, "null cohorts with findings": 0.8}


@pytest.mark.parametrize(
    ("unregistered", "missed"),
    [(BAD, 0), (GOOD, 1)],  # an analysis that succeeds without registration is no test of it
)
def test_registered_must_pass_and_unregistered_must_fail(monkeypatch, unregistered, missed):
    def simulate(_plan, settings, seeds):
        assert len(seeds) == group.FEW_COHORTS
        return unregistered if settings.registration.align == "none" else GOOD

    monkeypatch.setattr(group, "run_simulation", simulate)
    for name in ("_corrections", "_amplitudes", "_together", "repeated_visits"):
        monkeypatch.setattr(group, name, lambda *_: "")
    (table,) = group.run(full=False).tables
    assert table.targets == 2
    assert table.missed == missed


@pytest.mark.long
def test_the_default_moves_groups_least_where_curvature_differs(monkeypatch):
    some = ("the same", "all 30 % smaller")
    monkeypatch.setattr(group, "AMPLITUDES", {name: group.AMPLITUDES[name] for name in some})
    table = group._amplitudes(2)
    assert table.targets == 4
    assert table.missed == 0
    shifted = table.rows[-1]
    assert shifted["registr, each standardized"] < 0.25
    assert shifted["registr, as measured"] > 0.4


@pytest.mark.long
def test_corrections_keep_the_family_wise_error_and_find_the_effect(monkeypatch):
    monkeypatch.setattr(group, "PERMUTATIONS", 60)
    table = group._corrections(12, *group.limits(12))
    assert table.targets == 4
    assert table.missed == 0
    power = {row["correction"]: row["core power"] for row in table.rows}
    wide, single = (
        power[f"family-wise error, {how}"] for how in ("cluster enhancement", "largest t")
    )
    # The effect is wide and weak, as cluster enhancement likes it.
    assert wide > single > 0.2


@pytest.mark.long
def test_measures_together_keep_the_family_wise_error_and_find_more(monkeypatch):
    monkeypatch.setattr(group, "PERMUTATIONS", 60)
    table = group._together(10, *group.limits(10))
    assert table.targets == 5
    assert table.missed == 0
    both, single = (
        {row["test"]: row[f"power, effect in {what}"] for row in table.rows}
        for what in ("both", "the first")
    )
    fisher, either = both["together, Fisher (default)"], both["either, each at half the level"]
    assert fisher > either + 0.05
    assert either > both["first measure alone, largest t"]
    assert both["together, Fisher, cluster enhancement"] > fisher
    # What it costs where one measure has no effect.
    assert single["together, Fisher (default)"] < single["first measure alone, largest t"]


def test_group_is_short_for_its_suite():
    assert build_parser().parse_args(["--group"]).suite == ["group"]
    assert build_parser().parse_args([]).suite == []
