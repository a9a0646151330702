"""The share of the sheet in each voxel, where labels come with probabilities.

Labels decide topology, ends, subfields and repairs. Shares move the wall, by at most a voxel: the
surface at one half of the voxels' shares is the wall that binary labels know to half a voxel only.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.geometry import digital
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.types import Bool, Float, LabelVolume

#: Where voxels have shares, the smoothing of binary labels is less by this factor.
SHARE_SMOOTHING = 0.6
#: SD of the window in which it is judged whether they have, mm.
SOFT_WINDOW = 1.0

Shares = NDArray[np.float32]

_HALF = 0.5  # of a voxel: the wall
_WIDTH_WINDOW = 0.6  # mm, SD of the window in which a wall's width is averaged
_BLUR = 0.75  # voxels, SD of the Gaussian with which slopes are taken
_DENSITY = 0.3544
"""Mean of the standard normal density, weighted by (F (1 - F))^3 of its distribution function F."""
_MARGIN = 3  # voxels round the sheet in which probabilities are looked at


class SheetShare(NamedTuple):
    """The sheet in each voxel, by probabilities."""

    values: Shares
    """(I, J, K) share of the sheet; 0 and 1 farther than a voxel from the border of the labels."""
    unlike: digital.Index
    """(N, 3) voxels farther away in which probabilities contradict the labels."""


def sheet_share(volume: LabelVolume, body: Bool, sheet: tuple[int, ...]) -> SheetShare | None:
    """Compute the share of the sheet in each voxel; ``None`` without probabilities.

    ``body`` (I, J, K) is the mended sheet, ``sheet`` lists the tissues of which it is made. Where a
    voxel of the body has another label, as of the molecular layer, the label's share counts there
    and in the voxels that have no nearer voxel of this label. The share of a head or tail label is
    divided like the other labels of its voxel: wholly up to two thirds of theirs, and not at all
    where it is as large. Filled voxels are full, removed voxels are empty.
    """
    if not volume.shares:
        return None
    labeled = np.isin(volume.tissue, sheet)
    removed = labeled & ~body
    index = digital.positions(body | removed)
    around = digital.box(
        np.maximum(index.min(axis=0) - _MARGIN, 0), index.max(axis=0) + _MARGIN + 1
    )
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    inside, kind = body[around], volume.tissue[around]

    def at_nearest(values: Bool, voxels: Bool) -> Bool:
        nearest = ndimage.distance_transform_edt(
            ~voxels, sampling=edges, return_distances=False, return_indices=True
        )
        return np.asarray(values[tuple(nearest)])

    plain = np.zeros(kind.shape, dtype=np.float32)
    part, subfields = plain.copy(), plain.copy()
    for tissue, share in volume.shares.items():
        if tissue not in (Tissue.BACKGROUND, Tissue.HIPPOCAMPUS):
            subfields += share[around]
        if tissue in sheet:
            plain += share[around]
        elif tissue != Tissue.BACKGROUND and inside[kind == tissue].any():
            part += share[around] * at_nearest(inside, kind == tissue)
    part += plain
    if Tissue.HIPPOCAMPUS in volume.shares:
        hidden = volume.shares[Tissue.HIPPOCAMPUS][around]
        ratio = hidden / np.maximum(subfields, 1e-6)
        part *= 1 + ratio * np.clip(3 * (1 - ratio), 0, 1)
    part[inside & ~np.isin(kind, [t for t in volume.shares if t != Tissue.BACKGROUND])] = 1
    part[at_nearest(removed[around], (body | removed)[around])] = 0
    deep = ndimage.binary_erosion(inside, structure=digital.CUBE)
    near = ndimage.binary_dilation(inside, structure=digital.CUBE)
    # Beyond an end plane, the label of head or tail is no contradiction.
    foreign = ~near & ~np.isin(volume.tissue[around], sheet) & (plain > _HALF)
    unlike = digital.positions(np.where(deep, part < _HALF, foreign))
    values = np.zeros(body.shape, dtype=np.float32)
    values[around] = np.where(deep, 1, np.where(near, np.clip(part, 0, 1), 0))
    return SheetShare(values, unlike + digital.low_corner(around))


def softness(share: Shares, reach: Float) -> Shares:
    """Return how soft the wall is near each voxel: 0 for binary labels, 1 for shares.

    Above 1, probabilities are wider than the ramp that voxels make of a wall. Slices across an axis
    with ``reach`` 0 are looked at apart. Softness is the sum of p (1 - p) in a Gaussian window of
    SD ``reach``, voxels, over the sum that the wall's true shares have. A voxel's share of a
    half-space is the distribution function of its projection on the normal, whose width depends
    little on the direction: per area of wall, the sum is a sixth of a voxel's edge along the
    normal.
    """
    smooth = ndimage.gaussian_filter(share, np.where(reach > 0, 0.5, 0))
    slopes = np.gradient(smooth, axis=tuple(np.flatnonzero(reach).tolist()))
    wall = np.sqrt(sum(slope * slope for slope in slopes)) / 6
    window = (ndimage.gaussian_filter(part, reach) for part in (share * (1 - share), wall))
    observed, expected = window
    return np.asarray(observed / np.maximum(expected, 1e-6), dtype=np.float32)


def wall_sd(share: Shares, edges: Float) -> Shares:
    """Return the SD of the place of the wall near each voxel (I, J, K), mm, by probabilities.

    Where probabilities are near a half, a normal distribution function with their slope has this
    SD, less what the Gaussian and voxels of these ``edges`` (3,), mm, make of a sharp wall.
    """
    smooth = ndimage.gaussian_filter(share, _BLUR)
    slope = ndimage.gaussian_gradient_magnitude(share, _BLUR)
    weight = (smooth * (1 - smooth)) ** 3
    reach = _WIDTH_WINDOW / edges
    slope, weight = (ndimage.gaussian_filter(part, reach) for part in (weight * slope, weight))
    variance = (_DENSITY * weight / np.maximum(slope, 1e-9)) ** 2 - _BLUR**2 - 1 / 12
    return np.asarray(np.cbrt(edges.prod()) * np.sqrt(np.maximum(variance, 0)), dtype=np.float32)
