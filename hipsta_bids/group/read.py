"""All that the group level reads, joined into rows of a table and maps of these rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.group.collect import (
    Collection,
    Exclusion,
    GroupRequest,
    Measured,
    check_summaries,
    choose_measures,
    collect_sheets,
    read_sheets,
    visits_of,
    wanted_by,
)
from hipsta_bids.group.comparison import Comparison, choose_visits
from hipsta_bids.group.covariates import VisitTime, add_time, read_covariates, read_icv
from hipsta_bids.group.data import PARTICIPANT, SESSION, Cohort, Measures
from hipsta_bids.group.model import ModelRequest, wanted_measures
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.surfaces import (
    ExternalCohorts,
    MapPattern,
    add_external,
    find_all,
    map_patterns,
    taken_names,
)
from hipsta_bids.group.volumes import add_volumes, check_volumes
from hipsta_bids.io import files


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


#: Column that takes the intracranial volume estimated by the segmentation's program.
_ICV = "icv"


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupInputs:
    """What the models are fitted to."""

    found: Collection
    """Hemispheres that were measured."""
    cohort: Cohort
    """Visits that are compared, with covariates and sheets."""
    others: Mapping[str, Cohort]
    """The same visits with other programs' maps, by the names of these."""
    wanted: tuple[str, ...]
    """Measures by the user's choice; empty is the default."""
    measures: Measures
    """Those of the sheets."""
    icv: str | None
    """Column of intracranial volume."""
    time: VisitTime | None
    exclusions: tuple[Exclusion, ...]
    n_other_visits: int
    """How many of the exclusions are sessions that are not compared."""
    notes: tuple[str, ...]


def read_inputs(options: GroupOptions, settings: GroupSettings) -> GroupInputs:
    """Find and read sheets, other maps, volumes and covariates."""
    check_volumes(options.volumes)
    found = collect_sheets(options.sheets, may_lack=bool(options.maps))
    taken = taken_names(with_sheets=bool(found.records))
    requests = map_patterns(options.maps, options.surfaces, taken)
    wanted = wanted_measures(options.model, options.measures)
    measures = choose_measures(wanted, found.records, [one.name for one in requests])
    foreign = _read_maps(options, found, requests, measures)
    measured, volume_notes = add_volumes(
        foreign.measured, found.records, options.volumes, options.bids_dir
    )
    check_summaries(measures, measured.sides)
    everybody = Cohort(
        table=read_covariates(measured.visits, options.bids_dir, options.covariates),
        sides=measured.sides,
        x=measured.x,
        y=measured.y,
        units=measured.units,
    )
    cohort, reasons = choose_visits(everybody, options.comparison)
    keep = everybody.table.index.isin(cohort.table.index)
    cohort, icv = _with_icv(cohort, measured, settings)
    cohort, time = _with_time(cohort, options.comparison, settings)
    return GroupInputs(
        found=found,
        cohort=cohort,
        others={
            name: replace(other.take(keep), table=cohort.table)
            for name, other in foreign.others.items()
        },
        wanted=wanted,
        measures=replace(
            measures, maps=tuple(name for name in measures.maps if name not in foreign.others)
        ),
        icv=icv,
        time=time,
        exclusions=(*found.exclusions, *_other_visits(measured, reasons, options.comparison)),
        n_other_visits=len(reasons),
        notes=(*found.notes, *foreign.notes, *volume_notes),
    )


def _read_maps(
    options: GroupOptions,
    found: Collection,
    requests: Sequence[MapPattern],
    measures: Measures,
) -> ExternalCohorts:
    """Read the maps that are asked for, of the sheets and of other programs."""
    asked = [one for one in requests if one.name in measures.maps]
    files_of, visits = find_all(
        asked, options.bids_dir, visits_of(found.records), wanted_by(options.sheets)
    )
    names = {one.name for one in requests}
    own = [name for name in measures.maps if name not in names]
    measured = read_sheets(found.records, found.settings, own, visits)
    return add_external(measured, files_of, visits)


def _other_visits(
    measured: Measured, reasons: Mapping[str, str], comparison: Comparison
) -> list[Exclusion]:
    """List the sessions that are not compared."""
    return [
        Exclusion(
            participant=row[PARTICIPANT],
            session=row[SESSION],
            hemi=files.MISSING,
            reason="other-session" if comparison.pair else "later-session",
            message=message,
        )
        for visit, message in reasons.items()
        for row in measured.visits.loc[[visit]].to_dict("records")
    ]


def _with_time(
    cohort: Cohort, comparison: Comparison, settings: GroupSettings
) -> tuple[Cohort, VisitTime | None]:
    """Add the time of visits, if it is needed."""
    if not comparison.longitudinal:
        return cohort, None
    visits = add_time(cohort.table, settings)
    return replace(cohort, table=visits.table), visits


def _with_icv(
    cohort: Cohort, measured: Measured, settings: GroupSettings
) -> tuple[Cohort, str | None]:
    """Find the column of intracranial volume, or make one from what the programs estimated."""
    by_name = {str(column).casefold(): str(column) for column in cohort.table.columns}
    for name in settings.model.icv_columns:
        if name in by_name:
            return cohort, by_name[name]
    known = {
        name: measured.sources[name] for name in cohort.table.index if name in measured.sources
    }
    read = read_icv([source for source, _ in known.values()], [root for _, root in known.values()])
    volumes = dict(zip(known, read, strict=True))
    if all(volume is None for volume in read):
        return cohort, None
    column = [volumes.get(name) for name in cohort.table.index]
    table = cohort.table.assign(**{_ICV: pd.array(column, dtype=np.float64)})
    return replace(cohort, table=table), _ICV
