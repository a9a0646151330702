"""The search as a whole: which datasets, which subjects, which of several, and what is said."""

import json
import pickle
import sys
from pathlib import Path

import pytest
from input_cases import by_key, describe, find, save_values, touch

from hipsta_bids.errors import InputError, NothingToDoError, ProtocolError, UsageError
from hipsta_bids.inputs import tree
from hipsta_bids.inputs.account import selection_table
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import (
    HemisphereInput,
    InputRequest,
    dataset_notes,
    find_hemispheres,
)

LEFT, RIGHT = (f"mri/{side}h.hippoAmygLabels-T1.v22.mgz" for side in "lr")
CROP = "hemi-L_space-cropT1w_desc-subfields_dseg.nii.gz"


def freesurfer(root, *subjects):
    for subject in subjects:
        touch(root / subject, LEFT, RIGHT)
    return root


def subjects(items):
    return [item.subject for item in items]


def test_inputs_are_equal_and_hashable_as_values(tmp_path):
    """Caches take them as keys."""
    freesurfer(tmp_path / "derivatives" / "freesurfer", "sub-01")
    first, second = (find(tmp_path)[0] for _ in range(2))
    assert first == second
    assert hash(first) == hash(second)


# Which datasets


@pytest.mark.parametrize(
    "place",
    [
        "derivatives/freesurfer",
        "derivatives/anything",
        "derivatives",
        "derivatives/run-2/freesurfer",
        "derivatives/fmriprep/sourcedata/freesurfer",
        "sourcedata/freesurfer",
        ".",
    ],
)
def test_default_places(tmp_path, place):
    freesurfer(tmp_path / place, "sub-01")
    touch(tmp_path / "derivatives" / "fmriprep" / "sub-01" / "anat", "sub-01_T1w.nii.gz")
    assert subjects(find(tmp_path)) == ["01", "01"]


def test_a_bids_dir_is_searched_itself_only_if_it_is_a_derivative(tmp_path):
    freesurfer(tmp_path, "sub-01")
    describe(tmp_path, kind="raw")
    with pytest.raises(NothingToDoError, match=r"no derivatives/\* or sourcedata/\*"):
        find(tmp_path)
    describe(tmp_path, kind="derivative")
    assert len(find(tmp_path)) == 2


@pytest.mark.parametrize("name", ["hipsta_bids", "hipsta-bids", "Hipsta_BIDS"])
def test_our_own_outputs_are_not_inputs(tmp_path, name):
    own = tmp_path / "derivatives" / "out"
    freesurfer(own, "sub-01")
    describe(own, name)
    freesurfer(tmp_path / "derivatives" / "fs", "sub-02")
    assert set(subjects(find(tmp_path))) == {"02"}


def test_older_and_broken_descriptions_do_no_harm(tmp_path):
    root = freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    for text in ('{"PipelineDescription": {"Name": "x"}}', "not json", "[1]", '{"GeneratedBy": 3}'):
        (root / "dataset_description.json").write_text(text, encoding="utf-8")
        assert len(find(tmp_path)) == 2


def test_named_datasets_and_convenience_options(tmp_path):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "a", "sub-01")
    ashs = tmp_path / "b"
    touch(ashs / "sub-01" / "final", "x_left_lfseg_heur.nii.gz")
    hippunfold = tmp_path / "c"
    touch(hippunfold / "sub-01" / "anat", f"sub-01_{CROP}")
    options = {"ashs_atlas": "PMC", "hemis": ("L",)}
    by_option = find(
        tmp_path / "bids",
        freesurfer_dir=fs,
        ashs_dir=ashs,
        hippunfold_dir=hippunfold,
        **options,
    )
    names = {"one": fs, "two": ashs, "three": hippunfold}
    by_name = find(tmp_path / "bids", derivatives=names, **options)
    assert [item.protocol.name for item in by_option] == ["ashsPMC", "freesurfer", "hippunfold"]
    assert [item.source for item in by_option] == ["ashs", "freesurfer", "hippunfold"]
    assert [item.source for item in by_name] == ["two", "one", "three"]
    assert [item.files for item in by_name] == [item.files for item in by_option]


def test_a_convenience_option_finds_its_own_kind_only(tmp_path):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "a", "sub-01")
    with pytest.raises(NothingToDoError, match="no hippocampal segmentation"):
        find(tmp_path / "bids", ashs_dir=fs)


def test_a_dataset_given_twice_is_searched_once(tmp_path):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    link = tmp_path / "link"
    link.symlink_to(fs)
    items = find(tmp_path, derivatives={"again": fs, "link": link}, freesurfer_dir=fs)
    assert [item.source for item in items] == ["again", "again"]
    assert all(item.passed_over == () for item in items)


