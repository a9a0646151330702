"""Labels are refused or flagged before anything is meshed: tissues, volumes, axes."""

from dataclasses import replace
from pathlib import Path
from time import process_time

import nibabel as nib
import numpy as np
import pytest
from geometry_cases import short_phantom
from scipy.spatial.transform import Rotation

from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode, GeometryError
from hipsta_bids.geometry import label_checks
from hipsta_bids.geometry.label_checks import check_label_image, naming_causes, note_labels
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.phantom import (
    KINDS,
    Hemisphere,
    Phantom,
    PhantomSpec,
    Thinning,
    rigid_motion,
    write_dataset,
)
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import CORE, Part, Tissue
from hipsta_bids.settings import CheckSettings
from validation.cases import hippunfold_beside, segmentations

FREESURFER, CHECKS = load_protocol("freesurfer"), CheckSettings()
DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "cobralab"

#: Signs of the axes right, anterior and superior.
FLIPS = {
    "AP": (1, -1, 1),
    "SI": (1, 1, -1),
    "LR": (-1, 1, 1),
    "AP+SI": (1, -1, -1),
    "AP+LR": (-1, -1, 1),
    "SI+LR": (-1, 1, -1),
    "all": (-1, -1, -1),
}
MIRRORS = {name: signs for name, signs in FLIPS.items() if np.prod(signs) < 0}


def moved(volume, matrix):
    """The same voxels with an affine that was multiplied by a matrix (3, 3)."""
    affine = np.eye(4)
    affine[:3, :3] = matrix
    return replace(volume, affine=affine @ volume.affine)


def flags(volume, hemi="L"):
    return {found.reason for found in check_label_image(volume, hemi, CHECKS) if found.raised}


def verdict(volume, hemi="L"):
    """The reasons of flags, or that of the refusal."""
    try:
        return flags(volume, hemi)
    except GeometryError as error:
        return {error.reason}


@pytest.fixture(scope="module")
def body():
    return short_phantom().label_volume(FREESURFER)


@pytest.fixture(scope="module")
def hippocampus():
    """A spiral that bows laterally, with a thin tail, as real ones have."""
    thin = Thinning(depth=0.8, u=(-1.0, 2.0), v=(-1.0, 0.45))
    spec = PhantomSpec(length=24.0, bend=0.06, thickness=2.2, thinnings=(thin,))
    volume = Phantom(spec).label_volume(FREESURFER, voxel_size=(0.5, 0.5, 0.5))
    index = np.argwhere(volume.tissue > 0)
    y = (index @ volume.affine[:3, :3].T)[:, 1]
    tail = np.zeros(volume.tissue.shape, dtype=bool)
    tail[tuple(index[y < np.median(y)].T)] = True
    tissue = np.where(tail & np.isin(volume.tissue, CORE), 0, volume.tissue)
    return replace(volume, tissue=tissue, part=np.where(tissue > 0, volume.part, 0))


def unlabeled(volume):
    """Without labels of head and tail."""
    return replace(volume, part=np.where(volume.tissue > 0, Part.BODY, 0))


@pytest.mark.parametrize(
    ("absent", "name"),
    [
        ((Tissue.SUBICULUM,), "SUBICULUM"),
        ((Tissue.CA1,), "CA1"),
        ((Tissue.CA2_3,), "CA2_3"),
        ((Tissue.SUBICULUM, Tissue.CA1), "SUBICULUM, CA1"),
    ],
)
def test_an_image_without_a_tissue_of_the_sheet_is_refused(body, absent, name):
    volume = replace(body, tissue=np.where(np.isin(body.tissue, absent), 0, body.tissue))
    with pytest.raises(GeometryError, match=f"no label of {name}, needed by") as caught:
        check_label_image(volume, "L", CHECKS)
    assert caught.value.reason == "tissue-missing"


