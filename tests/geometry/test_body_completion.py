"""The uncus beside the body, and cavities at their limits."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import rotation, straight_ends

from hipsta_bids.geometry import completion
from hipsta_bids.geometry.digital import affine_of
from hipsta_bids.geometry.ends import EndPlane, EndPlanes
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import LabelVolume

EDGE = 0.5
ENDS = replace(straight_ends(8.0), half_slice=0.5)
AFFINE = affine_of(EDGE * np.eye(3), np.array([-5.0, 3.0, 0.25]))
UNCUS = slice(8, 12), slice(8, 12), slice(12, 16)  # z of 6.25 to 7.75 mm


def beside_the_body(uncus=UNCUS, *, wide=0, tilted=0):
    """Voxels of a body along +z, 10 mm wide, and a piece of CA2 that CA1 connects to it.

    ``wide``: its posterior half lies so many voxels more laterally; ``tilted``: its subiculum
    begins so many slices behind the first one.
    """
    tissue = np.zeros((52, 16, 16), dtype=np.uint8)
    for levels, shift in ((slice(0, 8), wide), (slice(8, 16), 0)):
        tissue[19:26, 6:12, levels] = Tissue.SUBICULUM
        tissue[26:, 6:12, levels] = Tissue.CA1
        tissue[34 + shift :, 6:12, levels] = 0
        tissue[34 + shift : 40 + shift, 6:12, levels] = Tissue.CA3
    tissue[19:26, :, :tilted] = 0
    tissue[uncus] = Tissue.CA2
    tissue[uncus[0].stop : 19, uncus[1], uncus[2]] = Tissue.CA1
    return tissue


def found(tissue):
    """Mask of the uncus; the same if the body is turned and its voxels are in another order."""
    turn = rotation(0, 20) @ rotation(2, -35)
    z = turn[:, 2]
    planes = EndPlane(np.zeros(3), z, "labels"), EndPlane(8.0 * z, z, "labels")
    ends = EndPlanes(posterior=planes[0], anterior=planes[1], axis=z, half_slice=0.5)
    turned = affine_of(turn, np.zeros(3)) @ AFFINE
    turned = turned @ affine_of(np.diag([-1.0, 1, 1]), np.array([len(tissue) - 1.0, 0, 0]))
    masks = np.zeros((2, *tissue.shape), dtype=bool)
    masks[0][tuple(completion.find_uncus(tissue, AFFINE, ENDS).T)] = True
    masks[1, ::-1][tuple(completion.find_uncus(tissue[::-1], turned, ends).T)] = True
    np.testing.assert_array_equal(*masks)
    return masks[0]


def test_the_uncus_gets_the_nearer_half_of_what_connects_it():
    """Of seven voxels to the subiculum, the one in the middle is the body's."""
    expected = np.zeros((52, 16, 16), dtype=bool)
    expected[8:15, 8:12, 12:16] = True
    np.testing.assert_array_equal(found(beside_the_body()), expected)


@pytest.mark.parametrize(
    ("uncus", "wide", "tilted", "is_uncus"),
    [
        # Its middle lies 5.25 or 4.75 mm medially of that of CA3, 18 mm from the first voxel.
        ((slice(24, 28), slice(14, 16), slice(12, 16)), 0, 0, True),
        ((slice(25, 29), slice(14, 16), slice(12, 16)), 0, 0, False),
        # The same whatever lies elsewhere along the body.
        ((slice(24, 28), slice(14, 16), slice(12, 16)), 6, 6, True),
        ((slice(25, 29), slice(14, 16), slice(12, 16)), 6, 6, False),
        # 1.25 and 1.75 mm behind the anterior plane: three half slices are 1.5 mm.
        ((slice(8, 12), slice(8, 12), slice(8, 14)), 0, 0, True),
        ((slice(8, 12), slice(8, 12), slice(8, 13)), 0, 0, False),
        # 1.125 and 0.875 mm3.
        ((slice(8, 11), slice(8, 11), slice(15, 16)), 0, 0, True),
        ((slice(8, 15), slice(8, 9), slice(15, 16)), 0, 0, False),
        # Laterally of the body.
        ((slice(48, 52), slice(14, 16), slice(12, 16)), 0, 0, False),
    ],
)
def test_the_uncus_is_large_and_medial_at_the_anterior_plane(uncus, wide, tilted, is_uncus):
    tissue = beside_the_body(uncus, wide=wide, tilted=tilted)
    assert found(tissue).any() == is_uncus
    assert found(tissue)[uncus].all() == is_uncus


