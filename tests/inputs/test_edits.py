"""Which corrected file belongs to which hemisphere."""

import pytest
from input_cases import by_key, describe, touch

from hipsta_bids.errors import InputError
from hipsta_bids.inputs.account import selection_table
from hipsta_bids.inputs.generic import is_edited
from hipsta_bids.inputs.search import InputRequest, find_inputs
from hipsta_bids.protocols.protocol import Tissue

FS = "derivatives/freesurfer"
LEFT = ("01", "", "L", "freesurfer")
RIGHT = ("01", "", "R", "freesurfer")


@pytest.fixture
def data(tmp_path):
    data = tmp_path / "data"
    describe(data, kind="raw")
    touch(
        data / FS,
        *(f"sub-{s}/mri/{h}h.hippoAmygLabels.mgz" for s in ("01", "02") for h in "lr"),
    )
    return data


def search(data, **options):
    found = find_inputs(InputRequest(bids_dir=data, **options))
    return by_key(found.items), found.notes


def names(item):
    return [(edit.kind, edit.path.name) for edit in item.edits]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("sub-01_hemi-L_desc-edited_dseg.nii.gz", True),
        ("sub-01_ses-2_hemi-R_seg-x_desc-edited_mask.nii", True),
        ("hemi-L_desc-edited_dseg.mgz", True),
        ("sub-01_hemi-L_desc-edited_dseg.tsv", False),
        ("sub-01_hemi-L_desc-edited_dseg.json", False),
        ("sub-01_hemi-L_desc-body_mask.nii.gz", False),
        ("sub-01_hemi-L_desc-edited2_dseg.nii.gz", False),
        ("sub-01_desc-edited_T1w.nii.gz", False),
    ],
)
def test_names(name, wanted):
    assert is_edited(name) == wanted


def test_beside_the_labels(data):
    labels, mask = "sub-01_hemi-L_desc-edited_dseg.nii.gz", "hemi-L_desc-edited_mask.mgz"
    touch(data / FS / "sub-01" / "mri", labels, mask)
    items, notes = search(data)
    assert sorted(names(items[LEFT])) == [("labels", labels), ("mask", mask)]
    assert items[RIGHT].edits == ()
    assert notes == ()
    table = {(row["subject"], row["hemisphere"]): row for row in selection_table(items.values())}
    assert labels in table["01", "L"]["edited"]
    assert table["02", "L"]["edited"] == "n/a"


def test_in_a_folder_of_their_own(data, tmp_path):
    edits = tmp_path / "edits"
    name = "sub-01_hemi-R_seg-freesurfer_desc-edited_dseg.nii.gz"
    touch(edits, f"sub-01/anat/{name}", "sub-02/sub-02_hemi-L_desc-edited_mask.nii")
    items, notes = search(data, edited_dir=edits)
    (edit,) = items[RIGHT].edits
    assert (edit.kind, edit.path, edit.source) == ("labels", edits / "sub-01/anat" / name, "edited")
    assert names(items["02", "", "L", "freesurfer"])[0][0] == "mask"
    assert notes == ()


def test_sessions(tmp_path):
    touch(
        tmp_path / FS,
        "sub-01_ses-a/mri/lh.hippoSfLabels.mgz",
        "sub-01_ses-b/mri/lh.hippoSfLabels.mgz",
    )
    edits = tmp_path / "edits"
    touch(edits, "sub-01/ses-b/anat/sub-01_ses-b_hemi-L_desc-edited_dseg.nii.gz")
    touch(edits, "sub-01/anat/sub-01_hemi-L_desc-edited_dseg.nii.gz")
    items, (note,) = search(tmp_path, edited_dir=edits, hemis=("L",))
    assert {key[1]: len(item.edits) for key, item in items.items()} == {"a": 0, "b": 1}
    assert "no labels of sub-01 hemi-L are processed" in note


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("sub-01_desc-edited_dseg.nii.gz", "its name has no hemi-L or hemi-R"),
        ("sub-02_hemi-L_desc-edited_dseg.nii.gz", "its name has sub-02, but"),
        ("sub-01_ses-1_hemi-L_desc-edited_dseg.nii.gz", "its name has ses-1, but"),
        ("sub-01_hemi-L_seg-ashsPMC_desc-edited_mask.nii", "sub-01 hemi-L has seg-freesurfer"),
    ],
)
def test_a_file_that_corrects_nothing_gets_a_line(data, tmp_path, name, reason):
    edits = tmp_path / "edits"
    touch(edits / "sub-01" / "anat", name)
    items, (note,) = search(data, edited_dir=edits)
    assert str(edits / "sub-01" / "anat" / name) in note
    assert reason in note
    assert not any(item.edits or item.problem for item in items.values())


def test_a_file_in_the_wrong_folder_gets_a_line(data):
    touch(data / FS / "sub-01", "sub-01_hemi-L_desc-edited_dseg.nii.gz")
    items, (note,) = search(data)
    assert items[LEFT].edits == ()
    assert "does not lie beside the labels of sub-01 hemi-L" in note
    assert str(data / FS / "sub-01" / "mri") in note


