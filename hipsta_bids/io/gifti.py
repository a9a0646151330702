"""Surfaces and maps on them as GIFTI and CIFTI-2, and meshes in formats of other programs.

Structure names are those of Connectome Workbench's ``StructureEnum``, which knows
``HippocampusLeft`` and ``HippocampusRight``; the metadata keys are those of the GIFTI 1.0
specification (Harwell et al. 2011) and of Workbench. CIFTI-2 calls them
``CIFTI_STRUCTURE_HIPPOCAMPUS_LEFT`` and ``_RIGHT``. HippUnfold's CIFTI files are made by
Workbench from a left and a right map, which makes their structures those of the cortex; both are
read.

VTU, VTK, PLY and OBJ are meshio's, which is slow to load, seldom needed, and writes to paths only.
"""

import importlib
import os
import re
import struct
import tempfile
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from xml.parsers.expat import ExpatError

import nibabel as nib
import numpy as np
from nibabel.cifti2.cifti2 import (
    CIFTI_BRAIN_STRUCTURES,
    Cifti2BrainModel,
    Cifti2HeaderError,
    Cifti2Image,
)
from nibabel.cifti2.cifti2_axes import BrainModelAxis, ScalarAxis
from nibabel.filebasedimages import ImageFileError
from nibabel.gifti.gifti import (
    GiftiCoordSystem,
    GiftiDataArray,
    GiftiImage,
    GiftiLabel,
    GiftiLabelTable,
    GiftiMetaData,
)
from nibabel.spatialimages import HeaderDataError
from numpy.typing import ArrayLike, NDArray

from hipsta_bids.errors import InputError, MissingFileError, UsageError
from hipsta_bids.io import files
from hipsta_bids.io.hippunfold import has_opposite_sign, suffix
from hipsta_bids.opening import TABLE, open_regular, read_bounded
from hipsta_bids.types import Coordinates, Float, Int, Mesh, TetMesh

#: Ending of the names of CIFTI files with one number per vertex.
DENSE_SCALARS = ".dscalar.nii"

#: Endings of surfaces that meshio reads and writes.
ENDINGS = (".vtk", ".ply", ".obj")

#: Names of the harmonic coordinates as point data of the tetrahedral mesh, in their order.
COORDINATE_NAMES = ("medial_lateral", "posterior_anterior", "interior_exterior")

_PRIMARY = "AnatomicalStructurePrimary"
_STRUCTURE = {"L": "HippocampusLeft", "R": "HippocampusRight"}

Image = TypeVar("Image", GiftiImage, Cifti2Image)

#: Sides at the end of CIFTI's names of structures.
_CIFTI_SIDES = {"LEFT": "L", "RIGHT": "R"}

#: What nibabel raises on files that are damaged.
_DAMAGE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, AssertionError, MemoryError),
    *(ImageFileError, HeaderDataError, Cifti2HeaderError, ExpatError, zlib.error, struct.error),
)
#: Another structure of Workbench 2 in files of the HCP, which nibabel does not know.
_DENTATE = "HIPPOCAMPUS_DENTATE"
CIFTI_BRAIN_STRUCTURES.add_codes(
    [
        (f"{_DENTATE}_{side}", f"CIFTI_STRUCTURE_{_DENTATE}_{side}", f"{_DENTATE.title()} {side}")
        for side in ("LEFT", "RIGHT")
    ]
)
_MOST_VERTICES = 10_000_000  # of a surface that a file names but does not hold

#: Where a GIFTI file names another with its numbers, and a CIFTI file how many it has of a part.
_OTHER_FILE = re.compile(rb"ExternalFileName\s*=\s*[\"']([^\"']+)")
_COUNT = re.compile(rb"IndexCount\s*=\s*[\"']\s*(\d+)")

#: Unit of maps whose file names none.
ARBITRARY = "arbitrary"

