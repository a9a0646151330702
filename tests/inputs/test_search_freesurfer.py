import pytest
from input_cases import by_key, find, touch

from hipsta_bids.errors import UsageError
from hipsta_bids.inputs.freesurfer import parse_analysis
from hipsta_bids.inputs.layouts import volume_table

FULL = "hippoAmygLabels-T1.v22"


def names(item):
    return [path.name for path in item.files]


def both(stem):
    return [f"{side}.{stem}" for side in ("lh", "rh")]


def put(root, subject, *stems, folder="mri"):
    touch(root / "derivatives" / "freesurfer" / subject / folder, *stems)


def one(tmp_path, *stems, **options):
    """Find the left hemisphere of a dataset with one subject."""
    put(tmp_path, "sub-01", *(f"lh.{stem}" for stem in stems))
    (item,) = find(tmp_path, **options)
    return item


@pytest.mark.parametrize(
    "stem",
    [
        "hippoAmygLabels.mgz",
        "hippoAmygLabels-T1.v22.mgz",
        "hippoAmygLabels-T1-T2.v21.mgz",
        "hippoAmygLabels-T2.v22.mgz",
        "hippoAmygLabels.long.mgz",
        "hippoAmygLabels_rerun.mgz",
        "hippoAmygLabelsT2.mgz",
        "hippoAmygLabels-T1.long.v21.mgz",
        "hippoAmygLabels-T1-HR.acq.v21.mgz",
        "hippoAmygLabels-T1.v22.nii.gz",
    ],
)
def test_the_full_hierarchy_is_found_under_every_suffix(tmp_path, stem):
    put(tmp_path, "sub-01", *both(stem))
    found = by_key(find(tmp_path))
    assert set(found) == {("01", "", hemi, "freesurfer") for hemi in "LR"}
    assert names(found["01", "", "R", "freesurfer"]) == [f"rh.{stem}"]
    assert found["01", "", "R", "freesurfer"].parts_protocol is None


def test_the_full_hierarchy_comes_before_all_others(tmp_path):
    others = [f"{FULL}{kind}.mgz" for kind in (".CA", ".FS60", ".HBT", ".FSvoxelSpace")]
    item = one(tmp_path, f"{FULL}.mgz", *others, f"{FULL}.CA.FSvoxelSpace.mgz")
    assert names(item) == [f"lh.{FULL}.mgz"]
    assert item.protocol.name == "freesurfer"
    reasons = dict(item.passed_over)
    assert set(reasons) == {f"lh.{name}" for name in [*others, f"{FULL}.CA.FSvoxelSpace.mgz"]}
    assert "less detail" in reasons[f"lh.{FULL}.CA.mgz"]
    assert "resampled to 1 mm" in reasons[f"lh.{FULL}.FSvoxelSpace.mgz"]
    assert item.notes == ()


@pytest.mark.parametrize(
    ("kinds", "taken", "protocol"),
    [
        ([".CA", ".HBT"], [".CA", ".HBT"], "freesurferCA"),
        ([".FS60", ".HBT"], [".FS60", ".HBT"], "freesurferFS60"),
        ([".CA", ".FS60", ".HBT"], [".FS60", ".HBT"], "freesurferFS60"),
        ([".CA"], [".CA"], "freesurferCA"),
        ([".FS60", ".CA"], [".FS60"], "freesurferFS60"),
    ],
)
def test_subfields_and_parts_are_combined(tmp_path, kinds, taken, protocol):
    item = one(tmp_path, *(f"{FULL}{kind}.mgz" for kind in kinds))
    assert names(item) == [f"lh.{FULL}{kind}.mgz" for kind in taken]
    assert item.protocol.name == protocol
    expected = "freesurferHBT" if ".HBT" in taken else None
    assert (item.parts_protocol.name if item.parts_protocol else None) == expected


def test_without_a_suffix_hierarchies_are_told_apart_too(tmp_path):
    item = one(tmp_path, "hippoAmygLabels.CA.mgz", "hippoAmygLabels.HBT.mgz")
    assert item.protocol.name == "freesurferCA"
    assert len(item.files) == 2


def test_the_resampled_file_is_taken_only_if_there_is_no_other(tmp_path):
    item = one(tmp_path, f"{FULL}.FSvoxelSpace.mgz")
    assert names(item) == [f"lh.{FULL}.FSvoxelSpace.mgz"]
    assert "only .FSvoxelSpace exists" in item.notes[0]
    # Even an analysis that comes later is better than a resampled one.
    finer = one(tmp_path, "hippoAmygLabels-T1-T2.v22.FSvoxelSpace.mgz", "hippoAmygLabels.CA.mgz")
    assert names(finer) == ["lh.hippoAmygLabels.CA.mgz"]


def test_freesurfer_6(tmp_path):
    item = one(tmp_path, "hippoSfLabels-T1.v10.mgz", "hippoSfLabels-T1.v10.FSvoxelSpace.mgz")
    assert names(item) == ["lh.hippoSfLabels-T1.v10.mgz"]
    assert item.protocol.name == "freesurferFS60"
    assert "FreeSurfer 6.0" in item.explanation
    newer = one(tmp_path, f"{FULL}.mgz")
    assert newer.protocol.name == "freesurfer"
    assert any("hippoSfLabels" in name for name, _ in newer.passed_over)


