"""Every entry of a dataset and every hemisphere has a row, whatever laboratories call things."""

import random
from pathlib import Path

import pytest
from input_cases import touch

from hipsta_bids.errors import InputError, NothingToDoError
from hipsta_bids.inputs.account import count_inputs, input_table, other_entries_table
from hipsta_bids.inputs.search import InputRequest, find_inputs

FS = "{}h.hippoAmygLabels-T1.v22.mgz"
ASHS = "x_{}_lfseg_corr_usegray.nii.gz"


def account(bids_dir, **options):
    """List the rows of a search by path and hemisphere."""
    found = find_inputs(InputRequest(bids_dir=bids_dir, **options))
    rows = input_table(found.items, (*found.ignored, *found.other_entries), bids_dir)
    assert sum(int(part.split()[0]) for part in count_inputs(rows).split(", ")) == len(rows)
    assert len(other_entries_table(found.other_entries)) <= len(found.other_entries)
    return {(row["path"], row.get("hemi"), row.get("seg")): row for row in rows}


def statuses(rows):
    """Return status and reason of each path."""
    return {path: (row["status"], row["reason"]) for (path, *_), row in rows.items()}


def put_freesurfer(folder):
    touch(folder / "mri", *(FS.format(side) for side in "lr"))


def put_ashs(folder):
    touch(folder / "final", *(ASHS.format(side) for side in ("left", "right")))


# What nobody named


def test_folders_of_ashs_of_any_name(tmp_path):
    ashs = tmp_path / "derivatives" / "ashs"
    for name in ("P001", "AD_05", "20230117_1203", "sub-04"):
        put_ashs(ashs / name)
    rows = statuses(account(tmp_path, ashs_atlas="ashsPMC"))
    for name, label in (("P001", "P001"), ("AD_05", "AD05"), ("20230117_1203", "202301171203")):
        status, reason = rows[f"derivatives/ashs/{name}"]
        assert status == "not used"
        assert reason.endswith(f"--ashs-dir {ashs} takes it as sub-{label}")
    found = find_inputs(InputRequest(bids_dir=tmp_path, ashs_dir=ashs, ashs_atlas="ashsPMC"))
    assert {item.subject for item in found.items} == {"04", "202301171203", "AD05", "P001"}
    assert any("renamed: 3 folders (20230117_1203 as sub-2023" in note for note in found.notes)


@pytest.mark.parametrize(
    ("make", "place", "reason"),
    [
        (lambda f: (f / "final").mkdir(parents=True), "", "final/ holds no labels"),
        (lambda f: touch(f, "bootstrap/fusion/lfseg_corr_usegray_left.nii.gz"), "", "no labels in"),
        (lambda f: touch(f, "mri/orig/001.mgz"), "", "its mri folder holds no hippocampal"),
        (lambda f: touch(f, "tse.nii.gz"), "", "no labels of subfields in it"),
        (lambda f: f.mkdir(), "", "no labels of subfields in it"),
        (
            lambda f: (f / "mri" / FS.format("l")).mkdir(parents=True),
            f"/mri/{FS.format('l')}",
            "a folder, though it is named as labels are",
        ),
        (
            lambda f: touch(f / "new run" / "final", ASHS.format("left")),
            "/new run",
            "labels in it (final/x_left_lfseg_corr_usegray.nii.gz), a place",
        ),
        (lambda f: touch(f / "anat", "sub-09_hemi-L_dseg.nii.gz"), "/anat", "no _dseg.tsv defines"),
    ],
)
def test_a_subject_without_labels_has_a_reason(tmp_path, make, place, reason):
    dataset = tmp_path / "mixed"
    put_freesurfer(dataset / "sub-01")
    make(dataset / "sub-09")
    rows = statuses(account(tmp_path, derivatives={"mixed": dataset}))
    named = {path: row for path, row in rows.items() if path.startswith(f"mixed/sub-09{place}")}
    assert named
    status, text = next(iter(named.values()))
    if place != "/anat":  # this dataset is named by the user, so that its labels fail
        assert (status, reason in text) == ("not used", True)
    else:
        assert (status, reason in text) == ("failed", True)


