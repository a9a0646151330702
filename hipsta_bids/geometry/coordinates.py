"""The intrinsic coordinate system: three harmonic functions on the body."""

import numpy as np

from hipsta_bids.artifacts import Coordinates, TetMesh
from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.laplace import HarmonicSolver


def solve_coordinates(
    mesh: TetMesh, boundaries: Boundaries, solver: HarmonicSolver | None = None
) -> Coordinates:
    """Solve Laplace's equation between each pair of opposite boundaries.

    Each function is -1 on the first boundary (medial, posterior, interior), 1 on the second, and
    has no flux through the rest of the surface (Diers et al. 2023, section 2.1.4).

    Parameters
    ----------
    mesh : TetMesh
    boundaries : Boundaries
    solver : HarmonicSolver, optional
        Of this mesh, if there is one already.

    Returns
    -------
    Coordinates

    Raises
    ------
    GeometryError
        ``laplace`` if a problem has no finite solution.
    """
    solver = solver or HarmonicSolver(mesh)
    values = (
        solver.between(boundaries.medial, boundaries.lateral),
        solver.between(boundaries.posterior, boundaries.anterior),
        solver.between(boundaries.interior, boundaries.exterior, few=True),
    )
    return Coordinates(values=np.column_stack(values))
