"""Reads maps and surfaces that other programs wrote: GIFTI, or tables."""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers.expat import ExpatError

import nibabel as nib
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.gifti.gifti import GiftiImage

from hipsta_bids.bids import files
from hipsta_bids.bids.label_tables import entities
from hipsta_bids.errors import InputError
from hipsta_bids.group_data import Float, Mesh

#: Unit of maps that do not say theirs.
ARBITRARY = "arbitrary"

#: Units of what HippUnfold measures per vertex, by the suffix of its files.
_UNITS = {"thickness": "mm", "surfarea": "mm^2", "gyrification": "1"}
#: Columns of a table that say where a row is.
_PLACES = ("x", "y", "node_x", "node_y", "vertex", "index", "point")


@dataclass(frozen=True, eq=False, kw_only=True)
class PointMap:
    """One number per point."""

    values: Float
    """(points,); NaN is missing."""
    unit: str
    nodes: tuple[int, int] | None = None
    """Nodes along x and y, where a table says that they are the sheet's."""


def read_map(path: Path, name: str) -> PointMap:
    """Read a map.

    Parameters
    ----------
    path : Path
        ``.gii`` with one array, or ``.tsv`` with one row per point.
    name : str
        Column of a table that has several.

    Returns
    -------
    PointMap

    Raises
    ------
    InputError
        If it cannot be read, or holds several maps.
    """
    if path.suffix == ".tsv":
        return _from_table(path, name)
    image = _load(path)
    arrays = [array for array in image.darrays if array.data.dtype.kind in "fiu"]
    arrays = [array for array in arrays if array.data.ndim == 1]
    if len(arrays) != 1:
        raise InputError(
            f"{path}: holds {len(arrays)} maps; give a file with one", reason="several-maps"
        )
    pairs = entities(path.name)
    unit = dict(arrays[0].meta).get("Units") or _UNITS.get(pairs["suffix"], ARBITRARY)
    return PointMap(values=_finite(arrays[0].data), unit=str(unit))


def _finite(values: Any) -> Float:  # noqa: ANN401  (whatever nibabel gives)
    numbers = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _from_table(path: Path, name: str) -> PointMap:
    rows = files.read_tsv(path)
    columns = list(rows[0]) if rows else []
    others = [column for column in columns if column not in _PLACES]
    column = name if name in columns else others[0] if len(others) == 1 else None
    if column is None:
        what = f"columns {', '.join(others)}" if others else "no column of values"
        raise InputError(
            f"{path}: has {what}; name the map after one of them", reason="several-maps"
        )
    try:
        values = [np.nan if row[column] == files.MISSING else float(row[column]) for row in rows]
        nodes = _nodes(rows) if {"x", "y"} <= set(columns) else None
    except ValueError as error:
        raise InputError(
            f"{path}: column {column} has cells that are no numbers ({error}); mark missing ones"
            " n/a",
            reason="unreadable-map",
        ) from error
    return PointMap(values=_finite(values), unit=ARBITRARY, nodes=nodes)


def _nodes(rows: list[dict[str, str]]) -> tuple[int, int] | None:
    """Nodes along x and y if rows are those of a sheet, y fastest; ``None`` otherwise."""
    x, y = (np.array([float(row[axis]) for row in rows]) for axis in "xy")
    nx, ny = int(x.max()), int(y.max())
    expected = np.divmod(np.arange(len(rows)), max(ny, 1))
    regular = nx * ny == len(rows) and (x == expected[0] + 1).all() and (y == expected[1] + 1).all()
    return (nx, ny) if regular else None


def read_mesh(path: Path) -> Mesh:
    """Read a surface.

    Parameters
    ----------
    path : Path
        ``.surf.gii``.

    Returns
    -------
    Mesh

    Raises
    ------
    InputError
        If it is none.
    """
    image = _load(path)
    found = [
        image.get_arrays_from_intent(f"NIFTI_INTENT_{intent}")
        for intent in ("POINTSET", "TRIANGLE")
    ]
    if any(len(arrays) != 1 for arrays in found):
        raise InputError(
            f"{path}: is no surface (points and triangles); give a .surf.gii file",
            reason="unreadable-surface",
        )
    points, triangles = (arrays[0].data for arrays in found)
    mesh = Mesh(
        points=np.asarray(points, dtype=np.float64),
        triangles=np.asarray(triangles, dtype=np.int64),
    )
    if mesh.triangles.min(initial=0) < 0 or mesh.triangles.max(initial=-1) >= len(mesh.points):
        raise InputError(
            f"{path}: has triangles between vertices that do not exist; write it again",
            reason="unreadable-surface",
        )
    return mesh


def _load(path: Path) -> GiftiImage:
    try:
        image = nib.load(path)
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        ImageFileError,
        ExpatError,
        zlib.error,
        struct.error,
    ) as error:
        first = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: not readable as GIFTI ({first}); write it again", reason="unreadable-map"
        ) from error
    if not isinstance(image, GiftiImage):
        raise InputError(
            f"{path}: is no GIFTI file; maps are .shape.gii, .func.gii or .tsv files",
            reason="unreadable-map",
        )
    return image
