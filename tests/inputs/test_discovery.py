"""Entries that cannot be used hide nothing else, and are named; FreeSurfer folders of any name."""

import os
from pathlib import Path

import pytest
from input_cases import describe, find, touch

from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.inputs.search import InputRequest, find_inputs, list_subjects

LABELS = tuple(f"mri/{side}h.hippoAmygLabels-T1.v22.mgz" for side in "lr")


@pytest.fixture
def close(monkeypatch):
    """Make folders impossible to list or to look into, also for an administrator."""
    real_list, real_stat = os.scandir, Path.stat
    closed = set()

    def scandir(path):
        if Path(path) in closed:
            raise PermissionError(13, "Permission denied")
        return real_list(path)

    def stat(path, **options):
        if closed.intersection(path.parents):
            raise PermissionError(13, "Permission denied")
        return real_stat(path, **options)

    monkeypatch.setattr(os, "scandir", scandir)
    monkeypatch.setattr(Path, "stat", stat)
    return closed.add


def freesurfer(root, *names):
    for name in names:
        touch(root / name, *LABELS)
    return root


def search(bids_dir, **options):
    return find_inputs(InputRequest(bids_dir=bids_dir, **options))


def subjects(found):
    return sorted({item.subject for item in found.items})


def reasons(found, root):
    return {str(entry.path.relative_to(root)): entry.reason for entry in found.ignored}


# Entries that cannot be listed


@pytest.mark.parametrize("place", ["sub-02", "sub-02/mri", "sub-01/ses-9", "sub-01/anat"])
def test_a_closed_folder_hides_nothing_else(tmp_path, close, place):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-02", "sub-03")
    (fs / place).mkdir(parents=True, exist_ok=True)
    close(fs / place)
    found = search(tmp_path)
    assert subjects(found) == (["01", "03"] if "02" in place else ["01", "02", "03"])
    assert reasons(found, fs) == {
        place: "cannot list the folder (Permission denied); check its permissions"
    }
    # It is nothing to somebody who asks for another one.
    assert search(tmp_path, participant_labels=("03",)).ignored == ()
    assert search(tmp_path, excluded_labels=(place[4:6],)).ignored == ()


def test_a_closed_dataset_hides_nothing_else(tmp_path, close):
    freesurfer(tmp_path / "derivatives" / "a" / "deep", "sub-01")
    closed = freesurfer(tmp_path / "derivatives" / "b", "sub-02")
    close(closed)
    found = search(tmp_path)
    assert subjects(found) == ["01"]
    assert list(reasons(found, tmp_path)) == ["derivatives/b"]
    with pytest.raises(InputError, match=r"derivatives/b: cannot list"):
        search(tmp_path, derivatives={"x": closed})


def test_closed_folders_below_a_named_one_hide_nothing_else(tmp_path, close):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "fs", "bert", "ernie")
    edited = tmp_path / "edited"
    touch(edited, "sub-bert/anat/sub-bert_hemi-L_desc-edited_dseg.nii.gz", "sub-ernie/anat/x")
    close(fs / "ernie")
    close(edited / "sub-ernie" / "anat")
    found = search(tmp_path / "bids", freesurfer_dir=fs, edited_dir=edited)
    assert [len(item.edits) for item in found.items] == [1, 0]
    assert list(reasons(found, tmp_path)) == ["edited/sub-ernie/anat", "fs/ernie"]


def test_links_in_circles_are_named(tmp_path):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    (fs / "sub-09").symlink_to(fs / "sub-09")
    found = search(tmp_path)
    assert reasons(found, fs) == {"sub-09": "no folder, or a link that leads nowhere"}


def test_datasets_in_circles_are_searched_once(tmp_path):
    freesurfer(tmp_path / "derivatives" / "fs", "sub-01")
    for name in "abcd":
        (tmp_path / "derivatives" / name).mkdir()
        (tmp_path / "derivatives" / name / "sourcedata").symlink_to(tmp_path / "derivatives")
    assert len(find(tmp_path)) == 2


# Names


