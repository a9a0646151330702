"""The x coordinate of the sheet: harmonic on the mid-surface, whatever the thickness.

In a thin sheet the volume's harmonic x obeys div(t grad x) = 0 on the mid-surface, t its thickness:
steps of x are short where the sheet is thin, so that one thin place moves columns of whole rows.
The x made here is a rising function of that one along each row: columns are numbered anew, and none
of them moves.
"""

import numpy as np
from lapy import TriaMesh
from scipy import ndimage

from hipsta_bids.geometry.fem import Laplace, bare_mesh
from hipsta_bids.geometry.sheet import middle_surface
from hipsta_bids.types import Coordinates, Float, TetMesh

#: Lines of equal x and y of the mid-surface on which x is solved for.
X_LINES, Y_LINES = 81, 41
#: The outermost lines are sampled here and extended to the edge, where rounding would choose among
#: the tetrahedra.
X_OUTERMOST = 0.99
#: Spikes of an edge that are narrower than this do not count, mm; nor do notches.
SPIKE, NOTCH = 2.5, 8.0
#: Notches are filled with columns within this distance of the edge, mm, or so many depths.
FILL_REACH, FILL_DEPTHS = 4.0, 2.5
#: Notches that are deeper have no columns, mm.
DEEPEST = 1.6


def straighten_rows(mesh: TetMesh, coordinates: Coordinates, solver: str) -> Coordinates:
    """Make x harmonic on the mid-surface, between its medial and lateral edge without notches.

    Columns on the far side of a notch keep their number; those beside it are squeezed.
    """
    x, y = np.linspace(-X_OUTERMOST, X_OUTERMOST, X_LINES), np.linspace(-0.998, 0.998, Y_LINES)
    middle = middle_surface(mesh, coordinates, x, y)
    for axis, lines in enumerate((x, y)):
        ends = np.moveaxis(middle, axis, 0)
        beyond = (lines[0] + 1) / (lines[1] - lines[0])
        ends[[0, -1]] += beyond * (ends[[0, -1]] - ends[[1, -2]])
        lines[[0, -1]] = -1, 1
    values = coordinates.values.copy()
    position = [
        np.interp(values[:, k], axis, np.arange(axis.size)) for k, axis in enumerate((x, y))
    ]
    values[:, 0] = ndimage.map_coordinates(_even_levels(middle, solver), position, order=1)
    return Coordinates(values=values)


def _even_levels(middle: Float, solver: str) -> Float:
    """Values (Nx, Ny) of the new x at points (Nx, Ny, 3) of the mid-surface, RAS mm."""
    number = np.arange(middle[..., 0].size, dtype=np.int32).reshape(middle.shape[:2])
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=-2)
    laplace = Laplace(bare_mesh(TriaMesh, middle.reshape(-1, 3), triangles.reshape(-1, 3)), solver)
    steps = np.diff(middle, axis=0)
    # Each triangle has one side along a row: the first half the lower one, the second the upper.
    along = np.stack([steps[:, :-1], steps[:, 1:]], axis=-2).reshape(-1, 3)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = laplace.integrate(along).reshape(number.shape)  # mm
    edges, depths = [], []
    for row, sign in ((0, -1.0), (-1, 1.0)):
        edge = sign * across[row]
        steps_y = np.linalg.norm(np.diff(middle[row], axis=0), axis=1)
        position = np.concatenate([[0.0], steps_y.cumsum()])
        closed = hull(-hull(-edge, position, SPIKE), position, NOTCH)
        edges.append(closed)
        depths.append(closed - edge)
    scale = 2 / float(np.median(edges[0] + edges[1]))
    fixed = np.concatenate([number[0], number[-1]])
    limits = np.concatenate([scale * depths[0] - 1, 1 - scale * depths[1]])
    levels = laplace.solve(fixed, limits).reshape(number.shape)
    for row, sign, depth in ((0, -1.0, depths[0]), (-1, 1.0, depths[1])):
        reach = np.maximum(FILL_REACH, FILL_DEPTHS * np.abs(depth))
        near = np.clip(1 - np.abs(across - across[row]) / reach, 0, 1)
        levels = levels + sign * scale * np.minimum(depth, DEEPEST) * near**2
    return np.asarray(np.maximum.accumulate(levels, axis=0))


def hull(values: Float, position: Float, width: float) -> Float:
    """Highest chord (N,) of a curve, over each of its points, of at most a width.

    ``position`` (N,) rises, in the unit of the width.
    """
    start, end = position[:, None, None], position[None, :, None]
    span = end - start
    share = np.where(span > 0, (position - start) / np.where(span > 0, span, 1.0), 0.0)
    chord = (1 - share) * values[:, None, None] + share * values[None, :, None]
    covers = (start <= position) & (position <= end) & (span <= width)
    return np.asarray(np.where(covers, chord, -np.inf).max(axis=(0, 1)))
