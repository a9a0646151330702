"""The outline of the ribbon in one slice: between the pixels, fragments joined, holes filled."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.schemes import Tissue, lateral_rank
from hipsta_bids.settings import SliceSettings

Image = NDArray[np.float32]


def outline_slice(tissue: NDArray[np.uint8], pixel: float, settings: SliceSettings) -> Image:
    """Find the signed distance from the ribbon's outline in a slice.

    Parameters
    ----------
    tissue : (I, J) array of uint8
        Sheet tissue at the pixels of the segmentation.
    pixel : float
        Edge of a pixel, mm.
    settings : SliceSettings

    Returns
    -------
    (upsampling I, upsampling J) array of float32
        mm at finer pixels, positive inside, between minus and plus ``reach``.

    Notes
    -----
    Across a straight edge, a mask smoothed by a Gaussian is the normal distribution function of the
    distance over sigma. Its inverse finds the outline between pixels; whole pixels put it off by
    up to half of one, which the smoothing of the working grid cannot undo along the slice.
    """
    block = np.ones((settings.upsampling,) * 2, dtype=np.uint8)
    labels = np.kron(tissue, block)
    if not labels.any():
        return np.full(labels.shape, -settings.reach, dtype=np.float32)
    fine = pixel / settings.upsampling
    sigma = settings.smoothing * settings.upsampling
    smooth = ndimage.gaussian_filter((labels > 0).astype(np.float64), sigma)
    distance = _signed_distance(smooth > 0.5, fine)  # noqa: PLR2004 -- the outline
    exact = sigma * fine * ndtri(np.clip(smooth, 1e-6, 1 - 1e-6))
    distance = np.where(np.abs(distance) < sigma * fine, exact, distance)
    distance = _join(distance, lateral_rank(labels).astype(int), labels > 0, fine, settings)
    return np.asarray(np.clip(distance, -settings.reach, settings.reach), dtype=np.float32)


def part_distance(
    tissue: NDArray[np.uint8], kinds: Collection[Tissue], pixel: float, settings: SliceSettings
) -> Image:
    """Find the signed distance from some subfields of a slice, to the pixel.

    Parameters
    ----------
    tissue : (I, J) array of uint8
    kinds : collection of Tissue
    pixel : float
        Edge of a pixel, mm.
    settings : SliceSettings

    Returns
    -------
    (upsampling I, upsampling J) array of float32
        As :func:`outline_slice`.
    """
    fine = np.kron(np.isin(tissue, tuple(kinds)), np.ones((settings.upsampling,) * 2, dtype=bool))
    distance = _signed_distance(fine, pixel / settings.upsampling)
    return np.asarray(np.clip(distance, -settings.reach, settings.reach), dtype=np.float32)


def _signed_distance(mask: Bool, pixel: float) -> Float:
    """Distance from the border between pixels, mm, positive inside."""
    if not mask.any():
        return np.full(mask.shape, -np.inf)
    inside = ndimage.distance_transform_edt(mask)
    outside = ndimage.distance_transform_edt(~mask)
    return np.asarray((np.maximum(inside - 0.5, 0) - np.maximum(outside - 0.5, 0)) * pixel)


def _join(
    distance: Float, ranks: NDArray[np.intp], labeled: Bool, pixel: float, settings: SliceSettings
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
        jump = np.abs(ranks - ranks[tuple(nearest)]) > settings.max_rank_jump
        cost = gap + np.where(jump & labeled, settings.reach, 0)
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
