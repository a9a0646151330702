"""Linear finite elements on tetrahedra: stiffness, Dirichlet problems, eigenfunctions."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.mesh import cross, tetra_volumes
from hipsta_bids.types import Bool, Float, Int, TetMesh

# Conjugate gradients for the Laplace problems of the volume, faster than a factorization.


_RESIDUAL = 1e-11  # of the right-hand side; it leaves errors of 1e-9 mm in the sheet
_MAX_STEPS = 1000  # bodies take 100 to 150
_GROUPS = 2.0  # times the root of the number of unknowns: a step's two levels cost about the same


def compact_groups(points: Float) -> NDArray[np.intp]:
    """Part points into compact groups of equal size by halving along the longest side.

    Returns their number is a power of two near 2 sqrt(N).
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


def stiffness(vertices: Float, tetrahedra: Int, tensor: Float | None = None) -> sparse.csc_array:
    """Stiffness matrix of linear elements.

    Entries are the integrals of grad(i) . D grad(j) of the hat functions (Reuter et al. 2006,
    Computer-Aided Design 38:342-366, for the Laplace case). The same matrix as LaPy's, made in
    one step for all elements.
    """
    a, b, c = (vertices[tetrahedra[:, k]] - vertices[tetrahedra[:, 0]] for k in (1, 2, 3))
    gradients = np.empty((len(tetrahedra), 4, 3))
    gradients[:, 1], gradients[:, 2], gradients[:, 3] = cross(b, c), cross(c, a), cross(a, b)
    volumes = np.einsum("td,td->t", a, gradients[:, 1]) / 6
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    gradients /= 6 * volumes[:, None, None]
    flux = gradients if tensor is None else gradients @ tensor
    local = np.einsum("tid,tjd->tij", flux, gradients) * volumes[:, None, None]
    return _assemble(local, tetrahedra, len(vertices))


def triangle_stiffness(
    vertices: Float, triangles: Int, directions: Float, diffusion: Float
) -> sparse.csc_array:
    """Stiffness matrix of linear elements on a surface, slowed along one direction.

    The operator of Andreux et al. 2014 (ECCV workshops, LNCS 8928:299-312), as in LaPy's
    anisotropic solver, whose weights are exponentials of curvature only.
    """
    corners = vertices[triangles]
    opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    normal = np.cross(opposite[:, 0], opposite[:, 1])
    double = np.linalg.norm(normal, axis=1)
    gradients = np.cross((normal / double[:, None])[:, None], opposite) / double[:, None, None]
    along = np.einsum("tid,td->ti", gradients, directions)
    local = np.einsum("tid,tjd->tij", gradients, gradients)
    local -= (1 - diffusion)[:, None, None] * along[:, :, None] * along[:, None]
    return _assemble(local * (double / 2)[:, None, None], triangles, len(vertices))


def gradients(vertices: Float, tetrahedra: Int, values: Float) -> Float:
    """Gradient (T, 3) of a piecewise linear function (V,), per mm."""
    steps = vertices[tetrahedra[:, 1:]] - vertices[tetrahedra[:, :1]]
    rise = values[tetrahedra[:, 1:]] - values[tetrahedra[:, :1]]
    gradient: Float = np.linalg.solve(steps, rise[..., None])[..., 0].astype(np.float64)
    return gradient


def lumped_mass(vertices: Float, tetrahedra: Int) -> Float:
    """Diagonal of the lumped mass matrix, (V,), mm3."""
    share = np.repeat(tetra_volumes(vertices, tetrahedra) / 4, 4)
    return np.bincount(tetrahedra.ravel(), share, minlength=len(vertices)).astype(np.float64)


def solve_dirichlet(
    matrix: sparse.csc_array,
    fixed: NDArray[np.intp],
    values: Float,
    groups: NDArray[np.intp] | None = None,
    guess: Float | None = None,
) -> Float:
    """Harmonic function with given values at some vertices and free boundary elsewhere."""
    count = matrix.shape[0]
    free = np.ones(count, dtype=bool)
    free[fixed] = False
    result = np.zeros(count)
    result[fixed] = values
    right = -(matrix @ result)
    if groups is not None:
        result += solve_two_level(matrix.tocsr(), right, free, groups, guess)
    else:
        result[free] = _factor(matrix[free][:, free].tocsc()).solve(right[free])
    if not np.isfinite(result).all():
        raise GeometryError(
            "a Laplace problem has no finite solution: the mesh is broken", reason="laplace"
        )
    return result


class HarmonicSolver:
    """Harmonic functions on a mesh, from -1 to 1; the matrix is assembled once."""

    _MANY = 4000  # vertices from which on iterating is faster than factorizing

    def __init__(self, mesh: TetMesh) -> None:
        self.mesh = mesh
        self._matrix = stiffness(mesh.vertices, mesh.tetrahedra)
        self._groups = compact_groups(mesh.vertices) if len(mesh.vertices) > self._MANY else None

    def between(
        self, first: Int, second: Int, *, few: bool = False, guess: Float | None = None
    ) -> Float:
        """Solve Laplace's equation between two sets of vertices, without flux elsewhere."""
        return solve_dirichlet(
            self._matrix,
            np.concatenate([first, second]),
            np.repeat([-1.0, 1.0], [len(first), len(second)]),
            None if few else self._groups,
            guess,
        )


def smallest_eigenfunctions(
    matrix: sparse.csc_array, mass: Float, count: int
) -> tuple[Float, Float]:
    """Eigenvalues (count,) and eigenfunctions (V, count) above the constant one, in order."""
    size = matrix.shape[0]
    shift = -1e-2 * float(matrix.diagonal().sum() / mass.sum()) / size
    factor = _factor((matrix - shift * sparse.diags_array(mass, format="csc")).tocsc())
    operator = linalg.LinearOperator((size, size), matvec=factor.solve, dtype=np.float64)
    start = np.cos(np.arange(size, dtype=np.float64))  # any fixed vector: results repeat exactly
    values, functions = linalg.eigsh(
        matrix,
        k=count + 1,
        M=sparse.diags_array(mass, format="csc"),
        sigma=shift,
        OPinv=operator,
        v0=start,
        ncv=min(2 * count + 8, size),  # the default of 20 means twice as many solutions
        tol=1e-6,
    )
    order = np.argsort(values)[1:]
    return values[order], functions[:, order]


def _assemble(local: Float, cells: Int, count: int) -> sparse.csc_array:
    """Sum symmetric element matrices (N, K, K) of cells (N, K), whose rows sum to zero."""
    first, second = np.triu_indices(cells.shape[1], k=1)
    rows, columns = cells[:, first].ravel(), cells[:, second].ravel()
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    above = sparse.csc_array((local[:, first, second].ravel(), (low, high)), shape=(count, count))
    apart = above + above.T.tocsc()
    return sparse.csc_array(apart - sparse.diags_array(apart.sum(axis=0), format="csc"))


def _factor(matrix: sparse.csc_array) -> linalg.SuperLU:
    try:
        return linalg.splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:  # exactly singular
        raise GeometryError(
            "a Laplace problem has no solution: the mesh is not connected", reason="laplace"
        ) from error
