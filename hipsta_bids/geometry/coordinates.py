"""The intrinsic coordinate system: three harmonic functions on the body."""

import numpy as np

from hipsta_bids.artifacts import Coordinates, TetMesh
from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.laplace import solve_dirichlet, stiffness
from hipsta_bids.geometry.two_level import compact_groups

_MANY = 4000  # vertices from which on iterating is faster than factorizing


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
    groups = compact_groups(mesh.vertices) if len(mesh.vertices) > _MANY else None
    pairs = (
        (boundaries.medial, boundaries.lateral, groups),
        (boundaries.posterior, boundaries.anterior, groups),
        # Few vertices lie between the two walls.
        (boundaries.interior, boundaries.exterior, None),
    )
    values = np.column_stack(
        [
            solve_dirichlet(
                matrix,
                np.concatenate([first, second]),
                np.repeat([-1.0, 1.0], [len(first), len(second)]),
                levels,
            )
            for first, second, levels in pairs
        ]
    )
    return Coordinates(values=values)