def test_a_missing_hemisphere_has_a_row_and_a_note(tmp_path):
    dataset = tmp_path / "derivatives" / "fs"
    put_freesurfer(dataset / "sub-01")
    touch(dataset / "sub-02" / "mri", FS.format("r"))
    found = find_inputs(InputRequest(bids_dir=tmp_path))
    assert found.notes == ("no labels of one hemisphere: 1 visit (sub-02 L)",)
    row = account(tmp_path)["derivatives/fs/sub-02/mri", "L", None]
    assert (row["status"], row["subject"]) == ("not used", "sub-02")
    # Nobody misses what was not asked for.
    assert find_inputs(InputRequest(bids_dir=tmp_path, hemis=("R",))).notes == ()


def test_labels_outside_of_subjects_folders(tmp_path):
    dataset = tmp_path / "derivatives" / "ashs"
    put_ashs(dataset / "sub-01")
    touch(dataset, ASHS.format("left"), "README")
    touch(dataset / "collected" / "final", ASHS.format("right"))
    rows = statuses(account(tmp_path, ashs_atlas="ashsPMC"))
    assert rows["derivatives/ashs/README"] == ("not a segmentation", "no subject's folder")
    status, reason = rows[f"derivatives/ashs/{ASHS.format('left')}"]
    assert (status, reason[:6]) == ("not used", "labels")
    status, reason = rows["derivatives/ashs/collected"]
    assert status == "not used"


@pytest.mark.parametrize("inner", ["sub-01", "sub-01/mri"])
def test_the_folder_of_one_subject_is_answered_by_that_of_all(tmp_path, inner):
    fs = tmp_path / "fs"
    put_freesurfer(fs / "sub-01")
    with pytest.raises(NothingToDoError, match=rf"give the folder of all subjects, {fs}$"):
        find_inputs(InputRequest(bids_dir=tmp_path, freesurfer_dir=fs / inner))


def test_people_of_the_dataset_without_any_labels(tmp_path):
    put_freesurfer(tmp_path / "derivatives" / "fs" / "sub-01")
    touch(tmp_path, "sub-01/anat/a", "sub-02/anat/b")
    rows = statuses(account(tmp_path))
    assert rows["sub-02"] == ("not used", "no dataset has labels of it")
    assert rows["sub-01"][0] == "not a segmentation"  # this folder of raw images


# Names


def test_letters_that_labels_lack(tmp_path):
    fs = tmp_path / "fs"
    for name in ("Müller", "Bjørn", "王", "Ana-María 2"):
        put_freesurfer(fs / name)
    found = find_inputs(InputRequest(bids_dir=tmp_path, freesurfer_dir=fs))
    assert {item.subject for item in found.items} == {"Muller", "AnaMaria2"}
    assert "renamed: 2 folders (Ana-María 2 as sub-AnaMaria2, Müller as sub-Muller)" in found.notes
    refused = {entry.path.name: entry.reason for entry in found.ignored}
    assert set(refused) == {"Bjørn", "王"}
    assert all("--participants-map" in reason for reason in refused.values())


