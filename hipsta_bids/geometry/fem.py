"""The Laplace operator of a mesh: LaPy's matrices of linear finite elements, and their solution."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import copy
from functools import cached_property
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from lapy import Solver, TetMesh, TriaMesh
from lapy.diffgeo import compute_divergence, compute_gradient
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from hipsta_bids import types
from hipsta_bids.errors import GeometryError
from hipsta_bids.types import Bool, Float, Int

_ITERATED_SIZE = 4000  # vertices of a volume from which on iterating is faster than factorizing
_RESIDUAL = 1e-7  # of the right-hand side; it leaves errors of 1e-5 mm in the sheet
DIRECTION_RESIDUAL = 1e-5  # for directions, which are averaged over many tetrahedra
_MAX_STEPS = 1000  # bodies take 60 to 130
_ROUGH = 1e-2  # of the stiffness times the function; it moves lines of zeros by 1e-4 mm
_MAX_ROUGH_STEPS = 40  # similar operators take 7 to 9
_GROUPS = 2.0  # times the root of the number of unknowns: a step's two levels cost about the same


class Laplace:
    """The Laplace operator on triangles or tetrahedra; the matrices are made once.

    LaPy (Reuter et al. 2006, Computer-Aided Design 38:342-366) makes them. With the solver
    ``lapy`` it also solves its equations. ``two-level`` takes less time: it iterates where most
    vertices of a large volume are free, uses the symmetry of matrices, and asks ARPACK for no more
    vectors than it needs, which ``Solver.poisson`` and ``Solver.eigs`` have no options for.
    """

    def __init__(
        self, mesh: TriaMesh | TetMesh, solver: str = "two-level", fem: Solver | None = None
    ) -> None:
        """Make the matrices, or take those that LaPy has made."""
        self.points: Float = mesh.v
        self.cells: Int = mesh.t
        self._mesh, self._solver = mesh, solver
        self._fem = Solver(mesh, lump=True) if fem is None else fem
        if self._fem.stiffness.shape[0] != len(self.points):
            raise _unsolvable()  # the last vertex belongs to no cell
        symmetric = self._fem.stiffness
        self.stiffness = sparse.csr_array(
            (symmetric.data, symmetric.indices, symmetric.indptr), shape=symmetric.shape
        )

    def solve(
        self, fixed: NDArray[np.integer], values: Float, residual: float = _RESIDUAL
    ) -> Float:
        """Harmonic function (V,) with given values at some vertices and no flux elsewhere.

        Where it is iterated, the residual is at most ``residual`` of the right-hand side.
        """
        result, free = np.zeros(len(self.points)), np.ones(len(self.points), dtype=bool)
        result[fixed], free[fixed] = values, False
        with _solvable():
            if self._solver == "lapy":
                fixed_vertices = np.flatnonzero(~free)
                result = self._fem.poisson(0.0, (fixed_vertices, result[fixed_vertices]))
            else:
                result += self._rest(-(self.stiffness @ result), free, residual)
        if not np.isfinite(result).all():
            raise _unsolvable()
        return result

    def between(self, first: Int, second: Int, residual: float = _RESIDUAL) -> Float:
        """Harmonic function (V,) from -1 to 1 between two sets of vertices, as in ``solve``."""
        values = np.repeat([-1.0, 1.0], [len(first), len(second)])
        return self.solve(np.concatenate([first, second]), values, residual)

    def screened(self, weight: Float, values: Float) -> Float:
        """Find the function (V,) of least energy plus weighted squared difference from values.

        Where the weight (V,) is infinite, the function has these values.
        """
        result, free = np.where(np.isinf(weight), values, 0.0), np.isfinite(weight)
        added = np.where(free, weight, 0.0)
        right = added * values - self.stiffness @ result
        matrix = self.stiffness[free][:, free] + sparse.diags_array(added[free])
        with _solvable():
            result[free] = _factor(matrix.tocsc()).solve(right[free])
        return result

    def integrate(self, field: Float) -> Float:
        """Find the function (V,) whose gradient is nearest to a field (T, 3) on triangles.

        Its first value is zero. The equation is K f = -div of the field, as LaPy defines it.
        """
        right = -compute_divergence(self._mesh, field)
        free = np.ones(len(self.points), dtype=bool)
        free[0] = False
        with _solvable():
            return self._rest(right, free, _RESIDUAL)

    def gradient(self, values: Float) -> Float:
        """Compute the gradient (T, 3) of a piecewise linear function (V,), per mm."""
        flow: Float = compute_gradient(self._mesh, values)
        # LaPy 1.7 returns the negative gradient on tetrahedra; the true one rises along edges.
        start, stop = self.cells[:, 0], self.cells[:, 1]
        edges, rise = self.points[stop] - self.points[start], values[stop] - values[start]
        return flow if np.einsum("tk,tk,t->", flow, edges, rise) >= 0 else -flow

    def eigenfunctions(self, count: int) -> tuple[Float, Float]:
        """Compute eigenvalues (count,) and eigenfunctions (V, count) above the constant."""
        size, matrix, mass = len(self.points), self._fem.stiffness, self._fem.mass
        start = np.cos(np.arange(size, dtype=np.float64))  # any fixed vector: results repeat
        with _solvable():
            if self._solver == "lapy":
                values, functions = self._fem.eigs(count + 1, sigma=self._shift, v0=start)
                return values[1:], functions[:, 1:]
            values, functions = linalg.eigsh(
                matrix,
                k=count + 1,
                M=mass,
                sigma=self._shift,
                OPinv=self._inverse,
                v0=start,
                ncv=min(2 * count + 8, size),  # the default of 20 means twice as many solutions
                tol=1e-6,
            )
        order = np.argsort(values)[1:]
        return values[order], functions[:, order]

    def first_near(self, values: Float, similar: "Laplace") -> Float:
        """Compute the first eigenfunction (V,), roughly, from a similar operator's.

        The factors of the other operator are used (LOBPCG: Knyazev 2001, SIAM J Sci Comput
        23:517-541).
        """
        matrix, mass = self._fem.stiffness, self._fem.mass
        if self._solver != "lapy":
            start = values / math.sqrt(values @ (mass @ values))
            scale = float(start @ (matrix @ start) * np.linalg.norm(mass @ start))
            with suppress(UserWarning), catch_warnings():
                simplefilter("error")  # it warns if it does not converge
                _, functions = linalg.lobpcg(
                    matrix,
                    start[:, None],
                    B=mass,
                    M=similar._inverse,  # noqa: SLF001 -- of the same class
                    Y=np.ones((len(values), 1)),
                    tol=_ROUGH * scale,
                    maxiter=_MAX_ROUGH_STEPS,
                    largest=False,
                )
                return np.asarray(functions[:, 0])
        return np.asarray(self.eigenfunctions(1)[1][:, 0])

    @property
    def _shift(self) -> float:
        """Where eigenvalues are sought, a little below zero."""
        mean = float(self._fem.stiffness.trace() / self._fem.mass.sum())
        return -1e-2 * mean / len(self.points)

    @cached_property
    def _inverse(self) -> linalg.LinearOperator:
        """The inverse of the stiffness, shifted so that it has one."""
        matrix = self._fem.stiffness - self._shift * self._fem.mass
        solve = _factor(matrix).solve
        return linalg.LinearOperator(matrix.shape, matvec=solve, matmat=solve, dtype=np.float64)

    def _rest(self, right: Float, free: Bool, residual: float) -> Float:
        """Solve for the free vertices; zero at the others."""
        volume = self.cells.shape[1] == 4  # noqa: PLR2004 -- corners of a tetrahedron
        if volume and len(free) > _ITERATED_SIZE and free.mean() > 0.5:  # noqa: PLR2004 -- most
            return solve_two_level(self.stiffness, right, free, self._groups, residual)
        result = np.zeros(len(free))
        result[free] = _factor(self.stiffness[free][:, free].tocsc()).solve(right[free])
        return result

    @cached_property
    def _groups(self) -> NDArray[np.intp]:
        return compact_groups(self.points)


def volume_laplace(mesh: types.TetMesh, solver: str = "two-level") -> Laplace:
    """Make the Laplace operator of a volume, without flux through its surface."""
    return Laplace(bare_mesh(TetMesh, mesh.vertices, mesh.tetrahedra), solver)


def bare_mesh(kind: type[Any], points: Float, cells: Int) -> Any:  # noqa: ANN401  (LaPy's)
    """Make LaPy's mesh without its tables of neighbors, which take a quarter of an operator's time.

    The operators need none.
    """
    mesh = object.__new__(kind)
    mesh.v, mesh.t = points, cells
    return mesh


class Directed:
    """Operators on the same triangles, with two speeds of diffusion in each of them.

    What does not depend on the speeds is made once. LaPy's constructor knows no other speeds than
    exponentials of curvature. Anisotropic diffusion as in Andreux et al. 2014 (ECCV workshops,
    LNCS 8928:299-312).
    """

    def __init__(self, laplace: Laplace, first: Float, second: Float) -> None:
        """Take directions (T, 3) of the two speeds."""
        self._laplace = laplace
        triangles, count = laplace.cells, len(laplace.points)
        corners = laplace.points[triangles.T]
        edges = np.roll(corners, -1, axis=0) - corners
        along = np.stack([np.einsum("etk,tk->et", edges, way) for way in (first, second)], axis=-1)
        areas = 2 * np.linalg.norm(np.cross(edges[1], edges[2]), axis=1)  # four times the area
        least = np.finfo(float).eps
        areas[areas < least] = max(1e-4 * areas.mean(), least)
        self._shares = np.roll(along, -1, axis=0) * np.roll(along, 1, axis=0) / areas[:, None]
        start, stop = triangles.T, np.roll(triangles.T, -1, axis=0)
        code = np.minimum(start, stop).astype(np.int64) * count + np.maximum(start, stop)
        code, edge = np.unique(code, return_inverse=True)
        self._edge = edge.ravel()
        low, high = np.divmod(code, count)
        rows, columns = np.concatenate([low, high]), np.concatenate([high, low])
        # Each entry holds the number of its edge.
        numbers = np.tile(np.arange(len(code)), 2)
        self._edges = sparse.csc_matrix((numbers, (rows, columns)), shape=(count, count))

    def __call__(self, speeds: Float) -> Laplace:
        """Make the operator with speeds (T, 2)."""
        sides = np.einsum("etk,tk->et", self._shares, speeds)
        links = self._edges.astype(np.float64)
        weights = np.asarray(np.bincount(self._edge, sides.ravel()), dtype=np.float64)
        links.data = weights[self._edges.data]
        fem = copy(self._laplace._fem)  # noqa: SLF001 -- of this module
        fem.stiffness = links - sparse.diags(np.asarray(links.sum(axis=0))[0], format="csc")
        return Laplace(self._laplace._mesh, self._laplace._solver, fem)  # noqa: SLF001 -- likewise


def _factor(matrix: sparse.csc_array) -> linalg.SuperLU:
    """Factorize a symmetric positive definite matrix."""
    return linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


@contextmanager
def _solvable() -> Iterator[None]:
    """Turn SciPy's error for a singular matrix into a reason."""
    try:
        yield
    except RuntimeError as error:
        raise _unsolvable() from error


