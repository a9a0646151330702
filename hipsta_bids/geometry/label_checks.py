"""Noise and thin gaps in the labels themselves, which smoothing hides from the later steps."""

import numpy as np
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Flag
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.boxes import box_around, low_corner
from hipsta_bids.geometry.checks import name_place
from hipsta_bids.settings import CheckSettings

_ALL = np.ones((3, 3, 3), dtype=bool)
_FACES = ndimage.generate_binary_structure(3, 1)


def check_labels(body: Body, settings: CheckSettings) -> list[Flag]:
    """Flag labels with noise, or with a gap of about one voxel through the sheet.

    Returns
    -------
    list of Flag
        ``noisy-labels`` where many single voxels inside the sheet lack its label, ``thin-gap``
        where a layer of voxels without a label lies between labeled ones, ``loose-part`` where a
        large part of the sheet touches the rest by edges of voxels at most.
    """
    index, _ = body.inside_points()
    around = box_around(index)
    low = low_corner(around)
    sheet = np.pad(body.tissue[around] > 0, 1)
    within = np.pad(body.inside[around], 1)
    gap = np.zeros_like(sheet)
    gap[tuple((body.gap - low + 1).T)] = True
    # The gap between the end planes: next to voxels that lie between them.
    free = ~sheet & ndimage.binary_dilation(within, structure=_ALL)
    rows = [
        _noise(free, within, settings),
        _thin_gap(gap, settings),
        _loose_part(within, settings),
    ]
    flags = []
    for row in rows:
        if row is not None:
            reason, message, remedy, found = row
            nodes = np.argwhere(found) - 1 + low
            place = name_place(nodes @ body.affine[:3, :3].T + body.affine[:3, 3], body)
            flags.append(Flag(reason=reason, message=f"{message}, near {place}: {remedy}"))
    return flags


Finding = tuple[str, str, str, Bool] | None
"""Reason, what is wrong, remedy, and where."""


def _noise(free: Bool, within: Bool, settings: CheckSettings) -> Finding:
    """Find single voxels with the sheet on five or six of their sides."""
    sides = sum(
        np.roll(within, step, axis).astype(np.int8) for axis in range(3) for step in (-1, 1)
    )
    pinholes = free & (sides >= 5)  # noqa: PLR2004 -- of six faces
    share = int(np.count_nonzero(pinholes)) / int(np.count_nonzero(within))
    if share <= settings.flag_pinholes:
        return None
    text = f"the labels are noisy: {share:.1%} of the sheet are single voxels without a label"
    return "noisy-labels", text, "smooth or correct the labels", pinholes


def _thin_gap(gap: Bool, settings: CheckSettings) -> Finding:
    """Judge the largest layer of voxels that has the sheet on opposite sides."""
    size = int(np.count_nonzero(gap))
    if size <= settings.flag_gap:
        return None
    text = f"a thin gap of {size} voxels without a label parts the sheet"
    return "thin-gap", text, "fill it in the labels", gap


def _loose_part(within: Bool, settings: CheckSettings) -> Finding:
    """Find a second piece of voxels that share faces."""
    pieces, count = ndimage.label(within, structure=_FACES)
    if count < 2:  # noqa: PLR2004 -- a second piece
        return None
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    second = int(np.argsort(sizes)[-2])
    share = float(sizes[second]) / float(sizes.sum())
    if share <= settings.flag_loose_part:
        return None
    text = f"{share:.0%} of the sheet do not touch the rest by any face of a voxel"
    return "loose-part", text, "fill the gap in the labels", pieces == second
