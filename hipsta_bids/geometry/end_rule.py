"""Where the body ends if nothing is labeled head or tail."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Float, Int, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.schemes import Tissue
from hipsta_bids.settings import BodySettings

End = Literal["posterior", "anterior"]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Slices:
    """Cross-sections at equal steps along an axis."""

    axis: Float
    first: float
    """Level of the first slice along the axis, mm."""
    step: float

    def level(self, number: float) -> float:
        return float(self.first + self.step * number)


def automatic_range(
    volume: LabelVolume,
    sheet: NDArray[np.uint8],
    axis: Float,
    known: dict[End, tuple[Float, Float, str]],
    settings: BodySettings,
) -> dict[End, tuple[float, str]]:
    """Find the ends of the body that have no labels by the rule of Diers et al. 2023, section 2.1.

    Parameters
    ----------
    volume : LabelVolume
    sheet : (I, J, K) array of uint8
        Sheet tissue after the layer was given away.
    axis : (3,) array
        Unit vector along which slices are counted.
    known : dict
        Point, normal and rule of the ends that have labels.
    settings : BodySettings

    Returns
    -------
    dict
        Level along the axis, mm, and rule of each end.

    Raises
    ------
    GeometryError
        ``no-body`` where no slice fulfils the rule.
    """
    index = np.argwhere(sheet > 0)
    along = (index @ volume.affine[:3, :3].T + volume.affine[:3, 3]) @ axis
    step = float(np.abs(axis @ volume.affine[:3, :3]).max())
    slices = _Slices(axis=axis, first=float(along.min()), step=step)
    number = np.floor((along - slices.first) / step + 0.5).astype(int)
    low, high = _subfield_range(sheet[sheet > 0], number, slices, known)
    section, pixel = _sections(sheet > 0, volume.affine, slices, (low, high))
    first, last = (low + number for number in _body_like(section, pixel, settings))
    area = section.sum(axis=(1, 2))[first - low : last - low + 1]
    reach = max(round(settings.end_reach / step), 1)
    before, after = (_grazed(a, reach, settings.end_fullness) for a in (area, area[::-1]))
    # Each kept slice reaches half a step to both sides.
    return {
        "posterior": (
            slices.level(first + before - 0.5) + settings.end_margin,
            "cross-section" if first > low else "subfields",
        ),
        "anterior": (
            slices.level(last - after + 0.5) - settings.end_margin,
            "cross-section" if last < high else "subfields",
        ),
    }


def _subfield_range(
    values: NDArray[np.uint8],
    number: Int,
    slices: _Slices,
    known: dict[End, tuple[Float, Float, str]],
) -> tuple[int, int]:
    """First slice that has CA1 and CA2 or CA3, and last that has CA2 or CA3, between known ends."""
    count = int(number.max()) + 1
    ca1 = np.bincount(number[values == Tissue.CA1], minlength=count) > 0
    lateral = np.isin(values, (Tissue.CA2, Tissue.CA2_3, Tissue.CA3))
    ca23 = np.bincount(number[lateral], minlength=count) > 0
    levels = slices.first + slices.step * np.arange(count)
    if "posterior" in known:
        ca23 &= levels > known["posterior"][0] @ slices.axis
    if "anterior" in known:
        ca23 &= levels < known["anterior"][0] @ slices.axis
    both = np.flatnonzero(ca1 & ca23)
    if not len(both):
        raise GeometryError(
            "no slice across the long axis has both CA1 and CA2/CA3, and there are no head and "
            "tail labels: cannot tell where the body lies",
            reason="no-body",
        )
    return int(both[0]), int(np.flatnonzero(ca23)[-1])


def _body_like(section: Bool, pixel: float, settings: BodySettings) -> tuple[int, int]:
    """First and last cross-section, counted from the middle, that look like the body.

    Where CA2/CA3 is labeled in the head or in the tail's bend, the rule of the paper runs deep
    into them. The body ends where the cross-section falls into two large pieces, or twice running
    exceeds the usual area.
    """
    area = section.sum(axis=(1, 2)) * pixel**2
    count = len(area)
    usual = float(np.median(area[count // 4 : count - count // 4]))
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[1] = True  # pieces are sought within each slice
    pieces, total = ndimage.label(section, structure=in_slice)
    sizes = np.bincount(pieces.ravel(), minlength=total + 1)[1:] * pixel**2
    owner = np.zeros(total, dtype=int)
    number = np.broadcast_to(np.arange(count)[:, None, None], section.shape)
    owner[pieces[section] - 1] = number[section]
    split = np.bincount(owner[sizes > settings.head_piece], minlength=count) > 1
    wide = area > settings.head_growth * usual
    twice = np.zeros(count, dtype=bool)
    twice[:-1] |= wide[:-1] & wide[1:]
    twice[1:] |= wide[1:] & wide[:-1]
    odd = np.flatnonzero(split | twice)
    before, after = odd[odd < count // 2], odd[odd > count // 2]
    first = int(before[-1]) + 1 if len(before) else 0
    last = int(after[0]) - 1 if len(after) else count - 1
    return first, last


def _grazed(area: Int, reach: int, fullness: float) -> int:
    """How many of the first cross-sections are smaller than those that follow them.

    Labels that end obliquely leave cross-sections that have a part of them only.
    """
    outer = area[: min(reach, len(area) // 4)]
    usual = [np.median(area[i + 1 : i + 1 + reach]) for i in range(len(outer))]
    whole = np.flatnonzero(outer >= fullness * np.array(usual))
    return int(whole[0]) if len(whole) else len(outer)


def _sections(
    mask: Bool, affine: Float, slices: _Slices, bounds: tuple[int, int]
) -> tuple[Bool, float]:
    """Sample the mask in the slices between bounds, (N, A, B); also the pixel edge, mm."""
    axis = slices.axis
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side = side / np.linalg.norm(side)
    up = np.cross(axis, side)
    pixel = float(np.linalg.norm(affine[:3, :3], axis=0).min())
    points = np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3]
    a, b = (
        np.arange(reach.min() - 1, reach.max() + 1, pixel) for reach in (points @ side, points @ up)
    )
    levels = slices.first + slices.step * np.arange(bounds[0], bounds[1] + 1)
    where = (
        a[None, :, None, None] * side
        + b[None, None, :, None] * up
        + levels[:, None, None, None] * axis
    )
    inverse = np.linalg.inv(affine)
    voxels = np.moveaxis(where @ inverse[:3, :3].T + inverse[:3, 3], -1, 0)
    field = ndimage.map_coordinates(mask.astype(np.float32), voxels, order=1, output=np.float32)
    return field > 0.5, pixel  # noqa: PLR2004 -- halfway between outside and inside
