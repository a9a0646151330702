"""The group level from sheets and covariates to results: a straight line of calls."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.default_model import Groups
from hipsta_bids.group.design import Design, build_design
from hipsta_bids.group.glm import PointwiseFit, fit_points
from hipsta_bids.group.model_spec import ModelSpec
from hipsta_bids.group.multiplicity import Discoveries, MapKey, discover
from hipsta_bids.group.pairs import PairComparison
from hipsta_bids.group.profiles import GroupShift, mean_profiles, shift_by_group
from hipsta_bids.group.registration import Registration, register, register_to
from hipsta_bids.group.summaries import MeasureFit, classify_groups, fit_summaries
from hipsta_bids.group.template import Template
from hipsta_bids.group.warps import warp_labels, warp_values
from hipsta_bids.group_data import Cohort, Float, Int, Measures, SideMaps
from hipsta_bids.group_settings import GroupSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class SideResult:
    """What was found in one hemisphere."""

    profiles: Float
    """(sheets, x) curvature before registration, 1/mm."""
    registration: Registration
    registered: SideMaps
    subfield: Int
    """(x, y) most frequent subfield after registration, place in ``registered.names``."""
    shifts: Mapping[str, GroupShift]
    """By group; empty without groups."""
    used: Int
    """Sheets that the model is fitted to, as places in ``registered``."""
    fits: Mapping[str, PointwiseFit]
    """By measure."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Analysis:
    """Results of one model."""

    model: ModelSpec
    design: Design
    groups: Groups | None
    sides: Mapping[str, SideResult]
    """By hemisphere."""
    measured: Measures
    """What the model was fitted to."""
    found: Mapping[MapKey, Discoveries]
    measures: Sequence[MeasureFit]
    pairs: Sequence[tuple[str, str, PairComparison]]
    """Hemisphere, added measure, and result."""
    skipped: Sequence[str]
    """What was left out, and why; one line each."""


def analyze_cohort(
    cohort: Cohort,
    model: ModelSpec,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    measures: Measures,
    references: Mapping[str, str],
    icv: str | None = None,
    templates: Mapping[str, Template] | None = None,
) -> Analysis:
    """Register, fit a model at each point and to each summary measure, and classify.

    Parameters
    ----------
    cohort : Cohort
        One visit per participant.
    model : ModelSpec
        Formula and contrasts.
    groups : Groups or None
        For classification and for figures by group.
    settings : GroupSettings
        All of the group level.
    measures : Measures
        What to fit the model to.
    references : mapping of str to str
        Reference levels of factors.
    icv : str, optional
        Column of intracranial volume, for volumes.
    templates : mapping of str to Template, optional
        By hemisphere; else they are made from this cohort.

    Raises
    ------
    ModelError
        If the model cannot be fitted to these data.
    """
    references = _references(model, groups, references)
    design = build_design(cohort.table, model, settings.design, references)
    sides = {
        hemi: _analyze_side(
            cohort,
            hemi,
            design,
            maps=measures.maps,
            groups=groups,
            settings=settings,
            templates=templates,
        )
        for hemi in (cohort.sides if measures.maps else ())
    }
    found = discover(
        {
            MapKey(measure, test.contrast.name, hemi): test.p
            for hemi, side in sides.items()
            for measure, fit in side.fits.items()
            for test in fit.tests
        },
        settings.multiplicity,
    )
    summaries, notes = fit_summaries(
        cohort,
        model,
        design,
        settings,
        only=measures.summaries,
        references=references,
        icv=icv,
    )
    pairs, more = classify_groups(cohort, groups, settings) if groups else ([], [])
    return Analysis(
        model=model,
        design=design,
        groups=groups,
        sides=sides,
        measured=measures,
        found=found,
        measures=summaries,
        pairs=pairs,
        skipped=[*notes, *more],
    )


def _references(
    model: ModelSpec, groups: Groups | None, references: Mapping[str, str]
) -> dict[str, str]:
    """Take reference levels of the user, and that of the groups if they are in the model."""
    chosen = dict(references)
    words = model.formula.replace("*", " ").replace(":", " ").replace("+", " ").split()
    if groups is not None and groups.column in words:
        chosen.setdefault(groups.column, groups.reference)
    return chosen


def _analyze_side(
    cohort: Cohort,
    hemi: str,
    design: Design,
    *,
    maps: Sequence[str],
    groups: Groups | None,
    settings: GroupSettings,
    templates: Mapping[str, Template] | None,
) -> SideResult:
    side = cohort.sides[hemi]
    profiles = mean_profiles(side.maps["curvature"], settings.registration)
    if templates is None:
        registration = register(profiles, settings.registration)
    else:
        registration = register_to(profiles, templates[hemi], settings.registration)
    registered = _register_maps(side, registration.warps)
    used, rows = _used(side, design)
    matrix = design.matrix[rows]
    try:
        fits = {
            name: fit_points(
                _rows(registered.maps[name], used).reshape(len(used), -1),
                matrix,
                design.contrasts,
                settings.glm,
            )
            for name in maps
        }
    except ModelError as error:
        raise ModelError(f"hemisphere {hemi}: {error}", reason=error.reason) from error
    for name, fit in fits.items():
        if not np.isfinite(fit.sigma).any():
            raise ModelError(
                f"hemisphere {hemi}: no point of the {name} maps has enough values for the model;"
                " look at the sheets, or use a smaller model",
                reason="all-points-invalid",
            )
    shifts: Mapping[str, GroupShift] = {}
    if groups is not None:
        names = cohort.table[groups.column].iloc[side.rows]
        known = names.notna().to_numpy()
        shifts = shift_by_group(
            replace(registration, warps=registration.warps[known]),
            names[known].astype(str).to_numpy(dtype=np.str_),
        )
    return SideResult(
        profiles=profiles,
        registration=registration,
        registered=registered,
        subfield=most_frequent(registered.subfield[used], len(side.names)),
        shifts=shifts,
        used=used,
        fits=fits,
    )


def _register_maps(side: SideMaps, warps: Float) -> SideMaps:
    labels = warp_labels(side.subfield.astype(np.int64), warps)
    return SideMaps(
        rows=side.rows,
        maps={name: warp_values(maps, warps) for name, maps in side.maps.items()},
        subfield=labels.astype(np.int8),
        names=side.names,
        summary=side.summary,
    )


def _rows(maps: Float, used: Int) -> Float:
    """Take some sheets, without a copy if they are all."""
    return maps if len(used) == len(maps) else maps[used]


def _used(side: SideMaps, design: Design) -> tuple[Int, Int]:
    """Sheets whose visits are complete, and their rows of the design."""
    _, used, rows = np.intersect1d(side.rows, design.rows, assume_unique=True, return_indices=True)
    return np.asarray(used, dtype=np.int64), np.asarray(rows, dtype=np.int64)


def most_frequent(labels: NDArray[np.int8], count: int) -> Int:
    """Most frequent label at each point.

    Parameters
    ----------
    labels : ndarray of int, shape (sheets, x, y)
        -1 is missing.
    count : int
        Labels are below this.

    Returns
    -------
    ndarray of int, shape (x, y)
        -1 where there is none.
    """
    votes = np.stack([(labels == label).sum(axis=0) for label in range(count)])
    return np.where(votes.max(axis=0) > 0, votes.argmax(axis=0), -1).astype(np.int64)