def holed(cavity, opening=None):
    """A block, CA1 beside dentate gyrus, with a hole between them and a way out of the image."""
    tissue = np.zeros((16, 12, 14), dtype=np.uint8)
    tissue[:8], tissue[8:] = Tissue.CA1, Tissue.DENTATE_GYRUS
    for hole in (cavity, opening):
        if hole is not None:
            tissue[hole] = 0
    return tissue


def cavities(tissue, edge=EDGE, ends=None):
    volume = LabelVolume(
        tissue=tissue,
        part=np.zeros_like(tissue),
        affine=affine_of(edge * np.eye(3), np.array([0.0, 0.0, 0.25])),
        protocol=load_protocol("freesurferCA"),
    )
    sheet = np.where(tissue == Tissue.CA1, tissue, 0).astype(np.uint8)
    planes = ends or straight_ends(14.0 * edge)
    return tuple(
        completion.find_cavities(volume, sheet, planes, BodySettings(), second=second)
        for second in (False, True)
    )


PIT = slice(7, 9), slice(4, 6), slice(5, 7)


@pytest.mark.parametrize(
    ("depth", "edge", "count", "doubtful"),
    [
        (4, 0.5, 0, False),  # 16 of 56 voxels round it: more than a fourth
        (3, 0.5, 1, False),  # 12
        (4, 0.7, 0, True),  # 2.7 mm3, 1.14 times the limit
        (3, 0.7, 1, False),  # 1 / 1.17
    ],
)
def test_a_cavity_with_large_openings_to_the_next_slices_is_none(depth, edge, count, doubtful):
    """The next slice is open from the border of the image to above the cavity."""
    opening = slice(6, 10), slice(0, 3 + depth), 7
    first, second = cavities(holed(PIT, opening), edge)
    assert len(first.narrow) == count
    assert first.doubtful is second.doubtful is doubtful
    assert len(second.narrow) == (count ^ doubtful)
    for index in first.narrow:
        np.testing.assert_array_equal(index, np.argwhere(holed(PIT, None) == 0))


@pytest.mark.parametrize(("size", "wide", "narrow"), [(3, 0, 1), (5, 1, 0)])
def test_a_cavity_with_room_for_a_ball_is_wide(size, wide, narrow):
    """The middle of a cube of 3 or 5 voxels is 2 or 3 voxels from its walls; 0.9 mm are 1.8."""
    cube = (slice(6, 6 + size),) * 2 + (slice(5, 5 + size),)
    (first, _), (fine, _) = cavities(holed(cube), 0.31), cavities(holed(cube), 0.15)
    assert (len(first.wide), len(first.narrow)) == (wide, narrow)
    assert (len(fine.wide), len(fine.narrow)) == (0, 1)
    both = {tuple(place) for place in first.all.tolist()}
    assert both == {tuple(place) for place in np.argwhere(holed(cube) == 0).tolist()}


def test_cavities_touch_both_sides_and_lie_between_the_planes():
    assert not len(cavities(holed((slice(2, 4), *PIT[1:])))[0].all)  # amid the sheet
    assert not len(cavities(holed((slice(12, 14), *PIT[1:])))[0].all)
    assert not len(cavities(holed(PIT), ends=straight_ends(2.5))[0].all)  # voxels from 2.75 mm on
    (index,) = cavities(holed(PIT), ends=straight_ends(3.0))[0].narrow
    assert set(index[:, 2]) == {5}
