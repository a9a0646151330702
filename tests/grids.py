"""Regular grids, and triangles on them."""

import numpy as np

from hipsta_bids.geometry.grid import WedgeGrid


def grid_triangles(nx, ny):
    """Two triangles per cell, (cells * 2, 3) numbers of nodes, y along rows."""
    nodes = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]
    cells = (np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d)))
    return np.concatenate(list(cells))


def straight_grid(shape, spacing=0.5):
    """A working grid without tilt: node (a, b, w) lies at ``spacing`` (a, b, w) mm."""
    return WedgeGrid(
        shape=shape,
        spacing=spacing,
        origin=np.zeros(3),
        across=np.eye(3)[:2],
        axis=np.array([0.0, 0.0, 1.0]),
        posterior=np.zeros(3),
        anterior=np.array([spacing * (shape[2] - 1), 0.0, 0.0]),
    )
