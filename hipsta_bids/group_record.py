"""What the group level is asked for, what comes of it, and the record of both."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.bids.group_inputs import Collection, GroupRequest
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.comparison import Comparison
from hipsta_bids.group_model import ModelRequest
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.settings_file import resolve


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """What the user asked for."""

    bids_dir: Path
    out_dir: Path
    sheets: GroupRequest
    model: ModelRequest
    covariates: tuple[Path, ...] = ()
    maps: tuple[tuple[str, str], ...] = ()
    """Names and patterns of other programs' maps."""
    surfaces: tuple[tuple[str | None, str], ...] = ()
    """Patterns of the surfaces to draw these on, for one or for all."""
    volumes: tuple[tuple[str, str], ...] = ()
    """Names and patterns of other programs' tables of volumes."""
    measures: tuple[str, ...] = ()
    """What to fit the model to; empty for the default or the formula's left-hand side."""
    template: Path | None = None
    comparison: Comparison = field(default_factory=Comparison)
    reports: bool = True
    """Whether a page is made."""
    command: tuple[str, ...] = ()
    """The command line, for the record."""


def notes_of(found: Collection, analysis: Analysis, *, n_other_visits: int) -> list[str]:
    """Say what a reader of the results should know, one line each."""
    notes = list(analysis.skipped)
    if n_other_visits and analysis.comparison.pair is None:
        notes.append(
            f"{n_other_visits} later sessions are not in it; --longitudinal takes all, --paired two"
        )
    if flagged := sum(record.flagged for record in found.records):
        notes.append(
            f"{flagged} flagged hemispheres are in it; look at them, or use --exclude-flagged"
        )
    if len(found.versions) > 1:
        notes.append(f"hemispheres were measured by several versions, {', '.join(found.versions)}")
    if separated := sum(pair.comparison.separated for _, _, pair in analysis.pairs):
        notes.append(
            f"{separated} of {len(analysis.pairs)} comparisons of classifiers are separated, and"
            " fitted by Firth's method"
        )
    for key, discoveries in analysis.found.items():
        if discoveries.lenient:
            notes.append(
                f"{key.measure}, {key.contrast}, {key.hemi}: p up to {discoveries.cutoff:.3g}"
                " survives, above the level; effects are widespread"
            )
    for hemi, side in analysis.sides.items():
        if not side.registration.converged:
            notes.append(f"hemisphere {hemi}: registration had not settled when it ended")
        if side.registration.extreme.any():
            notes.append(
                f"hemisphere {hemi}: extreme warps: {int(side.registration.extreme.sum())}, see"
                " warps.tsv"
            )
    return notes


def record_of(
    options: GroupOptions,
    found: Collection,
    settings: GroupSettings,
    analysis: Analysis,
    notes: Sequence[str],
) -> dict[str, Any]:
    """Record what was run, with which settings and seeds, on what."""
    return {
        "command": list(options.command),
        "version": __version__,
        "inputs": {
            "datasets": [str(root.resolve()) for root in options.sheets.roots],
            "settings_hash": found.settings_hash,
            "versions": found.versions,
            "seg": found.records[0].place.name.seg if found.records else None,
            "maps": dict(options.maps),
            "volumes": dict(options.volumes),
            "covariates": [str(path) for path in options.covariates],
            "template": None if options.template is None else str(options.template),
        },
        "measures": {"maps": analysis.measured.maps, "summaries": analysis.measured.summaries},
        "formula": analysis.model.formula,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "comparison": asdict(analysis.comparison),
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": analysis.n_participants,
        "rows": len(analysis.design.rows),
        "hemispheres": {hemi: len(one.used) for hemi, one in analysis.fitted.items()},
        "notes": notes,
        "settings": resolve(settings),
    }
