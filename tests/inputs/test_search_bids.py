"""HippUnfold's files, and BIDS files with a label table."""

import pytest
from input_cases import by_key, describe, find, touch

from hipsta_bids.inputs.search import InputRequest, find_inputs

TABLE = (
    "index\tname\tabbreviation\tcolor\n1\tsubiculum\tSub\t#112233\n2\tCA1\tCA1\tn/a\n3\tCA3\tCA3\n"
)


def hipp(root, *names, subject="sub-01", session=None, dataset="hippunfold"):
    inner = f"{subject}/{f'ses-{session}/' if session else ''}anat"
    stem = f"{subject}_ses-{session}" if session else subject
    touch(root / "derivatives" / dataset / inner, *(f"{stem}_{name}" for name in names))


def only(root, **options):
    (item,) = find(root, **options)
    return item


@pytest.mark.parametrize(
    "name",
    [
        "hemi-L_space-cropT1w_desc-subfields_dseg.nii.gz",
        "hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz",
        "hemi-L_space-cropT2w_desc-subfields_atlas-multihist7_dseg.nii.gz",
        "atlas-multihist7_hemi-L_space-cropT2w_desc-subfields_dseg.nii.gz",
        "hemi-L_space-cropT2w_label-hipp_atlas-multihist7_desc-subfields_dseg.nii.gz",
    ],
)
def test_hippunfold_files_of_all_versions(tmp_path, name):
    hipp(tmp_path, name, name.replace("hemi-L", "hemi-R"))
    hipp(tmp_path, name, subject="sub-02", session="pre")
    found = by_key(find(tmp_path))
    assert set(found) == {
        ("01", "", "L", "hippunfold"),
        ("01", "", "R", "hippunfold"),
        ("02", "pre", "L", "hippunfold"),
    }
    assert all(item.problem is None and not item.notes for item in found.values())


def test_the_cropped_space_comes_first(tmp_path):
    hipp(
        tmp_path,
        "hemi-L_space-T1w_desc-subfields_atlas-multihist7_dseg.nii.gz",
        "hemi-L_space-cropT1w_desc-subfields_atlas-multihist7_dseg.nii.gz",
        "hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz",
        "hemi-L_space-corobl_desc-subfields_atlas-multihist7_dseg.nii.gz",
        "hemi-L_space-cropT1w_label-dentate_desc-subfields_dseg.nii.gz",
        "hemi-L_space-cropT1w_desc-postproc_dseg.nii.gz",
        "space-cropT1w_desc-subfields_atlas-multihist7_volumes.tsv",
    )
    item = only(tmp_path)
    assert "space-cropT1w_desc-subfields_atlas-multihist7" in item.files[0].name
    reasons = [reason for _, reason in item.passed_over]
    assert len(reasons) == 3
    assert any("coarser grid" in reason for reason in reasons)
    assert any("atlas multihist7 is preferred" in reason for reason in reasons)
    assert any("may be scaled" in reason for reason in reasons)


def test_the_images_own_grid_is_used_with_a_note(tmp_path):
    hipp(tmp_path, "hemi-L_space-T2w_desc-subfields_dseg.nii.gz")
    item = only(tmp_path)
    assert item.problem is None
    assert "no space-crop* file" in item.notes[0]


@pytest.mark.parametrize("space", ["corobl", "unfold", "MNI152NLin2009cAsym"])
def test_spaces_that_change_sizes_are_a_problem(tmp_path, space):
    hipp(tmp_path, f"hemi-L_space-{space}_desc-subfields_atlas-multihist7_dseg.nii.gz")
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "template-space"


def test_other_atlases_need_the_users_protocol(tmp_path):
    hipp(tmp_path, "hemi-L_space-cropT1w_desc-subfields_atlas-magdeburg_dseg.nii.gz")
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "unknown-atlas"
    item = only(tmp_path, protocol=write_scheme(tmp_path))
    assert item.problem is None
    assert item.protocol.name == "mine"


def test_the_folder_that_version_1_makes_inside_its_output_is_found(tmp_path):
    out = tmp_path / "elsewhere" / "out"
    name = "sub-01_hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz"
    touch(out / "hippunfold" / "sub-01" / "anat", name)
    touch(out / "logs", "log.txt")
    (tmp_path / "bids").mkdir()
    (item,) = find(tmp_path / "bids", hippunfold_dir=out)
    assert item.source_path == out / "hippunfold"


def write_scheme(root):
    path = root / "mine.toml"
    path.write_text(
        'name = "mine"\ntitle = "t"\ncitation = "c"\nsheet = ["subiculum", "CA1"]\nlayer = []\n'
        "interior = []\nlabels = [\n"
        '{ code = 1, tissue = "CA1", name = "a", abbreviation = "a", color = "#000000" },\n'
        '{ code = 2, tissue = "subiculum", name = "b", abbreviation = "b", color = "#000000" },\n'
        "]\n",
        encoding="utf-8",
    )
    return path


def lab(root, *names, table="dseg.tsv", text=TABLE):
    """A laboratory's own derivative: some images, and a table."""
    dataset = root / "derivatives" / "my-lab"
    touch(dataset / "sub-01" / "anat", *(f"sub-01_{name}" for name in names))
    if table:
        (dataset / table).parent.mkdir(parents=True, exist_ok=True)
        (dataset / table).write_text(text, encoding="utf-8")
    return dataset


