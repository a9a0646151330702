"""Surfaces as a viewer sees them: what each pixel shows, lit from above, without a GPU."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.io.hippunfold import unfolded_shares
from hipsta_bids.reports.display import X_ENDS, Y_ENDS
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.types import Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Pixels are a square of this many, whose mean is shown.
_FINER = 2
#: Brightness where light only grazes the surface; colors must stay readable.
_SHADOW = 0.55
#: Directions to the lamp: to the right, upward, and to the viewer.
_LAMP = np.array([-0.35, 0.45, 0.82])
_CHUNK = 200_000  # pixels of triangles in memory at once
_EDGE = (0.25, 0.25, 0.25)  # color of outlines
_OUTLINE = 1.2  # their width in pixels shown
#: Neighboring pixels lie on different folds if they differ by this depth in mm, or this slope.
_FOLD, _STEEP = 0.35, 4.0
_FAR = 1e9  # mm, depth of the background
_STEP = 4  # of 255, between shades
_HALF = 0.5  # of a label, at its border
#: Tangent of the angle by which views from above and below are turned to lateral.
_TILT = 0.4
_UPRIGHT = 0.95  # of a long axis that has no superior side, only a posterior one
#: Windows of an image, and the same moved by a pixel.
_DOWN = np.s_[:-1, :], np.s_[1:, :]
_RIGHT = np.s_[:, :-1], np.s_[:, 1:]


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """A surface seen from one direction, without perspective; rows run from top to bottom.

    There are more pixels than are shown, by a factor along both sides, so that edges are smooth.
    """

    mesh: Mesh
    triangle: Int
    """(rows, columns) what is nearest to the viewer; -1 is the background."""
    weights: Float
    """(pixels, 3) of the corners, where the surface is."""
    light: Float
    """(pixels,) brightness there, up to 1."""
    outline: Bool
    """(rows, columns) where the surface ends or passes in front of itself."""

    @cached_property
    def seen(self) -> Bool:
        """(rows, columns) where the surface is."""
        return np.asarray(self.triangle >= 0)

    @cached_property
    def _corners(self) -> Int:
        """(pixels, 3) points round each pixel of the surface."""
        return self.mesh.triangles[self.triangle[self.seen]].astype(np.int32)

    def spread(self, values: Float) -> Float:
        """Interpolate values (points,) to the pixels (pixels,) of the surface."""
        return np.asarray(np.einsum("pc,pc->p", values[self._corners], self.weights))

    def region(self, labels: Int, label: int) -> Bool:
        """(rows, columns) where a label of the points (points,) is the closest one."""
        inside = np.zeros(self.triangle.shape, dtype=bool)
        inside[self.seen] = self.spread((labels == label).astype(np.float64)) > _HALF
        return inside

    def border(self, region: Bool, width: float) -> Bool:
        """(rows, columns) line round a region, of a width in pixels shown, on the same fold."""
        hidden = self.outline | ~self.seen
        line = np.zeros(region.shape, dtype=bool)
        for first, second in (_DOWN, _RIGHT):
            line[first] |= (region[first] != region[second]) & ~hidden[first] & ~hidden[second]
        return _thick(line, width) & self.seen

    def picture(self, colors: Float, lines: Bool) -> NDArray[np.uint8]:
        """(height, width, 4) lit colors (pixels, 3), 0 to 1, and lines in black, else clear."""
        image = np.zeros((*self.triangle.shape, 4), np.float32)  # a third of the time
        image[self.seen, :3] = colors * self.light[:, None]
        image[self.outline, :3] = _EDGE
        image[lines, :3] = 0.0
        image[self.seen, 3] = 1.0
        rows, columns = (n // _FINER for n in self.triangle.shape)
        parts = image.reshape(rows, _FINER, columns, _FINER, 4)
        total = sum(parts[:, i, :, j] for i, j in product(range(_FINER), repeat=2))
        small = np.asarray(total) / _FINER**2
        small[..., :3] /= np.where(small[..., 3:] > 0, small[..., 3:], 1.0)
        # Files are half as large without the steps that nobody sees.
        darkness = _STEP * np.round(255 / _STEP * (1 - small))
        return np.asarray(255 - np.minimum(darkness, 255), dtype=np.uint8)


def across(along: Float, lateral: Float, *, below: bool) -> Float:
    """(3, 3) directions of a view from above, or below, with ``along`` upward.

    A structure of the brain in RAS is seen from superior, or inferior, square to its long axis.
    """
    up = along / np.linalg.norm(along)
    toward = np.array([0.0, 0.0, -1.0 if below else 1.0])
    if abs(up[2]) > _UPRIGHT:
        toward = np.array([0.0, 1.0 if below else -1.0, 0.0])
    # A little to lateral, so that the lateral wall is seen too.
    toward += _TILT * lateral
    toward -= up * (up @ toward)
    toward /= np.linalg.norm(toward)
    return np.stack([np.cross(up, toward), up, toward])


def look(mesh: Mesh, axes: Float, scale: float, shape: tuple[int, int]) -> View:
    """Find what each pixel of a picture shows, with a depth buffer.

    Both sides of the mesh (mm) are visible. ``axes`` (3, 3) are unit vectors to the right, upward
    and to the viewer, ``scale`` is in pixels per mm, and ``shape`` is the height and width of the
    picture in pixels, whose middle is the surface's.
    """
    rows, columns = (n * _FINER for n in shape)
    projected = mesh.points @ axes.T * (scale * _FINER)
    projected -= (projected.min(axis=0) + projected.max(axis=0)) / 2
    flat = np.stack([projected[:, 0] + columns / 2, rows / 2 - projected[:, 1]], axis=1)[
        mesh.triangles
    ]
    nearest = np.full(rows * columns, -np.inf)
    triangle = np.full(rows * columns, -1, dtype=np.int64)
    weights = np.zeros((rows * columns, 3))
    for numbers, pixels, corners in _covered(flat, rows, columns):
        depth = np.einsum("pc,pc->p", projected[mesh.triangles[numbers], 2], corners)
        # Of those given to one pixel the last stays: the nearest.
        order = np.argsort(depth, kind="stable")
        order = order[depth[order] > nearest[pixels[order]]]
        at = pixels[order]
        nearest[at], triangle[at], weights[at] = depth[order], numbers[order], corners[order]
    weights = weights[triangle >= 0]
    normals = (_normals(mesh) @ axes.T)[mesh.triangles[triangle[triangle >= 0]]]
    depths = nearest.reshape(rows, columns) / (scale * _FINER)
    light = _light(np.einsum("pci,pc->pi", normals, weights))
    return View(  # pictures of all measures share views, so that these are kept small
        mesh=mesh,
        triangle=triangle.reshape(rows, columns).astype(np.int32),
        weights=weights.astype(np.float32),
        light=light.astype(np.float32),
        outline=_outline(depths, max(_FOLD, _STEEP / (scale * _FINER))),
    )


def _covered(flat: Float, rows: int, columns: int) -> Iterator[tuple[Int, Int, Float]]:
    """Pixels that triangles (N, 3, 2) cover, with weights of the corners, in parts."""
    low = np.clip(np.ceil(flat.min(axis=1) - 0.5), 0, [columns, rows]).astype(np.int64)
    high = np.clip(np.floor(flat.max(axis=1) - 0.5) + 1, 0, [columns, rows]).astype(np.int64)
    spans = np.maximum(high - low, 0)
    counts = spans.prod(axis=1)
    area = _cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    counts[area == 0] = 0
    parts = np.cumsum(counts) // _CHUNK
    for part in np.unique(parts):
        corners = np.flatnonzero((parts == part) & (counts > 0))
        numbers = np.repeat(corners, counts[corners])
        steps = np.arange(len(numbers)) - np.repeat(
            np.cumsum(counts[corners]) - counts[corners], counts[corners]
        )
        j = low[numbers, 0] + steps % spans[numbers, 0]
        i = low[numbers, 1] + steps // spans[numbers, 0]
        center = np.stack([j, i], axis=1) + 0.5
        a, b, c = (flat[numbers, corner] - center for corner in range(3))
        shares = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
        shares /= area[numbers, None]
        inside = (shares >= 0).all(axis=1)
        yield numbers[inside], (i * columns + j)[inside], shares[inside]


def _cross(a: Float, b: Float) -> Float:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _normals(mesh: Mesh) -> Float:
    """(points, 3) normals, of the triangles round each point weighted by their areas."""
    a, b, c = (mesh.points[mesh.triangles[:, corner]] for corner in range(3))
    face_normals = np.cross(b - a, c - a)
    total = np.zeros_like(mesh.points)
    for corner in range(3):
        np.add.at(total, mesh.triangles[:, corner], face_normals)
    return total


def _light(normals: Float) -> Float:
    """Brightness by Lambert's law, the same of both sides of the surface."""
    length = np.linalg.norm(normals, axis=1) * np.linalg.norm(_LAMP)
    facing = np.where(normals[:, 2] < 0, -1.0, 1.0) * (normals @ _LAMP)
    facing /= np.where(length > 0, length, 1.0)
    return np.asarray(_SHADOW + (1 - _SHADOW) * np.clip(facing, 0, 1))


