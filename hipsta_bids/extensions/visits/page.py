"""Visits of a participant that share a sheet: thickness and its change, side by side."""

from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.names import natural_order
from hipsta_bids.errors import InputError
from hipsta_bids.io import files, gifti
from hipsta_bids.reports.display import THICKNESS, MapKind
from hipsta_bids.reports.page import Section
from hipsta_bids.reports.participant import Series
from hipsta_bids.reports.results import Hemisphere, find_results
from hipsta_bids.reports.unfolded import draw_map

#: Noise is about 0.1 mm.
THICKNESS_CHANGE = MapKind(
    column="thickness_change",
    title="Change of thickness",
    unit="mm",
    colors="PRGn",
    centered=True,
    digits=3,
    limits=(-0.3, 0.3),
)


def read_change(hemisphere: Hemisphere) -> Mapping[str, Any]:
    """Read thickness (Nx, Ny) minus the mean of all visits, by column, where there is one."""
    path, name = hemisphere.result.path("change"), THICKNESS_CHANGE.column
    if not hemisphere.record.get("visits") or not path.exists():
        return {}
    return {name: gifti.read_map(path, name, hemisphere.result.name.hemi).values}


def sharing(hemisphere: Hemisphere) -> list[Hemisphere]:
    """List the measured visits that share the sheet of a hemisphere, in natural order."""
    sessions = {str(visit.get("session")) for visit in hemisphere.record.get("visits") or ()}
    name = hemisphere.result.name
    return [
        visit
        for session in sorted(sessions, key=natural_order)
        for visit in find_results(hemisphere.result.root, name.subject, session)
        if visit.measured
        and (visit.result.name.hemi, visit.result.name.protocol) == (name.hemi, name.protocol)
        and THICKNESS_CHANGE.column in visit.sheet.columns
    ]


def draw_visits(hemisphere: Hemisphere, bids_dir: Path | None) -> dict[str, Any] | None:
    """Draw thickness at all visits that share a sheet, and its difference from their mean."""
    visits = sharing(hemisphere)
    if len(visits) < 2:  # noqa: PLR2004 -- nothing to compare
        return None
    dates = _dates(f"sub-{hemisphere.result.name.subject}", bids_dir)
    visits = _by_time(visits, dates)
    names = [_name(visit) for visit in visits]
    titles = [f"{hemisphere.side}, {name}" for name in names]
    return {
        "side": hemisphere.side,
        "visits": [", ".join(filter(None, (name, dates.get(name, "")[:10]))) for name in names],
        "pictures": [draw_map(k, visits, titles=titles) for k in (THICKNESS, THICKNESS_CHANGE)],
    }


def _name(visit: Hemisphere) -> str:
    return f"ses-{visit.result.name.session}"


def _by_time(visits: list[Hemisphere], dates: Mapping[str, str]) -> list[Hemisphere]:
    """Sort visits by their dates if all are known."""
    with suppress(KeyError, ValueError):  # no date, or another form than that of BIDS
        times = {
            name: datetime.fromisoformat(dates[name]).replace(tzinfo=None)
            for name in map(_name, visits)
        }
        return sorted(visits, key=lambda visit: times[_name(visit)])
    return visits


def _dates(participant: str, bids_dir: Path | None) -> dict[str, str]:
    """Read the times of sessions, as far as the dataset has them."""
    path = (bids_dir or Path()) / participant / f"{participant}_sessions.tsv"
    with suppress(InputError):  # maps have no need of dates
        rows = files.read_tsv(path) if bids_dir and path.exists() else []
        dates = {row.get("session_id", ""): row.get("acq_time", "n/a") for row in rows}
        return {name: date for name, date in dates.items() if not files.is_missing(date)}
    return {}


def _visits(series: Series) -> Mapping[str, Any] | None:
    sides = list(filter(None, (draw_visits(h, series.bids_dir) for h in series.measured)))
    return {"sides": sides} if sides else None


#: Sections of the page of a participant.
SECTIONS = (Section("visits", "Visits on one sheet", "visits.html", _visits, after="sheet"),)