@pytest.mark.parametrize(
    ("suffixes", "default"),
    [
        (["-T1.v22", "-T1-T2.v22", "-T2.v22", ""], "-T1-T2.v22"),
        (["-T1.v22", "-T2.v22", ""], "-T2.v22"),
        (["-T1.v21", "-T1.v22", ""], "-T1.v22"),
        (["-T1.v21", ""], "-T1.v21"),
        (["-T1.v21", "-T1.long.v22"], "-T1.v21"),
    ],
)
def test_of_several_analyses_the_documented_one_is_taken(tmp_path, suffixes, default):
    item = one(tmp_path, *(f"hippoAmygLabels{suffix}.mgz" for suffix in suffixes))
    assert names(item) == [f"lh.hippoAmygLabels{default}.mgz"]
    assert len(item.passed_over) == len(suffixes) - 1
    assert all("--fs-analysis" in reason for _, reason in item.passed_over)


@pytest.mark.parametrize(
    ("wanted", "taken"),
    [
        ("T1", "-T1.v22"),
        ("T1.v21", "-T1.v21"),
        ("T1-T2", "-T1-T2.v21"),
        ("-T1-T2.v21", "-T1-T2.v21"),
        ("T1.long", "-T1.long.v21"),
        ("unnamed", ""),
    ],
)
def test_fs_analysis_chooses(tmp_path, wanted, taken):
    suffixes = ["-T1.v22", "-T1.v21", "-T1-T2.v21", "-T1.long.v21", ""]
    stems = [f"hippoAmygLabels{suffix}.mgz" for suffix in suffixes]
    item = one(tmp_path, *stems, fs_analysis=wanted)
    assert names(item) == [f"lh.hippoAmygLabels{taken}.mgz"]
    assert item.problem is None


def test_an_analysis_that_no_hemisphere_has_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match=r"--fs-analysis T3.*found T1\.v22"):
        one(tmp_path, f"{FULL}.mgz", fs_analysis="T3")


def test_a_hemisphere_without_the_analysis_fails_alone(tmp_path):
    put(tmp_path, "sub-01", f"lh.{FULL}.mgz")
    put(tmp_path, "sub-02", "lh.hippoAmygLabels-T1-T2.v22.mgz")
    first, second = find(tmp_path, fs_analysis="T1-T2")
    assert first.problem is not None
    assert first.problem.reason == "analysis-missing"
    assert second.problem is None


def test_parts_without_subfields_are_a_problem(tmp_path):
    item = one(tmp_path, f"{FULL}.HBT.mgz")
    assert item.problem is not None
    assert item.problem.reason == "no-subfields"


def test_sessions_in_any_spelling_and_longitudinal_folders(tmp_path):
    put(tmp_path, "sub-01_ses-a", f"lh.{FULL}.mgz")
    put(tmp_path, "sub-02/ses-b", f"lh.{FULL}.mgz")
    put(tmp_path, "sub-03_ses-c", f"lh.{FULL}.mgz")
    put(tmp_path, "sub-03_ses-c.long.sub-03", f"lh.{FULL}.mgz")
    put(tmp_path, "fsaverage", f"lh.{FULL}.mgz")
    items = find(tmp_path)
    assert [item.key[:2] for item in items] == [("01", "a"), ("02", "b"), ("03", "c")]
    assert ".long." not in str(items[2].files[0])
    (long,) = find(tmp_path, fs_analysis="T1.long", participant_labels=("03",))
    assert ".long.sub-03" in str(long.files[0])


def test_what_segment_subregions_writes(tmp_path):
    kinds = ("", ".HBT", ".FS60", ".CA")
    stems = [f"hippoAmygLabels{kind}{copy}.mgz" for kind in kinds for copy in ("", ".FSvoxelSpace")]
    put(tmp_path, "sub-01", *both("hippoSfVolumes.txt"), *(name for s in stems for name in both(s)))
    left, right = find(tmp_path)
    assert (names(left), names(right)) == (["lh.hippoAmygLabels.mgz"], ["rh.hippoAmygLabels.mgz"])
    assert len(left.passed_over) == len(stems) - 1
    table = volume_table(left.files[0], "freesurfer")
    assert table is not None
    assert table.exists()


def test_folders_that_fastsurfer_links_to_as_longitudinal_count_once(tmp_path):
    put(tmp_path, "sub-01_ses-a", "lh.hippoAmygLabels.long.mgz", "lh.hippoAmygLabels.mgz")
    dataset = tmp_path / "derivatives" / "freesurfer"
    (dataset / "sub-01_ses-a.long.sub-01").symlink_to("sub-01_ses-a")
    (item,) = find(tmp_path)
    assert (item.session, names(item)) == ("a", ["lh.hippoAmygLabels.mgz"])
    assert [name for name, _ in item.passed_over] == ["lh.hippoAmygLabels.long.mgz"]
    (item,) = find(tmp_path, fs_analysis="long")
    assert names(item) == ["lh.hippoAmygLabels.long.mgz"]
    assert item.problem is None


def test_other_files_of_a_freesurfer_folder_do_not_matter(tmp_path):
    item = one(
        tmp_path,
        f"{FULL}.mgz",
        "hippoAmygLabels-T1.v22.mgz.bak",
        "amygNucVolumes-T1.v22.txt",
        "hippoSfVolumes-T1.v22.txt",
    )
    assert item.passed_over == ()


def test_names_of_analyses_are_read_back():
    for name in ("T1", "T1.v22", "T1-T2.v21", "T1.long.v21", "long", "unnamed"):
        assert parse_analysis(name).name == name
