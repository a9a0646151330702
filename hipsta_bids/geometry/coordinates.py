"""The intrinsic coordinate system: three harmonic functions on the body."""

import numpy as np

from hipsta_bids.artifacts import Coordinates, TetMesh
from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.laplace import solve_dirichlet, stiffness


def solve_coordinates(mesh: TetMesh, boundaries: Boundaries) -> Coordinates:
    """Solve Laplace's equation between each pair of opposite boundaries.

    Each function is -1 on the first boundary (medial, posterior, interior), 1 on the second, and
    has no flux through the rest of the surface (Diers et al. 2023, section 2.1.4).

    Parameters
    ----------
    mesh : TetMesh
    boundaries : Boundaries

    Returns
    -------
    Coordinates

    Raises
    ------
    GeometryError
        ``laplace`` if a problem has no finite solution.
    """
    matrix = stiffness(mesh.vertices, mesh.tetrahedra)
    pairs = (
        (boundaries.medial, boundaries.lateral),
        (boundaries.posterior, boundaries.anterior),
        (boundaries.interior, boundaries.exterior),
    )
    values = np.column_stack(
        [
            solve_dirichlet(
                matrix,
                np.concatenate([first, second]),
                np.repeat([-1.0, 1.0], [len(first), len(second)]),
            )
            for first, second in pairs
        ]
    )
    return Coordinates(values=values)
