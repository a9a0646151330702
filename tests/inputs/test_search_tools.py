"""HSF, MAGeT Brain and NextBrain: which files are theirs, and what the user has to say."""

import pytest
from input_cases import by_key, describe, find, touch

from hipsta_bids.errors import NothingToDoError, ProtocolError

HSF = "sub-01_T2w_{}_hippocampus_seg.nii.gz"


def put(root, *names, dataset="tools", folder="sub-01/anat", generator=None):
    """Make files of one subject in a derivative dataset."""
    root = root / "derivatives" / dataset
    touch(root / folder, *names)
    describe(root, generator)


def both(name):
    return [name.format(side) for side in ("left", "right")]


def test_hsf_needs_its_mode(tmp_path):
    put(tmp_path, *both(HSF))
    left, right = find(tmp_path)
    for item in (left, right):
        assert item.problem is not None
        assert item.problem.reason == "ambiguous-scheme"
        assert item.protocol.name == "hsf"  # its name in status.tsv
    message = str(left.problem)
    assert "HSF's codes depend on its ca_mode" in message
    assert "--scheme hsf (HSF, ca_mode 1/2/3" in message
    assert "--scheme hsfCA23 (HSF, ca_mode 1/23" in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["hsf", "hsfCA23"])
def test_the_named_mode_is_taken_and_nothing_is_opened(tmp_path, name):
    put(tmp_path, *both(HSF))
    found = by_key(find(tmp_path, protocol=name))
    assert set(found) == {("01", "", hemi, name) for hemi in "LR"}
    right = found["01", "", "R", name]
    assert [path.name for path in right.files] == [HSF.format("right")]
    assert (right.bilateral, right.code_offset, right.problem) == (False, 0, None)
    assert right.explanation == f"HSF, protocol {name} from --scheme"


def test_hsf_writes_beside_the_images(tmp_path):
    describe(tmp_path, kind="raw")
    touch(tmp_path / "sub-01" / "ses-a" / "anat", *both(HSF), "sub-01_T2w.nii.gz")
    found = find(tmp_path, derivatives={"hsf": tmp_path}, protocol="hsf")
    assert [(item.session, item.hemi) for item in found] == [("a", "L"), ("a", "R")]


def test_other_files_of_hsf_are_not_segmentations(tmp_path):
    crops = ["hsf_outputs/sub-01_T2w_left_hippocampus_seg_crop.nii.gz"]
    put(tmp_path, *crops, "sub-01_T2w_left_hippocampus.nii.gz", HSF.format("left"))
    (item,) = find(tmp_path, protocol="hsf")
    assert item.files[0].name == HSF.format("left")
    assert item.passed_over == ()


def test_of_several_images_t2_comes_first_and_others_are_not_chosen_between(tmp_path):
    t1 = HSF.replace("T2w", "T1w").format("left")
    put(tmp_path, HSF.format("left"), t1)
    (item,) = find(tmp_path, protocol="hsf")
    assert item.files[0].name == HSF.format("left")
    assert item.passed_over == ((t1, "T2w is preferred"),)
    put(tmp_path, HSF.replace("T2w", "acq-tse_T2w").format("left"))
    (item,) = find(tmp_path, protocol="hsf")
    assert item.problem is not None
    assert item.problem.reason == "several-files"


@pytest.mark.parametrize("name", ["hs", "hsfCA123", "HSF"])
def test_a_mode_that_is_not_known_is_an_error(tmp_path, name):
    put(tmp_path, *both(HSF))
    with pytest.raises(ProtocolError, match=r"did you mean .hsf|bundled: .*hsf, hsfCA23"):
        find(tmp_path, protocol=name)


def test_a_users_file_describes_a_tool_that_it_names(tmp_path):
    put(tmp_path, *both(HSF))
    protocol = tmp_path / "mine.toml"
    protocol.write_text(
        'name = "mine"\ntitle = "t"\ncitation = "c"\ntool = "hsf"\nsheet = ["CA1"]\nlayer = []\n'
        'interior = []\nlabels = [{ code = 2, tissue = "CA1", name = "a", abbreviation = "a", '
        'color = "#000000" }]\n',
        encoding="utf-8",
    )
    assert {item.protocol.name for item in find(tmp_path, protocol=protocol)} == {"mine"}


def test_a_tools_protocol_leaves_other_files_alone(tmp_path):
    put(tmp_path, *both(HSF))
    put(tmp_path, "sub-01_hemi-L_desc-hipp_dseg.nii.gz", dataset="lab")
    table = tmp_path / "derivatives" / "lab" / "dseg.tsv"
    table.write_text("index\tname\n1\tsubiculum\n2\tCA1\n", encoding="utf-8")
    atlas = "sub-01_hemi-L_space-cropT2w_desc-subfields_atlas-freesurfer_dseg.nii.gz"
    put(tmp_path, atlas, dataset="hippunfold")
    found = by_key(find(tmp_path, protocol="hsf"))
    assert {(*key[2:], item.problem and item.problem.reason) for key, item in found.items()} == {
        ("L", "hsf", None),
        ("R", "hsf", None),
        ("L", "lab", None),
        ("L", "hippunfold", "unknown-atlas"),
    }


def test_a_bundled_protocol_reads_files_without_a_table(tmp_path):
    put(tmp_path, "sub-01_hemi-L_dseg.nii.gz")
    (item,) = find(tmp_path, protocol="hsf")
    assert (item.protocol.name, item.explanation) == ("hsf", "labels named by --scheme")


def test_the_protocol_without_subfields_is_refused(tmp_path):
    put(tmp_path, *both(HSF))
    with pytest.raises(ProtocolError, match="has no subfields; run ASHS"):
        find(tmp_path, protocol="ashsT1")


@pytest.mark.parametrize("name", ["sub-01_T1w_labels.nii.gz", "sub-01_label_hippocampus.nii.gz"])
@pytest.mark.parametrize(
    ("generator", "options"),
    [("MAGeTbrain", {}), ("antsRegistration-MAGeT", {}), (None, {"protocol": "cobralab"})],
)
def test_maget_has_one_file_for_both_hemispheres(tmp_path, name, generator, options):
    put(tmp_path, name, generator=generator)
    left, right = find(tmp_path, **options)
    for item, shift in ((left, 100), (right, 0)):
        assert [path.name for path in item.files] == [name]
        assert (item.bilateral, item.code_offset, item.problem) == (True, shift, None)
        assert item.protocol.name == "cobralab"
        assert "MAGeT Brain, both hemispheres in one file" in item.explanation


def test_names_that_other_programs_use_too_have_to_be_claimed(tmp_path):
    put(tmp_path, "sub-01_T1w_labels.nii.gz", "seg.left.nii.gz")
    with pytest.raises(NothingToDoError, match="no hippocampal segmentation"):
        find(tmp_path)


@pytest.mark.parametrize(
    ("name", "table"),
    [("seg.{}.nii.gz", "lut.txt"), ("seg_{}.mgz", "lookup_table.txt")],
)
def test_nextbrain_is_known_by_the_table_beside_it(tmp_path, name, table):
    soft = "seg.left.rgb.nii.gz"
    put(tmp_path, *both(name), table, soft, "SynthSeg.mgz", folder="sub-01/ses-a")
    found = by_key(find(tmp_path))
    assert set(found) == {("01", "a", hemi, "nextbrain") for hemi in "LR"}
    assert all(item.problem is None for item in found.values())
    assert found["01", "a", "L", "nextbrain"].files[0].name == name.format("left")
    assert found["01", "a", "L", "nextbrain"].passed_over == ()