#: Units of what HippUnfold measures per vertex, by the suffix of its files.
_UNITS = {"thickness": "mm", "surfarea": "mm^2", "gyrification": "1"}

#: Columns of a table that hold the position of a row.
_POSITIONS = ("x", "y", "node_x", "node_y", "vertex", "index", "point")


def sheet_triangles(nx: int, ny: int, *, flip: bool = False) -> Int:
    """Triangulate a regular grid, two triangles per cell."""
    index = np.arange(nx * ny, dtype=np.int32).reshape(nx, ny)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.ascontiguousarray(triangles[:, ::-1] if flip else triangles)


def surface_bytes(
    points: Float, triangles: Int, *, hemi: str, secondary: str | None, unfolded: bool
) -> bytes:
    """Encode a surface, (N, 3) vertices in mm: scanner RAS, or the plane of the unfolded sheet."""
    meta = {_PRIMARY: _STRUCTURE[hemi], "GeometricType": "Flat" if unfolded else "Anatomical"}
    if secondary:
        meta["AnatomicalStructureSecondary"] = secondary
    vertices = _array(points, "POINTSET", meta)
    space = "NIFTI_XFORM_UNKNOWN" if unfolded else "NIFTI_XFORM_SCANNER_ANAT"
    vertices.coordsys = GiftiCoordSystem(space, space, np.eye(4))
    faces = _array(triangles, "TRIANGLE", {"TopologicalType": "Open"})
    return _encode([vertices, faces], hemi)


def shape_bytes(values: Float, *, hemi: str, name: str, unit: str, note: str = "") -> bytes:
    """Encode one number per vertex, NaN where missing."""
    meta = {"Name": name, "Units": unit} | ({"Description": note} if note else {})
    return _encode([_array(values, "SHAPE", meta)], hemi)


def maps_bytes(values: Float, *, hemi: str, names: Sequence[str], series: bool = True) -> bytes:
    """Encode one or several numbers per vertex, (N, maps), of unknown unit, NaN where missing."""
    kind = "TIME_SERIES" if series and len(names) > 1 else "SHAPE"
    arrays = [_array(v, kind, {"Name": name}) for name, v in zip(names, values.T, strict=True)]
    return _encode(arrays, hemi)


def cifti_bytes(values: Mapping[str, Float], names: Sequence[str], note: str = "") -> bytes:
    """Encode maps of both sides as CIFTI-2; ``values`` are (maps, vertices) by hemisphere."""
    models = [
        BrainModelAxis.from_surface(np.arange(rows.shape[1]), rows.shape[1], _STRUCTURE[hemi])
        for hemi, rows in values.items()
    ]
    data = np.concatenate(list(values.values()), axis=1).astype(np.float32)
    meta = [{"Description": note} if note else {} for _ in names]
    axes = ScalarAxis(list(names), meta), sum(models[1:], start=models[0])
    image = Cifti2Image(data, axes)
    image.nifti_header.set_intent("ConnDenseScalar")
    content: bytes = image.to_bytes()
    return content


def label_bytes(
    keys: NDArray[np.uint8], *, hemi: str, name: str, table: Mapping[int, tuple[str, str]]
) -> bytes:
    """Encode one label per vertex; the table has names and colors (``#rrggbb``) by key."""
    labels = GiftiLabelTable()
    # Workbench calls the unlabeled key "???" and expects it to be transparent.
    for key, (title, color) in {0: ("???", ""), **table}.items():
        rgba = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] + [1.0] if color else [0.0] * 4
        label = GiftiLabel(key, *rgba)
        label.label = title  # type: ignore[attr-defined]  # nibabel sets it from outside, too
        labels.labels.append(label)
    return _encode([_array(keys, "LABEL", {"Name": name})], hemi, labels)


