"""A plate whose walls and edges are known, and fields of bodies that differ from it."""

import numpy as np
from grids import straight_grid

from hipsta_bids.geometry.grid import Field
from hipsta_bids.types import Sheet

NX, NY, NZ = 15, 9, 9
LOW, HIGH = 8.0, 10.0  # mm, walls of the sheet along a
#: mm; the spline rounds the bend of the field in the middle of the plate.
BENT = 0.015


def flat_sheet():
    """A plate whose columns run along x of RAS, from 8 to 10 mm."""
    x = np.linspace(LOW, HIGH, NZ)
    along, across = np.linspace(4, 16, NX), np.linspace(4, 12, NY)
    points = np.stack(np.broadcast_arrays(x, along[:, None, None], across[:, None]), axis=-1)
    return Sheet(points=points, valid=np.ones((NX, NY), dtype=bool))


def plate_field(low, high, further=()):
    """A field that is positive between walls, functions of the other coordinates, mm."""
    grid = straight_grid((40, 40, 40))
    points = grid.node_points()
    depth = np.minimum(points[..., 0] - low(points), high(points) - points[..., 0])
    for start, end in further:
        depth = np.maximum(depth, np.minimum(points[..., 0] - start, end - points[..., 0]))
    return Field(grid=grid, values=depth.astype(np.float32))


def bounded_field(edges):
    """A field of the plate, with its own edges along the rows (along y of RAS), mm."""
    field = plate_field(at(LOW), at(HIGH))
    along = field.grid.node_points()[..., 1]
    depth = np.minimum(field.values, np.minimum(along - edges[0], edges[1] - along))
    return Field(grid=field.grid, values=depth.astype(np.float32))


def at(value):
    return lambda points: np.full(points.shape[:-1], value)
