"""Effects of sites are taken out of a cohort."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.sites import NAME, combat
from hipsta_bids.extensions.sites.planning import SitePlan
from hipsta_bids.extensions.sites.saved import SavedEffects
from hipsta_bids.extensions.sites.settings import HarmonizationSettings
from hipsta_bids.group.cohort.data import Cohort, Measures, compare_sessions, grows_with_head
from hipsta_bids.group.output.results import Analysis, digests
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.registration import Registration


@dataclass(frozen=True, eq=False, kw_only=True)
class Harmonization:
    """Effects of sites on all maps and summary measures of a cohort."""

    plan: SitePlan
    cohort: Cohort
    """Visits after it."""
    effects: Mapping[tuple[str, str, str], tuple[combat.SiteEffects, combat.SiteMoments]]
    """By kind (``map``, or ``summary`` of a single point), hemisphere and measure; maps first."""
    notes: tuple[str, ...]
    """What to know, one line each."""

    def leaks(self, groups: str) -> bool:
        """Check whether values of participants depend on their groups.

        A classifier predicts groups of participants with unknown groups: it cannot have them among
        the effects kept, nor sites that were estimated with them.
        """
        return bool(self.plan.estimated) or groups in closed_formula(self.plan.formula).names


def adjust(analysis: Analysis, plan: SitePlan) -> Analysis:
    """Take effects of sites out of the maps and summary measures of an analysis."""
    request = analysis.request
    harmonization = harmonize_cohort(
        analysis.cohort, plan, request.settings, request.measures, analysis.registrations
    )
    parts = {**analysis.parts, NAME: harmonization}
    return replace(analysis, cohort=harmonization.cohort, parts=parts).noted(harmonization.notes)


def choose_classified(analysis: Analysis, plan: SitePlan) -> Analysis:  # noqa: ARG001  (as all)
    """Give classifiers the measures before harmonization, where it knew the groups."""
    request, harmonization = analysis.request, part_of(analysis)
    if request.groups is None or not harmonization.leaks(request.groups.column):
        return analysis
    cohort = replace(request.cohort, sides=analysis.registered or request.cohort.sides)
    return replace(analysis, classified=compare_sessions(cohort, request.comparison.sessions))


def part_of(analysis: Analysis) -> Harmonization:
    """Return the harmonization of an analysis."""
    harmonization: Harmonization = analysis.parts[NAME]
    return harmonization


def harmonize_cohort(
    cohort: Cohort,
    plan: SitePlan,
    settings: GroupSettings,
    measures: Measures,
    registrations: Mapping[str, Registration],
) -> Harmonization:
    """Estimate or take effects of sites, and take them out of maps and summary measures."""
    if plan.saved and registrations:
        _check_templates(plan.saved, registrations)
    effects: dict[tuple[str, str, str], tuple[combat.SiteEffects, combat.SiteMoments]] = {}
    sides, unknown = {}, set()
    for hemi, side in cohort.sides.items():
        visits = plan.visits.take(side.rows)
        changed, summary = dict(side.maps), side.summary.astype(np.float64)
        for measure in measures.maps:
            key = "map", hemi, measure
            values = side.maps[measure].reshape(len(side.rows), -1)
            effects[key] = _effects(values, visits, plan, settings, key)
            harmonized = combat.harmonize(values, visits, effects[key][0])
            changed[measure] = harmonized.reshape(side.maps[measure].shape)
        for name in summary.columns:
            key = "summary", hemi, name
            values = summary[[name]].to_numpy()
            saved = plan.saved and plan.saved.effects_on_summaries.get((hemi, name))
            # Earlier files adjust volumes alone.
            is_adjusted = len(saved.slopes) > len(plan.names) if saved else grows_with_head(name)
            adjusted = _with_icv(visits, plan, side.rows) if is_adjusted else visits
            if plan.saved and not saved:
                unknown.add(name)
                summary[name] = np.nan
            elif len(np.unique(values[np.isfinite(values)])) > 1:
                effects[key] = _effects(values, adjusted, plan, settings, key)
                summary[name] = combat.harmonize(values, adjusted, effects[key][0])[:, 0]
        sides[hemi] = replace(side, maps=changed, summary=summary)
    maps = [("map", hemi, name) for name in measures.maps for hemi in sides]
    return Harmonization(
        plan=plan,
        cohort=replace(cohort, sides=sides),
        effects={key: effects.pop(key) for key in maps} | effects,
        notes=tuple(_notes(plan, settings, unknown)),
    )


def _with_icv(visits: combat.Visits, plan: SitePlan, rows: Any) -> combat.Visits:  # noqa: ANN401  (an array)
    if plan.icv is None:
        return visits
    icv = plan.icv_values[rows]
    columns = np.column_stack([visits.columns, icv])
    return replace(visits, site=np.where(np.isfinite(icv), visits.site, -1), columns=columns)


def _effects(
    values: Float,
    visits: combat.Visits,
    plan: SitePlan,
    settings: GroupSettings,
    key: tuple[str, str, str],
) -> tuple[combat.SiteEffects, combat.SiteMoments]:
    kind, hemi, measure = key
    pooled = settings.of(HarmonizationSettings).pooling and kind == "map"
    if plan.saved is None:
        n, longitudinal = len(plan.sites), settings.longitudinal
        return combat.fit_effects(values, visits, n, longitudinal, pooled=pooled)
    known_effects = plan.saved.effects_on_maps if kind == "map" else plan.saved.effects_on_summaries
    effects = known_effects.get((hemi, measure))
    if effects is None:
        raise ModelError(
            f"{plan.saved.file}: has no map of {measure} of hemisphere {hemi}; choose other maps"
            " by --measures, or harmonize anew"
        )
    if len(effects.mean) != values.shape[1]:
        raise ModelError(
            f"{plan.saved.file}: its map of {measure} has {len(effects.mean)} points, these "
            f"participants {values.shape[1]}; use one grid"
        )
    return combat.extend_effects(effects, values, visits, pooled=pooled)


def _notes(plan: SitePlan, settings: GroupSettings, unknown: set[str]) -> Iterator[str]:
    if plan.lost:
        yield (
            f"{plan.lost} visits lack {plan.column} or an effect that is kept, and are not "
            "harmonized"
        )
    for name, share in plan.explained.items():
        if share > settings.of(HarmonizationSettings).explained:
            yield f"{plan.column} explains {share:.0%} of {name}: its effect is poorly known"
    if unknown and plan.saved:
        names = formulas.listed(unknown)
        yield f"{plan.saved.file} lacks these measures, which are excluded: {names}"
    if plan.saved is None and not plan.portable:
        yield "harmonization.json is not written: this model's columns depend on all participants"


def _check_templates(saved: SavedEffects, registrations: Mapping[str, Registration]) -> None:
    """Refuse parameters of other points than those of this cohort."""
    for hemi, digest in digests(registrations).items():
        if saved.templates.get(hemi) != digest:
            is_unregistered = saved.templates.get(hemi) == "none"
            remedy = (
                "--align none" if is_unregistered else "--template with the template.json beside it"
            )
            raise ModelError(
                f"{saved.file}: hemisphere {hemi} was registered to another template there; give"
                f" {remedy}"
            )