def _unsolvable() -> GeometryError:
    return GeometryError(
        "a Laplace problem has no solution: the mesh is broken; check the labels", reason="laplace"
    )


def compact_groups(points: Float) -> NDArray[np.intp]:
    """Group number (N,) of points: about 2 sqrt(N) compact groups of equal size.

    Their number is a power of two, as each is cut in halves across its longest side.
    """
    levels = round(math.log2(_GROUPS * math.sqrt(len(points))))
    size = -(-len(points) // 2**levels) * 2**levels
    members = np.arange(size)[None] % len(points)  # some points twice, so that halves are equal
    for _ in range(levels):
        position = points.T.take(members, axis=1)
        longest = np.ptp(position, axis=2).argmax(axis=0)
        along = np.take_along_axis(position, longest[None, :, None], axis=0)[0]
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
    residual: float = _RESIDUAL,
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
        (rows * matrix.data * inverse.take(matrix.indices), matrix.indices, matrix.indptr),
        shape=matrix.shape,
    )
    # Functions that are constant on each group.
    members = sparse.csr_array((1.0 * free, (np.arange(len(free)), groups)))
    coarse = (members.T.tocsr() @ matrix @ members).toarray()
    empty = members.sum(axis=0) == 0
    coarse[empty, empty] = 1.0
    try:
        coarse = np.linalg.inv(coarse)
    except np.linalg.LinAlgError as error:
        raise _unsolvable() from error
    members.data *= root
    sums = members.T.tocsr()

    def both_levels(residual: Float) -> Float:
        return np.asarray(residual + members @ (coarse @ (sums @ residual)))

    levels = linalg.LinearOperator(matrix.shape, matvec=both_levels, dtype=np.float64)
    result, unfinished = linalg.cg(
        scaled, inverse * right, rtol=residual, atol=0.0, maxiter=_MAX_STEPS, M=levels
    )
    if unfinished:
        raise _unsolvable()
    return np.asarray(inverse * result)
