"""Correlation of two maps of a surface, with p-values that allow for their smoothness."""

from typing import Any

import numpy as np
from lapy import Solver, TriaMesh
from scipy.sparse import coo_array
from scipy.stats import rankdata

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.arrays import Bool, Float, blocks
from hipsta_bids.types import Mesh

#: Fewest and most points with both values; time rises with the third power of their number.
_LEAST_POINTS, _MOST_POINTS = 30, 5000
#: Range of the covariance over the SD of the smoothing kernel; chosen by simulation.
_RANGE = 3.0
#: Over this times the range, fields fade beyond the boundary (Roininen et al. 2014).
_BOUNDARY = 1.42
_FWHM = float(np.sqrt(8 * np.log(2)))  # of a normal distribution, over its SD
_BATCH = 1000  # surrogates in memory at once


def correlate_maps(
    first: Float, second: Float, mesh: Mesh, permutations: int, seed: int
) -> dict[str, float]:
    """Correlate two maps (points,) of a surface, NaN is missing; columns of a table.

    Surrogates of the first map have random signs of its coefficients in the eigenmodes of a
    covariance (Moran spectral randomization; Wagner and Dray 2015): coefficients of a field with
    this covariance are uncorrelated. The Laplacian's modes are not the field's, as they double
    the variance at the boundary.
    """
    if first.shape != second.shape or first.shape != (len(mesh.points),):
        raise ModelError(
            f"correlation: maps of {first.size} and {second.size} points, surface of"
            f" {len(mesh.points)} vertices; give maps of one surface"
        )
    present: Bool = np.asarray(np.isfinite(first) & np.isfinite(second))
    triangles = mesh.triangles[present[mesh.triangles].all(axis=1)]
    if not _LEAST_POINTS <= len(np.unique(triangles)) <= present.sum() <= _MOST_POINTS:
        raise ModelError(
            f"correlation: {present.sum()} points have both values; {_LEAST_POINTS} to"
            f" {_MOST_POINTS} adjoining points are needed"
        )
    maps = np.stack([first, second])
    if (np.ptp(maps[:, present], axis=1) == 0).any():
        raise ModelError("correlation: a map has one value everywhere; choose another map")
    widths, area = _smoothness(maps, mesh.points, triangles)
    modes = _modes(mesh, present, float(np.sqrt(widths.prod())))
    products = []
    for pair in (maps[:, present], rankdata(maps[:, present], axis=1)):
        centered = pair - pair.mean(axis=1, keepdims=True)
        units = centered / np.linalg.norm(centered, axis=1, keepdims=True)
        products.append((units @ modes).prod(axis=0))  # their sum is the correlation
    terms = np.stack(products, axis=1)
    r, reached, random = terms.sum(axis=0), np.ones(2), np.random.default_rng(seed)
    for part in blocks(permutations - 1, _BATCH):
        count = min(part.stop, permutations - 1) - part.start
        signs = 2.0 * random.integers(0, 2, (count, len(terms)), dtype=np.int8) - 1
        # Values may be off by rounding.
        reached += (np.abs(signs @ terms) >= np.abs(r) * (1 - 1e-9)).sum(axis=0)
    names = ("n", "pearson", "pearson_p", "spearman", "spearman_p", "fwhm_first", "fwhm_second")
    p = reached / permutations
    numbers = (int(present.sum()), r[0], p[0], r[1], p[1], *(widths * _FWHM))
    share = np.sqrt(widths.prod() / area) * _FWHM
    return dict(zip((*names, "smooth_share"), (*numbers, share), strict=True))


def _smoothness(maps: Float, points: Float, triangles: Any) -> tuple[Float, float]:  # noqa: ANN401  (LaPy's)
    """Estimate the SD of the kernel that makes white noise as smooth as maps, and the area.

    The variance of such a field over that of its gradient is the square of the SD.
    """
    nodes, corners = np.unique(triangles, return_inverse=True)
    solver = Solver(TriaMesh(points[nodes], corners.reshape(-1, 3)))
    weights = np.asarray(solver.mass.sum(axis=0)).ravel()
    values = maps[:, nodes] - (maps[:, nodes] @ weights / weights.sum())[:, None]
    squares, slopes = (
        np.sum(values * (matrix @ values.T).T, axis=1) for matrix in (solver.mass, solver.stiffness)
    )
    return np.sqrt(squares / slopes), float(weights.sum())


def _modes(mesh: Mesh, present: Bool, width: float) -> Float:
    """Eigenmodes (points, modes) of the centered covariance of points with a value.

    It is of the field of (1 / range^2 - Laplacian) f = noise, with Robin's boundary condition.
    """
    surface = TriaMesh(mesh.points, mesh.triangles)
    solver, adjacent = Solver(surface), surface.adj_sym.tocoo()
    ends = np.stack([adjacent.row, adjacent.col])[:, adjacent.data == 1]  # each edge, both ways
    lengths = np.linalg.norm(np.diff(mesh.points[ends], axis=0)[0], axis=1)
    # An edge has a third of its length at each end, and a sixth between them.
    weights, places = np.concatenate([lengths / 3, lengths / 6]), np.hstack([ends[[0, 0]], ends])
    edge = coo_array((weights, tuple(places)), shape=solver.mass.shape)
    length = _RANGE * width
    operator = solver.stiffness + solver.mass / length**2 + edge / (_BOUNDARY * length)
    solved = np.linalg.inv(operator.toarray())[present]
    covariance = solved @ (solver.mass @ solved.T)
    covariance -= covariance.mean(axis=0)
    covariance -= covariance.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh((covariance + covariance.T) / 2)[1], dtype=np.float64)