@pytest.mark.parametrize(
    ("names", "visits"),
    [
        (
            [
                "OAS30001",
                "OAS30001_MR_d0129",
                "OAS30001_MR_d0129.long.OAS30001",
                "OAS30001_MR_d0757.long.OAS30001",
                "OAS30002_MR_d0001",
            ],
            {("OAS30001", "MRd0129"), ("OAS30001", "MRd0757"), ("OAS30002MRd0001", None)},
        ),
        (
            ["002_S_0295_20061102", "002_S_0295_20070525", "002_S_0295.base", "0021_S_1"],
            {("002S0295", "20061102"), ("002S0295", "20070525"), ("0021S1", None)},
        ),
        (
            ["tp1.long.bert_base", "tp2.long.bert_base", "bert_base"],
            {("bert", "tp1"), ("bert", "tp2")},
        ),
        (
            ["sub-01a.long.sub-01", "sub-01b.long.sub-01", "sub-01a", "sub-02.long.sub-02_base"],
            {("01", "a"), ("01", "b"), ("02", None)},
        ),
        (
            ["sub-01_ses-1.long.sub-01", "sub-01_ses-2.long.sub-01", "sub-01"],
            {("01", "1"), ("01", "2")},
        ),
    ],
)
def test_the_base_of_longitudinal_runs_names_the_person(tmp_path, names, visits):
    fs = tmp_path / "fs"
    for name in names:
        put_freesurfer(fs / name.removesuffix(".base"))
        if name.endswith(".base"):
            touch(fs / name.removesuffix(".base"), "base-tps")
    found = find_inputs(InputRequest(bids_dir=tmp_path, freesurfer_dir=fs))
    assert {(item.subject, item.session) for item in found.items} == visits
    assert all(item.problem is None for item in found.items)
    assert len(found.items) == 2 * len(visits)
    bases = [
        e for e in found.other_entries if e.reason == "the base of longitudinal runs, no visit"
    ]
    assert [e.path.name for e in bases] == [
        name.removesuffix(".base")
        for name in names
        if name in {"OAS30001", "002_S_0295.base", "bert_base", "sub-01"}
    ]


def test_runs_of_both_kinds_are_never_used_for_one_visit(tmp_path):
    fs = tmp_path / "fs"
    touch(fs / "sub-01_ses-1" / "mri", FS.format("l"))
    put_freesurfer(fs / "sub-01_ses-1.long.sub-01")
    found = find_inputs(InputRequest(bids_dir=tmp_path, freesurfer_dir=fs))
    assert {item.files[0].parent.parent.name for item in found.items} == {
        "sub-01_ses-1.long.sub-01"
    }
    touch(fs / "sub-01_ses-1" / "mri", FS.format("r"))
    found = find_inputs(InputRequest(bids_dir=tmp_path, freesurfer_dir=fs))
    assert {item.files[0].parent.parent.name for item in found.items} == {"sub-01_ses-1"}


# A table of people


