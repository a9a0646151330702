"""Parts of a grid that hold what is worked on, so that the rest need not be touched."""

import numpy as np
from numpy.typing import NDArray

Box = tuple[slice, slice, slice]


def box_around(index: NDArray[np.intp]) -> Box:
    """Box round voxels or nodes (N, 3), with one to spare on each side where the grid has one."""
    low = np.maximum(index.min(axis=0) - 1, 0)
    first, second, third = (
        slice(int(a), int(b)) for a, b in zip(low, index.max(axis=0) + 2, strict=True)
    )
    return first, second, third


def low_corner(box: Box) -> NDArray[np.intp]:
    """Index (3,) at which a box begins."""
    return np.array([side.start for side in box], dtype=np.intp)
