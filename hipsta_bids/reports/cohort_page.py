"""The page about everybody: who can be used, who stands apart, and who is to be left out."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from hipsta_bids.artifacts import Status
from hipsta_bids.bids.names import participant_report
from hipsta_bids.reports.cohort import (
    MEASURES,
    SMALLEST_COMPARED,
    Cohort,
    Distance,
    distances,
    title_of,
)
from hipsta_bids.reports.page import render
from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.reports.sprites import make_sprites, read_maps
from hipsta_bids.reports.words import number

#: Robust z-scores beyond this are rare without a cause (Iglewicz and Hoaglin 1993).
APART = 3.5

#: Columns of the table, with shorter titles than those of the measures.
_SHOWN = {
    "thickness_mean": "Thickness",
    "curvature_mean": "Curvature",
    "volume": "Volume",
    "area_mid": "Area",
    "extent_y": "Length",
}
_QUALITY = {
    "voxels_across": "Voxels across",
    "changed_fraction": "Repaired",
    "filled_fraction": "Filled",
}


def cohort_page(cohort: Cohort) -> str | None:
    """Make the page about all hemispheres of an output dataset.

    Parameters
    ----------
    cohort : Cohort

    Returns
    -------
    str or None
        The page; ``None`` if there is no hemisphere.
    """
    hemispheres = cohort.hemispheres
    if not hemispheres:
        return None
    maps = [read_maps(h) if h.measured else {} for h in hemispheres]
    thickness = {
        title_of(h.place.name): found["thickness"]
        for h, found in zip(hemispheres, maps, strict=True)
        if found
    }
    apart = distances(cohort, thickness)
    sprites, grid = make_sprites(hemispheres, maps)
    counts = Counter(str(h.status) for h in hemispheres)
    rows = [
        _row(h, apart.get(title_of(h.place.name)), grid.places.get(n))
        for n, h in enumerate(hemispheres)
    ]
    return render(
        "cohort.html",
        title="All hemispheres",
        n=len(hemispheres),
        n_participants=len({h.place.name.subject for h in hemispheres}),
        counts=[(str(status), counts[str(status)]) for status in Status if counts[str(status)]],
        n_apart=sum(distance.value > APART for distance in apart.values()),
        apart=APART,
        smallest=SMALLEST_COMPARED,
        compared=bool(apart),
        sprites=sprites,
        data={
            "columns": _columns(hemispheres),
            "rows": rows,
            "apart": APART,
            "grid": {
                "columns": grid.columns,
                "rows": grid.rows,
                "aspect": _aspect(hemispheres),
            },
        },
    )


def _columns(hemispheres: tuple[Hemisphere, ...]) -> list[Mapping[str, Any]]:
    """Columns of the table; those that say the same everywhere are left out."""
    names = [h.place.name for h in hemispheres]
    measures = {measure.name: measure for measure in MEASURES}
    columns: list[Mapping[str, Any]] = [{"key": "participant", "title": "Participant"}]
    if any(name.session for name in names):
        columns.append({"key": "session", "title": "Session"})
    columns.append({"key": "hemi", "title": "Side"})
    if len({name.seg for name in names}) > 1:
        columns.append({"key": "seg", "title": "Protocol"})
    if len({name.region for name in names}) > 1:
        columns.append({"key": "region", "title": "Region"})
    columns += [
        {"key": "status", "title": "Status"},
        {"key": "reason", "title": "Reason"},
        {"key": "distance", "title": "Apart", "digits": 1, "help": "largest robust z-score"},
        {"key": "farthest", "title": "most in"},
    ]
    columns += [
        {
            "key": name,
            "title": title,
            "unit": measures[name].unit,
            "digits": measures[name].digits,
        }
        for name, title in _SHOWN.items()
    ]
    columns += [
        {
            "key": key,
            "title": title,
            "digits": 1,
            **({"percent": True} if key.endswith("fraction") else {}),
        }
        for key, title in _QUALITY.items()
    ]
    return columns


def _row(hemisphere: Hemisphere, distance: Distance | None, tile: int | None) -> dict[str, Any]:
    name, record = hemisphere.place.name, hemisphere.record
    numbers = {key: hemisphere.summary.get(key, np.nan) for key in _SHOWN}
    numbers |= {key: number(hemisphere.metrics, key) for key in _QUALITY}
    return {
        "page": participant_report(name.subject, name.session),
        "participant": f"sub-{name.subject}",
        "session": f"ses-{name.session}" if name.session else None,
        "hemi": name.hemi,
        "seg": name.seg,
        "region": name.region,
        "status": str(hemisphere.status),
        "reason": record.get("reason") or "",
        "message": hemisphere.message,
        "distance": round(distance.value, 2) if distance else None,
        "farthest": distance.measure.partition(",")[0] if distance else "",
        "tile": tile,
        **{key: float(f"{v:.6g}") if np.isfinite(v) else None for key, v in numbers.items()},
    }


def _aspect(hemispheres: tuple[Hemisphere, ...]) -> float:
    """Usual length over width of a sheet."""
    ratios = [
        h.summary["extent_y"] / h.summary["extent_x"]
        for h in hemispheres
        if np.isfinite(h.summary.get("extent_x", np.nan)) and h.summary["extent_x"] > 0
    ]
    return round(float(np.median(ratios)), 3) if ratios else 1.0
