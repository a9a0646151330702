"""The group suite says what is met by its targets; the simulation is tested elsewhere."""

import pytest

from hipsta_bids.group.simulation import SimulationResult
from hipsta_bids.subcommands import validate_parser
from hipsta_bids.validation import group

GOOD = SimulationResult(
    false_discovery_rate=0.02, core_power=0.8, peak_error=1.0, null_findings=0.03, cohorts=4
)
BAD = SimulationResult(
    false_discovery_rate=0.67, core_power=0.8, peak_error=2.0, null_findings=0.8, cohorts=4
)


@pytest.mark.parametrize(
    ("unregistered", "missed"),
    [(BAD, 0), (GOOD, 1)],  # an analysis that succeeds without registration is no test of it
)
def test_registered_must_pass_and_unregistered_must_fail(monkeypatch, unregistered, missed):
    def simulate(_plan, settings, seeds):
        assert len(seeds) == group.FEW_COHORTS
        return unregistered if settings.registration.align == "none" else GOOD

    monkeypatch.setattr(group, "run_simulation", simulate)
    (table,) = group.run(full=False).tables
    assert table.targets == 3
    assert table.missed == missed


def test_group_is_short_for_its_suite():
    assert validate_parser().parse_args(["--group"]).suite == ["group"]
    assert validate_parser().parse_args([]).suite == []