def _outline(depth: Float, jump: float) -> Bool:
    """Pixels of the surface next to the background, or in front of another fold."""
    line = np.zeros(depth.shape, dtype=bool)
    padded = np.pad(np.maximum(depth, -_FAR), 1, constant_values=-_FAR)
    rows, columns = depth.shape
    for i, j in ((0, 1), (2, 1), (1, 0), (1, 2)):
        line |= padded[1:-1, 1:-1] - padded[i : i + rows, j : j + columns] > jump
    return _thick(line, _OUTLINE) & np.isfinite(depth)


def _thick(line: Bool, width: float) -> Bool:
    """Widen lines of one pixel to a number of pixels shown."""
    radius = width * _FINER / 2
    reach = int(np.ceil(radius))
    padded, wide = np.pad(line, reach), np.zeros_like(line)
    for i, j in product(range(2 * reach + 1), repeat=2):  # ten times as fast as SciPy's dilation
        if (i - reach) ** 2 + (j - reach) ** 2 <= radius**2:
            wide |= padded[i : i + line.shape[0], j : j + line.shape[1]]
    return wide


def draw_mesh(axes: "Axes", mesh: Mesh, values: Float, scale: Mapping[str, Any]) -> None:
    """Draw a map on a flat surface, in its coordinates."""
    plane, _, name = flat_layout(mesh)
    finite = np.isfinite(values.ravel()[mesh.triangles]).all(axis=1)
    axes.set_aspect("equal")
    axes.set_ylabel(name, labelpad=2)
    (left, bottom), (right, top) = plane.min(axis=0), plane.max(axis=0)
    if finite.any():
        faces = mesh.triangles[finite]
        colors = values.ravel()[faces].mean(axis=1)
        axes.tripcolor(
            plane[:, 0],
            plane[:, 1],
            triangles=faces,
            facecolors=colors,
            **scale,
            edgecolors="none",
            rasterized=True,
        )
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def flat_layout(mesh: Mesh) -> tuple[Float, tuple[str, str], str]:
    """Positions of a flat surface in the plane, words at its lower ends, and the upright axis.

    HippUnfold's surfaces lie as sheets do, the posterior end at the bottom. Others have their
    longer axis upright.
    """
    reach = np.ptp(mesh.points, axis=0)
    along = int(reach[1] >= reach[0])
    plane = mesh.points[:, [1 - along, along]]
    if unfolded_shares(mesh) is None:
        return plane, (f"{'yx'[along]} of the surface", ""), f"{'xy'[along]} of the surface"
    return plane, X_ENDS, " to ".join(Y_ENDS)
