"""Triangles of regular grids."""

import numpy as np


def grid_triangles(nx, ny):
    """Two triangles per cell, (cells * 2, 3) numbers of nodes, y along rows."""
    nodes = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]
    cells = (np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d)))
    return np.concatenate(list(cells))
