"""Lines across the sheet: of steepest ascent of a function on tetrahedra, from wall to wall.

Their lengths are what the two arrival times of Yezzi & Prince 2003 (IEEE Trans Med Imaging
22:1332-1339) approximate; followed one by one they need neither an order nor an iteration.
"""

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.types import Bool, Float, TetMesh

_STEPS = 400
_LEVEL = 1e-12
"""What changes less per mm does not change."""
_OPPOSITE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


class Lines:
    """Directions on a mesh, means over the tetrahedra round each vertex, linear in between.

    So they do not jump between tetrahedra, and no line is caught between two of them.
    """

    def __init__(self, mesh: TetMesh, gradient: Float) -> None:
        """Prepare directions from a gradient (T, 3), neighbors and barycentric coordinates."""
        cells = mesh.tetrahedra
        self.points, self.cells = mesh.vertices, cells
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        flow = gradient / np.maximum(length, 1e-12) * tetra_volumes(mesh.vertices, cells)[:, None]
        directions: Float = np.stack(
            [np.bincount(cells.ravel(), part, len(self.points)) for part in flow.repeat(4, 0).T], 1
        )
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        self.directions = directions / np.maximum(length, 1e-12)
        corner = mesh.vertices[cells]
        edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
        inverse = np.linalg.inv(edges)
        #: (T, 4, 3) gradients of the four barycentric coordinates.
        self.gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        faces = np.sort(cells[:, _OPPOSITE].reshape(-1, 3), axis=1).astype(np.int64)
        code = (faces[:, 0] * len(self.points) + faces[:, 1]) * len(self.points) + faces[:, 2]
        order = np.argsort(code, kind="stable")
        twin = np.flatnonzero(code[order[1:]] == code[order[:-1]])
        neighbor = np.full(len(code), -1, dtype=np.intp)
        a, b = order[twin], order[twin + 1]
        neighbor[a], neighbor[b] = b // 4, a // 4
        #: (T, 4) tetrahedron beyond the face opposite to each corner; -1 outside.
        self.neighbor = neighbor.reshape(-1, 4)

    def columns(
        self, cell: NDArray[np.intp], points: Float, count: int, limit: float
    ) -> tuple[Float, Bool]:
        """Points (N, count, 3) evenly along the lines through points (N, 3), lowest value first.

        Also whether (N,) both ends of a line reached the surface, each within ``limit``, mm.
        """
        (up, first), (down, second) = (self._follow(cell, points, s, limit) for s in (1.0, -1.0))
        path = np.concatenate([down[:, :0:-1], up], axis=1)
        steps = np.linalg.norm(np.diff(path, axis=1), axis=2)
        along = np.concatenate([np.zeros((len(path), 1)), steps.cumsum(axis=1)], axis=1)
        share = np.linspace(0, 1, count)
        samples = np.empty((len(path), count, 3))
        for row, (corners, length) in enumerate(zip(path, along, strict=True)):
            for axis in range(3):
                samples[row, :, axis] = np.interp(share * length[-1], length, corners[:, axis])
        return samples, first & second

    def _weights(self, cell: NDArray[np.intp], points: Float) -> Float:
        """Barycentric coordinates (N, 4) of points (N, 3) in their cells."""
        first = self.points[self.cells[cell, 0]]
        weights: Float = np.einsum("nij,nj->ni", self.gradients[cell], points - first)
        weights[:, 0] += 1
        return weights

    def _follow(
        self, cell: NDArray[np.intp], points: Float, sign: float, limit: float
    ) -> tuple[Float, Bool]:
        """Follow lines from points (N, 3) in cells (N,) to the surface.

        Returns the corners (N, S, 3) of the lines, their last point repeated, and whether (N,) each
        reached the surface within a length of ``limit``, mm.
        """
        at, cell = points.copy(), cell.copy()
        path = [at.copy()]
        active = np.arange(len(at))
        arrived = np.zeros(len(at), dtype=bool)
        length = np.zeros(len(at))
        for _ in range(_STEPS):
            if not len(active):
                break
            position, inside = at[active], cell[active]
            weight = np.clip(self._weights(inside, position), 0, 1)
            way = sign * np.einsum("ni,nij->nj", weight, self.directions[self.cells[inside]])
            size = np.linalg.norm(way, axis=1)
            way /= np.maximum(size, 1e-12)[:, None]
            rate = np.einsum("nij,nj->ni", self.gradients[inside], way)
            with np.errstate(divide="ignore", invalid="ignore"):
                far = np.where(rate < -_LEVEL, weight / -rate, np.inf)
            exit_ = far.argmin(axis=1)
            step = far[np.arange(len(active)), exit_]
            step = np.where(np.isfinite(step), step, 0.0)
            at[active] = position + step[:, None] * way
            length[active] += step
            beyond = self.neighbor[inside, exit_]
            arrived[active[beyond < 0]] = True
            cell[active] = np.where(beyond < 0, inside, beyond)
            path.append(at.copy())
            active = active[(beyond >= 0) & (length[active] < limit) & (size > 0)]
        return np.stack(path, axis=1), arrived
