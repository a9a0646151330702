"""Fields whose sign marching cubes reads as digital topology does."""

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Bool


def consistent_values(values: NDArray[np.float32], after: Bool) -> NDArray[np.float32]:
    """Make the field's sign that of the repaired body, and marching cubes agree with it.

    Where the sign is ambiguous on a face or inside a cube, marching cubes decides by the values;
    small positive and larger negative ones keep foreground corners apart, as 6-connectivity does.
    """
    result = np.where(after, np.maximum(values, 0.01), np.minimum(values, -0.01))
    edited = after != (values > 0)
    result = np.where(edited, np.where(after, 0.1, -0.1), result)
    corners = np.zeros(after.shape, dtype=bool)
    for axis in range(3):
        a = np.moveaxis(after, axis, 0)
        faces = (a[:, 1:, 1:] == a[:, :-1, :-1]) & (a[:, 1:, :-1] == a[:, :-1, 1:])
        faces &= a[:, 1:, 1:] != a[:, 1:, :-1]
        _mark(np.moveaxis(corners, axis, 0), faces, cube=False)
    opposite = np.zeros(tuple(n - 1 for n in after.shape), dtype=bool)
    total = after.astype(np.int8)
    for axis in range(3):
        total = np.take(total, range(1, total.shape[axis]), axis) + np.take(
            total, range(total.shape[axis] - 1), axis
        )
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        first = after[dx : dx - 1 or None, dy : dy - 1 or None, :-1]
        last = after[1 - dx : -dx or None, 1 - dy : -dy or None, 1:]
        opposite |= first & last & (total == 2)  # noqa: PLR2004 -- two opposite corners only
        opposite |= ~first & ~last & (total == 6)  # noqa: PLR2004 -- the reverse
    _mark(corners, opposite, cube=True)
    positive = np.minimum(result, 0.03)
    negative = np.minimum(result, -0.08)
    return np.where(corners, np.where(after, positive, negative), result).astype(np.float32)


def _mark(corners: Bool, cells: Bool, *, cube: bool) -> None:
    """Mark the corners of flagged faces (first axis runs over nodes) or cubes, in place."""
    for dx in (0, 1) if cube else (None,):
        for dy in (0, 1):
            for dz in (0, 1):
                first = slice(None) if dx is None else slice(dx, dx - 1 or None)
                corners[first, dy : dy - 1 or None, dz : dz - 1 or None] |= cells
