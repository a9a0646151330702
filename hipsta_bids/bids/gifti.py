"""GIFTI files of the sheet that Workbench, nilearn and nibabel load.

Structure names are those of Connectome Workbench's ``StructureEnum``, which knows
``HippocampusLeft`` and ``HippocampusRight``; the metadata keys are those of the GIFTI 1.0
specification (Harwell et al. 2011) and of Workbench.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.parsers.expat import ExpatError

import numpy as np
from nibabel.gifti.gifti import (
    GiftiCoordSystem,
    GiftiDataArray,
    GiftiImage,
    GiftiLabel,
    GiftiLabelTable,
    GiftiMetaData,
)
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float, Int
from hipsta_bids.errors import InputError

_STRUCTURE = {"L": "HippocampusLeft", "R": "HippocampusRight"}


def sheet_triangles(nx: int, ny: int, *, flip: bool = False) -> Int:
    """Triangulate a regular grid, two triangles per cell.

    Parameters
    ----------
    nx, ny : int
        Numbers of nodes along x and y; node (i, j) is vertex ``i * ny + j``.
    flip : bool
        Turn all triangles round.

    Returns
    -------
    (2 (nx - 1) (ny - 1), 3) int32
        Counterclockwise seen from the side that x cross y points to, unless flipped.
    """
    index = np.arange(nx * ny, dtype=np.int32).reshape(nx, ny)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.ascontiguousarray(triangles[:, ::-1] if flip else triangles)


def surface_bytes(
    points: Float, triangles: Int, *, hemi: str, secondary: str | None, unfolded: bool
) -> bytes:
    """Encode a surface.

    Parameters
    ----------
    points : (V, 3) float64
        Vertices in mm: scanner RAS, or the plane of the unfolded sheet.
    triangles : (F, 3) int32
        Outward oriented.
    hemi : str
        ``L`` or ``R``.
    secondary : str or None
        Workbench's secondary surface type, where it has one that fits.
    unfolded : bool
        Whether the points lie in the unfolded space, which is no scanner's.

    Returns
    -------
    bytes
        A ``.surf.gii`` file.
    """
    meta = {
        "AnatomicalStructurePrimary": _STRUCTURE[hemi],
        "GeometricType": "Flat" if unfolded else "Anatomical",
    }
    if secondary:
        meta["AnatomicalStructureSecondary"] = secondary
    space = "NIFTI_XFORM_UNKNOWN" if unfolded else "NIFTI_XFORM_SCANNER_ANAT"
    vertices = GiftiDataArray(
        points.astype(np.float32),
        intent="NIFTI_INTENT_POINTSET",
        datatype="NIFTI_TYPE_FLOAT32",
        coordsys=GiftiCoordSystem(space, space, np.eye(4)),
        meta=GiftiMetaData(meta),
    )
    faces = GiftiDataArray(
        triangles.astype(np.int32),
        intent="NIFTI_INTENT_TRIANGLE",
        datatype="NIFTI_TYPE_INT32",
        meta=GiftiMetaData({"TopologicalType": "Open"}),
    )
    return _encode([vertices, faces], hemi)


def shape_bytes(values: Float, *, hemi: str, name: str, unit: str) -> bytes:
    """Encode one number per vertex.

    Parameters
    ----------
    values : (V,) float64
        NaN where missing.
    hemi : str
        ``L`` or ``R``.
    name, unit : str
        What the map is called in viewers, and its unit.

    Returns
    -------
    bytes
        A ``.shape.gii`` file.
    """
    array = GiftiDataArray(
        values.astype(np.float32),
        intent="NIFTI_INTENT_SHAPE",
        datatype="NIFTI_TYPE_FLOAT32",
        meta=GiftiMetaData({"Name": name, "Units": unit}),
    )
    return _encode([array], hemi)


def maps_bytes(values: Float, *, hemi: str, names: Sequence[str], series: bool = True) -> bytes:
    """Encode one or several numbers per vertex, of unknown unit.

    Parameters
    ----------
    values : (V, T) float64
        NaN where missing.
    hemi : str
        ``L`` or ``R``.
    names : sequence of str
        What the T maps are called in viewers.
    series : bool
        Whether several are a series, as over time.

    Returns
    -------
    bytes
        A ``.shape.gii`` file, or of a series a ``.func.gii`` file.
    """
    kind = "NIFTI_INTENT_SHAPE" if len(names) == 1 or not series else "NIFTI_INTENT_TIME_SERIES"
    arrays = [
        GiftiDataArray(
            column.astype(np.float32),
            intent=kind,
            datatype="NIFTI_TYPE_FLOAT32",
            meta=GiftiMetaData({"Name": name}),
        )
        for name, column in zip(names, values.T, strict=True)
    ]
    return _encode(arrays, hemi)


def label_bytes(
    keys: NDArray[np.uint8], *, hemi: str, name: str, table: Mapping[int, tuple[str, str]]
) -> bytes:
    """Encode one label per vertex.

    Parameters
    ----------
    keys : (V,) uint8
        Labels; 0 is none.
    hemi : str
        ``L`` or ``R``.
    name : str
        What the map is called in viewers.
    table : mapping of int to (str, str)
        Name and ``#rrggbb`` color per key.

    Returns
    -------
    bytes
        A ``.label.gii`` file.
    """
    array = GiftiDataArray(
        keys.astype(np.int32),
        intent="NIFTI_INTENT_LABEL",
        datatype="NIFTI_TYPE_INT32",
        meta=GiftiMetaData({"Name": name}),
    )
    labels = GiftiLabelTable()
    # Workbench calls the unlabeled key "???" and expects it to be transparent.
    for key, (title, color) in {0: ("???", ""), **table}.items():
        rgba = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] + [1.0] if color else [0.0] * 4
        label = GiftiLabel(key, *rgba)
        label.label = title  # type: ignore[attr-defined]  # nibabel sets it from outside, too
        labels.labels.append(label)
    return _encode([array], hemi, labels)


def _encode(
    arrays: Sequence[GiftiDataArray],
    hemi: str,
    labels: GiftiLabelTable | None = None,
) -> bytes:
    meta = GiftiMetaData({"AnatomicalStructurePrimary": _STRUCTURE[hemi]})
    image = GiftiImage(meta=meta, darrays=list(arrays), labeltable=labels)
    content: bytes = image.to_bytes()
    return content


def read_points(path: Path) -> Float:
    """Read the vertices of a surface.

    Parameters
    ----------
    path : Path
        A ``.surf.gii`` file.

    Returns
    -------
    (V, 3) float64
        RAS mm.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        image = GiftiImage.from_bytes(path.read_bytes())
        points = image.agg_data("NIFTI_INTENT_POINTSET")
        return np.asarray(points, dtype=np.float64).reshape(-1, 3)
    except (OSError, ValueError, TypeError, ExpatError) as error:
        raise InputError(
            f"{path}: not readable as a surface ({error}); run the participant level again with"
            " --force",
            reason="unreadable-surface",
        ) from error