@pytest.mark.parametrize("option", ["bids_dir", "derivatives", "freesurfer_dir"])
@pytest.mark.parametrize("kind", ["missing", "file"])
def test_folders_that_the_user_gave_have_to_exist(tmp_path, option, kind):
    bad = tmp_path / "bad"
    if kind == "file":
        bad.touch()
    options = {"bids_dir": tmp_path / "bids"}
    options["bids_dir"].mkdir()
    options[option] = {"x": bad} if option == "derivatives" else bad
    with pytest.raises(InputError, match=str(bad)):
        find(**options)


def test_a_folder_that_cannot_be_listed(tmp_path, monkeypatch):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    closed = tmp_path / "sourcedata"
    closed.mkdir()
    real = tree.os.scandir

    def scandir(path):
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied")
        return real(path)

    monkeypatch.setattr(tree.os, "scandir", scandir)
    # By default nobody asked for it; named by the user, it has to be readable.
    assert len(find(tmp_path)) == 2
    with pytest.raises(InputError, match=r"cannot list the folder.*Permission denied"):
        find(tmp_path, derivatives={"x": closed})


@pytest.mark.parametrize(
    "place", ["loop", "derivatives/loop", "derivatives/fs/sub-09", "derivatives/fs/sub-01/loop"]
)
def test_links_in_circles_hide_nothing_else(tmp_path, place):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02")
    (tmp_path / place).symlink_to(tmp_path / place)
    assert len(find(tmp_path)) == 4


def test_a_file_that_is_a_link_in_circles_is_its_own_problem(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    labels = tmp_path / "derivatives" / "fs" / "sub-02" / "mri" / "lh.hippoAmygLabels-T1.v22.mgz"
    labels.parent.mkdir(parents=True)
    labels.symlink_to(labels)
    found = find(tmp_path)
    assert [item.subject for item in found] == ["01", "01", "02"]
    with pytest.raises(InputError, match="cannot be read as an image"):
        read_label_volume(found[-1])


# Which subjects, sessions, hemispheres and files


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, ["01", "01", "02", "02", "10", "10"]),
        ({"participant_labels": ("sub-01", "10")}, ["01", "01", "10", "10"]),
        ({"participant_labels": ("02", "99")}, ["02", "02"]),
        ({"hemis": ("R",)}, ["01", "02", "10"]),
        ({"session_labels": ("ses-a",)}, ["10", "10"]),
    ],
)
def test_labels_restrict_the_search(tmp_path, options, expected):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02", "sub-10_ses-a")
    assert subjects(find(tmp_path, **options)) == expected


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"participant_labels": ("99",)}, r"--participant-label 99 .* 2 subjects \(01, 02\)"),
        ({"session_labels": ("b",)}, r"--session-label b .* 2 subjects .* and 0 sessions; looked"),
    ],
)
def test_labels_that_match_nothing(tmp_path, options, message):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02")
    with pytest.raises(NothingToDoError, match=message) as caught:
        find(tmp_path, **options)
    assert "\n" not in str(caught.value)


def test_a_dataset_without_segmentations_says_what_was_looked_for(tmp_path):
    touch(tmp_path / "derivatives" / "fs" / "sub-01" / "mri", "aseg.mgz")
    with pytest.raises(NothingToDoError, match=r"derivatives/fs.*looked for FreeSurfer's"):
        find(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"participant_labels": ("sub_01",)}, "--participant-label"),
        ({"session_labels": ("",)}, "--session"),
        ({"hemis": ("left",)}, "--hemi"),
        ({"hemis": ()}, "--hemi"),
    ],
)
def test_impossible_labels_are_usage_errors(tmp_path, options, message):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    with pytest.raises(UsageError, match=message):
        find(tmp_path, **options)


