"""Columns of a sheet, cut at the walls of a body."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.measures import column_area
from hipsta_bids.types import Bool, Float, Sheet

#: Columns are continued by this much beyond the walls of the participant's sheet, mm.
BEYOND = 1.5
#: Steps along and beyond a column.
STEPS, STEPS_BEYOND = 40, 30
#: A wall farther than this from the wall of the participant's sheet may belong to another turn, mm:
#: its weight falls smoothly, to 1/e here.
NEAR = 0.5
#: Columns with a wall farther away than this are counted as filled from their neighbors, mm.
FARTHEST = 0.7
#: Full width at half maximum of the Gaussian that smooths the moves of walls on the sheet, mm.
SMOOTHING = 1.0

_FWHM = float(np.sqrt(8 * np.log(2)))  # of a Gaussian, in standard deviations
_TAIL = 1e-4  # weight of a Gaussian of four times the width, for places without a wall near


@dataclass(frozen=True, eq=False, kw_only=True)
class Walls:
    """Distances of the walls of a visit from the walls of the common sheet, along columns."""

    moves: Float
    """(Nx, Ny, 2) of the interior and exterior wall, mm, smoothed; to the exterior is positive."""
    raw: Float
    """(Nx, Ny, 2) before smoothing; NaN where there is no wall."""

    @property
    def distances(self) -> Float:
        """Distances (Nx, Ny, 2) of the walls, mm, up to the farthest one that is counted."""
        return np.asarray(np.fmin(np.abs(self.raw), FARTHEST))

    @property
    def known(self) -> Bool:
        """Columns (Nx, Ny) with both walls."""
        return np.asarray((self.distances < FARTHEST).all(axis=-1))

    @property
    def distance(self) -> float:
        """Distance of the walls, RMS over the sheet, mm."""
        return float(np.sqrt((self.distances**2).mean()))


def find_walls(sheet: Sheet, motion: Float, field: Field) -> Walls:
    """Find the walls of a visit along the columns of the participant's sheet.

    ``motion`` (4, 4) leads from the sheet to the visit, and ``field`` is positive in its body. The
    walls are the ends of the piece of a column inside the body that overlaps the sheet's most.
    """
    raw = ends_inside(sheet, motion, field)
    middle = sheet.points[:, :, sheet.middle].reshape(-1, 3)
    squared = ((middle[:, None] - middle[None]) ** 2).sum(axis=-1)
    smooth = smooth_moves(raw.reshape(-1, 2), squared, column_area(sheet).ravel(), SMOOTHING, NEAR)
    return Walls(moves=smooth.reshape(raw.shape), raw=raw)


def column_length(sheet: Sheet) -> Float:
    """Length of each column (Nx, Ny), mm."""
    return np.asarray(np.linalg.norm(np.diff(sheet.points, axis=2), axis=3).sum(axis=2))


def _continued(sheet: Sheet) -> tuple[Float, Float]:
    """Points (Nx, Ny, M, 3) along and beyond each column, and their depths (Nx, Ny, M), mm."""
    outside = np.linspace(0, BEYOND, STEPS_BEYOND + 1)[1:]
    length = column_length(sheet)[..., None]
    inner = length * np.linspace(0, 1, STEPS + 1)
    start, end = (
        np.broadcast_to(v, (*length.shape[:2], v.size)) for v in (-outside[::-1], outside)
    )
    depth = np.concatenate([start, inner, length + end], axis=2)
    return points_along(sheet, depth), depth


def points_along(sheet: Sheet, depth: Float) -> Float:
    """Points (Nx, Ny, M, 3) at depths along columns, straight on beyond their ends."""
    points = sheet.points
    last = points.shape[2] - 1
    place = depth / np.maximum(column_length(sheet)[..., None], 1e-9) * last
    below = np.clip(np.floor(place), 0, last - 1).astype(np.intp)
    start = np.take_along_axis(points, below[..., None], axis=2)
    end = np.take_along_axis(points, below[..., None] + 1, axis=2)
    return np.asarray(start + (place - below)[..., None] * (end - start))


def ends_inside(sheet: Sheet, motion: Float, field: Field) -> Float:
    """Find where columns enter and leave the body of a visit.

    Returns distances (Nx, Ny, 2), mm, from the ends of the columns; NaN without this place.
    """
    points, depth = _continued(sheet)
    nodes = field.grid.to_nodes(to_ras(points.reshape(-1, 3), motion))
    values = ndimage.map_coordinates(field.values, nodes.T, order=3, mode="nearest")
    low, high = _piece(np.asarray(values, dtype=np.float64).reshape(depth.shape), depth)
    return np.stack([low, high - column_length(sheet)], axis=-1)


def _piece(values: Float, depth: Float) -> tuple[Float, Float]:
    """Find where the piece of each column inside the body, values (Nx, Ny, M), begins and ends.

    Depths (Nx, Ny, M), mm; NaN where it goes on to the end of the column, or there is none.
    """
    inside = values > 0
    shape, count = inside.shape[:2], inside.shape[2]
    change = np.diff(inside, axis=2, prepend=False)
    number = np.cumsum(change, axis=2)  # pieces inside have odd numbers
    within = np.zeros(count)
    within[STEPS_BEYOND : STEPS_BEYOND + STEPS + 1] = 1.0
    column = np.arange(shape[0] * shape[1])[:, None] * (count + 1)
    pieces = (column + number.reshape(len(column), -1)).ravel()
    overlap = np.bincount(
        pieces, (inside * within).ravel(), minlength=len(column) * (count + 1)
    ).reshape(*shape, count + 1)
    piece = inside & (number == overlap.argmax(axis=2)[..., None])
    piece &= overlap.max(axis=2)[..., None] > 0
    first = piece.argmax(axis=2)
    final = count - 1 - piece[..., ::-1].argmax(axis=2)
    crosses = piece.any(axis=2)
    low = _crossing(values, depth, np.maximum(first - 1, 0), first)
    high = _crossing(values, depth, np.minimum(final + 1, count - 1), final)
    return (
        np.where(crosses & (first > 0), low, np.nan),
        np.where(crosses & (final < count - 1), high, np.nan),
    )


def _crossing(
    values: Float, depth: Float, outside: NDArray[np.intp], inside: NDArray[np.intp]
) -> Float:
    """Depth (Nx, Ny) at which values are zero between a node outside and its neighbor inside."""
    (a, b), (s, t) = (
        [np.take_along_axis(v, n[..., None], axis=2)[..., 0] for n in (outside, inside)]
        for v in (values, depth)
    )
    share = a / np.where(a != b, a - b, 1.0)
    return np.asarray(s + share * (t - s))


def smooth_moves(moves: Float, squared: Float, size: Float, width: float, near: float) -> Float:
    """Smooth moves (N, 2), mm, by a Gaussian of a width at half maximum, mm.

    ``squared`` (N, N) are distances between their places, and ``size`` (N,) is their area or
    length. Moves farther than ``near`` weigh less, and unknown moves nothing: they are filled by
    wider Gaussians of little weight.
    """
    exponent = -squared / (2 * (width / _FWHM) ** 2)
    kernel = sum(_TAIL**level * np.exp(exponent / 16**level) for level in range(3)) * size
    weight = np.where(np.isfinite(moves), np.exp(-((moves / near) ** 4)), 0.0)
    total = kernel @ (weight * np.nan_to_num(moves))
    return np.asarray(total / np.maximum(kernel @ weight, np.finfo(float).tiny))
