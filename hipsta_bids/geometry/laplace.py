"""Linear finite elements on tetrahedra: stiffness, Dirichlet problems, eigenfunctions."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from hipsta_bids.artifacts import Float, Int
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.tetra import tetra_volumes


def stiffness(vertices: Float, tetrahedra: Int, tensor: Float | None = None) -> sparse.csc_array:
    """Stiffness matrix of linear elements.

    Parameters
    ----------
    vertices : (V, 3) array, mm
    tetrahedra : (T, 4) array, positive volume
    tensor : (3, 3) array, optional
        Constant symmetric diffusion tensor; identity if missing.

    Returns
    -------
    (V, V) sparse array, symmetric positive semi-definite

    Notes
    -----
    Entries are the integrals of grad(i) . D grad(j) of the hat functions (Reuter et al. 2006,
    Computer-Aided Design 38:342-366, for the Laplace case). The same matrix as LaPy's, made in
    one step for all elements.
    """
    corners = vertices[tetrahedra]
    volumes = tetra_volumes(vertices, tetrahedra)
    gradients = np.empty((len(tetrahedra), 4, 3))
    for corner, (i, j, k) in enumerate(((1, 3, 2), (0, 2, 3), (0, 3, 1), (0, 1, 2))):
        gradients[:, corner] = np.cross(
            corners[:, j] - corners[:, i], corners[:, k] - corners[:, i]
        )
    gradients /= 6 * volumes[:, None, None]
    flux = gradients if tensor is None else gradients @ tensor
    local = np.einsum("tid,tjd->tij", flux, gradients) * volumes[:, None, None]
    rows = np.repeat(tetrahedra, 4, axis=1).ravel()
    columns = np.tile(tetrahedra, (1, 4)).ravel()
    shape = (len(vertices), len(vertices))
    return sparse.csc_array(sparse.coo_array((local.ravel(), (rows, columns)), shape=shape))


def lumped_mass(vertices: Float, tetrahedra: Int) -> Float:
    """Diagonal of the lumped mass matrix, (V,), mm3."""
    share = np.repeat(tetra_volumes(vertices, tetrahedra) / 4, 4)
    return np.bincount(tetrahedra.ravel(), share, minlength=len(vertices)).astype(np.float64)


def solve_dirichlet(matrix: sparse.csc_array, fixed: NDArray[np.intp], values: Float) -> Float:
    """Harmonic function with given values at some vertices and free boundary elsewhere.

    Parameters
    ----------
    matrix : (V, V) sparse array
        Stiffness.
    fixed : (N,) array of int
    values : (N,) array

    Returns
    -------
    (V,) array
    """
    count = matrix.shape[0]
    free = np.ones(count, dtype=bool)
    free[fixed] = False
    result = np.zeros(count)
    result[fixed] = values
    inner = matrix[free]
    right = -(inner[:, ~free] @ result[~free])
    result[free] = _factor(inner[:, free].tocsc()).solve(right)
    if not np.isfinite(result).all():
        raise GeometryError("a Laplace problem has no finite solution", reason="laplace")
    return result


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
        tol=1e-6,
    )
    order = np.argsort(values)[1:]
    return values[order], functions[:, order]


def _factor(matrix: sparse.csc_array) -> linalg.SuperLU:
    return linalg.splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