def write_people(root, *rows):
    path = root / "people.tsv"
    lines = ["folder\tparticipant_id\tsession_id", *("\t".join(row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("option", ["ashs_dir", "derivatives"])
def test_a_table_says_whose_folders_are(tmp_path, option):
    ashs = tmp_path / "ashs"
    for name in ("P001/V1", "P001/V2", "P001/V3", "Bjørn", "sub-07"):
        put_ashs(ashs / name)
    table = write_people(
        tmp_path,
        *(("P001/V1", "sub-01", "ses-1"), ("P001/V2", "01", "2"), ("Bjørn", "02", "n/a")),
        ("P009", "09", "n/a"),
    )
    options = {option: ashs if option == "ashs_dir" else {"mine": ashs}, "ashs_atlas": "ashsPMC"}
    found = find_inputs(InputRequest(bids_dir=tmp_path, participants_map=table, **options))
    visits = {(item.subject, item.session) for item in found.items}
    assert visits == {("01", "1"), ("01", "2"), ("02", None)}
    reasons = {entry.path.name: entry.reason for entry in found.ignored}
    assert set(reasons) == {"P009", "V3", "sub-07"}
    assert reasons["P009"] == "named in --participants-map, but no dataset has it"
    assert reasons["V3"] == reasons["sub-07"]
    assert "not named in --participants-map" in reasons["V3"]


def test_a_folder_without_its_zeros_is_refused(tmp_path):
    put_ashs(tmp_path / "ashs" / "007")
    table = write_people(tmp_path, ("7", "07", "n/a"))
    request = InputRequest(
        bids_dir=tmp_path, participants_map=table, ashs_dir=tmp_path / "ashs", ashs_atlas="ashsPMC"
    )
    with pytest.raises(InputError, match=f"{table}: column folder: 7 may be 007; write it so"):
        find_inputs(request)


def test_a_person_s_folder_of_visits_is_no_dataset(tmp_path):
    ashs = tmp_path / "ashs"
    for name in ("P001/20230117", "P001/20240117", "P002/20230117"):
        put_ashs(ashs / name)
    put_ashs(ashs / "sub-01")
    rows = statuses(account(tmp_path, ashs_dir=ashs, ashs_atlas="ashsPMC"))
    for name in ("P001", "P002"):
        status, reason = rows[f"ashs/{name}"]
        assert status == "not used"
        assert "--participants-map" in reason


# 200 trees


NAMES = ("sub-01", "sub-02_ses-a", "sub-X_1", "P001", "AD_05", "20230117_1203", "Bjørn", "Müller")
NAMES += ("T1.long.P001", "sub-03", "sub-03_ses-1", "logs", "fsaverage", "README", "a b", "sub-")
PLACES = ("", "mri", "final", "anat", "ses-1/anat", "ses-1/mri", "ses_2/mri", "x/final", "x/y/mri")
FILES = (
    *(FS.format("l"), FS.format("r"), "lh.hippoSfLabels-T1.v10.mgz", "orig.mgz"),
    *(ASHS.format("left"), ASHS.format("right"), "x_lfseg_heur.nii.gz", "tse.nii.gz"),
    "s_hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz",
    *("s_T2w_left_hippocampus_seg.nii.gz", "seg.left.nii.gz", "lut.txt", "s_hemi-R_dseg.nii.gz"),
)
LABELS = {name for name in FILES if name not in {"orig.mgz", "tse.nii.gz", "lut.txt"}}


def grow(root, seed):
    """Make a random tree of a laboratory, and list its files of labels and its entries."""
    chance = random.Random(seed)  # noqa: S311 (trees, no secrets)
    put_freesurfer(root / "sub-good")
    for name in chance.sample(NAMES, 6):
        for _ in range(chance.randint(0, 3)):
            folder = root / name / chance.choice(PLACES)
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / chance.choice(FILES)
            if file.exists():
                continue
            if chance.random() < 0.1:
                file.mkdir()
            else:
                file.touch()
    return [path for path in root.rglob("*") if path.name in LABELS], sorted(root.iterdir())


@pytest.mark.parametrize("seed", range(200))
def test_nothing_of_a_tree_is_without_a_row(tmp_path, seed):
    options = {"ashs_atlas": "ashsPMC"}
    kind = ("derivatives", "freesurfer_dir", "ashs_dir", None)[seed % 4]
    dataset = tmp_path / ("derivatives/lab" if kind is None else "lab")
    labels, entries = grow(dataset, seed)
    if kind == "ashs_dir":
        put_ashs(dataset / "sub-good")
    if kind is not None:
        options[kind] = {"lab": dataset} if kind == "derivatives" else dataset
    rows = account(tmp_path, **options)
    rows_at = {}
    for (path, *_), row in rows.items():
        rows_at.setdefault(tmp_path / path, []).append(row)
    for path in labels:
        places = [path, *(p for p in path.parents if p.is_relative_to(dataset))]
        own = next(rows_at[place] for place in places if place in rows_at)
        # A folder that stands for its labels says so: these are missed.
        reason = own[0]["reason"]
        nobody = reason.startswith(("part of FreeSurfer", "the base of longitudinal"))
        assert path in rows_at or nobody or own[0]["status"] == "not used", path
    for entry in entries:
        assert any(place.is_relative_to(entry) for place in rows_at), entry
    visits = {(r["subject"], r.get("session")) for r in rows.values() if r["status"] == "used"}
    sides = {(r["subject"], r.get("session"), r["hemi"]) for r in rows.values() if "hemi" in r}
    assert {(*visit, hemi) for visit in visits for hemi in "LR"} <= sides
    assert all(Path(row["path"]).name and row["reason"] for row in rows.values())