def test_what_is_not_asked_for_is_no_stray(data, tmp_path):
    edits = tmp_path / "edits"
    touch(edits, "sub-02/anat/sub-02_hemi-L_desc-edited_dseg.nii.gz")
    touch(edits, "sub-01/anat/sub-01_hemi-R_desc-edited_dseg.nii.gz")
    items, notes = search(data, edited_dir=edits, participant_labels=("01",), hemis=("L",))
    assert list(items) == [LEFT]
    assert notes == ()


def test_two_for_one_hemisphere_fail_it_alone(data, tmp_path):
    edits = tmp_path / "edits"
    touch(edits, "sub-01/anat/sub-01_hemi-L_desc-edited_dseg.nii.gz")
    touch(data / FS / "sub-01" / "mri", "sub-01_hemi-L_desc-edited_dseg.mgz")
    items, notes = search(data, edited_dir=edits)
    assert items[LEFT].problem.reason == "edit-ambiguous"
    assert "keep one" in str(items[LEFT].problem)
    assert str(edits) in str(items[LEFT].problem)
    assert items[LEFT].edited == ("labels",)
    assert items[RIGHT].problem is None
    assert notes == ()


def test_one_for_two_protocols_fails_both(data, tmp_path):
    touch(data / "derivatives/hippunfold/sub-01/anat", "sub-01_hemi-L_desc-subfields_dseg.nii.gz")
    edits = tmp_path / "edits"
    touch(edits, "sub-01/anat/sub-01_hemi-L_desc-edited_dseg.nii.gz")
    items, _ = search(data, edited_dir=edits)
    problems = [items["01", "", "L", name].problem for name in ("freesurfer", "hippunfold")]
    assert all("_seg-freesurfer_desc-edited_" in str(problem) for problem in problems)
    assert items["02", "", "L", "freesurfer"].problem is None
    (edits / "sub-01/anat/sub-01_hemi-L_desc-edited_dseg.nii.gz").unlink()
    touch(edits, "sub-01/anat/sub-01_hemi-L_seg-hippunfold_desc-edited_dseg.nii.gz")
    items, _ = search(data, edited_dir=edits)
    assert [len(items["01", "", "L", name].edits) for name in ("freesurfer", "hippunfold")] == [
        0,
        1,
    ]


def test_edited_labels_are_no_segmentation_of_their_own(tmp_path):
    """Also where a table describes all files of the dataset."""
    lab = tmp_path / "lab"
    touch(lab, "sub-01/anat/sub-01_hemi-L_dseg.nii.gz")
    touch(lab, "sub-01/anat/sub-01_hemi-L_desc-edited_dseg.nii.gz")
    (lab / "dseg.tsv").write_text("index\tname\n1\tsubiculum\n2\tCA1\n")
    items, notes = search(tmp_path, derivatives={"lab": lab}, hemis=("L",))
    (item,) = items.values()
    assert item.files[0].name == "sub-01_hemi-L_dseg.nii.gz"
    assert len(item.edits) == 1
    assert notes == ()


def test_the_folder_of_edits_may_be_a_dataset_that_is_searched(data):
    touch(data / FS / "sub-01" / "mri", "sub-01_hemi-L_desc-edited_dseg.nii.gz")
    items, notes = search(data, edited_dir=data / FS)
    assert len(items[LEFT].edits) == 1
    assert items[LEFT].problem is None
    assert notes == ()


def test_edits_in_the_output_folder_are_found(data, tmp_path):
    out = tmp_path / "out"
    assert search(data, output_dir=out)[1] == ()  # not there yet
    name = "sub-01_hemi-L_seg-freesurfer_desc-edited_mask.nii.gz"
    touch(out / "sub-01" / "anat", name, name.replace("edited", "body"))
    for options in ({}, {"edited_dir": out}):  # naming it twice is no ambiguity
        items, notes = search(data, output_dir=out, **options)
        assert names(items[LEFT]) == [("mask", name)]
        assert items[LEFT].problem is None
        assert notes == ()


def test_a_missing_folder_is_an_error(data, tmp_path):
    with pytest.raises(InputError, match="folder not found"):
        search(data, edited_dir=tmp_path / "none")


def test_a_table_beside_edited_labels_says_what_they_are(data):
    folder = data / FS / "sub-01" / "mri"
    touch(folder, "sub-01_hemi-L_desc-edited_dseg.nii.gz")
    table = folder / "sub-01_hemi-L_desc-edited_dseg.tsv"
    table.write_text("index\tname\n1\tsubiculum\n2\tCA1\n3\tDG\n")
    items, _ = search(data)
    protocol = items[LEFT].protocol
    assert protocol.name == "freesurfer"
    assert "Iglesias" in protocol.citation
    assert any(table.name in note for note in items[LEFT].notes)
    assert {label.code: label.tissue for label in protocol.labels} == {
        1: Tissue.SUBICULUM,
        2: Tissue.CA1,
        3: Tissue.DENTATE_GYRUS,
    }
    table.write_text("index\tname\n1\tnothing known\n")
    assert search(data)[0][LEFT].problem.reason == "unclear-names"
