"""The boundary strips: the part of the wall that closes the sheet at its rims."""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, TetMesh
from hipsta_bids.geometry.laplace import HarmonicSolver, gradients
from hipsta_bids.geometry.rims import middle_lines
from hipsta_bids.geometry.wall import Wall, edge_graph, vertex_normals
from hipsta_bids.settings import BoundarySettings

Pair = tuple[Float, Float]


def facing_strips(
    wall: Wall, solver: HarmonicSolver, curves: Pair, thickness: float, settings: BoundarySettings
) -> tuple[tuple[Bool, Bool], Pair]:
    """Find the parts of the wall near two curves that face along the sheet, away from it.

    A flat rim is such a part from edge to edge; of a round one, it is the middle. The direction
    of the sheet at its rim is that of a harmonic function from rim to rim, continued from inside
    the sheet, where it does not depend on where exactly the curves lie. The middle lines of the
    strips replace the curves, and the same is done again.

    Parameters
    ----------
    wall : Wall
    solver : HarmonicSolver
        Of the mesh.
    curves : two (N, 3) arrays
        Medial and lateral, or the other way round, RAS mm.
    thickness : float
        Of the sheet, mm.
    settings : BoundarySettings

    Returns
    -------
    strips : two (V,) arrays of bool
        Vertices of the wall.
    curves : two (N, 3) arrays
        Their middle lines.
    """
    mesh = solver.mesh
    finder = _Finder(wall, mesh, thickness, settings)
    starts, function = curves, None
    strips = _near(wall, curves, settings.first_strip * thickness)
    for reach in settings.strip_reach:
        lines = _near(wall, curves, settings.least_strip * thickness)
        limits = _near(wall, curves, reach * thickness)
        ends = wall.index[strips[0]], wall.index[strips[1]]
        function = solver.between(*ends, guess=function)
        flow = gradients(mesh.vertices, mesh.tetrahedra, function)
        strips = (
            finder.strip(starts[0], flow, lines[0], limits[0]),
            finder.strip(starts[1], -flow, lines[1], limits[1]),
        )
        starts = (wall.vertices[strips[0]], wall.vertices[strips[1]])
        curves = middle_lines(wall, strips) or curves
    return strips, curves


def _near(wall: Wall, curves: Pair, reach: float) -> tuple[Bool, Bool]:
    return wall.near(curves[0], reach), wall.near(curves[1], reach)


class _Finder:
    """Finds the vertices that face away from the sheet."""

    def __init__(
        self, wall: Wall, mesh: TetMesh, thickness: float, settings: BoundarySettings
    ) -> None:
        self._wall, self._settings = wall, settings
        self._step = settings.strip_step * thickness
        links = edge_graph(wall.edges, np.ones(len(wall.edges)), len(wall.vertices))
        self._normals = _unit((links + sparse.eye_array(len(wall.vertices))) @ vertex_normals(wall))
        self._centers = cKDTree(mesh.vertices[mesh.tetrahedra].mean(axis=1))

    def strip(self, starts: Float, inward: Float, line: Bool, limit: Bool) -> Bool:
        """Vertices (V,) within a limit that face away from the sheet, with a line among them.

        Parameters
        ----------
        starts : (N, 3) array
            Points of the rim.
        inward : (T, 3) array
            From this rim into the sheet, in each tetrahedron.
        line, limit : (V,) arrays of bool
            Vertices that belong to the strip, and those that may.

        Returns
        -------
        (V,) array of bool
        """
        away = -self._direction_at_rim(starts, inward)
        close = np.flatnonzero(limit)
        count = min(self._settings.rim_neighbors, len(starts))
        _, nearest = cKDTree(starts).query(self._wall.vertices[close], k=count)
        towards = _unit(away[nearest].mean(axis=1))
        facing = line.copy()
        cosine = (self._normals[close] * towards).sum(axis=1)
        facing[close] |= cosine > self._settings.strip_facing
        return self._wall.connected(facing, line)

    def _direction_at_rim(self, starts: Float, inward: Float) -> Float:
        """Direction (N, 3) of the sheet at its rim.

        Three steps are made into the sheet; a line through the directions found there gives the
        one at the rim, since the sheet may bend.
        """
        place, direction = starts, self._mean(starts, inward)
        found = []
        for _ in range(3):
            place = place + self._step * direction
            direction = self._mean(place, inward)
            found.append(direction)
        # Least squares through steps 1, 2 and 3, continued to 0.
        return _unit((4 * found[0] + found[1] - 2 * found[2]) / 3)

    def _mean(self, places: Float, flow: Float) -> Float:
        _, nearest = self._centers.query(places, k=self._settings.strip_neighbors)
        return _unit(flow[nearest].mean(axis=1))


def _unit(vectors: Float) -> Float:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
