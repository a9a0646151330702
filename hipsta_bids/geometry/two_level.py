"""Conjugate gradients for the Laplace problems of the volume, faster than a factorization."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.errors import GeometryError

_RESIDUAL = 1e-11  # of the right-hand side; it leaves errors of 1e-9 mm in the sheet
_MAX_STEPS = 1000  # bodies take 100 to 150
_GROUPS = 2.0  # times the root of the number of unknowns: a step's two levels cost about the same


def compact_groups(points: Float) -> NDArray[np.intp]:
    """Part points into compact groups of equal size by halving along the longest side.

    Parameters
    ----------
    points : (N, 3) array

    Returns
    -------
    (N,) array of int
        Numbers of the groups from 0; their number is a power of two near 2 sqrt(N).
    """
    levels = round(math.log2(_GROUPS * math.sqrt(len(points))))
    size = -(-len(points) // 2**levels) * 2**levels
    members = np.arange(size)[None] % len(points)  # some points twice, so that halves are equal
    for _ in range(levels):
        place = points[members]
        longest = np.ptp(place, axis=1).argmax(axis=1)
        along = np.take_along_axis(place, longest[:, None, None], axis=2)[..., 0]
        half = members.shape[1] // 2
        order = np.argpartition(along, half, axis=1)
        members = np.take_along_axis(members, order, axis=1).reshape(-1, half)
    groups = np.empty(len(points), dtype=np.intp)
    groups[members.ravel()] = np.repeat(np.arange(len(members)), members.shape[1])
    return groups


def solve_two_level(
    matrix: sparse.csr_array,
    right: Float,
    free: Bool,
    groups: NDArray[np.intp],
    guess: Float | None = None,
) -> Float:
    """Solve a symmetric positive definite system on some of the unknowns.

    Parameters
    ----------
    matrix : (N, N) sparse array
    right : (N,) array
    free : (N,) array of bool
        The unknowns; the other rows and columns are left out.
    groups : (N,) array of int
        Of :func:`compact_groups`.
    guess : (N,) array, optional
        To start from; it changes the time and not the accuracy.

    Returns
    -------
    (N,) array
        0 where not free.

    Raises
    ------
    GeometryError
        ``laplace`` if there is no finite solution.

    Notes
    -----
    Conjugate gradients (Hestenes & Stiefel 1952, J Res Natl Bur Stand 49:409-436) with two levels
    added up, as in Nicolaides 1987 (SIAM J Numer Anal 24:355-365): the diagonal, and the system for
    functions that are constant on each group, which carries information across the body in one
    step.
    """
    diagonal = np.where(free, matrix.diagonal(), 1.0)
    if not diagonal.min() > 0:
        raise _unsolvable()
    # In units in which the diagonal is one; rows and columns of what is not free are zero.
    root = np.where(free, np.sqrt(diagonal), 0.0)
    inverse = np.where(free, 1 / np.sqrt(diagonal), 0.0)
    rows = np.repeat(inverse, np.diff(matrix.indptr))
    scaled = sparse.csr_array(
        (rows * matrix.data * inverse[matrix.indices], matrix.indices, matrix.indptr),
        shape=matrix.shape,
    )
    coarse = _coarse_inverse(matrix, free, groups)

    def both_levels(rest: Float) -> Float:
        sums = coarse @ np.bincount(groups, root * rest, len(coarse))
        return np.asarray(rest + root * sums[groups])

    start = np.zeros(len(right)) if guess is None else root * guess
    return inverse * _conjugate_gradients(scaled, inverse * right, start, both_levels)


def _conjugate_gradients(
    matrix: sparse.csr_array, right: Float, start: Float, precondition: Callable[[Float], Float]
) -> Float:
    result, rest = start.copy(), right - matrix @ start
    step = precondition(rest)
    size = float(rest @ step)
    limit = _RESIDUAL * float(np.linalg.norm(right))
    for _ in range(_MAX_STEPS):
        if np.linalg.norm(rest) <= limit:
            return result
        change = matrix @ step
        length = size / float(step @ change)
        result += length * step
        rest -= length * change
        ahead = precondition(rest)
        before, size = size, float(rest @ ahead)
        step *= size / before
        step += ahead
    raise _unsolvable()


def _unsolvable() -> GeometryError:
    return GeometryError(
        "a Laplace problem has no solution: the mesh is broken or not connected", reason="laplace"
    )


def _coarse_inverse(matrix: sparse.csr_array, free: Bool, groups: NDArray[np.intp]) -> Float:
    """Inverse of the matrix for functions that are constant on each group, dense."""
    count = int(groups.max()) + 1
    row = np.repeat(np.arange(len(groups)), np.diff(matrix.indptr))
    inner = free[row] & free[matrix.indices]
    code = groups[row] * count + groups[matrix.indices]
    coarse = np.bincount(code[inner], matrix.data[inner], count**2).reshape(count, count)
    empty = np.bincount(groups[free], minlength=count) == 0
    coarse[empty, empty] = 1.0
    try:
        return np.asarray(np.linalg.inv(coarse))
    except np.linalg.LinAlgError as error:
        raise _unsolvable() from error
