"""Simulated cohorts without displacement: what each correction for many points finds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.design import Design
from hipsta_bids.group.fitted import fit_maps
from hipsta_bids.group.inference import correct
from hipsta_bids.group.multiplicity import MapKey
from hipsta_bids.group.row_model import RowModel
from hipsta_bids.group.simulation import SimulatedCohort, SimulationPlan, simulate_cohort
from hipsta_bids.group_data import Float, SideMaps
from hipsta_bids.group_settings import CORRECTIONS, GroupSettings

Bool = NDArray[np.bool_]

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
    found: dict[str, list[tuple[Bool, Bool]]] = {method: [] for method in CORRECTIONS}
    affected = []
    for seed in seeds:
        cohort = simulate_cohort(plan, seed)
        empty = simulate_cohort(replace(plan, effect=0.0), seed)
        affected.append(cohort.affected)
        for method, results in found.items():
            how = replace(settings.multiplicity, method=method, seed=seed)
            chosen = replace(settings, multiplicity=how)
            results.append((_found(cohort, chosen), _found(empty, chosen)))
    return {method: _summary(results, affected) for method, results in found.items()}


def _summary(results: Sequence[tuple[Bool, Bool]], affected: Sequence[Float]) -> CorrectionResult:
    shares, power = [], []
    for (found, _), where in zip(results, affected, strict=True):
        shares.append((found & (where == 0)).sum() / max(found.sum(), 1))
        power.append(found[where == 1].mean())
    return CorrectionResult(
        null_findings=float(np.mean([empty.any() for _, empty in results])),
        false_discovery_rate=float(np.mean(shares)),
        core_power=float(np.mean(power)),
        cohorts=len(results),
    )


def _found(cohort: SimulatedCohort, settings: GroupSettings) -> Bool:
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
    flags: Bool = found[MapKey("thickness", _GROUP, "L")].rejected
    return flags.reshape(cohort.affected.shape)
