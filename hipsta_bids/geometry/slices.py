"""Between thick slices: repair each slice, and move its shape into the next one.

Where slices are much thicker than their pixels, the ribbon moves sideways by its own thickness from
one slice to the next, and blending slices in place would tear it. Each slice becomes a signed
distance from its outline with thin tails kept and fragments joined; neighboring slices are
registered, and the shapes between them are blends of both, moved along the registration.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import skeletonize
from skimage.registration import optical_flow_ilk

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.geometry.body import Body
from hipsta_bids.settings import SliceSettings

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True)
class FineVolume:
    """A volume that can be sampled by linear interpolation."""

    values: NDArray[np.float32]
    """(I, J, K), 0 outside to 1 inside."""
    affine: Float


def has_thick_slices(affine: Float, settings: SliceSettings) -> bool:
    """Whether the longest voxel edge is long enough for interpolation by shape."""
    edges = np.sort(np.linalg.norm(affine[:3, :3], axis=0))
    return bool(edges[2] > settings.min_ratio * edges[1])


def interpolate_slices(body: Body, settings: SliceSettings) -> FineVolume:
    """Fill the gaps between thick slices with shapes in between.

    Parameters
    ----------
    body : Body
        Its image has one axis with long voxel edges.
    settings : SliceSettings

    Returns
    -------
    FineVolume
        Pixels of half the size, slices ``spacing`` mm apart at the most.
    """
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    through = int(np.argmax(edges))
    pixel = float(np.delete(edges, through).mean()) / settings.upsampling
    tissue = np.moveaxis(body.tissue, through, 0)
    box = _bounds(
        np.moveaxis(body.inside, through, 0), settings.reach / (pixel * settings.upsampling)
    )
    outlines = [_outline(image, pixel, settings) for image in tissue[box]]
    steps = max(int(np.ceil(edges[through] / settings.spacing)), 1)
    planes = [outlines[0]]
    for below, above in pairwise(outlines):
        planes += _between(below, above, steps, pixel, settings)
    ramp = np.clip(np.stack(planes) / (2 * settings.edge) + 0.5, 0, 1).astype(np.float32)
    return FineVolume(
        values=np.moveaxis(ramp, 0, through),
        affine=_finer(body.affine, through, box, steps, settings.upsampling),
    )


def _bounds(inside: Bool, margin: float) -> tuple[slice, slice, slice]:
    """Slices that hold the body, and a box in the slices with a margin in pixels."""
    index = np.argwhere(inside)
    low, high = index.min(axis=0), index.max(axis=0) + 1
    room = np.array([0, np.ceil(margin), np.ceil(margin)], dtype=int)
    low, high = np.maximum(low - room, 0), np.minimum(high + room, inside.shape)
    return slice(low[0], high[0]), slice(low[1], high[1]), slice(low[2], high[2])


def _finer(
    affine: Float, through: int, box: tuple[slice, slice, slice], steps: int, upsampling: int
) -> Float:
    """Affine of the fine volume: pixels of the box split, ``steps`` planes a slice."""
    scale = np.insert(np.full(2, 1 / upsampling), through, 1 / steps)
    split = 0.5 / upsampling - 0.5  # fine pixel centers lie inside the pixel
    shift = np.array([box[1].start + split, box[2].start + split])
    fine = affine.copy()
    fine[:3, :3] = affine[:3, :3] * scale
    fine[:3, 3] += affine[:3, :3] @ np.insert(shift, through, box[0].start)
    return fine


def _outline(tissue: NDArray[np.uint8], pixel: float, settings: SliceSettings) -> Image:
    """Signed distance from a slice's outline, mm, positive inside, at the fine pixels."""
    mask = tissue > 0
    fine = np.kron(mask, np.ones((settings.upsampling,) * 2)).astype(np.float32)
    ranks = np.kron(tissue, np.ones((settings.upsampling,) * 2, np.uint8))
    smooth = ndimage.gaussian_filter(fine, settings.smoothing * settings.upsampling)
    distance = _signed_distance(smooth > 0.5, pixel, settings)  # noqa: PLR2004 -- the outline
    if mask.any():
        skeleton = skeletonize(fine > 0)  # type: ignore[no-untyped-call]
        spine = ndimage.distance_transform_edt(~skeleton) * pixel
        distance = np.maximum(distance, settings.tail - spine)
        distance = _join(distance, ranks, pixel, settings)
    return np.asarray(np.clip(distance, -settings.reach, settings.reach), dtype=np.float32)


def _signed_distance(mask: Bool, pixel: float, settings: SliceSettings) -> Float:
    """Distance from the border between pixels, mm, positive inside."""
    if not mask.any():
        return np.full(mask.shape, -settings.reach)
    inside = ndimage.distance_transform_edt(mask)
    outside = ndimage.distance_transform_edt(~mask)
    return np.asarray((np.maximum(inside - 0.5, 0) - np.maximum(outside - 0.5, 0)) * pixel)