def filtered(root, query, **options):
    path = root / "filter.json"
    path.write_text(json.dumps(query), encoding="utf-8")
    return find(root, bids_filter_file=path, **options)


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"session": "pre"}, ["pre_space-cropT1w", "pre_space-cropT1w"]),
        ({"session": ["pre", "post"], "hemi": "L"}, ["post_space-cropT1w", "pre_space-cropT1w"]),
        ({"space": "T2w", "hemi": "R"}, ["post_acq-hi_space-T2w", "pre_space-T2w"]),
        ({"space": "T2w", "acquisition": None}, ["pre_space-T2w", "pre_space-T2w"]),
        ({"space": "T2w", "acquisition": "*"}, ["post_acq-hi_space-T2w"] * 2),
        ({"space": "T2w", "acquisition": "Query.NONE", "hemi": "L"}, ["pre_space-T2w"]),
        (
            {"acquisition": [None, "hi"], "space": "T2w", "session": "post"},
            ["post_acq-hi_space-T2w"] * 2,
        ),
        ({"acquisition": "Query.OPTIONAL", "session": "pre"}, ["pre_space-cropT1w"] * 2),
        ({"subject": "01", "session": "post", "datatype": "anat"}, ["post_space-cropT1w"] * 2),
    ],
)
def test_a_filter_file_selects_as_in_fmriprep(tmp_path, query, expected):
    folder = tmp_path / "derivatives" / "hippunfold" / "sub-01"
    for session, acquisition in (("pre", ""), ("post", "acq-hi_")):
        for hemi in "LR":
            stem = f"sub-01_ses-{session}_%shemi-{hemi}_space-%s_desc-subfields_dseg.nii.gz"
            anat = folder / f"ses-{session}" / "anat"
            touch(anat, stem % ("", "cropT1w"), stem % (acquisition, "T2w"))
    items = filtered(tmp_path, {"dseg": query, "t1w": {"run": 1}})
    names = [
        item.files[0].name.removeprefix("sub-01_ses-").replace(f"_hemi-{item.hemi}", "")
        for item in items
    ]
    assert names == [f"{name}_desc-subfields_dseg.nii.gz" for name in expected]


@pytest.mark.parametrize("query", [{"t1w": {"run": 1}}, {"dseg": {}}, {}])
def test_a_filter_file_that_restricts_nothing_is_refused(tmp_path, query):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    with pytest.raises(UsageError, match=r"restricts nothing: segmentations are under 'dseg'"):
        filtered(tmp_path, query)


@pytest.mark.parametrize(
    ("run", "expected"), [(1, ["1", "01"]), ("01", ["1", "01"]), ([2, 3], ["2"]), ("*", None)]
)
def test_numbers_in_a_filter_file_are_numbers(tmp_path, run, expected):
    folder = tmp_path / "derivatives" / "hippunfold" / "sub-01" / "anat"
    names = {
        f"sub-01_run-{label}_hemi-{hemi}_space-cropT1w_desc-subfields_dseg.nii.gz": label
        for label, hemi in (("1", "L"), ("01", "R"), ("2", "L"))
    }
    touch(folder, *names)
    found = filtered(tmp_path, {"dseg": {"run": run}})
    if expected is None:  # two runs of one hemisphere are a question
        assert [item.problem and item.problem.reason for item in found] == ["several-files", None]
        assert "--bids-filter-file" in str(found[0].problem)
    else:
        assert [names[item.files[0].name] for item in found] == expected
        assert all(item.problem is None for item in found)


def test_two_pipelines_of_one_protocol_are_a_question(tmp_path):
    for dataset in ("a", "b"):
        freesurfer(tmp_path / "derivatives" / dataset, "sub-01")
    freesurfer(tmp_path / "derivatives" / "b", "sub-02")
    found = by_key(find(tmp_path))
    problem = found["01", "", "L", "freesurfer"].problem
    assert problem.reason == "several-pipelines"
    path = tmp_path / "derivatives" / "a"
    assert str(problem) == (f"a and b both have labels of freesurfer; choose one: -d a={path}")
    assert found["02", "", "L", "freesurfer"].problem is None
    for name in "ab":
        chosen = find(tmp_path, derivatives={name: tmp_path / "derivatives" / name})
        assert all(item.problem is None for item in chosen)
        assert chosen[0].source == name


@pytest.mark.parametrize(
    "content", [None, "/annex/objects/x\n", "version https://git-lfs.github.com/"]
)
def test_labels_that_were_not_fetched(tmp_path, content):
    root = freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    path = root / "sub-01" / LEFT
    path.unlink()
    if content is None:
        path.symlink_to("../../.git/annex/objects/aa/bb/x/x.mgz")
    else:
        path.write_text(content, encoding="utf-8")
    left, right = find(tmp_path)
    assert right.problem is None
    assert (left.problem.reason, str(left.problem)) == (
        "not-fetched",
        f"{path}: its content was not fetched; run `datalad get {path}`",
    )


