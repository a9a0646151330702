"""What harmonization adds to results: tables, figures, files, methods and record."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.extensions.sites import EXTENSION
from hipsta_bids.extensions.sites.combat import ARRAYS, SiteEffects
from hipsta_bids.extensions.sites.harmonize import Harmonization, part_of
from hipsta_bids.extensions.sites.planning import SitePlan
from hipsta_bids.extensions.sites.saved import SavedEffects
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output import style
from hipsta_bids.group.output.results import Analysis, digests
from hipsta_bids.group.output.tables import Averages, read_columns
from hipsta_bids.io import files
from hipsta_bids.joints import Writer
from hipsta_bids.reports.cells import display_name
from hipsta_bids.reports.display import COLORS
from hipsta_bids.stats.arrays import Float, mean_of_known
from hipsta_bids.types import SIDES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def tables(
    cohort: Cohort, analysis: Analysis, prefix: str
) -> Iterator[tuple[str, pd.DataFrame, Mapping[str, str]]]:
    """Table of shifts and scales, with the meaning of its columns."""
    if rows := list(_site_rows(part_of(analysis), cohort.units)):
        yield f"{prefix}sites", pd.DataFrame(rows), read_columns(EXTENSION.package)


def _site_rows(harmonization: Harmonization, units: Mapping[str, str]) -> Iterator[dict[str, Any]]:
    """List shifts and scales of sites: means over the points of a map, or of a summary measure."""
    for (kind, hemi, measure), (effects, moments) in harmonization.effects.items():
        shift, after = effects.shift * effects.sd, moments.after(effects)
        for number, site in enumerate(harmonization.plan.sites):
            if moments.n[number].any():
                yield {
                    "measure": measure,
                    "unit": units.get(measure, "1"),
                    "kind": kind,
                    "hemi": hemi,
                    "site": site,
                    "estimated": site in harmonization.plan.estimated,
                    "n": int(moments.n[number].max()),
                    "site_shift": _mean_known(shift[number]),
                    "site_shift_rms": _root_mean_square(shift[number]),
                    "site_scale": _mean_known(effects.scale[number]),
                    "offset_before": _root_mean_square(moments.mean[number]),
                    "offset_after": _root_mean_square(after.mean[number]),
                    "spread_before": _mean_known(moments.sd[number]),
                    "spread_after": _mean_known(after.sd[number]),
                }


def _mean_known(values: Float) -> float:
    return float(mean_of_known(values, 0))


def _root_mean_square(values: Float) -> float:
    return float(np.sqrt(mean_of_known(values**2, 0)))


def figures(cohort: Cohort, analysis: Analysis) -> Iterator[tuple[str, style.Drawing]]:
    """Figure of sites of the maps of a surface."""
    if analysis.fitted:
        name = "sites" if analysis.registered else f"{next(iter(analysis.measured.maps))}_sites"
        yield name, partial(draw_sites, cohort, analysis)


def draw_sites(cohort: Cohort, analysis: Analysis) -> "list[Figure]":
    """Draw means and SDs of the residuals of sites over points, before and after harmonization."""
    harmonization = part_of(analysis)
    shown_sites = [site for site in harmonization.plan.sites if site in harmonization.plan.counts]
    height = 2 * (20 + 5 * len(shown_sites))
    maps = {key: pair for key, pair in harmonization.effects.items() if key[0] == "map"}
    figure, axes = style.new_panels(2, len(maps), (style.TWO_COLUMNS, height))
    for j, ((_, hemi, measure), (effects, moments)) in enumerate(maps.items()):
        states = {"before": moments, "after": moments.after(effects)}
        unit = cohort.units.get(measure, "1")
        for number, (name, state) in enumerate(states.items()):
            for axis, values in ((axes[0, j], state.mean * effects.sd), (axes[1, j], state.sd)):
                for row, site in enumerate(shown_sites):
                    _spread(axis, values[harmonization.plan.sites.index(site)], row, number, name)
        for axis, label, ideal in (
            (axes[0, j], f"mean, {display_name(measure)} [{unit}]", 0.0),
            (axes[1, j], "SD, over the SD of all", 1.0),
        ):
            axis.axvline(ideal, color="black", linewidth=0.5)
            axis.set_yticks(
                range(len(shown_sites)), shown_sites if j == 0 else [""] * len(shown_sites)
            )
            axis.set_ylim(len(shown_sites) - 0.5, -0.5)
            axis.locator_params(axis="x", nbins=4)
            axis.set_xlabel(label)
        axes[0, j].set_title(f"{display_name(measure)}, {SIDES[hemi]}")
    style.explain(figure, axes[0, 0])
    return [figure]


def _spread(axis: "Axes", values: Float, row: int, number: int, name: str) -> None:
    """Draw the 5th to the 95th percentile, the quartiles and the median of points as lines."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    low, first, middle, third, high = np.percentile(finite, [5, 25, 50, 75, 95])
    y, color = row - 0.16 + 0.32 * number, ("0.6", COLORS[0])[number]
    axis.plot([low, high], [y, y], color=color, linewidth=1.0)
    axis.plot([first, third], [y, y], color=color, linewidth=4.5, label=name, solid_capstyle="butt")
    axis.plot([middle], [y], "|", color="white", markersize=4.5)


def source(plan: SitePlan) -> Iterator[tuple[str, Mapping[str, list[str]]]]:
    """Name a file of effects, and the segmentations that it rests on."""
    if plan.saved:
        yield plan.saved.file, plan.saved.labels


def effect_files(
    cohorts: Mapping[str, Cohort],  # noqa: ARG001  (as of all steps)
    analyses: Mapping[str, Analysis],
    labels: Mapping[str, list[str]],
    averages: Averages,  # noqa: ARG001  (as of all steps)
) -> Iterator[Writer]:
    """Write parameters for other participants."""
    harmonizations = [part_of(analysis) for analysis in analyses.values()]
    (sheets, *_) = analyses.values()
    if effects := effects_of(harmonizations, digests(sheets.registrations)):
        effects = effects.model_copy(update={"labels": dict(labels)})
        content = effects.model_dump(by_alias=True)
        yield lambda folder: files.write_json(folder / "harmonization.json", content)


def record(analysis: Analysis) -> Iterator[tuple[str, Any]]:
    """Record the effects removed and kept."""
    harmonization, groups = part_of(analysis), analysis.groups
    plan = harmonization.plan
    content = {
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
    yield "harmonization", content


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
        sites={one: known_sites.get(one, plan.counts.get(one, 0)) for one in plan.sites},
        repeated=plan.visits.participant is not None,
        icv=plan.icv,
        templates=dict(templates),
        maps=files.as_nested(_of_kind("map", parts), ARRAYS),
        summaries=files.as_nested(_of_kind("summary", parts[:1]), ARRAYS),
    )


def _of_kind(kind: str, parts: Sequence[Harmonization]) -> dict[tuple[str, str], SiteEffects]:
    pairs = (pair for part in parts for pair in part.effects.items())
    return {key[1:]: effects for key, (effects, _) in pairs if key[0] == kind}