def _array(values: NDArray[Any], intent: str, meta: Mapping[str, str]) -> GiftiDataArray:
    """Prepare values, as 32-bit floats or, of triangles and labels, integers."""
    integers = intent in {"TRIANGLE", "LABEL"}
    return GiftiDataArray(
        values.astype(np.int32 if integers else np.float32),
        intent=f"NIFTI_INTENT_{intent}",
        datatype="NIFTI_TYPE_INT32" if integers else "NIFTI_TYPE_FLOAT32",
        meta=GiftiMetaData(dict(meta)),
    )


def _encode(
    arrays: Sequence[GiftiDataArray], hemi: str, labels: GiftiLabelTable | None = None
) -> bytes:
    meta = GiftiMetaData({_PRIMARY: _STRUCTURE[hemi]})
    content: bytes = GiftiImage(meta=meta, darrays=list(arrays), labeltable=labels).to_bytes()
    return content


@dataclass(frozen=True, eq=False, kw_only=True)
class PointMap:
    """One number per point."""

    values: Float
    """(points,); NaN is missing."""
    unit: str
    nodes: tuple[int, int] | None = None
    """Nodes along x and y, where a table says that they are the sheet's."""
    name: str = ""
    """The column, of a table."""


def cifti_sides(path: Path) -> list[str]:
    """List the hemispheres that a CIFTI file has on surfaces."""
    return list(_surface_models(path, _load(path, Cifti2Image)))


def _surface_models(path: Path, image: Cifti2Image) -> dict[str, Cifti2BrainModel]:
    """Find where the data of each hemisphere are, and of which vertices."""
    models: dict[str, Cifti2BrainModel] = {}
    try:  # the axes that nibabel makes of it would hold a word per vertex
        brain_models = list(image.header.get_index_map(image.ndim - 1).brain_models)
    except _DAMAGE as error:
        raise _unreadable(path, "CIFTI", error) from error
    sheets = [model for model in brain_models if _DENTATE not in model.brain_structure]
    for model in sheets or brain_models:
        hemi = _CIFTI_SIDES.get(model.brain_structure.rpartition("_")[2])
        if hemi is None or not model.surface_number_of_vertices:
            continue
        if hemi in models:
            raise InputError(
                f"{path}: has several surfaces of hemisphere {hemi}; give a file with one"
            )
        models[hemi] = model
    return models


def _from_cifti(path: Path, hemi: str) -> PointMap:
    """Read the map of one side; vertices that the file leaves out are missing."""
    image = _load(path, Cifti2Image)
    if image.ndim != 2 or image.shape[0] != 1:  # noqa: PLR2004 -- maps by vertices
        raise InputError(f"{path}: holds {image.shape[0]} maps; give a file with one")
    model = _surface_models(path, image).get(hemi)
    if model is None:
        raise InputError(
            f"{path}: has no surface of hemisphere {hemi}; leave {{hemi}} out of the pattern"
        )
    first, count = model.index_offset, model.index_count
    try:
        with np.errstate(all="ignore"):  # a wrong type or scale; what is infinite is missing
            data = np.asarray(image.dataobj[0, first : first + count], dtype=np.float64)
        if model.surface_number_of_vertices > _MOST_VERTICES:
            raise ValueError(f"a surface of {model.surface_number_of_vertices} vertices")
        values = np.full(model.surface_number_of_vertices, np.nan)
        values[list(model.vertex_indices)] = data
    except _DAMAGE as error:
        raise _unreadable(path, "CIFTI", error) from error
    return PointMap(values=_finite(values), unit=_UNITS.get(suffix(path), ARBITRARY))


def read_map(path: Path, name: str, hemi: str) -> PointMap:
    """Read the map of a hemisphere; curvature has one sign on both sides."""
    point_map = _read_map(path, name, hemi)
    if has_opposite_sign(path, hemi):
        return replace(point_map, values=-point_map.values)
    return point_map