@pytest.mark.parametrize("name", ["100307", "sub-100307"])
def test_folders_of_the_human_connectome_project(tmp_path, name):
    (tmp_path / "bids").mkdir()
    study = tmp_path / "study"
    inner = f"{name}/T1w/HippUnfold/T1w/hippunfold/sub-100307/anat/sub-100307"
    touch(study, *(f"{inner}_{CROP.replace('hemi-L', f'hemi-{hemi}')}" for hemi in "LR"))
    touch(study, f"{name}/MNINonLinear/x", f"{name}/T1w/T1w_acpc_dc_restore.nii.gz")
    touch(study / name / "T1w" / name, LEFT, RIGHT)
    items = find(tmp_path / "bids", hippunfold_dir=study)
    assert [(i.subject, i.hemi, i.problem) for i in items] == [("100307", h, None) for h in "LR"]
    items = find(tmp_path / "bids", freesurfer_dir=study)
    assert [(i.subject, i.protocol.name) for i in items] == [("100307", "freesurfer")] * 2
    # Other contrasts beside it are a question, which the table of people answers.
    touch(study, f"{inner.replace('/T1w/hipp', '/T1wT2w/hipp')}_{CROP}")
    (left, _) = find(tmp_path / "bids", hippunfold_dir=study)
    assert "--participants-map" in str(left.problem)
    people = tmp_path / "people.tsv"
    folder = f"{name}/T1w/HippUnfold/T1wT2w/hippunfold/sub-100307"
    people.write_text(f"folder\tparticipant_id\n{folder}\t100307\n", encoding="utf-8")
    (left,) = find(tmp_path / "bids", hippunfold_dir=study, participants_map=people)
    assert left.problem is None
    assert "T1wT2w" in str(left.files[0])


def test_subjects_to_leave_out(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02", "sub-03")
    touch(tmp_path, "sub-02/anat/sub-02_T1w.nii.gz")
    describe(tmp_path, kind="raw")
    request = InputRequest(bids_dir=tmp_path, excluded_labels=("sub-02", "09"))
    items = find_hemispheres(request)
    assert {item.subject for item in items} == {"01", "03"}
    assert dataset_notes(request, items) == ()
    with pytest.raises(NothingToDoError, match="--exclude-participant-label 01"):
        find(tmp_path, excluded_labels=("01", "02", "03"))


def test_for_folders_without_entities_subject_and_session_are_filtered(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01_ses-a", "sub-01_ses-b", "sub-02_ses-a")
    items = filtered(tmp_path, {"dseg": {"session": "a", "subject": "02", "space": "T1w"}})
    assert [item.key[:3] for item in items] == [("02", "a", "L"), ("02", "a", "R")]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ('{"dseg": []}', UsageError, "is not of the form"),
        ('{"dseg": {"sesion": "a"}}', UsageError, "did you mean 'session'"),
        ("[]", UsageError, "is not of the form"),
        ("{", InputError, "not JSON"),
        (None, InputError, "cannot read the filter file"),
    ],
)
def test_a_bad_filter_file(tmp_path, text, error, message):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    path = tmp_path / "filter.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(error, match=message):
        find(tmp_path, bids_filter_file=path)


def test_pybids_is_not_imported_without_need(tmp_path, monkeypatch):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    monkeypatch.setitem(sys.modules, "bids", None)  # importing it fails from here on
    request = InputRequest(bids_dir=tmp_path)
    dataset_notes(request, find_hemispheres(request))


# Which of several


