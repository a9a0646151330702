"""Simulated cohorts: what registration, models and multiplicity make of a known effect."""

from dataclasses import replace

from hipsta_bids.group.simulated_inference import simulate_corrections
from hipsta_bids.group.simulation import SimulationPlan, SimulationResult, run_simulation
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.validation.suite import Cell, Suite, Table

COHORTS, FEW_COHORTS = 40, 4
MAX_FALSE, MIN_POWER, MAX_PEAK, MAX_NULL = 0.08, 0.70, 1.5, 0.15
"""Targets with registration: shares, and nodes."""
MIN_FALSE_UNREGISTERED = 0.4
"""Without registration, the shift has to be taken for thinning; else this is no test of it."""

#: For corrections: cohorts without displacement, whose effect is hard to find.
NULL_COHORTS, FEW_NULL_COHORTS, PERMUTATIONS = 100, 10, 200
SMALL = SimulationPlan(sizes=(40, 40), effect=0.8, shift=0.0, warp_sd=(0.0, 0.0))
LEVEL = 0.05

_CORRECTIONS = {
    "fdr2": "false discovery rate, two stages (default)",
    "bh": "false discovery rate, Benjamini-Hochberg",
    "permutation-tfce": "family-wise error, cluster enhancement",
    "permutation-max": "family-wise error, largest t",
}
_METHODS = {
    "registr": "registered, registr (default)",
    "penalized": "registered, penalized",
    "none": "not registered",
}


def run(full: bool) -> Suite:
    """Analyze cohorts with a thinner region and a shift, and with the shift alone.

    Parameters
    ----------
    full : bool
        Forty cohorts of each kind instead of four.

    Returns
    -------
    Suite
    """
    plan, seeds = SimulationPlan(), range(COHORTS if full else FEW_COHORTS)
    settings = GroupSettings()
    rows: list[tuple[Cell, ...]] = []
    for align, title in _METHODS.items():
        how = replace(settings, registration=replace(settings.registration, align=align))
        rows.append(_row(title, align, run_simulation(plan, how, seeds)))
    return Suite(
        name="group",
        title="Group level",
        text=f"Cohorts of {plan.sizes[0]} and {plan.sizes[1]} subjects with simulated sheets. In"
        f" the second group the wall is thinner in one region (d = {plan.effect:g}), and everything"
        f" lies {plan.shift:g} nodes more lateral. The model is group + age + sex at each point,"
        " with FDR2.",
        tables=(
            Table(
                title="Simulated cohorts",
                columns=(
                    "analysis",
                    "cohorts",
                    "FDR",
                    "core power",
                    "peak error, nodes",
                    "null cohorts with findings",
                    "met",
                ),
                rows=tuple(rows),
                notes="FDR: share of the findings that lie where there is no effect. Null cohorts"
                " have the shift only. Targets with registration: FDR at most"
                f" {MAX_FALSE:g}, power at least {MIN_POWER:g}, peak error at most {MAX_PEAK:g},"
                f" null cohorts at most {MAX_NULL:g}. Without registration an FDR above"
                f" {MIN_FALSE_UNREGISTERED:g} is expected: the analysis must fail there.",
            ),
            _corrections(NULL_COHORTS if full else FEW_NULL_COHORTS),
        ),
    )


def _corrections(cohorts: int) -> Table:
    """Tell what each correction finds where there is nothing, and where there is something."""
    settings = GroupSettings()
    how = replace(settings.multiplicity, permutations=PERMUTATIONS, alpha=LEVEL)
    found = simulate_corrections(SMALL, replace(settings, multiplicity=how), range(cohorts))
    # Three binomial standard deviations above the level.
    most = LEVEL + 3 * (LEVEL * (1 - LEVEL) / cohorts) ** 0.5
    return Table(
        title="Corrections for many points",
        columns=("correction", "cohorts", "null cohorts with findings", "FDR", "core power", "met"),
        rows=tuple(
            (
                _CORRECTIONS[method],
                one.cohorts,
                one.null_findings,
                one.false_discovery_rate,
                one.core_power,
                bool(one.null_findings <= most),
            )
            for method, one in found.items()
        ),
        notes=f"Cohorts of {SMALL.sizes[0]} and {SMALL.sizes[1]} subjects without displacement,"
        f" with d = {SMALL.effect:g} in the region or without any effect; {PERMUTATIONS}"
        f" permutations. Target: at most {most:.2g} of the null cohorts have findings, that is"
        f" {LEVEL:g} and three standard deviations of this many cohorts. The false discovery rate"
        " is held at the same level by the first two only; by the others, it comes out as it may.",
    )


def _row(title: str, align: str, found: SimulationResult) -> tuple[Cell, ...]:
    if align == "none":
        met = found.false_discovery_rate > MIN_FALSE_UNREGISTERED
    else:
        met = (
            found.false_discovery_rate <= MAX_FALSE
            and found.core_power >= MIN_POWER
            and found.peak_error <= MAX_PEAK
            and found.null_findings <= MAX_NULL
        )
    return (
        title,
        found.cohorts,
        found.false_discovery_rate,
        found.core_power,
        found.peak_error,
        found.null_findings,
        bool(met),
    )
