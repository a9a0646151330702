"""The tetrahedral mesh as a VTU file that ParaView and meshio read."""

import tempfile
from pathlib import Path

import meshio

from hipsta_bids.artifacts import Coordinates, TetMesh

#: Names of the harmonic coordinates as point data, in their order.
COORDINATE_NAMES = ("medial_lateral", "posterior_anterior", "interior_exterior")


def mesh_bytes(mesh: TetMesh, coordinates: Coordinates) -> bytes:
    """Encode a tetrahedral mesh with its coordinates.

    Parameters
    ----------
    mesh : TetMesh
        Vertices in RAS mm.
    coordinates : Coordinates
        Three values per vertex in [-1, 1].

    Returns
    -------
    bytes
        A ``.vtu`` file (XML, compressed binary data).
    """
    data = meshio.Mesh(
        mesh.vertices,
        [("tetra", mesh.tetrahedra)],
        point_data={
            name: coordinates.values[:, axis].copy() for axis, name in enumerate(COORDINATE_NAMES)
        },
    )
    # meshio writes to paths only; the result still reaches its place through one writer.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.vtu"
        meshio.write(path, data, file_format="vtu")
        return path.read_bytes()