@pytest.mark.parametrize("absent", [Tissue.PRESUBICULUM, Tissue.CA2, Tissue.CA3])
def test_some_brains_have_no_label_of_a_subfield_at_an_end(absent):
    """Of CA2 and CA3 one is enough; the presubiculum is missing in labels that other tools made."""
    name = "freesurfer" if absent is Tissue.PRESUBICULUM else "ashsABC3T"
    volume = short_phantom().label_volume(load_protocol(name))
    assert (volume.tissue == absent).any()
    assert (
        flags(replace(volume, tissue=np.where(volume.tissue == absent, 0, volume.tissue))) == set()
    )


def test_coarse_voxels_are_refused_first(body):
    assert verdict(moved(body, 4 * np.eye(3))) == {"sheet-too-thin"}


@pytest.mark.parametrize(("scale", "possible"), [(0.15, False), (0.6, True), (1.4, True)])
def test_volumes_that_nobody_has_are_flagged(body, scale, possible):
    """As of a header in other units: the phantom has 700 mm3."""
    assert (verdict(moved(body, scale * np.eye(3))) == set()) is possible


def cut(volume, sides):
    """Crop an image on sides of its labels, by index."""
    index = np.argwhere(volume.tissue > 0)
    low, high = index.min(axis=0), index.max(axis=0) + 1
    box = tuple(
        slice(low[k] + sides.get((k, 0), -1), high[k] - sides.get((k, 1), -1)) for k in range(3)
    )
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ [side.start for side in box]
    return replace(volume, tissue=volume.tissue[box], part=volume.part[box], affine=affine)


@pytest.mark.parametrize(
    ("sides", "signs", "names"),
    [
        ({}, (1, 1, 1), ""),
        ({(0, 0): 0}, (1, 1, 1), "left"),
        ({(0, 1): 0}, (1, 1, 1), "right"),
        ({(0, 1): 0}, (-1, 1, 1), "left"),
        ({(2, 0): 4}, (1, 1, -1), "superior"),
        ({(1, 1): 4, (2, 0): 2}, (1, 1, 1), "anterior and inferior"),
    ],
)
def test_a_refusal_names_the_border_that_may_cut_the_labels(body, sides, signs, names):
    assert nib.aff2axcodes(body.affine) == ("R", "A", "S")
    volume = moved(cut(body, sides), np.diag(signs))
    lacking = replace(volume, tissue=np.where(volume.tissue == Tissue.CA1, 0, volume.tissue))
    with pytest.raises(GeometryError, match="needed by the") as caught, naming_causes(volume):
        check_label_image(lacking, "L", CHECKS)
    assert caught.value.reason == "tissue-missing"
    start = f"the labels touch the {names} border of the image (if" if names else "no label of CA1"
    assert str(caught.value).startswith(start)


def test_a_refusal_names_an_impossible_volume(body):
    """As of a header in other units; coarse voxels are no consequence of a cut."""
    volume = moved(cut(body, {(0, 0): 0}), 5 * np.eye(3))
    with pytest.raises(GeometryError, match="are too coarse") as caught, naming_causes(volume):
        check_label_image(volume, "L", CHECKS)
    assert str(caught.value).startswith("the hippocampus labels have ")
    assert "check the voxel size and its unit" in str(caught.value)
    assert "border" not in str(caught.value)


