"""The outline of the ribbon in single slices: joined where it is broken, cut where it closes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.special import ndtri

from hipsta_bids.geometry.digital import piece_sizes
from hipsta_bids.geometry.shares import SHARE_SMOOTHING
from hipsta_bids.protocols.protocol import Tissue, lateral_rank
from hipsta_bids.settings import SliceSettings
from hipsta_bids.types import Bool, Float, Int

#: The subiculum and CA2 or CA3 are kept apart where both are nearer than this, mm.
TOUCH_DISTANCE = 0.6
#: Half width of the slit that keeps them apart, mm.
SLIT_HALF_WIDTH = 0.3
#: Standard deviation of the Gaussian in a slice, pixels.
OUTLINE_SMOOTHING = 0.7
#: Distances from the outline are kept up to this, mm.
DISTANCE_REACH = 2.0
#: Most fragments that are joined in a slice.
MAX_FRAGMENTS = 8
#: Fragments are joined preferably to subfields at most this many ranks away.
MAX_RANK_JUMP = 2
#: Half width of a bridge between fragments, mm.
BRIDGE_HALF_WIDTH = 0.45
#: Longest bridge where a neighboring slice shows the ribbon, to pieces with another subfield, mm.
MAX_BREAK = 3.0
#: Fragments farther away are dropped if they are smaller than this, mm2.
CRUMB_AREA = 1.5
#: Rings are cut along the cheapest path: cost of its length, to which depth in the ribbon (mm)
#: is added.
RING_LENGTH = 0.02
#: What lies in the ribbon of neighboring slices costs their depth times this as well.
RING_NEIGHBORS = 2.0

Stack = NDArray[np.float32]
"""Images, on fine pixels or on those of the segmentation."""

_VISIBLE_SHARE = 0.2
"""Share of the way across a gap that a neighboring slice shows as ribbon, where it is broken."""


def outline_slice(
    tissue: NDArray[np.uint8],
    pixel: float,
    settings: SliceSettings,
    neighbors: Sequence[NDArray[np.uint8]] = (),
    soft: tuple[Stack, Stack] | None = None,
) -> Stack:
    """Signed distance, mm, from the ribbon's outline in a slice with pixels of ``pixel`` mm.

    Where the ribbon is broken, ``neighbors`` show that. Where the ribbon's
    shares (I, J) in the pixels are known, ``soft`` holds them and the proportion (I, J) in which
    the outline follows their half.

    It is sampled at finer pixels, positive inside, and clipped at the setting ``reach``. Across a
    straight edge, a mask smoothed by a Gaussian is the normal distribution function of the distance
    over sigma. Its inverse finds the outline between pixels; whole pixels would shift it by up to
    half of one, which the smoothing of the working grid cannot undo along the slice.
    """
    block = np.ones((settings.upsampling,) * 2, dtype=np.uint8)
    labels = np.kron(tissue, block)
    if not labels.any():
        return np.full(labels.shape, -DISTANCE_REACH, dtype=np.float32)
    fine = pixel / settings.upsampling
    sigma = OUTLINE_SMOOTHING * settings.upsampling
    smooth = ndimage.gaussian_filter((labels > 0).astype(np.float64), sigma)
    distance = _signed_distance(smooth > 0.5, fine)  # noqa: PLR2004 -- the outline
    exact = sigma * fine * ndtri(np.clip(smooth, 1e-6, 1 - 1e-6))
    distance = np.where(np.abs(distance) < sigma * fine, exact, distance)
    if soft is not None:
        share, proportion = soft
        at = _fine_pixels(share.shape, settings.upsampling)
        weight = ndimage.map_coordinates(proportion, at, order=1, mode="nearest")
        distance += weight * (_from_share(share, fine, settings) - distance)
    ranks = ranks_of(tissue, settings.upsampling)
    distance = _join(distance, ranks, neighbors, fine, settings)
    return np.asarray(np.clip(distance, -DISTANCE_REACH, DISTANCE_REACH), dtype=np.float32)


def _from_share(share: Stack, fine: float, settings: SliceSettings) -> Float:
    """Signed distance, mm, from where the share (I, J) in pixels is a half; fine pixels.

    Next to the outline it is the excess over a half by the slope, whatever the width of the ramp: a
    wall that leans in a thick slice has a wide one.
    """
    at = _fine_pixels(share.shape, settings.upsampling)
    smooth = ndimage.map_coordinates(share, at, order=1, mode="nearest")
    smooth = ndimage.gaussian_filter(smooth, SHARE_SMOOTHING * settings.upsampling)
    distance = _signed_distance(smooth > 0.5, fine)  # noqa: PLR2004 -- the outline
    slope = np.hypot(*np.gradient(smooth)) / fine
    exact = (smooth - 0.5) / np.maximum(slope, 1e-6)
    return np.where(np.abs(distance) < fine, np.clip(exact, -fine, fine), distance)


def _fine_pixels(shape: tuple[int, ...], upsampling: int) -> Float:
    """Places (2, I', J') of the fine pixels, in pixels."""
    at = [(np.arange(n * upsampling) + 0.5) / upsampling - 0.5 for n in shape]
    return np.stack(np.meshgrid(*at, indexing="ij"))


def part_distance(
    tissue: NDArray[np.uint8], kinds: tuple[Tissue, ...], pixel: float, settings: SliceSettings
) -> Stack:
    """Signed distance, mm, from some subfields of a slice, accurate to a fine pixel."""
    fine = np.kron(np.isin(tissue, kinds), np.ones((settings.upsampling,) * 2, dtype=bool))
    distance = _signed_distance(fine, pixel / settings.upsampling)
    return np.asarray(np.clip(distance, -DISTANCE_REACH, DISTANCE_REACH), dtype=np.float32)


def _signed_distance(mask: Bool, pixel: float) -> Float:
    """Distance from the border between pixels, mm, positive inside."""
    if not mask.any():
        return np.full(mask.shape, -np.inf)
    inside = ndimage.distance_transform_edt(mask)
    outside = ndimage.distance_transform_edt(~mask)
    return np.asarray((np.maximum(inside - 0.5, 0) - np.maximum(outside - 0.5, 0)) * pixel)


def _join(
    distance: Float,
    ranks: Float,
    neighbors: Sequence[NDArray[np.uint8]],
    pixel: float,
    settings: SliceSettings,
) -> Float:
    """Join near pieces of a slice to the largest, drop fragments farther away, fill small holes.

    A large piece farther away is left alone: only three dimensions show whether it belongs to the
    ribbon, which may bend into the uncus. But where it has a subfield that the largest one lacks,
    and a neighboring slice shows the ribbon between them, the ribbon is broken here.
    """
    block = np.ones((settings.upsampling,) * 2)
    for _ in range(MAX_FRAGMENTS):
        pieces, count = ndimage.label(distance > 0)
        if count < 2:  # noqa: PLR2004 -- one piece is the aim
            break
        sizes = piece_sizes(pieces) * pixel**2
        largest = sizes.argmax()
        main = pieces == largest
        gap, nearest = ndimage.distance_transform_edt(~main, return_indices=True)
        # The sheet is one ribbon: a fragment belongs to a neighbor in medial-to-lateral order,
        # not to the part that happens to lie across the sulcus.
        jump = np.abs(ranks - ranks[tuple(nearest)]) > MAX_RANK_JUMP
        cost = pixel * gap + np.where(jump, DISTANCE_REACH, 0)
        lacked = _with_others(pieces, main, ranks)
        bridges: list[tuple[float, int, Float | None]] = []
        for number in range(1, count + 1):
            if number == largest:
                continue
            position = np.unravel_index(
                np.where(pieces == number, cost, np.inf).argmin(), cost.shape
            )
            start = np.array([axis[position] for axis in nearest])
            way = pixel * _segment_distance(distance.shape, start, np.array(position))
            broken = number in lacked and not jump[position]
            shares = (np.kron(image > 0, block)[way < pixel].mean() for image in neighbors)
            broken = broken and any(share > _VISIBLE_SHARE for share in shares)
            limit = MAX_BREAK if broken else settings.max_gap
            if cost[position] <= limit:
                bridges.append((float(cost[position]), number, way))
            elif sizes[number] < CRUMB_AREA:
                bridges.append((float(cost[position]), number, None))
        if not bridges:
            break
        _, number, bridge = min(bridges, key=lambda item: item[0])
        if bridge is None:
            distance = np.where(pieces == number, -0.5 * pixel, distance)
        else:
            distance = np.maximum(distance, BRIDGE_HALF_WIDTH - bridge)
    holes, _ = ndimage.label(distance <= 0)
    area = np.bincount(holes.ravel()) * pixel**2
    small = (area < settings.hole_area)[holes] & (distance <= 0)
    return np.where(small, 0.5 * pixel, distance)


def _with_others(pieces: NDArray[Any], main: Bool, ranks: Float) -> NDArray[Any]:
    """Numbers of the pieces (I, J) with a subfield that the largest one lacks."""
    return np.asarray(np.unique(pieces[np.isfinite(ranks) & ~np.isin(ranks, ranks[main])]))


def _segment_distance(shape: tuple[int, ...], start: Int, end: Int) -> Float:
    """Distance of each pixel from a segment, in pixels."""
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    along = end - start
    share = ((grid - start) @ along) / max(float(along @ along), 1e-9)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(grid - foot, axis=-1))


def cut_rings(outlines: Stack, pixel: float) -> Stack:
    """Open each outline (N, I, J), mm, that closes round a hole; fine pixels of ``pixel`` mm.

    The sheet is a ribbon: where it closes to a ring, turns touch. The cut follows the cheapest path
    from the hole to the outside, through parts that are thin here and lie outside in the
    neighboring slices.
    """
    cut = outlines.copy()
    for number in range(len(outlines)):
        neighbors = [outlines[k] for k in (number - 1, number + 1) if 0 <= k < len(outlines)]
        near = np.mean(neighbors, axis=0) if neighbors else np.zeros_like(outlines[0])
        for _ in range(MAX_FRAGMENTS):
            path = _way_out(cut[number], near)
            if path is None:
                break
            gap = pixel * ndimage.distance_transform_edt(~path)
            cut[number] = np.minimum(cut[number], gap - SLIT_HALF_WIDTH)
    return cut


def _way_out(outline: Stack, neighbors: Stack) -> Bool | None:
    """Pixels of the cheapest path through the ribbon from its largest hole; None without holes."""
    empty, count = ndimage.label(np.pad(outline <= 0, 1, constant_values=True))
    if count == 1:
        return None
    sizes = piece_sizes(empty)
    sizes[empty[0, 0]] = 0
    outside, hole = empty == empty[0, 0], empty == sizes.argmax()
    depth, height = np.pad(outline, 1), np.pad(neighbors, 1, mode="edge")
    cost = RING_LENGTH + np.maximum(depth, 0)
    cost += RING_NEIGHBORS * np.clip(height + SLIT_HALF_WIDTH, 0, 1.5)
    cost[outside | (empty > 0)] = RING_LENGTH
    nodes = np.arange(cost.size).reshape(cost.shape)
    steps = []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        first = nodes[: cost.shape[0] - di, max(-dj, 0) : cost.shape[1] - max(dj, 0)]
        second = nodes[di:, max(dj, 0) : cost.shape[1] + min(dj, 0)]
        length = np.hypot(di, dj) * 0.5 * (cost.ravel()[first] + cost.ravel()[second])
        steps.append((first.ravel(), second.ravel(), length.ravel()))
    first, second, length = (np.concatenate(part) for part in zip(*steps, strict=True))
    graph = sparse.csr_array((length, (first, second)), shape=(cost.size,) * 2)
    distance, before, _ = csgraph.dijkstra(
        graph, directed=False, indices=nodes[hole], return_predecessors=True, min_only=True
    )
    at = int(nodes[outside][np.argmin(distance[nodes[outside]])])
    path = np.zeros(cost.size, dtype=bool)
    while at >= 0:
        path[at] = True
        at = int(before[at])
    return np.asarray(path.reshape(cost.shape)[1:-1, 1:-1])


def drop_doubles(outline: Stack, rank: Float) -> None:
    """Drop, in place, pieces of a slice (I, J) that have no subfield that the largest one lacks.

    The ribbon has each subfield once: a second piece is the uncus, which passes next to the body.
    """
    pieces, count = ndimage.label(outline > 0)
    if count < 2:  # noqa: PLR2004 -- one piece is the ribbon
        return
    main = pieces == piece_sizes(pieces).argmax()
    retained = np.isin(pieces, _with_others(pieces, main, rank)) | main
    outline[(pieces > 0) & ~retained] = -DISTANCE_REACH


def ranks_of(tissue: NDArray[np.uint8], upsampling: int) -> Float:
    """How lateral each fine pixel's label is; NaN without a label."""
    labels = np.kron(tissue, np.ones((upsampling,) * 2, dtype=np.uint8))
    return np.where(labels > 0, lateral_rank(labels), np.nan)


def keep_apart(medial: Stack, lateral: Stack) -> Stack:
    """Distance from a slit midway between the two ends of the ribbon, where both are near, mm."""
    separated = 0.5 * np.abs(medial - lateral) - SLIT_HALF_WIDTH
    far = -np.minimum(medial, lateral) - TOUCH_DISTANCE
    return np.asarray(np.maximum(separated, far))
