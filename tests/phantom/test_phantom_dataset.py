"""Whole synthetic datasets on disk."""

import json

import nibabel as nib
import numpy as np
import pytest

from hipsta_bids.errors import OutputError, SettingsError
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import find_hemispheres
from hipsta_bids.io import files
from hipsta_bids.phantom import (
    TRUTH_TABLE,
    Hemisphere,
    Phantom,
    PhantomSpec,
    rigid_motion,
    write_dataset,
    write_demo_dataset,
)
from hipsta_bids.phantom.dataset import LAYOUTS
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue, translate

SMALL = PhantomSpec(length=8.0, end_length=2.0)
COARSE = (0.6, 0.6, 0.6)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo data")  # a blank in the path, on purpose
    write_demo_dataset(folder)
    return folder


def tree(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_demo_has_four_hemispheres_with_their_truth(demo):
    rows = files.read_tsv(demo / TRUTH_TABLE)
    found = [(row["subject"], row["hemi"]) for row in rows]
    assert found == [(f"sub-demo{i}", hemi) for i in (1, 2) for hemi in "LR"]
    means = [float(row["thickness_mean"]) for row in rows]
    assert min(means) == 1.6
    assert max(means) == 2.2
    assert len({row["kind"] for row in rows}) == 3
    sidecar = files.read_json((demo / TRUTH_TABLE).with_suffix(".json"))
    assert sidecar["thickness_mean"]["Units"] == "mm"
    assert sidecar["Specifications"]["sub-demo1_hemi-R"]["variation"] > 0.0
    assert set(rows[0]) <= set(sidecar)


def test_demo_describes_itself_as_a_dataset(demo):
    top = json.loads((demo / "dataset_description.json").read_text())
    derivative = json.loads((demo / "derivatives/freesurfer/dataset_description.json").read_text())
    assert top["DatasetType"] == "raw"
    assert derivative["DatasetType"] == "derivative"
    assert [row["participant_id"] for row in files.read_tsv(demo / "participants.tsv")] == [
        "sub-demo1",
        "sub-demo2",
    ]
    assert "/phantom_*" in (demo / ".bidsignore").read_text().splitlines()
    # A folder per participant, or the table of participants would not fit the dataset.
    assert [p.name for p in sorted(demo.glob("sub-*/*"))] == [
        "sub-demo1_scans.tsv",
        "sub-demo2_scans.tsv",
    ]


def test_demo_is_found_and_read_as_freesurfer(demo):
    items = find_hemispheres(InputRequest(bids_dir=demo))
    assert [(item.subject, item.hemi) for item in items] == [
        (f"demo{i}", hemi) for i in (1, 2) for hemi in "LR"
    ]
    rows = files.read_tsv(demo / TRUTH_TABLE)
    for item, row in zip(items, rows, strict=True):
        assert item.problem is None
        assert item.protocol.name == "freesurfer"
        volume = read_label_volume(item)
        wall = np.isin(volume.tissue, (*item.protocol.sheet, *item.protocol.layer))
        size = abs(np.linalg.det(volume.affine[:3, :3]))
        counted = (wall & (volume.part == Part.BODY)).sum() * size
        # Some 5,000 voxels at the surface, half a voxel each, at random: 0.3 %.
        assert counted == pytest.approx(float(row["volume"]), rel=0.015)
        side = np.argwhere(wall).mean(axis=0) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
        assert (side[0] < 0.0) == (item.hemi == "L")


def test_the_same_dataset_has_the_same_bytes(tmp_path):
    item = Hemisphere(subject="01", hemi="L", spec=SMALL)
    for name in ("first", "second"):
        write_dataset(tmp_path / name, [item], layouts=tuple(LAYOUTS), voxel_size=COARSE)
    first = tree(tmp_path / "first")
    assert first == tree(tmp_path / "second")
    packed = [content for path, content in first.items() if path.suffix in (".mgz", ".gz")]
    assert len(packed) == len(LAYOUTS)
    assert all(content[4:8] == bytes(4) for content in packed)  # gzip's time stamp (RFC 1952)


@pytest.mark.parametrize("name", LAYOUTS)
def test_layout_holds_what_was_drawn(tmp_path, name):
    pose = rigid_motion((5.0, -8.0, 12.0), (1.0, 2.0, 3.0))
    item = Hemisphere(subject="07", hemi="R", spec=SMALL, pose=pose)
    write_dataset(tmp_path, [item], layouts=[name], voxel_size=COARSE)
    layout = LAYOUTS[name]
    path = layout.path.format(subject="sub-07", side=layout.sides[1])
    image = nib.load(tmp_path / "derivatives" / name / path)
    protocol = load_protocol(layout.protocol)
    drawn = Phantom(SMALL).label_volume(
        protocol, hemi="R", pose=pose, voxel_size=COARSE, axes="LIA"
    )
    assert nib.aff2axcodes(image.affine) == ("L", "I", "A")
    # mm: headers hold single precision, 1e-7 of positions below 100 mm.
    np.testing.assert_allclose(image.affine, drawn.affine, atol=2e-5)
    tissue, part = translate(np.asarray(image.dataobj), protocol)
    np.testing.assert_array_equal(tissue, drawn.tissue)
    np.testing.assert_array_equal(part, drawn.part)


def test_ashs_layout_is_found_and_its_atlas_told_by_its_labels(tmp_path):
    items = [Hemisphere(subject="07", hemi=hemi, spec=SMALL) for hemi in "LR"]
    write_dataset(tmp_path, items, layouts=["ashs"], voxel_size=COARSE)
    found = find_hemispheres(InputRequest(bids_dir=tmp_path))
    assert [(item.hemi, item.protocol.name) for item in found] == [
        ("L", "ashsABC3T"),
        ("R", "ashsABC3T"),
    ]
    volume = read_label_volume(found[0])
    assert (volume.part[volume.tissue == Tissue.HIPPOCAMPUS] != Part.BODY).all()


def test_rigid_motion_turns_and_then_shifts():
    motion = rigid_motion((0.0, 0.0, 90.0), (1.0, 2.0, 3.0))
    # A quarter turn about S takes R to A; 1e-12 is rounding.
    np.testing.assert_allclose(motion @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-12)


def test_unknown_layout_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="layout 'hipsta' is unknown; choose from freesurfer"):
        write_dataset(tmp_path, [], layouts=["hipsta"])


def test_a_place_that_cannot_be_written_is_an_output_error(tmp_path):
    (tmp_path / "taken").write_text("a file, not a folder")
    item = Hemisphere(subject="01", hemi="L", spec=SMALL)
    with pytest.raises(OutputError, match="taken"):
        write_dataset(tmp_path / "taken", [item], voxel_size=COARSE)