def test_names_that_are_not_bids_are_listed(tmp_path):
    describe(tmp_path, kind="raw")
    touch(tmp_path / "sub-A B" / "anat", "x.nii.gz")
    fs = tmp_path / "derivatives" / "fs"
    freesurfer(fs, "sub-01", "sub-AD_05", "sub-AD_06_ses-1", "bert", "fsaverage", "sub-")
    touch(fs / "sub-02" / "mri", "aseg.mgz")
    touch(fs, "logs/x", "qdec/x")
    found = search(tmp_path)
    assert subjects(found) == ["01"]
    why = reasons(found, tmp_path)
    at = "derivatives/fs/"
    assert set(why) == {"sub-A B"} | {
        at + name
        for name in ("sub-", "sub-02", "sub-AD_05", "sub-AD_06_ses-1", "bert", "fsaverage")
    }
    assert "letters and digits" in why["sub-A B"]
    assert "--freesurfer-dir" not in why["sub-A B"]
    assert why[f"{at}bert"].endswith(f"--freesurfer-dir {fs} takes it as sub-bert")
    assert why[f"{at}sub-AD_05"].endswith("takes it as sub-AD05")
    assert why[f"{at}sub-AD_06_ses-1"].endswith("takes it as sub-AD06")
    assert why[f"{at}sub-02"] == "its mri folder holds no hippocampal subfields"
    assert why[f"{at}fsaverage"] == "part of FreeSurfer, and no subject"
    # Templates are everywhere: they are listed, but not counted.
    (note,) = found.notes
    assert note == (
        "not used: 6 folders (bert, sub-, sub-02, sub-AD_05, sub-AD_06_ses-1, sub-A B); "
        "see --dry-run and the log for the reasons"
    )


@pytest.mark.parametrize("name", ["ses-", "ses-\u00fc", "ses-1_a"])
def test_sessions_of_other_names_are_named(tmp_path, name):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "sub-01", f"sub-01/{name}")
    found = search(tmp_path)
    assert subjects(found) == ["01"]
    place = f"sub-01/{name}"
    assert reasons(found, fs) == {place: "its name is not ses-LABEL, of letters and digits"}
    assert place in found.notes[0]


def test_what_was_not_asked_for_is_not_listed(tmp_path):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "sub-01", "sub-AD_05", "sub-AD_06")
    assert search(tmp_path, participant_labels=("01",)).ignored == ()
    found = search(tmp_path, participant_labels=("01", "AD05"))
    assert list(reasons(found, fs)) == ["sub-AD_05"]
    assert list(reasons(search(tmp_path, excluded_labels=("AD05",)), fs)) == ["sub-AD_06"]


def test_labels_that_are_passed_over_are_not_listed(tmp_path):
    freesurfer(tmp_path / "derivatives" / "a", "sub-01")
    freesurfer(tmp_path / "derivatives" / "b", "sub-01")
    assert search(tmp_path).ignored == ()
    assert search(tmp_path, hemis=("L",)).ignored == ()


@pytest.mark.parametrize("place", ["derivatives/fs", "derivatives/fmriprep/sourcedata/freesurfer"])
def test_folders_without_any_bids_name_are_named_in_the_error(tmp_path, place):
    freesurfer(tmp_path / place, "bert", "AD_05")
    with pytest.raises(NothingToDoError, match=r"Not used: 2 folders \(AD_05, bert\): its name"):
        find(tmp_path)


def test_a_folder_called_mri_that_holds_a_dataset(tmp_path):
    freesurfer(tmp_path / "derivatives" / "study" / "mri", "sub-01")
    found = search(tmp_path)
    assert (subjects(found), found.ignored) == (["01"], ())


# FreeSurfer's folders of any name


