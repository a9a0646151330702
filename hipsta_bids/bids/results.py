"""Writes the files of one hemisphere, and removes and recognizes them.

The quality record goes last and is removed first, so that it stands for a complete set.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.artifacts import BodyMask, Bool, Float, HemisphereMaps, Status
from hipsta_bids.bids import files, gifti, masks, tables
from hipsta_bids.bids.names import (
    EXTRA_OUTPUTS,
    OUTPUTS,
    HemisphereName,
    output_name,
    output_path,
)
from hipsta_bids.errors import HipstaError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sheet import is_left_handed
from hipsta_bids.schemes import Scheme

#: Workbench's word for a surface, where it has one that fits.
_SECONDARY = {"interior": None, "midthickness": "MidThickness", "exterior": None}


@dataclass(frozen=True, kw_only=True)
class ResultPlace:
    """Where the results of one hemisphere are."""

    root: Path
    """The output dataset."""
    name: HemisphereName

    def path(self, key: str, desc: str | None = None) -> Path:
        """Path of one output, by its key in the output table and, for maps, the user's name."""
        return self.root / output_path(self.name, key, desc)

    def paths(self, *, optional: bool) -> list[Path]:
        """Paths of all outputs, with the optional ones or without."""
        return [self.path(row.key) for row in OUTPUTS if optional or not row.optional]

    def extra_paths(self) -> list[Path]:
        """Existing files that came with an option or another command."""
        folder = self.root / self.name.folder
        names = [output_name(self.name, row.key) for row in EXTRA_OUTPUTS]
        return [path for name in names for path in sorted(folder.glob(name))]


def remove_results(place: ResultPlace) -> None:
    """Remove every file of one hemisphere, whole or half-written.

    Raises
    ------
    OutputError
        If one cannot be removed.
    """
    files.remove([*reversed(place.paths(optional=True)), *place.extra_paths()])
    folder = place.path("qc").parent
    if folder.is_dir():
        files.remove_leftovers(folder, place.name.pattern)


def write_results(
    place: ResultPlace,
    maps: HemisphereMaps,
    scheme: Scheme,
    record: Mapping[str, Any],
    *,
    write_meshes: bool,
    write_more: Callable[[], None] = lambda: None,
) -> None:
    """Write all files of one hemisphere; earlier ones are removed first.

    Parameters
    ----------
    place : ResultPlace
        Where.
    maps : HemisphereMaps
        What was measured.
    scheme : Scheme
        Protocol of the segmentation: names and colors of the subfields.
    record : mapping
        What the quality record says besides the measures (inputs, hashes, version, ...).
    write_meshes : bool
        Whether to add the tetrahedral mesh.
    write_more : callable, optional
        Writes what else there is to write, before the record.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    remove_results(place)
    tables.write_sheet(place.path("sheet"), place.path("sheet_sidecar"), maps, scheme)
    tables.write_summary(place.path("summary"), place.path("summary_sidecar"), maps.summary)
    tables.write_profile(place.path("profile"), place.path("profile_sidecar"), maps)
    tables.write_sections(place.path("sections"), place.path("sections_sidecar"), maps.sections)
    for key, content in gifti_files(maps, scheme, place.name.hemi):
        files.write_bytes(place.path(key), content)
    files.write_bytes(place.path("body_mask"), masks.mask_bytes(maps.body_mask))
    if write_meshes:
        tables.write_layers(place.path("layers"), place.path("layers_sidecar"), maps.layers)
        from hipsta_bids.bids.meshes import mesh_bytes  # noqa: PLC0415  (meshio is slow to load)

        files.write_bytes(place.path("mesh"), mesh_bytes(maps.mesh, maps.coordinates))
    write_more()
    undefined = int(np.isnan(maps.sheet.points[:, :, [0, -1]]).any(axis=(2, 3)).sum())
    status, reason, message = verdict(maps)
    files.write_json(
        place.path("qc"),
        {
            "status": status,
            "reason": reason,
            "message": message,
            **record,
            "repairs": maps.repairs,
            "flags": [{"reason": f.reason, "message": f.message} for f in maps.flags],
            "undefined_columns": undefined,
            "metrics": maps.qc,
        },
    )


def write_failure(
    place: ResultPlace,
    error: HipstaError,
    record: Mapping[str, Any],
    body: BodyMask | None = None,
) -> None:
    """Leave nothing of a failed hemisphere but its quality record, and its body to be corrected.

    Parameters
    ----------
    place : ResultPlace
        Where.
    error : HipstaError
        Why it failed.
    record : mapping
        Inputs, hashes, version, as far as known.
    body : BodyMask, optional
        What could not be measured, if known.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    remove_results(place)
    if body is not None:
        files.write_bytes(place.path("body_mask"), masks.mask_bytes(body))
    verdict = {"status": Status.FAILED, "reason": error.reason, "message": str(error)}
    files.write_json(place.path("qc"), verdict | dict(record))


