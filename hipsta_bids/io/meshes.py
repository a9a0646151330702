"""Meshes in formats of other programs, by meshio: VTU, and surfaces as VTK, PLY and OBJ.

meshio is loaded where it is used: it is slow to load, and seldom needed. It writes to paths only.
"""

import importlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.io import files, gifti
from hipsta_bids.opening import open_regular
from hipsta_bids.types import Coordinates, Float, Mesh, TetMesh

#: Endings of surfaces that meshio reads and writes.
ENDINGS = (".vtk", ".ply", ".obj")

#: Names of the harmonic coordinates as point data of the tetrahedral mesh, in their order.
COORDINATE_NAMES = ("medial_lateral", "posterior_anterior", "interior_exterior")


def mesh_bytes(mesh: TetMesh, coordinates: Coordinates) -> bytes:
    """Encode a tetrahedral mesh and its coordinates as VTU (XML with compressed binary data)."""
    values = zip(COORDINATE_NAMES, coordinates.values.T, strict=True)
    data = {name: column.copy() for name, column in values}
    return _encode("vtu", mesh.vertices, ("tetra", mesh.tetrahedra), data)


def write_surface(path: Path, mesh: Mesh, maps: Mapping[str, Float]) -> None:
    """Write a surface as VTK, PLY or OBJ, with one number per vertex of each map; OBJ has no maps.

    Vertices without a position are put at the mean of the others, and no triangle has them.
    """
    if path.suffix not in ENDINGS:
        raise UsageError(f"{path.name}: surfaces end with {', '.join(ENDINGS)}")
    present_points = np.asarray(np.isfinite(mesh.points).all(axis=1), dtype=np.bool_)
    points = np.where(
        present_points[:, None], mesh.points, mesh.points[present_points].mean(axis=0)
    )
    faces = mesh.triangles[present_points[mesh.triangles].all(axis=1)]
    data = {} if path.suffix == ".obj" else {name: np.ravel(maps[name]) for name in maps}
    files.write_bytes(path, _encode(path.suffix[1:], points, ("triangle", faces), data))


def read_surface(path: Path) -> Mesh:
    """Read a surface: VTK, PLY, OBJ, or else GIFTI."""
    if path.suffix not in ENDINGS:
        return gifti.read_mesh(path)
    try:  # meshio.read ends the process where a file is damaged
        open_regular(path).close()
        mesh = importlib.import_module(f"meshio.{path.suffix[1:]}").read(path)
        points, triangles = mesh.points, mesh.get_cells_type("triangle")
    except Exception as error:  # of any kind: meshio checks little
        raise InputError(
            f"{path}: not readable as {path.suffix[1:].upper()}; write it again"
        ) from error
    if not len(triangles):
        raise InputError(f"{path}: has no triangles; write it again")
    return gifti.checked_mesh(path, points, triangles)


def _encode(kind: str, points: Float, cells: tuple[str, Any], data: Mapping[str, Float]) -> bytes:
    import meshio  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh.{kind}"
        meshio.write(path, meshio.Mesh(points, [cells], point_data=dict(data)), file_format=kind)
        return path.read_bytes()
