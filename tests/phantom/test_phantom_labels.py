"""Drawing: which voxel gets which label, on any grid, in any protocol."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.errors import ProtocolError, SettingsError
from hipsta_bids.phantom import KINDS, Phantom, PhantomSpec, encode, rigid_motion
from hipsta_bids.phantom.labels import label_for, subfield_at
from hipsta_bids.protocols.load import load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Part, Tissue, translate
from hipsta_bids.types import LabelVolume

SMALL = PhantomSpec(length=8.0, end_length=2.0)
COARSE = (0.6, 0.6, 0.6)
FREESURFER = load_protocol("freesurfer")
MEASURABLE = [name for name in protocol_names() if not load_protocol(name).refused]
SHEET_SCHEMES = [name for name in protocol_names() if load_protocol(name).sheet]


@pytest.fixture(scope="module")
def phantom():
    return Phantom(SMALL)


def voxels(volume):
    """Labeled voxels: their centers (N, 3) in RAS mm, sorted, with tissue and part."""
    index = np.argwhere(volume.tissue)
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    points = np.round(points, 6) + 0.0  # mm; the same center by another way differs by 1e-14
    order = np.lexsort(points.T)
    at = tuple(index[order].T)
    return points[order], volume.tissue[at], volume.part[at]


def assert_same_voxels(volume, other):
    for a, b in zip(voxels(volume), voxels(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", MEASURABLE)
def test_codes_translate_to_the_volume(phantom, name):
    protocol = load_protocol(name)
    volume = phantom.label_volume(protocol, voxel_size=COARSE)
    tissue, part = translate(encode(volume), protocol)
    np.testing.assert_array_equal(tissue, volume.tissue)
    np.testing.assert_array_equal(part, volume.part)


@pytest.mark.parametrize("name", SHEET_SCHEMES)
def test_each_protocol_shows_its_whole_sheet_and_an_interior(phantom, name):
    protocol = load_protocol(name)
    found = set(np.unique(phantom.label_volume(protocol, voxel_size=COARSE).tissue))
    assert found >= set(protocol.sheet)
    assert found & set(protocol.interior)


@pytest.mark.parametrize("kind", KINDS)
def test_labels_lie_where_the_sheet_says(kind):
    phantom = Phantom(replace(SMALL, kind=kind, bend=0.02, variation=0.2))
    points, tissue, part = voxels(phantom.label_volume(FREESURFER, voxel_size=COARSE))
    u, v, n = phantom.body.locate(points).T
    half = phantom.body.thickness(u, v) / 2.0
    np.testing.assert_array_equal(part == Part.HEAD, v > 1.0)
    np.testing.assert_array_equal(part == Part.TAIL, v < 0.0)
    sheet = np.isin(tissue, FREESURFER.sheet)
    wall = np.abs(n) <= half
    np.testing.assert_array_equal(sheet, wall & (part != Part.TAIL))
    merged = np.where(subfield_at(u) >= Tissue.CA2, Tissue.CA2_3, subfield_at(u))
    np.testing.assert_array_equal(tissue[sheet], merged[sheet])
    inner = ~wall
    assert (n[inner] < 0.0).all()
    assert (u[inner] >= SMALL.interior_start).all()
    assert (-n - half)[inner].max() <= SMALL.interior_depth


def test_every_voxel_of_the_wall_is_labeled(phantom):
    volume = phantom.label_volume(FREESURFER, voxel_size=COARSE)
    index = np.indices(volume.tissue.shape).reshape(3, -1).T
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    u, v, n = phantom.body.locate(points).T
    inside = (np.abs(n) <= phantom.body.thickness(u, v) / 2.0) & (v >= 0.0) & (v <= 1.0)
    labeled = np.isin(volume.tissue, FREESURFER.sheet) & (volume.part == Part.BODY)
    np.testing.assert_array_equal(labeled.ravel(), inside)


def test_the_border_is_background(phantom):
    volume = phantom.label_volume(FREESURFER, voxel_size=COARSE, border=3.0)
    index = np.argwhere(volume.tissue)
    assert (index.min(axis=0) >= 4).all()  # 3 mm are 5 voxels; one for rounding outwards
    assert (index.max(axis=0) <= np.array(volume.tissue.shape) - 5).all()


@pytest.mark.parametrize("axes", ["LIA", "PSR", "SAL"])
def test_axis_order_and_direction_change_nothing_in_space(phantom, axes):
    turned = phantom.label_volume(FREESURFER, voxel_size=COARSE, axes=axes)
    assert_same_voxels(turned, phantom.label_volume(FREESURFER, voxel_size=COARSE))
    letters = ["RL".index, "AP".index, "SI".index]
    signs = [np.sign(turned.affine[i % 3, :3].sum()) for i in range(3)]
    for i, position in enumerate(letters):
        letter = next(x for x in axes if x in ("RL", "AP", "SI")[i])
        assert signs[i] == 1 - 2 * position(letter)


def test_right_hemisphere_is_the_mirror_image(phantom):
    left, right = (phantom.label_volume(FREESURFER, voxel_size=COARSE, hemi=hemi) for hemi in "LR")
    flipped = np.diag([-1.0, 1.0, 1.0, 1.0]) @ right.affine
    mirrored = LabelVolume(
        tissue=right.tissue, part=right.part, affine=flipped, protocol=right.protocol
    )
    assert_same_voxels(mirrored, left)


def test_whole_voxel_shift_moves_the_labels_along(phantom):
    shift = np.array([1.2, -1.8, 0.6])
    moved = phantom.label_volume(
        FREESURFER, voxel_size=COARSE, pose=rigid_motion((0.0, 0.0, 0.0), tuple(shift))
    )
    still = phantom.label_volume(FREESURFER, voxel_size=COARSE)
    np.testing.assert_array_equal(moved.tissue, still.tissue)
    np.testing.assert_allclose(moved.affine[:3, 3], still.affine[:3, 3] + shift, atol=1e-9)


def test_part_voxel_shift_changes_the_voxels(phantom):
    moved = phantom.label_volume(
        FREESURFER, voxel_size=COARSE, pose=rigid_motion((0.0, 0.0, 0.0), (0.3, 0.3, 0.3))
    )
    still = phantom.label_volume(FREESURFER, voxel_size=COARSE)
    assert not np.array_equal(voxels(moved)[0] - 0.3, voxels(still)[0])


def test_turning_grid_and_phantom_together_changes_nothing(phantom):
    pose = rigid_motion((10.0, 25.0, -40.0), (0.0, 0.0, 0.0))
    turned = phantom.label_volume(
        FREESURFER, voxel_size=COARSE, pose=pose, grid_rotation=pose[:3, :3]
    )
    still = phantom.label_volume(FREESURFER, voxel_size=COARSE)
    np.testing.assert_array_equal(turned.tissue, still.tissue)
    np.testing.assert_allclose(turned.affine, pose @ still.affine, atol=1e-9)  # mm, rounding


def test_thick_slices_have_the_voxel_size_asked_for(phantom):
    volume = phantom.label_volume(FREESURFER, voxel_size=(0.4, 0.5, 2.0), axes="LIA")
    np.testing.assert_allclose(np.linalg.norm(volume.affine[:3, :3], axis=0), [0.4, 0.5, 2.0])
    body = np.isin(volume.tissue, FREESURFER.sheet) & (volume.part == Part.BODY)
    # Four slices through an 8 mm body, tilted against them: a tenth is the scatter of its ends.
    assert body.sum() * 0.4 == pytest.approx(phantom.truth(0.5, 0.5).summary["volume"], rel=0.1)


def test_supersampling_takes_the_majority(phantom):
    """A voxel's 3 x 3 x 3 votes are the centers of a lattice three times finer."""
    size = 0.6
    coarse = phantom.label_volume(FREESURFER, voxel_size=(size,) * 3, supersample=3, border=0.6)
    fine = phantom.label_volume(FREESURFER, voxel_size=(size / 3,) * 3, border=1.6)
    codes = encode(fine)
    offset = (coarse.affine[:3, 3] - fine.affine[:3, 3]) / (size / 3) - 1.0  # its first vote
    start = np.rint(offset).astype(int)
    shape = np.array(coarse.tissue.shape)
    low, high = np.maximum(start, 0), start + 3 * shape
    assert (low == start).all()
    assert (high <= codes.shape).all()
    block = codes[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    votes = block.reshape(shape[0], 3, shape[1], 3, shape[2], 3)
    votes = votes.transpose(0, 2, 4, 1, 3, 5).reshape(-1, 27)
    wanted = encode(coarse).ravel()
    counts = (votes == wanted[:, None]).sum(axis=1)
    best = np.max([(votes == code).sum(axis=1) for code in np.unique(codes)], axis=0)
    np.testing.assert_array_equal(counts, best)  # nothing has more votes than what was chosen
    centers = phantom.label_volume(FREESURFER, voxel_size=(size,) * 3, border=0.6)
    assert not np.array_equal(encode(centers), encode(coarse))


def test_supersampling_may_differ_by_axis(phantom):
    volume = phantom.label_volume(FREESURFER, voxel_size=(0.6, 0.6, 2.0), supersample=(1, 1, 5))
    plain = phantom.label_volume(FREESURFER, voxel_size=(0.6, 0.6, 2.0))
    assert not np.array_equal(volume.tissue, plain.tissue)


def test_molecular_layer_is_the_inner_part_of_the_same_wall():
    bare, layered = Phantom(SMALL), Phantom(replace(SMALL, layer_thickness=0.5))
    points, tissue, part = voxels(layered.label_volume(FREESURFER, voxel_size=COARSE))
    n = layered.body.locate(points)[:, 2]
    layer = tissue == Tissue.MOLECULAR_LAYER
    inner = (n >= -1.0) & (n < -0.5) & (part != Part.TAIL)
    np.testing.assert_array_equal(layer, inner)
    whole, _, _ = voxels(bare.label_volume(FREESURFER, voxel_size=COARSE))
    np.testing.assert_array_equal(points, whole)
    assert layered.truth(0.5, 0.5).summary == bare.truth(0.5, 0.5).summary


@pytest.mark.parametrize("name", ["ashsPMC", "hippunfold"])
def test_protocol_without_molecular_layer_in_its_sheet_keeps_the_subfields(name):
    protocol = load_protocol(name)
    bare, layered = Phantom(SMALL), Phantom(replace(SMALL, layer_thickness=0.5))
    assert_same_voxels(
        layered.label_volume(protocol, voxel_size=COARSE),
        bare.label_volume(protocol, voxel_size=COARSE),
    )


def test_without_head_and_tail_labels_ca2_and_ca3_end_with_the_body(phantom):
    volume = phantom.label_volume(load_protocol("ashsPMC"), voxel_size=COARSE)
    points, tissue, _ = voxels(volume)
    v = phantom.body.locate(points)[:, 1]
    lateral = np.isin(tissue, [Tissue.CA2, Tissue.CA3])
    assert v[lateral].min() >= 0.0
    assert v[lateral].max() <= 1.0
    assert v[tissue == Tissue.CA1].min() < -0.2  # CA1 goes on, 2 of 8 mm
    assert v[tissue == Tissue.CA1].max() > 1.2


def test_a_label_for_the_tissue_and_part_comes_first():
    assert label_for(FREESURFER, Tissue.CA1, Part.HEAD).part is Part.HEAD
    assert label_for(FREESURFER, Tissue.CA1, Part.TAIL).tissue is Tissue.HIPPOCAMPUS
    assert label_for(FREESURFER, Tissue.CA2, Part.BODY).tissue is Tissue.CA2_3
    assert label_for(load_protocol("ashsPMC"), Tissue.CA3, Part.HEAD) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": "RAR"}, "axes 'RAR' must name each direction once"),
        ({"axes": "RA"}, "axes 'RA' must name"),
        ({"axes": "XYZ"}, "axes 'XYZ' must name"),
        ({"voxel_size": (0.4, 0.0, 0.4)}, "must be positive"),
        ({"grid_rotation": 2.0 * np.eye(3)}, "not rigid"),
        ({"supersample": 0}, "supersample must be 1 or more"),
        ({"hemi": "left"}, "hemi 'left' is unknown"),
    ],
)
def test_senseless_grids_are_refused(phantom, options, message):
    with pytest.raises(SettingsError, match=message):
        phantom.label_volume(FREESURFER, **options)


def test_protocol_with_too_few_subfields_is_refused(phantom):
    few = tuple(label for label in FREESURFER.labels if label.tissue is not Tissue.CA1)
    with pytest.raises(ProtocolError, match="no label for some subfield"):
        phantom.label_volume(FREESURFER.model_copy(update={"labels": few}), voxel_size=COARSE)


def test_a_volume_is_not_written_in_a_protocol_that_cannot_say_it(phantom):
    volume = phantom.label_volume(FREESURFER, voxel_size=COARSE)
    other = replace(volume, protocol=load_protocol("ashsPMC"))
    with pytest.raises(ProtocolError, match="protocol ashsPMC has no code for some tissues"):
        encode(other)