def verdict(maps: HemisphereMaps) -> tuple[Status, str | None, str | None]:
    """Sum up how a measured hemisphere ended.

    Parameters
    ----------
    maps : HemisphereMaps
        What was measured.

    Returns
    -------
    tuple of (Status, str or None, str or None)
        Status; machine-readable reason, several joined by ``+``; and message, about the flags if
        there are any, else about the repairs. ``None`` if there is nothing to say.
    """
    notes = [flag.message for flag in maps.flags] or list(maps.repairs)
    reasons = list(dict.fromkeys(flag.reason for flag in maps.flags))
    if maps.repairs:
        reasons.append("repaired")
    return maps.status, "+".join(reasons) or None, "; ".join(notes) or None


def gifti_files(maps: HemisphereMaps, scheme: Scheme, hemi: str) -> Iterator[tuple[str, bytes]]:
    """Encode the surfaces and the maps on them.

    Vertices are the sheet's columns, y fastest, as the rows of the sheet table are. Surfaces
    need finite vertices: a column without a position gets that of its nearest neighbor on the
    grid, while the maps keep their NaN.

    Parameters
    ----------
    maps : HemisphereMaps
        What was measured.
    scheme : Scheme
        Names and colors of the subfields.
    hemi : str
        ``L`` or ``R``.

    Yields
    ------
    (str, bytes)
        Key in the output table, and the file.
    """
    points = maps.sheet.points
    nx, ny = points.shape[:2]
    levels = {"interior": 0, "midthickness": points.shape[2] // 2, "exterior": -1}
    triangles = gifti.sheet_triangles(nx, ny, flip=is_left_handed(points))
    flat_triangles = gifti.sheet_triangles(nx, ny)
    for surface, level in levels.items():
        yield (
            f"{surface}_surface",
            gifti.surface_bytes(
                fill_from_nearest(points[:, :, level]).reshape(-1, 3),
                triangles,
                hemi=hemi,
                secondary=_SECONDARY[surface],
                unfolded=False,
            ),
        )
        yield (
            f"{surface}_unfold",
            gifti.surface_bytes(
                unfolded_points(maps, surface).reshape(-1, 3),
                flat_triangles,
                hemi=hemi,
                secondary=_SECONDARY[surface],
                unfolded=True,
            ),
        )
    for row in MAPS:
        values = maps.maps[row.name].ravel()
        yield row.name, gifti.shape_bytes(values, hemi=hemi, name=row.name, unit=row.unit)
    table = {
        int(tissue): (label.name, label.color)
        for tissue, label in tables.sheet_labels(scheme).items()
    }
    yield (
        "subfields",
        gifti.label_bytes(maps.subfield.ravel(), hemi=hemi, name="subfields", table=table),
    )


def unfolded_points(maps: HemisphereMaps, surface: str) -> Float:
    """Lay one surface of the sheet flat.

    Parameters
    ----------
    maps : HemisphereMaps
        What was measured.
    surface : str
        ``interior``, ``midthickness`` or ``exterior``.

    Returns
    -------
    (Nx, Ny, 3) float64
        x from medial to lateral and y from posterior to anterior, centered on 0, node spacing
        such that the rectangle is as wide and as long as the sheet is on average; z is minus or
        plus half the mean thickness on the interior and exterior surface. All in mm.
    """
    nx, ny = maps.sheet.points.shape[:2]
    extents = [maps.summary.get(f"extent_{axis}", np.nan) for axis in "xyz"]
    width, length, height = (e if np.isfinite(e) and e > 0 else 1.0 for e in extents)
    x = np.linspace(-width / 2, width / 2, nx)
    y = np.linspace(-length / 2, length / 2, ny)
    z = height * {"interior": -0.5, "midthickness": 0.0, "exterior": 0.5}[surface]
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], np.float64(z)), axis=-1)


def fill_from_nearest(points: Float) -> Float:
    """Give each undefined grid node the position of the nearest defined one.

    Parameters
    ----------
    points : (Nx, Ny, 3) float64
        NaN where undefined.

    Returns
    -------
    (Nx, Ny, 3) float64
        Finite, unless no node was defined.
    """
    undefined: Bool = np.asarray(np.isnan(points).any(axis=-1))
    if not undefined.any() or undefined.all():
        return points
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  (rarely needed)

    nearest = distance_transform_edt(undefined, return_distances=False, return_indices=True)
    filled: Float = points[tuple(nearest)]
    return filled
