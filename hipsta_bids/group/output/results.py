"""Results of an analysis: the values that tables, figures and pages are made of."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.cohort import data
from hipsta_bids.group.model import Comparison, Groups
from hipsta_bids.group.output.saved import SavedEffects, templates_to_json
from hipsta_bids.io.files import as_nested
from hipsta_bids.stats import arrays
from hipsta_bids.stats import registration as alignment
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.classify import ModelComparison
from hipsta_bids.stats.combat import ARRAYS, SiteEffects, SiteMoments, Visits
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.formula import ModelSpec
from hipsta_bids.stats.glm import FittedMaps, PointTest, PointwiseFit, RowModel
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.inference import Discoveries, MapKey
from hipsta_bids.stats.scores import NormativeScores
from hipsta_bids.types import PARTICIPANT

#: Group of all, where there are no groups.
ALL = "all"


@dataclass(frozen=True, eq=False, kw_only=True)
class SitePlan:
    """Effects to remove, and effects to keep."""

    column: str
    sites: tuple[str, ...]
    """Known ones of a file first."""
    estimated: tuple[str, ...]
    """Sites whose effects are estimated from this cohort."""
    counts: Mapping[str, int]
    """Participants by site whose visits are harmonized."""
    visits: Visits
    """Rows of the cohort's table; columns whose effects are kept, without an intercept."""
    names: tuple[str, ...]
    """Columns whose effects are kept, by this formula and these levels of factors."""
    formula: str
    levels: Mapping[str, Sequence[str]]
    portable: bool
    """Whether the columns of other people can be made from the formula."""
    icv: str | None
    """Column that volumes keep besides."""
    icv_values: Float
    """(visits,) NaN where not known or not used."""
    explained: Mapping[str, float]
    """Share of the variance of each column that sites explain."""
    saved: SavedEffects | None
    lost: int
    """Visits without a site or a variable that is kept."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Harmonization:
    """Effects of sites on all maps and summary measures of a cohort."""

    plan: SitePlan
    cohort: data.Cohort
    """Visits after it."""
    effects: Mapping[tuple[str, str, str], tuple[SiteEffects, SiteMoments]]
    """By kind (``map``, or ``summary`` of a single point), hemisphere and measure; maps first."""
    notes: tuple[str, ...]
    """What to know, one line each."""

    def leaks(self, groups: str) -> bool:
        """Check whether values of participants depend on their groups.

        A classifier predicts groups of participants with unknown groups: it cannot have them among
        the effects kept, nor sites that were estimated with them.
        """
        return bool(self.plan.estimated) or groups in closed_formula(self.plan.formula).names


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredMaps:
    """Scores of one hemisphere."""

    rows: Int
    """(sheets,) rows of the cohort's table."""
    reference: NDArray[np.bool_]
    """(sheets,) who belongs to the reference group."""
    scores: Mapping[str, NormativeScores]
    """By measure; points in the order of the sheet."""
    subfield: Int
    """(x, y) most frequent subfield, position in ``names``."""
    names: tuple[str, ...]


def templates_of(registrations: Mapping[str, alignment.Registration]) -> dict[str, Any] | None:
    """Write the templates of registration for ``template.json``; ``None`` without registration."""
    templates = {hemi: r.template for hemi, r in registrations.items() if r.template}
    return templates_to_json(templates) if templates else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Analysis:
    """Results of one model."""

    model: ModelSpec
    comparison: Comparison
    design: Design
    groups: Groups | None
    registrations: Mapping[str, alignment.Registration]
    """By hemisphere; empty without sheets."""
    registered: Mapping[str, arrays.SideMaps]
    """Maps of all visits that were chosen, by hemisphere."""
    harmonization: Harmonization | None
    """Effects of sites that were taken out after registration, if this was asked for."""
    measured: data.Measures
    """What the model was fitted to."""
    compared: data.Cohort
    """Rows of the model's table with registered maps; of two sessions, their differences."""
    row_model: RowModel
    """What was fitted to each row."""
    fitted: Mapping[str, FittedMaps]
    """Fitted maps by hemisphere; ``LR`` is left minus right."""
    found: Mapping[MapKey, Discoveries]
    unregistered: Mapping[MapKey, tuple[Float, Discoveries]]
    """Statistic (points,), and the same, of maps that were not registered; empty without
    registration, with permutations, which are too slow to do twice, and with harmonization from a
    file."""
    reference: tuple[str, int] | None
    """Covariates that scores are adjusted for, and participants of the reference group; ``None``
    without scores."""
    scored: Mapping[str, ScoredMaps]
    """Scores of maps by hemisphere."""
    scores: pd.DataFrame
    """One row per participant, hemisphere and summary measure or region of a map."""
    measures: Mapping[tuple[str, str], tuple[Sequence[str], PointwiseFit, Int]]
    """Of summary measures, by side (``LR`` for the mean of both) and formula: names, their fits as
    points, and participants with a value; a fit counts visits."""
    pairs: Sequence[tuple[str, str, tuple[str, str], ModelComparison]]
    """Hemisphere, added measure, control and case, and result."""
    skipped: Sequence[str]
    """What was left out, and why; one line each."""

    @property
    def n_participants(self) -> int:
        """Number of participants in the model; some may have several rows."""
        return int(self.compared.table[PARTICIPANT].iloc[self.design.rows].nunique())


