"""Simulated cohorts without displacement: what each correction for many points finds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.design import Design
from hipsta_bids.group.fitted import fit_maps
from hipsta_bids.group.inference import correct
from hipsta_bids.group.multiplicity import MapKey
from hipsta_bids.group.row_model import RowModel
from hipsta_bids.group.simulation import SimulatedCohort, SimulationPlan, simulate_cohort
from hipsta_bids.group_data import SideMaps
from hipsta_bids.group_settings import CORRECTIONS, GroupSettings

_GROUP = "group"


@dataclass(frozen=True, kw_only=True)
class CorrectionResult:
    """Means over cohorts."""

    null_findings: float
    """Share of cohorts without an effect in which anything is found: family-wise error."""
    false_discovery_rate: float
    """Share of the findings that have no effect, in cohorts with one."""
    core_power: float
    """Points with the full effect that are found, fraction."""
    cohorts: int
    """Of each kind."""


def simulate_corrections(
    plan: SimulationPlan, settings: GroupSettings, seeds: Sequence[int]
) -> Mapping[str, CorrectionResult]:
    """Analyze cohorts with and without an effect by each correction.

    Parameters
    ----------
    plan : SimulationPlan
        Cohorts with the effect; without it, they have the same noise.
    settings : GroupSettings
        Level, and number of permutations.
    seeds : sequence of int
        One per cohort.

    Returns
    -------
    mapping of str to CorrectionResult
        By the name of the correction.
    """
    results = {}
    for method in CORRECTIONS:
        found, null = [], []
        for seed in seeds:
            how = replace(settings.multiplicity, method=method, seed=seed)
            chosen = replace(settings, multiplicity=how)
            cohort = simulate_cohort(plan, seed)
            found.append((_found(cohort, chosen), cohort.affected))
            empty = simulate_cohort(replace(plan, effect=0.0), seed)
            null.append(_found(empty, chosen).any())
        shares = [(one & (where == 0)).sum() / max(one.sum(), 1) for one, where in found]
        results[method] = CorrectionResult(
            null_findings=float(np.mean(null)),
            false_discovery_rate=float(np.mean(shares)),
            core_power=float(np.mean([one[where == 1].mean() for one, where in found])),
            cohorts=len(null),
        )
    return results


def _found(cohort: SimulatedCohort, settings: GroupSettings) -> np.ndarray:
    """(x, y) points that survive."""
    n = len(cohort.age)
    matrix = np.column_stack([np.ones(n), cohort.group, cohort.age - cohort.age.mean(), cohort.sex])
    design = Design(
        matrix=matrix.astype(np.float64),
        columns=("Intercept", _GROUP, "age", "sex"),
        rows=np.arange(n),
        dropped={},
        references={},
        contrasts=(Contrast(_GROUP, np.array([0.0, 1.0, 0.0, 0.0])),),
    )
    side = SideMaps(
        rows=np.arange(n),
        maps={"thickness": cohort.thickness},
        subfield=np.zeros(cohort.thickness.shape, dtype=np.int8),
        names=("all",),
        summary=pd.DataFrame(index=range(n)),
    )
    model = RowModel(design)
    fitted = {"L": fit_maps("L", side, model, settings)}
    found = correct(fitted, model, pd.DataFrame(index=range(n)), settings)
    flags: np.ndarray = found[MapKey("thickness", _GROUP, "L")].rejected
    return flags.reshape(cohort.affected.shape)