@pytest.mark.parametrize("place", ["derivatives/freesurfer", "elsewhere"])
def test_folders_of_any_name_with_their_option(tmp_path, place):
    fs = freesurfer(
        tmp_path / place,
        *("AD_05", "bert", "sub-01", "sub-X-1", "MCI 7_ses-2", "tp1_a", "tp1_a.long.base"),
        *("fsaverage", "fsaverage_sym", "lh.EC_average", "rh.EC_average", "cvs_avg35_inMNI152"),
    )
    touch(fs, "logs/x", "README", "__/mri/x", "empty_1/mri/aseg.mgz")
    found = search(tmp_path, freesurfer_dir=fs)
    assert [(item.subject, item.session) for item in found.items if item.hemi == "L"] == [
        ("01", None),
        ("AD05", None),
        ("MCI7", "2"),
        ("X1", None),
        ("base", "tp1a"),
        ("bert", None),
    ]
    assert all(item.problem is None for item in found.items)
    notes = {item.subject: item.notes for item in found.items}
    assert notes["01"] == ()
    assert notes["AD05"] == ("the folder of sub-AD05 is AD_05",)
    assert notes["bert"] == ("the folder of sub-bert is bert",)
    assert "renamed: 6 folders (AD_05 as sub-AD05, " in found.notes[0]
    assert [entry.path.name for entry in found.ignored if not entry.template] == ["__", "empty_1"]
    assert len(found.ignored) == 7
    request = InputRequest(bids_dir=tmp_path, freesurfer_dir=fs)
    assert list_subjects(request) == ("01", "AD05", "MCI7", "X1", "base", "bert", "empty1")


def test_what_one_option_uses_is_not_listed_for_another_place(tmp_path):
    fs = freesurfer(tmp_path / "derivatives" / "fs", "bert", "ernie")
    touch(fs / "empty" / "mri", "aseg.mgz")
    found = search(tmp_path, freesurfer_dir=fs)
    assert subjects(found) == ["bert", "ernie"]
    assert reasons(found, fs) == {"empty": "its mri folder holds no hippocampal subfields"}


@pytest.mark.parametrize("label", ["AD05", "AD_05", "sub-AD05", "sub-AD_05"])
def test_subjects_by_label_or_by_folder(tmp_path, label):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "fs", "AD_05", "bert")
    options = {"freesurfer_dir": fs, "participant_labels": (label,)}
    assert subjects(search(tmp_path / "bids", **options)) == ["AD05"]
    options = {"freesurfer_dir": fs, "excluded_labels": (label,)}
    assert subjects(search(tmp_path / "bids", **options)) == ["bert"]
    if "_" in label:
        with pytest.raises(UsageError, match="letters and digits"):
            search(tmp_path / "bids", derivatives={"x": fs}, participant_labels=(label,))


@pytest.mark.parametrize(
    "names",
    [("AD05", "AD_05"), ("AD_05", "sub-AD05"), ("AD_05", "A_D05"), ("AD05_ses-1", "AD_05_ses-2")],
)
def test_two_folders_for_one_label_are_refused(tmp_path, names):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "fs", *names, "bert")
    for options in ({}, {"participant_labels": ("AD05", "bert")}, {"session_labels": ("2",)}):
        if "session_labels" in options and "ses" not in names[0]:
            continue
        found = search(tmp_path / "bids", freesurfer_dir=fs, **options)
        bad = [item for item in found.items if item.subject == "AD05"]
        assert bad
        for item in bad:
            assert item.problem.reason == "same-label"
            spelled = " and ".join(name.partition("_ses")[0] for name in names)
            assert str(item.problem).startswith(f"{spelled} would all be sub-AD05; ")
            assert "\n" not in str(item.problem)
        assert all(item.problem is None for item in found.items if item.subject == "bert")


def test_bids_names_of_one_subject_do_not_collide(tmp_path):
    (tmp_path / "bids").mkdir()
    fs = freesurfer(tmp_path / "fs", "sub-01", "sub-01_ses-1", "sub-01_ses-1.long.base")
    found = search(tmp_path / "bids", freesurfer_dir=fs)
    assert len(found.items) == 4
    assert all(item.problem is None for item in found.items)


# Places


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("place", ["derivatives/fmriprep/sourcedata/freesurfer", "sourcedata/fs"])
def test_freesurfer_in_sourcedata(tmp_path, place, own):
    freesurfer(tmp_path / place, "sub-01")
    touch(tmp_path / "derivatives" / "fmriprep" / "logs", "x")
    if own:
        touch(tmp_path / "derivatives" / "fmriprep" / "sub-01" / "anat", "sub-01_T1w.nii.gz")
    found = search(tmp_path)
    assert (subjects(found), found.ignored) == (["01"], ())
    if place.startswith("derivatives"):
        fmriprep = tmp_path / "derivatives" / "fmriprep"
        (tmp_path / "bids").mkdir()
        named = search(tmp_path / "bids", derivatives={"fmriprep": fmriprep})
        assert subjects(named) == ["01"]