def _join(
    distance: Float, ranks: NDArray[np.uint8], pixel: float, settings: SliceSettings
) -> Float:
    """Bridge near fragments of a slice to the largest, drop crumbs, fill holes.

    A large piece farther away is left alone: whether it belongs to the ribbon (it may turn into
    the uncus) is seen in three dimensions only.
    """
    for _ in range(settings.max_fragments):
        pieces, count = ndimage.label(distance > 0)
        if count < 2:  # noqa: PLR2004 -- one piece is the aim
            break
        sizes = np.bincount(pieces.ravel()) * pixel**2
        sizes[0] = 0
        main = pieces == sizes.argmax()
        gap, nearest = ndimage.distance_transform_edt(~main, return_indices=True)
        gap *= pixel
        # The sheet is one ribbon: a fragment belongs to a neighbor in medial-to-lateral order,
        # not to the part that happens to lie across the sulcus.
        jump = np.abs(ranks.astype(int) - ranks[tuple(nearest)]) > settings.max_rank_jump
        cost = gap + np.where(jump & (ranks > 0), settings.reach, 0)
        crumbs = (sizes < settings.crumb_area)[pieces]
        cost[(pieces == 0) | main | ((cost > settings.max_gap) & ~crumbs)] = np.inf
        end = np.array(np.unravel_index(np.argmin(cost), cost.shape))
        nearest_cost = cost[tuple(end)]
        if not np.isfinite(nearest_cost):
            break
        if nearest_cost > settings.max_gap:
            distance = np.where(pieces == pieces[tuple(end)], -0.5 * pixel, distance)
        else:
            start = np.array([axis[tuple(end)] for axis in nearest])
            bridge = _segment_distance(distance.shape, start, end) * pixel
            distance = np.maximum(distance, settings.bridge - bridge)
    holes, _ = ndimage.label(distance <= 0)
    area = np.bincount(holes.ravel()) * pixel**2
    small = (area < settings.hole_area)[holes] & (distance <= 0)
    return np.where(small, 0.5 * pixel, distance)


def _segment_distance(
    shape: tuple[int, ...], start: NDArray[np.intp], end: NDArray[np.intp]
) -> Float:
    """Distance of each pixel from a segment, in pixels."""
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    along = end - start
    share = ((grid - start) @ along) / max(float(along @ along), 1e-9)
    foot = start + np.clip(share, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(grid - foot, axis=-1))


def _between(
    below: Image, above: Image, steps: int, pixel: float, settings: SliceSettings
) -> list[Image]:
    """Shapes at 1/steps, 2/steps, ... 1 of the way from one slice to the next."""
    forward = _flow(below, above, pixel, settings)
    backward = _flow(above, below, pixel, settings)
    planes = []
    for step in range(1, steps):
        share = step / steps
        one = _blend(below, above, forward, share)
        other = _blend(above, below, backward, 1 - share)
        planes.append(0.5 * (one + other))
    return [*planes, above]


def _flow(fixed: Image, moving: Image, pixel: float, settings: SliceSettings) -> Image:
    """Displacement (2, I, J) in pixels with moving(x + flow) = fixed(x).

    Iterative Lucas-Kanade (Le Besnerais & Champagnat 2005, ICIP:I-137), as in scikit-image.
    """
    # At the pixels of the segmentation: the fine ones would cost much and tell no more.
    coarse = settings.upsampling
    small = [
        ndimage.zoom(image, 1 / coarse, order=1, grid_mode=True, mode="nearest")
        for image in (fixed, moving)
    ]
    radius = max(round(settings.flow_window / (pixel * coarse)), 1)
    flow = optical_flow_ilk(  # type: ignore[no-untyped-call]
        small[0], small[1], radius=radius, num_warp=settings.flow_iterations, gaussian=True
    )
    fine = [ndimage.zoom(part, coarse, order=1, grid_mode=True, mode="nearest") for part in flow]
    return np.asarray(np.stack(fine) * coarse, dtype=np.float32)


def _blend(first: Image, second: Image, flow: Image, share: float) -> Image:
    """Shape at a share of the way, both slices moved along the flow."""
    grid = np.indices(first.shape, dtype=np.float32)
    here = flow
    for _ in range(3):  # the flow is known at the first slice: find it at the place in between
        here = np.stack([_sample(part, grid - share * here) for part in flow])
    moved = _sample(first, grid - share * here), _sample(second, grid + (1 - share) * here)
    return np.asarray((1 - share) * moved[0] + share * moved[1], dtype=np.float32)


def _sample(image: Image, where: Image) -> Image:
    return np.asarray(
        ndimage.map_coordinates(image, where, order=1, mode="nearest", output=np.float32)
    )
