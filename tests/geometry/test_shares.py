"""Walls from shares of voxels: where they lie, what labels still decide, and how soft walls are."""

from dataclasses import replace

import numpy as np
import pytest
from extension_marks import needs
from scipy import ndimage
from scipy.stats import norm

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.shares import sheet_share, softness, wall_sd
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import LabelVolume
from validation import cases

PROTOCOL = load_protocol("freesurfer")
SPEC = PhantomSpec(kind="arc", thickness=1.8, variation=0.2)
POSE = cases.any_pose(np.random.default_rng(5))
SUBICULUM, LAYER, GYRUS = Tissue.SUBICULUM, Tissue.MOLECULAR_LAYER, Tissue.DENTATE_GYRUS


def half_space(direction, offset, count=24, points=5):
    """Compute the share of each voxel below a plane."""
    steps = (np.arange(points) + 0.5) / points - 0.5
    fine = np.stack(np.meshgrid(*([steps] * 3), indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.indices((count,) * 3).reshape(3, -1).T - count / 2
    below = (index[:, None] + fine) @ direction < offset
    return below.mean(axis=1).reshape((count,) * 3).astype(np.float32)


@pytest.mark.parametrize("direction", [(1, 0, 0), (1, 1, 0), (1, 1, 1), (3, 2, 1)])
def test_true_shares_are_soft_and_labels_are_not(direction):
    unit = np.array(direction) / np.linalg.norm(direction)
    middle = (slice(10, 14),) * 3
    # Over offsets, since a wall between voxels along their edges is the same in both.
    soft = [softness(half_space(unit, d), np.full(3, 2.0))[middle] for d in (0.1, 0.3, 0.5, 0.7)]
    assert np.mean(soft) == pytest.approx(1.0, abs=0.15)
    labels = half_space(unit, 0.3) > 0.5
    assert np.abs(softness(labels.astype(np.float32), np.full(3, 2.0))).max() < 1e-6


@pytest.mark.parametrize("direction", [(0, 0, 1), (1, 1, 0), (3, 2, 1)])
@pytest.mark.parametrize("sd", [0.0, 0.2, 0.45])
def test_the_width_of_a_thin_wall_is_the_sd_of_its_place(direction, sd):
    edges = np.full(3, 0.4)
    depth = np.indices((36, 36, 36)).reshape(3, -1).T @ direction / np.linalg.norm(direction) * 0.4
    steps = np.linspace(-0.18, 0.18, 9)  # of voxels along the normal
    near = 0.9 - np.abs(depth - depth.mean())[:, None] + steps
    share = np.mean(near > 0 if sd == 0 else norm.cdf(near / sd), axis=1).reshape(36, 36, 36)
    width = wall_sd(share.astype(np.float32), edges)[16:20, 16:20, 16:20]
    assert np.mean(width) == pytest.approx(sd, abs=0.13 if sd == 0 else 0.03)


def block(shares):
    """Make a slab of subiculum, 5 voxels thick, below a molecular layer and the dentate gyrus."""
    tissue = np.zeros((12, 12, 14), dtype=np.uint8)
    tissue[2:10, 2:10, 3:8] = SUBICULUM
    tissue[2:10, 2:10, 8] = LAYER
    tissue[2:10, 2:10, 9:12] = GYRUS
    full = {kind: (tissue == kind).astype(np.float32) for kind in (SUBICULUM, LAYER, GYRUS)}
    return LabelVolume(
        tissue=tissue,
        part=(tissue > 0).astype(np.uint8),
        affine=np.eye(4),
        protocol=PROTOCOL,
        shares=full | shares(full),
    )


def test_the_layer_that_was_handed_over_carries_its_share():
    def shares(full):
        layer = full[LAYER].copy()
        layer[2:10, 2:10, 8] = 0.7
        layer[2:10, 2:10, 9] = 0.2
        return {LAYER: layer}

    volume = block(shares)
    with_layer = np.isin(volume.tissue, (SUBICULUM, LAYER))
    values = sheet_share(volume, with_layer, (SUBICULUM,)).values
    np.testing.assert_allclose(values[5, 5, 6:12], [1, 1, 0.7, 0.2, 0, 0], atol=1e-6)
    alone = sheet_share(volume, volume.tissue == SUBICULUM, (SUBICULUM,)).values
    np.testing.assert_allclose(alone[5, 5, 6:12], [1, 1, 0, 0, 0, 0], atol=1e-6)


def test_the_layer_counts_in_voxels_of_the_sheet_beside_it():
    def shares(full):
        full[SUBICULUM][2, 2:10, 7], full[LAYER][2, 2:10, 7] = 0.6, 0.4
        return {}

    volume = block(shares)
    with_layer = np.isin(volume.tissue, (SUBICULUM, LAYER))
    values = sheet_share(volume, with_layer, (SUBICULUM,)).values
    np.testing.assert_allclose(values[2, 5, 6:9], 1, atol=1e-6)
    alone = sheet_share(volume, volume.tissue == SUBICULUM, (SUBICULUM,)).values
    np.testing.assert_allclose(alone[2, 5, 6:9], [1, 0.6, 0], atol=1e-6)


def test_a_tail_label_is_divided_like_the_other_labels_of_the_voxel():
    def shares(full):
        tail = np.zeros_like(full[SUBICULUM])
        wall, deep = (2, slice(2, 10), 3), (slice(3, 9), slice(3, 9), 3)
        full[SUBICULUM][wall], tail[wall] = 0.3, 0.2  # half of the voxel is background
        full[SUBICULUM][deep], tail[deep] = 0.6, 0.4
        tail[2:10, 2:10, 2], full[SUBICULUM][2:10, 2:10, 2] = 0.8, 0.2
        return {Tissue.HIPPOCAMPUS: tail}

    volume = block(shares)
    values = sheet_share(volume, volume.tissue == SUBICULUM, (SUBICULUM,)).values
    np.testing.assert_allclose(values[2:5, 5, 3], [0.5, 1, 1], atol=1e-6)
    assert values[5, 5, 2] == pytest.approx(0.2)  # most of the voxel is tail


def test_shares_of_a_tail_label_do_not_switch():
    def part(tail):
        def shares(full):
            wall = (2, slice(2, 10), 3)
            full[SUBICULUM][wall] = 1 - tail
            return {Tissue.HIPPOCAMPUS: np.where(full[SUBICULUM] == 1 - tail, tail, 0)}

        volume = block(shares)
        return sheet_share(volume, volume.tissue == SUBICULUM, (SUBICULUM,)).values[2, 5, 3]

    parts = np.array([part(np.float32(tail)) for tail in np.arange(0.3, 0.7, 0.01)])
    assert parts[0] == pytest.approx(1.0)
    assert parts[-1] == pytest.approx(0.31)
    assert np.abs(np.diff(parts)).max() < 0.07  # a switch at a half would make it 0.5


def test_labels_decide_what_is_filled_taken_out_and_deep():
    def shares(full):
        share = full[SUBICULUM].copy()
        share[5, 5, 5] = 0.1  # deep inside
        share[2:10, 2:10, 0] = 0.9  # far outside
        share[2:10, 2:10, 2] = 0.4
        return {SUBICULUM: share}

    volume = block(shares)
    body = volume.tissue == SUBICULUM
    body[2, 2:10, 3:8] = False  # as of an uncus
    body[3:10, 3, 2] = True  # as of a slit
    values, unlike = sheet_share(volume, body, (SUBICULUM,))
    assert values[5, 5, 5] == 1
    assert values[5, 6, 0] == 0
    assert values[5, 6, 2] == pytest.approx(0.4)
    assert (values[2, 2:10, 4:8] == 0).all()
    assert (values[3:10, 3, 2] == 1).all()
    assert [5, 5, 5] in unlike.tolist()
    assert [5, 6, 0] in unlike.tolist()


@pytest.fixture(scope="module")
def volume():
    return Phantom(SPEC).label_volume(PROTOCOL, pose=POSE, axes="LIA", supersample=3)


def error(volume):
    case = cases.Case(spec=SPEC, pose=POSE)
    maps = cases.measure_body(volume, "L")
    errors = cases.without_edges(cases.compare(Phantom(SPEC), case, maps).error)
    return maps, errors[np.isfinite(errors)]


@pytest.mark.slow
def test_shares_halve_the_error_and_certain_ones_change_nothing(volume):
    maps, binary = error(replace(volume, shares={}))
    _, soft = error(volume)
    assert soft.std() < 0.5 * binary.std()
    assert abs(soft.mean()) < 0.01
    certain = {kind: (volume.tissue == kind).astype(np.float32) for kind in volume.shares}
    again, _ = error(replace(volume, shares=certain))
    np.testing.assert_allclose(again.thickness, maps.thickness, atol=1e-6)
    np.testing.assert_array_equal(again.subfield, maps.subfield)


@pytest.mark.slow
def test_probabilities_that_contradict_labels_are_flagged(volume):
    moved = {kind: np.roll(share, 4, axis=0) for kind, share in volume.shares.items()}
    maps = cases.measure_body(replace(volume, shares=moved), "L")
    assert "probabilities-unlike" in {flag.reason for flag in maps.flags}


@pytest.mark.slow
@needs("uncertainty")
def test_copies_move_more_where_probabilities_are_broad(volume):
    from hipsta_bids.extensions.uncertainty.copies import estimate_uncertainty  # noqa: PLC0415  (may be absent)

    broad = {kind: ndimage.gaussian_filter(share, 1.0) for kind, share in volume.shares.items()}
    spreads = [
        estimate_uncertainty(replace(volume, shares=shares), "L", Settings(), 3).maps["thickness"]
        for shares in (volume.shares, broad)
    ]
    sharp, wide = (float(np.nanmedian(spread)) for spread in spreads)
    assert wide > 2 * sharp


@needs("uncertainty")
def test_copies_have_shares(volume):
    from hipsta_bids.extensions.uncertainty.copies import perturb  # noqa: PLC0415  (may be absent)

    ends = extract_body(volume, Settings().body).ends
    copy = perturb(volume, ends, Settings().uncertainty, 0)
    assert copy.shares.keys() == volume.shares.keys()
    np.testing.assert_allclose(sum(copy.shares.values()), 1, atol=1e-5)
    likeliest = np.array([*copy.shares])[np.argmax([*copy.shares.values()], axis=0)]
    assert (likeliest == copy.tissue).mean() > 0.98