def test_large_volumes_are_flagged():
    volume = Phantom(PhantomSpec(length=40.0, width=40.0, thickness=5.0, kind="slab"))
    labels = volume.label_volume(FREESURFER, voxel_size=(0.8, 0.8, 0.8))
    assert flags(labels) == {"volume-implausible"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("hemi", ["L", "R"])
def test_phantoms_in_any_position_pass(kind, hemi):
    phantom = short_phantom(kind=kind, curvature=None, width=16.0)
    volume = phantom.label_volume(FREESURFER, hemi=hemi, voxel_size=(0.5, 0.5, 0.5))
    for number in range(10):
        turn = Rotation.random(random_state=number).as_matrix()
        assert flags(moved(volume, turn), hemi) == set()


@pytest.mark.parametrize("flip", MIRRORS)
@pytest.mark.parametrize("kind", ["arc", "spiral", "tight"])
def test_mirror_images_are_refused(flip, kind):
    volume = short_phantom(kind=kind, curvature=None).label_volume(FREESURFER)
    assert flags(volume) == set()
    found = verdict(moved(volume, np.diag(MIRRORS[flip])))
    assert found == {"left-right-swapped" if MIRRORS[flip][0] < 0 else "axis-flipped"}


def test_one_line_says_what_to_check(body):
    with pytest.raises(GeometryError, match="is a mirror image; check the directions of the axes"):
        check_label_image(moved(body, np.diag(FLIPS["AP"])), "L", CHECKS)
    with pytest.raises(GeometryError, match="labeled right, but the subiculum lies"):
        check_label_image(body, "R", CHECKS)


def test_swapped_labels_of_head_and_tail_are_refused(body):
    part = np.select([body.part == Part.HEAD, body.part == Part.TAIL], [Part.TAIL, Part.HEAD], 2)
    assert verdict(replace(body, part=np.where(body.tissue > 0, part, 0))) == {"axis-flipped"}


def test_labels_in_the_wrong_order_are_no_mirror_image(body):
    tissue = np.select(
        [body.tissue == Tissue.CA1, body.tissue == Tissue.CA2_3],
        [Tissue.CA2_3, Tissue.CA1],
        body.tissue,
    )
    assert flags(replace(body, tissue=tissue)) == set()  # a later check refuses them


@pytest.mark.parametrize("flip", FLIPS)
@pytest.mark.parametrize("labeled", [True, False])
@pytest.mark.parametrize("degrees", [(0, 0, 0), (25, 0, 0), (0, -25, 0), (0, 0, 25)])
def test_any_flip_of_a_whole_hippocampus_is_noticed(hippocampus, flip, labeled, degrees):
    volume = hippocampus if labeled else unlabeled(hippocampus)
    turned = moved(volume, rigid_motion(degrees, (0, 0, 0))[:3, :3])
    assert flags(turned) == set()
    found = verdict(moved(turned, np.diag(FLIPS[flip])))
    if flip in MIRRORS or (not labeled and flip.startswith("AP")):
        assert found <= {"axis-flipped", "left-right-swapped"}  # the map would be wrong
        assert found
    else:
        assert found == {"position-doubtful"}  # the map is right


def test_what_is_cut_short_does_not_tell_its_direction(hippocampus):
    """A body alone has no head that could lie posterior."""
    y = np.indices(hippocampus.tissue.shape)
    share = np.tensordot(hippocampus.affine[1, :3], y, 1)
    middle = np.abs(share - np.median(share[hippocampus.tissue > 0])) < 5.0
    volume = unlabeled(replace(hippocampus, tissue=np.where(middle, hippocampus.tissue, 0)))
    assert flags(volume) == set()


@pytest.mark.parametrize(("hemi", "other", "sign"), [("L", "right", 1), ("R", "left", -1)])
def test_a_hemisphere_far_on_the_other_side_of_the_origin_is_noted(body, hemi, other, sign):
    """As 31 mm to the right for the left one; a head 30 mm aside is possible."""

    def at(right):
        affine = body.affine.copy()
        middle = affine[0, :3] @ np.argwhere(body.tissue > 0).mean(axis=0)
        affine[0, 3] = sign * right - middle
        return note_labels(replace(body, affine=affine), hemi)

    (note,) = at(31.0)
    assert f"31 mm to the {other} of the origin" in note
    assert at(5.0) == at(-25.0) == []


def test_subfields_without_a_label_are_noted(body):
    assert note_labels(body, "L") == []
    lacking = np.isin(body.tissue, [Tissue.PRESUBICULUM])
    assert lacking.any()
    (note,) = note_labels(replace(body, tissue=np.where(lacking, 0, body.tissue)), "L")
    assert note == "no label of PRESUBICULUM; the sheet has the other subfields"


def test_few_voxels_decide_nothing(body):
    """Of CA2 and CA3, and of what the sheet curls round."""
    tissue = body.tissue.copy()
    for kinds in ((Tissue.CA2_3,), CORE):
        index = np.argwhere(np.isin(tissue, kinds))
        tissue[tuple(index[40:].T)] = 0
    mirrored = moved(replace(body, tissue=tissue), np.diag(FLIPS["SI"]))
    assert "axis-flipped" not in verdict(mirrored)


def real():
    items = segmentations(DATA, DATA.parent / "cobralab-revised", *hippunfold_beside(DATA))
    return [(read_label_volume(item), item.hemi) for item in items]


@pytest.mark.long
@pytest.mark.skipif(not DATA.is_dir(), reason="shared test data not found")
def test_flips_of_real_labels_are_noticed_and_rotations_are_not():
    random = np.random.default_rng(5)
    for number, (volume, hemi) in enumerate(real()):
        start = process_time()
        assert flags(volume, hemi) == set()
        assert process_time() - start < 1.0  # s, as promised; 0.1 s are usual
        # Two with labels of head and tail, then two without.
        part = np.zeros_like(volume.part) if number // 2 % 2 else volume.part
        axis = random.standard_normal(3)
        turn = Rotation.from_rotvec(np.radians(30) * axis / np.linalg.norm(axis))
        turned = moved(replace(volume, part=part), turn.as_matrix())
        assert flags(turned, hemi) == set()
        for signs in FLIPS.values():
            assert verdict(moved(turned, np.diag(signs)), hemi)


@pytest.mark.slow
def test_a_dry_run_says_what_is_wrong(tmp_path, capsys):
    spec = PhantomSpec(kind="arc", length=8.0, width=12.0)
    hemispheres = [Hemisphere(subject="01", hemi=hemi, spec=spec) for hemi in "LR"]
    write_dataset(tmp_path / "bids", hemispheres, voxel_size=(0.5, 0.5, 0.5))
    (file,) = (tmp_path / "bids").rglob("lh.*.mgz")
    image = nib.load(file)
    codes = np.asarray(image.dataobj)
    flipped = image.affine @ np.diag([1, 1, 1, 1.0])
    flipped[1] *= -1
    nib.save(nib.MGHImage(codes, flipped), file)
    command = [str(tmp_path / "bids"), str(tmp_path / "out"), "participant", "--dry-run"]
    assert main.main(command) == ExitCode.OK
    *_, line, last = capsys.readouterr().out.splitlines()
    assert line.startswith("sub-01 L freesurfer, will be refused: the order of subiculum")
    assert last == "labels of 2 hemispheres checked, problems in 1"
    assert not (tmp_path / "out").exists()


def test_winding_of_three_groups_is_that_of_their_triangle():
    """4 3^0.5 area / sum of squared edges, seen along z; NaN if that is nearly edge-on."""
    spread = np.random.default_rng(1).normal(size=(50, 3))
    spread -= spread.mean(axis=0)
    for first, second, third, wanted in (
        ([0, 0, 0], [2, 0, 0], [1, 3**0.5, 0], 1.0),
        ([2, 0, 0], [0, 0, 0], [1, 3**0.5, 0], -1.0),
        ([0, 0, 5], [3, 0, 5], [0, 3, 5], 0.75**0.5),
        ([0, 0, 0], [1, 0, 0], [3, 0, 0], 0.0),
        ([0, 0, 0], [1, 0, 2.4], [0, 1, 0], np.nan),
        ([0, 0, 0], [1, 0, 2.2], [0, 1, 0], 2 * 3**0.5 / (2 * 4.84 + 4)),
    ):
        groups = [corner + spread for corner in (first, second, third)]
        for few, expected in ((0, wanted), (1, np.nan)):
            found = label_checks._winding([groups[0], groups[1], groups[2][few:]], np.eye(3)[2])
            assert found == pytest.approx(expected, abs=1e-12, nan_ok=True)
