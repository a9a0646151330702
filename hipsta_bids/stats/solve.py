"""Least squares at each point with weights of its own."""

import numpy as np

from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.glm import chunks, products_of


def solve_weighted(values: Float, weight: Float, design: Float, least: float = 0.0) -> Float:
    """(columns, points) weighted least squares, with weights (rows, points) of each point."""
    columns = design.shape[1]
    grams = np.zeros((values.shape[1], columns**2))
    for rows in chunks((columns**2, len(design)), 1):
        grams += weight[rows].T @ products_of(design[rows])
    return solve_points(grams.reshape(-1, columns, columns), (weight * values).T @ design, least)


def solve_points(grams: Float, right: Float, least: float) -> Float:
    """Solve the normal equations of each point: (columns, points), NaN where none is unique.

    ``grams`` (points, columns, columns) is overwritten; ``right`` is (points, columns). A column
    with no more than ``least`` on the diagonal has no values: its coefficient is 0.
    """
    diagonal = np.arange(grams.shape[1])
    size = grams[:, diagonal, diagonal]
    size = grams[:, diagonal, diagonal] = np.where(size > least, size, 1.0)
    size = np.sqrt(size)
    unit = grams / (size[:, :, None] * size[:, None, :])
    finite = np.isfinite(unit).all(axis=(1, 2))
    unit[~finite] = np.eye(len(diagonal))
    unique = finite & (np.linalg.eigvalsh(unit)[:, 0] > np.sqrt(np.finfo(np.float64).eps))
    unit[~unique] = np.eye(len(diagonal))
    solution = np.linalg.solve(unit, (right / size)[:, :, None])[:, :, 0] / size
    return np.where(unique[:, None], solution, np.nan).T
