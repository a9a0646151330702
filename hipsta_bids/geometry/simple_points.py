"""Digital topology on voxel grids: Euler number, simple points, growing and shrinking.

The object is 6-connected, the background 26-connected. A voxel is simple if changing it keeps the
topology of both: one 6-connected piece of object in its 18-neighborhood touches it by a face, and
one 26-connected piece of background lies in its 26-neighborhood (Bertrand & Malandain 1994,
Pattern Recognition Letters 15:169-175). Neighborhoods are 27-bit integers, so that a whole batch
of voxels is tested by a few integer operations on arrays.
"""

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Bool

Bits = NDArray[np.int32]

_OFFSETS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
_DISTANCE = np.abs(_OFFSETS).sum(axis=1)


def _mask(chosen: Bool) -> np.int32:
    return np.int32(sum(1 << int(k) for k in np.flatnonzero(chosen)))


_N6 = _mask(_DISTANCE == 1)
_N18 = _mask((_DISTANCE == 1) | (_DISTANCE == 2))  # noqa: PLR2004 -- face and edge neighbors
_N26 = _mask(_DISTANCE > 0)
# Which bits may move by one step along an axis without leaving the 3 x 3 x 3 block.
_UP = [_mask(_OFFSETS[:, axis] < 1) for axis in range(3)]
_DOWN = [_mask(_OFFSETS[:, axis] > -1) for axis in range(3)]
_STEP = (9, 3, 1)


def euler_number(mask: Bool) -> int:
    """Euler number of a 6-connected object: pieces - tunnels + cavities.

    Voxels are the vertices of a cubical complex; face neighbors its edges.
    """
    edges = [mask[1:] & mask[:-1], mask[:, 1:] & mask[:, :-1], mask[:, :, 1:] & mask[:, :, :-1]]
    squares = [
        edges[0][:, 1:] & edges[0][:, :-1],
        edges[0][:, :, 1:] & edges[0][:, :, :-1],
        edges[1][:, :, 1:] & edges[1][:, :, :-1],
    ]
    cubes = squares[0][:, :, 1:] & squares[0][:, :, :-1]
    count = np.count_nonzero
    return int(count(mask) - sum(map(count, edges)) + sum(map(count, squares)) - count(cubes))


def grow(start: Bool, allowed: Bool, field: NDArray[np.float32], levels: int) -> Bool:
    """Grow a set inside ``allowed`` by simple points, highest field value first.

    Parameters
    ----------
    start, allowed : (A, B, C) arrays of bool
        The outermost layer of voxels must be free in both.
    field : (A, B, C) array
    levels : int
        The values are ordered in this many steps of equal count.

    Returns
    -------
    (A, B, C) array of bool
        Same topology as ``start``; no voxel of ``allowed`` can be added any more.
    """
    state = start.copy()
    free = allowed & ~start
    if free.any():
        for level in np.quantile(field[free], np.linspace(1, 0, levels + 1)[1:]):
            _sweep(state, free & (field >= level), add=True)
    return state


def shrink(start: Bool, kept: Bool, field: NDArray[np.float32], levels: int) -> Bool:
    """Shrink a set towards ``kept`` by simple points, lowest field value first.

    Parameters and result as in :func:`grow`; ``kept`` must lie inside ``start``.
    """
    state = start.copy()
    free = start & ~kept
    if free.any():
        for level in np.quantile(field[free], np.linspace(0, 1, levels + 1)[1:]):
            _sweep(state, free & (field <= level), add=False)
    return state


def _sweep(state: Bool, free: Bool, *, add: bool) -> None:
    """Change free simple voxels in place until none is left.

    Voxels of one of the eight sub-grids of every second voxel are never neighbors, so changing
    them together is the same as one after the other.
    """
    flat = state.reshape(-1)
    strides = np.array([state.shape[1] * state.shape[2], state.shape[2], 1])
    shifts = (_OFFSETS @ strides).astype(np.int64)
    free_flat = free.reshape(-1)
    queue = np.flatnonzero(free_flat & (flat != add))
    # Only voxels on the frontier of the state can be simple.
    queue = _on_frontier(flat, queue, shifts, add)
    marked = np.zeros(flat.shape, dtype=bool)
    while len(queue):
        grid = np.stack(np.unravel_index(queue, state.shape))
        colour = (grid % 2).T @ np.array([4, 2, 1])
        changed = []
        for part in range(8):
            batch = queue[colour == part]
            if not len(batch):
                continue
            batch = batch[_simple(_neighborhood(flat, batch, shifts))]
            flat[batch] = add
            changed.append(batch)
        moved = np.concatenate(changed)
        if not len(moved):
            return
        near = (moved[:, None] + shifts[None, :]).ravel()
        near = near[free_flat[near] & (flat[near] != add)]
        marked[near] = True
        queue = np.flatnonzero(marked)
        marked[queue] = False


def _on_frontier(
    flat: Bool, queue: NDArray[np.int64], shifts: NDArray[np.int64], add: bool
) -> NDArray[np.int64]:
    near = np.zeros(len(queue), dtype=bool)
    for shift in shifts:
        near |= flat[queue + shift] == add
    return queue[near]


def _neighborhood(flat: Bool, index: NDArray[np.int64], shifts: NDArray[np.int64]) -> Bits:
    bits = np.zeros(len(index), dtype=np.int32)
    for position, shift in enumerate(shifts):
        bits |= flat[index + shift].astype(np.int32) << np.int32(position)
    return bits


def _simple(bits: Bits) -> Bool:
    """Whether the center voxel of each neighborhood is simple."""
    faces = bits & _N6
    inside = bits & _N18
    outside = ~bits & _N26
    one_piece = (_flood(faces & -faces, inside, faces_only=True) & faces) == faces
    one_background = _flood(outside & -outside, outside, faces_only=False) == outside
    return np.asarray((faces != 0) & (outside != 0) & one_piece & one_background)


def _flood(seed: Bits, within: Bits, *, faces_only: bool) -> Bits:
    """All bits of ``within`` that hang together with ``seed``."""
    reached = seed
    while True:
        spread = reached
        for axis, step in enumerate(_STEP):
            source = reached if faces_only else spread
            spread = (
                spread
                | ((source & _UP[axis]) << np.int32(step))
                | ((source & _DOWN[axis]) >> np.int32(step))
            )
        spread = spread & within
        if np.array_equal(spread, reached):
            return reached
        reached = spread
