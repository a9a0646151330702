"""Rigid alignment of the labels of several visits: known motions are found again."""

from dataclasses import replace

import numpy as np
import pytest
from nibabel.affines import apply_affine
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.visits import align as alignment
from hipsta_bids.extensions.visits.align import align
from hipsta_bids.geometry.digital import voxel_points
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol

SPEC = PhantomSpec(kind="spiral", bend=0.03, variation=0.2, end_length=5.0)


def rigid(degrees, shift):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    motion[:3, 3] = shift
    return motion


def drawn(pose, voxel=(0.4, 0.4, 0.4), hemi="L"):
    return Phantom(SPEC).label_volume(
        load_protocol("freesurfer"), voxel_size=voxel, pose=pose, hemi=hemi
    )


POSES = [rigid((0, 0, 0), (0, 0, 0)), rigid((8, -5, 4), (3, -2, 1)), rigid((-4, 6, -9), (-1, 4, 2))]


def spread(motions, poses, volume):
    """Largest distance of any two motions at the labels, once the poses are undone, mm."""
    points = apply_affine(np.linalg.inv(poses[0]), voxel_points(volume.tissue > 0, volume.affine))
    local = [
        apply_affine(np.linalg.inv(motion) @ pose, points[::50])
        for motion, pose in zip(motions, poses, strict=True)
    ]
    return max(np.linalg.norm(a - b, axis=1).max() for a in local for b in local)


@pytest.fixture(scope="module")
def visits():
    return [drawn(pose) for pose in POSES]


def test_poses_are_found_again(visits):
    # A quarter of a voxel: labels are drawn anew in each pose.
    assert spread(align(visits, "L"), POSES, visits[0]) < 0.1


def test_the_right_side_is_aligned_as_the_left_one():
    visits = [drawn(pose, hemi="R") for pose in POSES[:2]]
    assert spread(align(visits, "R"), POSES[:2], visits[0]) < 0.1


def test_thick_and_thin_slices_are_aligned():
    visits = [drawn(POSES[0]), drawn(POSES[1], (0.4, 2.0, 0.4))]
    # A fifth of a slice.
    assert spread(align(visits, "L"), POSES[:2], visits[0]) < 0.4


def test_the_order_of_the_visits_does_not_matter(visits):
    forward, backward = align(visits, "L"), align(visits[::-1], "L")[::-1]
    for motion, same in zip(forward, backward, strict=True):
        # The limit of convergence.
        assert np.allclose(motion, same, atol=1e-3)


def test_the_frame_points_right_anterior_and_up_beside_the_labels():
    for hemi, side in (("L", 1.0), ("R", -1.0)):
        volume = drawn(POSES[0], hemi=hemi)
        (motion,) = align([volume], hemi)
        assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)
        # The phantom's long axis points to anterior, and the subiculum lies medially.
        assert motion[1, 1] > 0.7
        assert side * motion[0, 0] * (1 if hemi == "L" else -1) > 0


def test_visits_on_one_grid_that_hardly_move_share_a_space(visits):
    volume = visits[0]
    edited = volume.tissue.copy()
    edited[:, :, : edited.shape[2] // 2][edited[:, :, : edited.shape[2] // 2] == 3] = 0
    noisy = type(volume)(
        tissue=edited, part=volume.part, affine=volume.affine, protocol=volume.protocol
    )
    first, second = align([volume, noisy], "L", shared=True)
    assert np.array_equal(first, second)
    first, second = align([volume, volume], "L")
    assert np.array_equal(first, second)


def test_moved_visits_on_one_grid_are_aligned():
    # As a scanner that always has the same field of view.
    first, second = drawn(POSES[0]), drawn(POSES[1])
    shape = np.maximum(first.tissue.shape, second.tissue.shape)
    grids = [
        type(v)(
            tissue=np.pad(v.tissue, [(0, n) for n in shape - v.tissue.shape]),
            part=np.pad(v.part, [(0, n) for n in shape - v.part.shape]),
            affine=first.affine,
            protocol=v.protocol,
        )
        for v in (first, second)
    ]
    moved = POSES[1].copy()
    moved[:3, 3] += first.affine[:3, 3] - second.affine[:3, 3]
    assert spread(align(grids, "L"), [POSES[0], moved], first) < 0.1


def test_alignment_of_one_grid_fades_in_without_a_step(visits, monkeypatch):
    volume = visits[0]
    shifted = np.roll(volume.tissue, 1, axis=1), np.roll(volume.part, 1, axis=1)
    pair = [volume, replace(volume, tissue=shifted[0], part=shifted[1])]
    apart = []
    distances = np.arange(0.0, 0.8, 0.05)
    for distance in distances:
        monkeypatch.setattr(alignment, "_spread", lambda *_, to=distance: to)
        first, second = align(pair, "L")
        apart.append(np.linalg.norm(first[:3, 3] - second[:3, 3]))
    assert apart[0] == 0
    assert apart[-1] == pytest.approx(0.4, abs=0.05)  # the voxel
    assert np.interp(0.1, distances, apart) < 0.01
    assert 0 <= np.diff(apart).min() <= np.diff(apart).max() < 0.1  # the voxel in one step: 0.4


def test_visits_that_share_no_space_are_refused(visits):
    far = replace(visits[0], affine=rigid((0, 0, 0), (0, 30, 0)) @ visits[0].affine)
    with pytest.raises(GeometryError, match="15 mm from their mean"):
        align([visits[0], far], "L", shared=True)
    assert len(align([visits[0], far], "L")) == 2


def test_labels_without_a_hippocampus_are_refused(visits):
    volume = visits[0]
    empty = type(volume)(
        tissue=np.zeros_like(volume.tissue),
        part=volume.part,
        affine=volume.affine,
        protocol=volume.protocol,
    )
    with pytest.raises(GeometryError, match="no voxel of the hippocampus"):
        align([volume, empty], "L")