def _read_map(path: Path, name: str, hemi: str) -> PointMap:
    if path.suffix == ".tsv":
        return _from_table(path, name)
    if path.name.endswith(DENSE_SCALARS):
        return _from_cifti(path, hemi)
    image = _load(path, GiftiImage)
    arrays = [array for array in image.darrays if np.asarray(array.data).dtype.kind in "fiu"]
    arrays = [array for array in arrays if array.data.ndim == 1]
    if len(arrays) != 1:
        raise InputError(f"{path}: holds {len(arrays)} maps; give a file with one")
    unit = dict(arrays[0].meta).get("Units") or _UNITS.get(suffix(path), ARBITRARY)
    return PointMap(values=_finite(arrays[0].data), unit=str(unit))


def _finite(values: Any) -> Float:  # noqa: ANN401  ((as nibabel returns them))
    numbers = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _from_table(path: Path, name: str) -> PointMap:
    rows = files.read_tsv(path)
    columns = list(rows[0]) if rows else []
    value_columns = [column for column in columns if column not in _POSITIONS]
    column = name if name in columns else value_columns[0] if len(value_columns) == 1 else None
    if column is None:
        fault = f"columns {', '.join(value_columns)}" if value_columns else "no column of values"
        raise InputError(f"{path}: has {fault}; name the map after one of them")
    try:
        values = [np.nan if files.is_missing(row[column]) else float(row[column]) for row in rows]
        nodes = _nodes(rows) if {"x", "y"} <= set(columns) else None
    except ValueError as error:
        raise InputError(
            f"{path}: column {column} has cells that are no numbers ({error}); mark missing ones"
            " n/a"
        ) from error
    return PointMap(values=_finite(values), unit=ARBITRARY, nodes=nodes, name=column)


def _nodes(rows: list[dict[str, str]]) -> tuple[int, int] | None:
    """Nodes along x and y if rows are those of a sheet, y fastest; ``None`` otherwise."""
    x, y = (np.array([float(row[axis]) for row in rows]) for axis in "xy")
    nx, ny = int(x.max()), int(y.max())
    expected = np.divmod(np.arange(len(rows)), max(ny, 1))
    regular = nx * ny == len(rows) and (x == expected[0] + 1).all() and (y == expected[1] + 1).all()
    return (nx, ny) if regular else None


def read_mesh(path: Path) -> Mesh:
    """Read a surface."""
    image = _load(path, GiftiImage)
    array_groups = [
        image.get_arrays_from_intent(f"NIFTI_INTENT_{intent}")
        for intent in ("POINTSET", "TRIANGLE")
    ]
    if any(len(arrays) != 1 for arrays in array_groups):
        raise InputError(f"{path}: is no surface (points and triangles); give a .surf.gii file")
    points, triangles = (arrays[0].data for arrays in array_groups)
    return checked_mesh(path, points, triangles)


def checked_mesh(path: Path, points: ArrayLike, triangles: ArrayLike) -> Mesh:
    """Return the surface of a file, or refuse triangles of vertices that it does not have."""
    points, triangles = np.asarray(points), np.asarray(triangles)
    kinds = points.dtype.kind in "fiu", triangles.dtype.kind in "iu"
    if not all(kinds) or not points.shape[1:] == triangles.shape[1:] == (3,):
        raise InputError(
            f"{path}: its points or triangles are not three numbers each; write it again"
        )
    mesh = Mesh(points=points.astype(np.float64), triangles=triangles.astype(np.int64))
    if mesh.triangles.min(initial=0) < 0 or mesh.triangles.max(initial=-1) >= len(mesh.points):
        raise InputError(
            f"{path}: has triangles between vertices that do not exist; write it again"
        )
    return mesh


def structure_side(path: Path) -> str | None:
    """Determine the side of a GIFTI file by the structure that it or one of its arrays names."""
    image = _load(path, GiftiImage)
    named = [str(element.meta.get(_PRIMARY, "")) for element in (image, *image.darrays)]
    sides = {side[0] for name in named for side in ("Left", "Right") if name.endswith(side)}
    return sides.pop() if len(sides) == 1 else None