def tested_maps(analysis: Analysis) -> Iterator[tuple[MapKey, PointTest, Discoveries]]:
    """Tests of all maps, with what survives correction."""
    for hemi, fitted in analysis.fitted.items():
        for measure, fit in fitted.fits.items():
            for test in fit.tests:
                key = MapKey(measure, test.contrast.name, hemi)
                yield key, test, analysis.found[key]


def rows_of(analysis: Analysis, fitted: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table of the sheets that were used."""
    return analysis.compared.table.iloc[fitted.maps.rows[fitted.used]]


def members_of(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, NDArray[np.bool_]]:
    """Determine the rows of each group; all to one where there are no groups."""
    if analysis.groups is None:
        return {ALL: np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def profiles_of(maps: Mapping[str, Float], name: str, rows: Bool) -> Float:
    """(sheets, x) means over y of some sheets of a map."""
    return np.concatenate(
        [arrays.mean_of_known(part, 2) for part in arrays.parts_of_sheets(maps, name, rows)]
    )


def digests(registrations: Mapping[str, alignment.Registration]) -> dict[str, str]:
    """Digest of the template by hemisphere, or ``none`` without registration."""
    digest_of = {}
    for hemi, registration in registrations.items():
        digest_of[hemi] = "none"
        if registration.template is not None:
            text = json.dumps(templates_to_json({hemi: registration.template}), sort_keys=True)
            digest_of[hemi] = hashlib.sha256(text.encode()).hexdigest()
    return digest_of


def harmonization_record(harmonization: Harmonization, groups: Groups | None) -> dict[str, Any]:
    """Record the effects removed and kept."""
    plan = harmonization.plan
    return {
        "column": plan.column,
        "participants": dict(plan.counts),
        "estimated": list(plan.estimated),
        "formula": plan.formula,
        "kept": list(plan.names),
        "explained": dict(plan.explained),
        "icv": plan.icv,
        "repeated": plan.visits.participant is not None,
        "classified": groups is not None and not harmonization.leaks(groups.column),
    }


def effects_of(parts: Sequence[Harmonization], templates: Mapping[str, str]) -> SavedEffects | None:
    """Collect parameters for other participants; ``None`` if they have no meaning there."""
    plan = parts[0].plan
    if not plan.portable:
        return None
    known_sites = plan.saved.sites if plan.saved else {}
    return SavedEffects(
        column=plan.column,
        formula=plan.formula,
        levels={name: list(levels) for name, levels in plan.levels.items()},
        columns=list(plan.names),
        sites={site: known_sites.get(site, plan.counts.get(site, 0)) for site in plan.sites},
        repeated=plan.visits.participant is not None,
        icv=plan.icv,
        templates=dict(templates),
        maps=as_nested(_of_kind("map", parts), ARRAYS),
        summaries=as_nested(_of_kind("summary", parts[:1]), ARRAYS),
    )


def _of_kind(kind: str, parts: Sequence[Harmonization]) -> dict[tuple[str, str], SiteEffects]:
    pairs = (pair for part in parts for pair in part.effects.items())
    return {key[1:]: effects for key, (effects, _) in pairs if key[0] == kind}