def test_different_protocols_of_a_hemisphere_are_separate_inputs(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    save_values(
        tmp_path / "derivatives" / "ashs" / "sub-01" / "x_left_lfseg_heur.nii.gz",
        [1, 2, 3, 4, 5, 8],
    )
    found = by_key(find(tmp_path))
    assert set(found) == {
        ("01", "", "L", "ashsABC3T"),
        ("01", "", "L", "freesurfer"),
        ("01", "", "R", "freesurfer"),
    }


def test_the_users_dataset_comes_before_default_places(tmp_path):
    freesurfer(tmp_path / "derivatives" / "aa", "sub-01")
    freesurfer(tmp_path / "derivatives" / "bb", "sub-01")
    freesurfer(tmp_path / "sourcedata" / "aa", "sub-01")
    mine = freesurfer(tmp_path / "mine", "sub-01")
    other = freesurfer(tmp_path / "other", "sub-01")
    left, _ = find(tmp_path, derivatives={"mine": mine}, freesurfer_dir=other)
    assert left.source == "mine"
    passed = [name for name, _ in left.passed_over]
    assert passed == [
        str(root / "sub-01" / LEFT)
        for root in (
            other,
            tmp_path / "derivatives" / "aa",
            tmp_path / "derivatives" / "bb",
            tmp_path / "sourcedata" / "aa",
        )
    ]
    assert all("which is preferred" in reason for _, reason in left.passed_over)


def test_usable_comes_before_unusable(tmp_path):
    mine = tmp_path / "mine"
    touch(mine / "sub-01" / "mri", "lh.hippoAmygLabels-T1.v22.HBT.mgz")
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    left, _ = find(tmp_path, derivatives={"mine": mine})
    assert left.source == "fs"
    assert left.passed_over[0][1] == "not usable (no-subfields)"


def test_a_users_protocol_is_checked_even_if_nothing_needs_it(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    with pytest.raises(ProtocolError, match="cannot read the protocol"):
        find(tmp_path, protocol=tmp_path / "absent.toml")


# What is said


def test_the_table_for_a_dry_run(tmp_path):
    touch(
        tmp_path / "derivatives" / "fs" / "sub-01_ses-a" / "mri",
        *(f"lh.hippoAmygLabels{kind}.mgz" for kind in (".CA", ".HBT", ".CA.FSvoxelSpace")),
    )
    touch(tmp_path / "derivatives" / "fs" / "sub-02" / "mri", "lh.hippoAmygLabels.HBT.mgz")
    first, second = selection_table(find(tmp_path))
    assert first == {
        "subject": "01",
        "session": "a",
        "hemisphere": "L",
        "file": (
            "sub-01_ses-a/mri/lh.hippoAmygLabels.CA.mgz + "
            "sub-01_ses-a/mri/lh.hippoAmygLabels.HBT.mgz"
        ),
        "scheme": "freesurferCA",
        "why": "fs: subfields from .CA, head/body/tail from .HBT, analysis unnamed",
        "edited": "n/a",
        "passed over": (
            "lh.hippoAmygLabels.CA.FSvoxelSpace.mgz: resampled to 1 mm; a finer file exists"
        ),
    }
    assert list(second) == list(first)
    assert (second["session"], second["passed over"]) == ("n/a", "n/a")
    assert "NOT USABLE" in second["why"]


def test_notes_name_participants_without_segmentation(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02")
    touch(tmp_path, "sub-01/anat/sub-01_T1w.nii.gz", "sub-09/ses-1/anat/sub-09_ses-1_T1w.nii.gz")
    request = InputRequest(bids_dir=tmp_path)
    no_description, missing = dataset_notes(request, find_hemispheres(request))
    assert "no dataset_description.json" in no_description
    assert missing == "no segmentation found for 1 participant (09)"
    describe(tmp_path, kind="raw")
    request = InputRequest(bids_dir=tmp_path, participant_labels=("01", "sub-77"))
    assert dataset_notes(request, find_hemispheres(request)) == (
        "no segmentation found for 1 participant (77)",
    )


def test_a_pybids_database_is_made_and_used(tmp_path):
    bids_dir, database = tmp_path / "bids", tmp_path / "database"
    describe(bids_dir, kind="raw")
    freesurfer(bids_dir / "derivatives" / "fs", "sub-01")
    touch(bids_dir, "sub-09/ses-1/anat/sub-09_ses-1_T1w.nii.gz")
    request = InputRequest(bids_dir=bids_dir, bids_database_dir=database)
    items = find_hemispheres(request)
    for _ in range(2):
        assert dataset_notes(request, items) == ("no segmentation found for 1 participant (09)",)
        assert list(database.iterdir())
    other = InputRequest(bids_dir=tmp_path, bids_database_dir=database)
    with pytest.raises(InputError, match="was made for"):
        dataset_notes(other, items)
    next(database.iterdir()).write_text("garbage", encoding="utf-8")
    with pytest.raises(InputError, match="cannot use this database"):
        dataset_notes(request, items)


def test_inputs_survive_pickling(tmp_path):
    touch(tmp_path / "derivatives" / "fs" / "sub-01" / "mri", "lh.hippoAmygLabels.HBT.mgz")
    (item,) = find(tmp_path)
    copy = pickle.loads(pickle.dumps(item))  # noqa: S301 (made on this line)
    assert isinstance(copy, HemisphereInput)
    assert (copy.key, copy.files, copy.protocol) == (item.key, item.files, item.protocol)
    assert str(copy.problem) == str(item.problem)


def test_large_trees_are_listed_once_per_folder(tmp_path, monkeypatch):
    freesurfer(tmp_path / "derivatives" / "fs", *(f"sub-{index:03d}" for index in range(50)))
    for index in range(50):
        touch(tmp_path / "derivatives" / "fs" / f"sub-{index:03d}", "surf/lh.white", "label/x/y")
    listed = []
    real = tree.os.scandir
    monkeypatch.setattr(tree.os, "scandir", lambda path: listed.append(str(path)) or real(path))
    assert len(find(tmp_path)) == 100
    folders = [path for path in listed if "sub-" in path]
    assert len(folders) == len(set(folders)) == 100  # each subject and its mri
