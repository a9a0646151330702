"""Visits of a participant that share a sheet, side by side on the same columns."""

from hipsta_bids.reports.display import THICKNESS, THICKNESS_CHANGE
from hipsta_bids.reports.maps import Picture, draw_map
from hipsta_bids.reports.results import Hemisphere, find_results


def sharing(hemisphere: Hemisphere) -> list[Hemisphere]:
    """List the measured visits that share the sheet of a hemisphere, by session."""
    sessions = {str(visit.get("session")) for visit in hemisphere.record.get("visits") or ()}
    name = hemisphere.result.name
    return [
        visit
        for session in sorted(sessions)
        for visit in find_results(hemisphere.result.root, name.subject, session)
        if visit.measured
        and (visit.result.name.hemi, visit.result.name.protocol) == (name.hemi, name.protocol)
        and THICKNESS_CHANGE.column in visit.sheet.columns
    ]


def draw_visits(hemisphere: Hemisphere) -> list[Picture]:
    """Draw thickness at all visits that share a sheet, and its difference from their mean."""
    visits = sharing(hemisphere)
    if len(visits) < 2:  # noqa: PLR2004 -- nothing to compare
        return []
    titles = [f"{visit.side}, ses-{visit.result.name.session}" for visit in visits]
    return [draw_map(kind, visits, titles=titles) for kind in (THICKNESS, THICKNESS_CHANGE)]
