"""The mean of aligned labels."""

import numpy as np
import pytest

from hipsta_bids.extensions.visits.average import VOXEL, average_labels
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import SliceSettings
from hipsta_bids.types import LabelVolume

EDGE = 0.4
#: mm, a seventh of a voxel: distances between centers of voxels round convex shapes off.
ROUNDED = 0.06


def ball(radius, edges=(EDGE, EDGE, EDGE), shift=0.0):
    """Draw a ball in the origin, its halves of two kinds."""
    edges = np.array(edges)
    count = np.ceil(14 / edges).astype(int)
    axes = [(np.arange(n) - (n - 1) / 2) * e + shift for n, e in zip(count, edges, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    inside = x**2 + y**2 + z**2 <= radius**2
    tissue = np.where(inside, np.where(x < 0, 3, 2), 0)
    affine = np.diag([*edges, 1.0])
    affine[:3, 3] = [axis[0] for axis in axes]
    return LabelVolume(
        tissue=tissue, part=2 * inside, affine=affine, protocol=load_protocol("freesurfer")
    )


def volume_of(mean):
    return np.count_nonzero(mean.tissue) * VOXEL**3


def radius_of(mean):
    return (3 * volume_of(mean) / (4 * np.pi)) ** (1 / 3)


def average(*volumes):
    return average_labels(volumes, [np.eye(4)] * len(volumes), SliceSettings())


def test_the_mean_of_balls_has_the_mean_radius():
    assert radius_of(average(ball(4.0), ball(4.8), ball(5.0))) == pytest.approx(4.6, abs=ROUNDED)


def test_copies_keep_their_size_and_their_halves():
    drawn = ball(5.0)
    mean = average(drawn, drawn)
    assert radius_of(mean) == pytest.approx(5.0, abs=ROUNDED)
    assert set(np.unique(mean.part)) == {0, 2}
    shares = [np.count_nonzero(v.tissue == 3) / np.count_nonzero(v.tissue) for v in (drawn, mean)]
    assert shares[1] == pytest.approx(shares[0], abs=0.02)  # a third of a voxel of the border


def test_thick_slices_are_averaged_by_shape():
    offsets = [ball(5.0, (EDGE, EDGE, 2.0), shift) for shift in (0.0, 0.7, 1.3)]
    # The slices next to both poles may lack; 3 % of the radius.
    assert radius_of(average(*offsets)) == pytest.approx(5.0, abs=0.15)


def test_the_mean_lies_in_the_frame():
    motion = np.eye(4)
    motion[:3, 3] = [3.0, -2.0, 1.0]
    moved = ball(4.0)
    affine = motion @ moved.affine
    moved = LabelVolume(
        tissue=moved.tissue, part=moved.part, affine=affine, protocol=moved.protocol
    )
    mean = average_labels([ball(4.0), moved], [np.eye(4), motion], SliceSettings())
    center = np.argwhere(mean.tissue > 0).mean(axis=0) @ mean.affine[:3, :3].T + mean.affine[:3, 3]
    assert center == pytest.approx([0, 0, 0], abs=0.05)
    assert radius_of(mean) == pytest.approx(4.0, abs=ROUNDED)