def _unreadable(path: Path, format_name: str, error: Exception) -> InputError:
    first = str(error).partition("\n")[0]
    return InputError(f"{path}: not readable as {format_name} ({first}); write it again")


def _check_claims(path: Path) -> None:
    """Refuse a file that names a pipe or a device, or more numbers than it holds."""
    content = read_bounded(path, TABLE)
    for name in _OTHER_FILE.findall(content):
        open_regular(path.parent / os.fsdecode(name)).close()
    if sum(map(int, _COUNT.findall(content))) > len(content):
        raise ValueError("it counts more vertices than it holds")


def _load(path: Path, kind: type[Image]) -> Image:
    format_name = "GIFTI" if kind is GiftiImage else "CIFTI"
    try:
        _check_claims(path)
        with warnings.catch_warnings(action="ignore"):  # of what is checked below, or harmless
            image = nib.load(path)
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: file not found; check its name") from error
    except _DAMAGE as error:
        raise _unreadable(path, format_name, error) from error
    if not isinstance(image, kind):
        raise InputError(
            f"{path}: is no {format_name} file; maps are .shape.gii, .func.gii, .dscalar.nii or"
            " .tsv files"
        )
    return image


def mesh_bytes(mesh: TetMesh, coordinates: Coordinates) -> bytes:
    """Encode a tetrahedral mesh and its coordinates as VTU (XML with compressed binary data)."""
    values = zip(COORDINATE_NAMES, coordinates.values.T, strict=True)
    data = {name: column.copy() for name, column in values}
    return _by_meshio("vtu", mesh.vertices, ("tetra", mesh.tetrahedra), data)


def write_surface(path: Path, mesh: Mesh, maps: Mapping[str, Float]) -> None:
    """Write a surface as VTK, PLY or OBJ, with one number per vertex of each map; OBJ has no maps.

    Vertices without a position are put at the mean of the others, and no triangle has them.
    """
    if path.suffix not in ENDINGS:
        raise UsageError(f"{path.name}: surfaces end with {', '.join(ENDINGS)}")
    files.write_bytes(path, encode_surface(path.suffix, mesh, maps))


def encode_surface(ending: str, mesh: Mesh, maps: Mapping[str, Float]) -> bytes:
    """Encode a surface for :func:`write_surface`."""
    present_points = np.asarray(np.isfinite(mesh.points).all(axis=1), dtype=np.bool_)
    points = np.where(
        present_points[:, None], mesh.points, mesh.points[present_points].mean(axis=0)
    )
    faces = mesh.triangles[present_points[mesh.triangles].all(axis=1)]
    data = {} if ending == ".obj" else {name: np.ravel(maps[name]) for name in maps}
    return _by_meshio(ending[1:], points, ("triangle", faces), data)


def read_surface(path: Path) -> Mesh:
    """Read a surface: VTK, PLY, OBJ, or else GIFTI."""
    if path.suffix not in ENDINGS:
        return read_mesh(path)
    try:  # meshio.read ends the process where a file is damaged
        open_regular(path).close()
        mesh = importlib.import_module(f"meshio.{path.suffix[1:]}").read(path)
        points, triangles = mesh.points, mesh.get_cells_type("triangle")
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: file not found; check its name") from error
    except Exception as error:  # of any kind: meshio checks little
        raise InputError(
            f"{path}: not readable as {path.suffix[1:].upper()}; write it again"
        ) from error
    if not len(triangles):
        raise InputError(f"{path}: has no triangles; write it again")
    return checked_mesh(path, points, triangles)


def _by_meshio(
    kind: str, points: Float, cells: tuple[str, Any], data: Mapping[str, Float]
) -> bytes:
    import meshio  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh.{kind}"
        meshio.write(path, meshio.Mesh(points, [cells], point_data=dict(data)), file_format=kind)
        return path.read_bytes()