@pytest.mark.parametrize(
    "table",
    [
        "dseg.tsv",
        "desc-hipp_dseg.tsv",
        "sub-01/sub-01_dseg.tsv",
        "sub-01/anat/sub-01_hemi-L_desc-hipp_dseg.tsv",
    ],
)
def test_a_table_beside_or_above_names_the_labels(tmp_path, table):
    lab(tmp_path, "hemi-L_desc-hipp_dseg.nii.gz", table=table)
    item = only(tmp_path)
    assert item.protocol.name == "mylab"
    assert [label.abbreviation for label in item.protocol.labels] == ["Sub", "CA1", "CA3"]
    assert item.protocol.labels[0].color == "#112233"
    assert item.protocol.sheet == tuple(label.tissue for label in item.protocol.labels)
    assert table.rpartition("/")[2] in item.explanation


def test_the_most_specific_table_that_applies_is_taken(tmp_path):
    dataset = lab(tmp_path, "hemi-L_atlas-new_desc-hipp_dseg.nii.gz", table="dseg.tsv")
    swapped = TABLE.replace("1\tsub", "9\tsub")
    (dataset / "atlas-new_dseg.tsv").write_text(swapped, encoding="utf-8")
    (dataset / "atlas-old_desc-hipp_dseg.tsv").write_text(TABLE, encoding="utf-8")
    item = only(tmp_path)
    assert item.protocol.name == "new"
    assert item.protocol.codes == {9, 2, 3}


def test_files_of_other_structures_are_left_out(tmp_path):
    cortex = "index\tname\n1\tinsula\n"
    dataset = lab(tmp_path, "hemi-L_desc-cortex_dseg.nii.gz", text=cortex)
    lab(tmp_path, "hemi-L_desc-hipp_dseg.nii.gz", table="desc-hipp_dseg.tsv")
    touch(dataset / "sub-01" / "anat", "sub-01_desc-hipp_dseg.nii.gz")  # no hemisphere
    touch(dataset / "sub-01" / "anat", "sub-01_hemi-L_desc-hipp_probseg.nii.gz")
    item = only(tmp_path)
    assert [path.name for path in item.files] == ["sub-01_hemi-L_desc-hipp_dseg.nii.gz"]
    assert item.passed_over == ()


def test_a_side_that_is_misspelled_is_noted(tmp_path):
    lab(tmp_path, "hemi-L_dseg.nii.gz", "hemi-r_dseg.nii.gz", "hemi-left_mask.nii.gz")
    found = find_inputs(InputRequest(bids_dir=tmp_path))
    (item,) = found.items
    assert (item.hemi, item.problem) == ("L", None)
    assert found.notes == (
        "no labels of one hemisphere: 1 visit (sub-01 R)",
        "not used: 1 file (sub-01_hemi-r_dseg.nii.gz); see --dry-run and the log for the reasons",
    )
    assert [entry.reason for entry in found.ignored] == [
        "no labels of this hemisphere, but of the other",
        "hemi-r is neither hemi-L nor hemi-R",
    ]


def test_a_name_of_somebody_else_is_noted(tmp_path):
    dataset = lab(tmp_path, "hemi-L_dseg.nii.gz")
    touch(dataset / "sub-02/ses-1/anat", "sub-03_ses-2_hemi-L_dseg.nii.gz")
    own, other = find(tmp_path)
    assert own.notes == ()
    assert (other.subject, other.session) == ("02", "1")
    assert other.notes == ("the file's name has sub-03_ses-2",)


def test_the_subjects_own_space_comes_first(tmp_path):
    lab(tmp_path, *(f"hemi-L_{s}dseg.nii.gz" for s in ("", "space-T1w_", "space-MNI152_")))
    item = only(tmp_path)
    assert item.files[0].name == "sub-01_hemi-L_dseg.nii.gz"
    assert len(item.passed_over) == 2


def test_labels_in_a_template_are_a_problem(tmp_path):
    lab(tmp_path, "hemi-L_space-MNI152NLin6Asym_dseg.nii.gz")
    item = only(tmp_path)
    assert item.problem is not None
    assert item.problem.reason == "template-space"


def test_without_a_table_only_a_named_dataset_counts(tmp_path):
    dataset = lab(tmp_path, "hemi-L_dseg.nii.gz", "hemi-R_dseg.nii.gz", table=None)
    describe(tmp_path, kind="raw")
    left, right = find(tmp_path, derivatives={"mine": dataset})
    assert left.problem is not None
    assert left.problem.reason == "undescribed-labels"
    assert "--scheme" in str(right.problem)
    described, _ = find(tmp_path, protocol=write_scheme(tmp_path))
    assert described.problem is None
    assert described.protocol.name == "mine"


def test_a_broken_table_is_a_problem_of_its_files(tmp_path):
    lab(tmp_path, "hemi-L_dseg.nii.gz", text="no\tcolumns\n1\t2\n")
    item = only(tmp_path, derivatives={"mine": tmp_path / "derivatives" / "my-lab"})
    assert item.problem is not None
    assert item.problem.reason == "unreadable-table"
    assert "'index' and 'name'" in str(item.problem)


def test_desc_subfields_of_other_software_is_not_hippunfold(tmp_path):
    dataset = lab(tmp_path, "hemi-L_desc-subfields_dseg.nii.gz")
    assert only(tmp_path).protocol.name == "hippunfold"
    describe(dataset, "OurTool")
    assert only(tmp_path).protocol.name == "mylab"


def test_tables_are_read_anew_in_each_search(tmp_path):
    dataset = lab(tmp_path, "hemi-L_dseg.nii.gz")
    assert only(tmp_path).protocol.codes == {1, 2, 3}
    (dataset / "dseg.tsv").write_text(TABLE.replace("\n3\t", "\n4\t"), encoding="utf-8")
    assert only(tmp_path).protocol.codes == {1, 2, 4}
