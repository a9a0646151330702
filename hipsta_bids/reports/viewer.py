"""Data of the three-dimensional view of a page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.reports.maps import MAP_KINDS, color_table, scale_of
from hipsta_bids.reports.results import SURFACES, Hemisphere, Views
from hipsta_bids.types import Float

#: Finer masks of failed hemispheres are thinned to about this edge before they are drawn, mm.
_EDGE = 0.6

#: Colors of subfields, from medial to lateral (Okabe and Ito 2008).
_SUBFIELD_COLORS = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#F0E442", "#0072B2", "#D55E00")


def scene_of(hemisphere: Hemisphere, views: Views | None, names: Sequence[str]) -> dict[str, Any]:
    """Collect the scene of one hemisphere."""
    scene: dict[str, Any] = {
        "side": hemisphere.side,
        "hemi": hemisphere.place.name.hemi,
        "findings": [
            {"kind": f.kind, "message": f.message, "point": f.point}
            for f in hemisphere.findings
            if f.point is not None
        ],
    }
    if hemisphere.measured:
        return scene | _sheet_scene(hemisphere, names)
    if views is not None and views.mask is not None:
        vertices, triangles = _body(views.mask, views)
        scene["body"] = {"vertices": _flat(vertices, 2), "triangles": triangles.ravel().tolist()}
    return scene


def scales_of(hemispheres: Sequence[Hemisphere]) -> dict[str, Any]:
    """Collect the color scales that all scenes of a page share."""
    scales: dict[str, Any] = {}
    for kind in MAP_KINDS:
        low, high = scale_of(kind, [h.sheet.columns[kind.column] for h in hemispheres])
        scales[kind.column] = {
            "title": kind.title,
            "unit": kind.unit,
            "low": low,
            "high": high,
            "digits": kind.digits,
            "colors": color_table(kind).tolist(),
        }
    return scales


def _sheet_scene(hemisphere: Hemisphere, names: Sequence[str]) -> dict[str, Any]:
    sheet = hemisphere.sheet
    index = {name: n for n, name in enumerate(names)}
    ends = (hemisphere.metrics.get(f"{end}_plane") for end in ("posterior", "anterior"))
    return {
        "shape": sheet.shape,
        "extent": [hemisphere.summary.get(f"extent_{axis}", 1.0) for axis in "xy"],
        "surfaces": {name: _flat(sheet.points[name], 2) for name in SURFACES},
        "maps": {kind.column: _flat(sheet.columns[kind.column], 4) for kind in MAP_KINDS},
        "subfields": [
            {"name": name, "color": _SUBFIELD_COLORS[n % len(_SUBFIELD_COLORS)]}
            for n, name in enumerate(names)
        ],
        "subfield": [index.get(str(name), -1) for name in sheet.subfield.ravel()],
        "valid": sheet.valid.astype(int).ravel().tolist(),
        "repaired": sheet.repaired.astype(int).ravel().tolist(),
        "planes": [
            {"point": plane["point_ras_mm"], "normal": plane["normal_ras"]}
            for plane in ends
            if isinstance(plane, Mapping)
        ],
    }


def subfields_of(hemispheres: Sequence[Hemisphere]) -> list[str]:
    """List the subfields of measured hemispheres from medial to lateral."""
    columns: dict[str, list[float]] = {}
    for hemisphere in hemispheres:
        subfield = hemisphere.sheet.subfield
        for name in np.unique(subfield[subfield != ""]).tolist():
            columns.setdefault(name, []).extend(np.nonzero(subfield == name)[0].tolist())
    return sorted(columns, key=lambda name: float(np.mean(columns[name])))


def _flat(values: Float, digits: int) -> list[float | None]:
    """Round to a list; missing values are ``None``."""
    return [
        round(value, digits) if np.isfinite(value) else None for value in values.ravel().tolist()
    ]


def _body(mask: NDArray[np.bool_], views: Views) -> tuple[Float, NDArray[np.int64]]:
    """Wrap a mask in triangles."""
    from skimage.measure import marching_cubes  # noqa: PLC0415  (slow to load, rarely needed)

    step = max(1, round(_EDGE / float(views.voxel.max())))
    padded = np.pad(mask, 2 * step).astype(np.float32)
    vertices, triangles, _, _ = marching_cubes(padded, 0.5, step_size=step)  # type: ignore[no-untyped-call]  # typed in part only
    points = (vertices - 2 * step) @ views.affine[:3, :3].T + views.affine[:3, 3]
    return points, triangles
