"""The account of inputs on the command line: the line of counts, --dry-run and inputs.tsv."""

import sys

import pytest
from input_cases import put_visits, said_of
from stand_ins import stand_in_jobs

from hipsta_bids.api.datasets import load
from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.participant import run as runner


@pytest.fixture(autouse=True)
def _measured(monkeypatch):
    """Take no time to measure; the files are no images, whose labels a dry run could check."""
    monkeypatch.setattr("hipsta_bids.participant.job.check_item", lambda *_: [])
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(
        runner, "run_jobs", lambda _, jobs: ((job, stand_in_jobs(job)) for job in jobs)
    )


@pytest.fixture
def study(tmp_path):
    """ASHS's folders as laboratories call them; the files say what the stand-in does."""
    for name, act in (
        ("P001", "use"),
        ("AD_05", "use"),
        ("20230117_1203", "bad-input"),
        ("sub-04", "use"),
    ):
        for side in ("left", "right"):
            path = tmp_path / "ashs" / name / "final" / f"x_{side}_lfseg_corr_usegray.nii.gz"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{act} {name} {side}")
    (tmp_path / "ashs" / "P009" / "bootstrap").mkdir(parents=True)
    (tmp_path / "ashs" / "README").touch()
    (tmp_path / "bids").mkdir()
    return tmp_path


def call(capsys, study, *more, code=ExitCode.OK):
    arguments = [study / "bids", study / "out", "participant", "--no-reports", *more]
    arguments += ["--ashs-dir", study / "ashs", "--ashs-atlas", "ashsPMC"]
    assert main.main([str(word) for word in arguments]) == code
    return capsys.readouterr()


def table(study):
    rows = files.read_tsv(study / "out" / "inputs.tsv")
    return {(row["subject"], row["hemi"], row["path"].rpartition("/")[2]): row for row in rows}


def test_every_folder_is_accounted_for(study, capsys):
    said = call(capsys, study, "--dry-run").out
    assert "inputs: 8 used, 0 failed, 1 not used, 1 not a segmentation" in said
    for name in ("P001", "AD_05", "20230117_1203", "sub-04", "P009", "README"):
        assert f"{name} " in said or f"{name}/" in said
    assert "ASHS has not finished" in said
    assert not (study / "out").exists()

    call(capsys, study, code=ExitCode.SOME_FAILED)
    rows = table(study)
    assert len(rows) == 10
    left = "x_left_lfseg_corr_usegray.nii.gz"
    assert rows["sub-AD05", "L", left]["status"] == "used"
    lost = rows["sub-202301171203", "L", left]
    assert (lost["status"], lost["seg"]) == ("failed", "ashsPMC")
    assert rows["sub-P009", "n/a", "P009"]["status"] == "not used"
    assert rows["n/a", "n/a", "README"]["status"] == "not a segmentation"
    described = files.read_json(study / "out" / "inputs.json")
    assert set(described) == set(lost)

    # Who is not asked for keeps the rows of the run before.
    call(capsys, study, "--participant-label", "sub-04")
    assert table(study).keys() == rows.keys()
    assert table(study)["sub-202301171203", "L", left] == lost


def test_a_table_of_people(study, capsys):
    people = study / "people.tsv"
    people.write_text(
        "folder\tparticipant_id\tsession_id\nP001\tsub-01\tses-1\nAD_05\tsub-01\tses-2\nX\t9\tn/a\n"
    )
    said = call(capsys, study, "--participants-map", people, "--dry-run").out
    assert "inputs: 4 used, 0 failed, 4 not used, 1 not a segmentation" in said
    assert said.count("not named in --participants-map") == 3
    assert "named in --participants-map, but no dataset has it" in said
    for text, message in (
        ("folder\tparticipant_id\nP001\tsub_01\n", "line 2: needs folder and participant_id"),
        ("folder\tparticipant_id\nP1\t01\nP1\t02\n", "line 3: folder P1 occurs twice"),
        ("participant_id\n01\n", "line 2: needs folder"),
        ("folder\tparticipant_id\n../ashs/P001\t01\n", "line 2: needs folder"),
        ("folder\tparticipant_id\n.\t01\n", "line 2: needs folder"),
        ("folder\tparticipant_id\tsession_id\nP001\t01\ta_1\n", "line 2: needs folder"),
    ):
        people.write_text(text)
        said = call(capsys, study, "--participants-map", people, code=ExitCode.BAD_DATA).err
        assert message in said
        assert said.count("\n") == 1


@pytest.mark.parametrize("label", ["AD05", "AD_05", "sub-AD_05"])
def test_participants_by_the_name_of_the_folder(study, capsys, label):
    said = call(capsys, study, "--participant-label", label, "--dry-run").out
    assert "inputs: 2 used, 0 failed, 0 not used, 1 not a segmentation" in said


def test_kinds_of_segmentation_are_noted_before_the_group_level_refuses_them(tmp_path, capsys):
    bids = tmp_path / "bids"
    for number, analysis in enumerate(["T1.v22", "T1.v22", "T1-T2.v22"], start=1):
        for side in "lr":
            folder = bids / "derivatives" / "fs" / f"sub-0{number}" / "mri"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{side}h.hippoAmygLabels-{analysis}.mgz").touch()
    arguments = [str(bids), str(tmp_path / "out"), "participant", "--dry-run"]
    assert main.main(arguments) == ExitCode.OK
    notes = [line for line in capsys.readouterr().out.splitlines() if "labels differ" in line]
    note = "labels differ in analysis: T1 (4), T1-T2 (2); group refuses this mix unless"
    assert notes == [f"note: {note} --mixed analysis allows it"]
    assert main.main([*arguments, "--participant-label", "01", "02"]) == ExitCode.OK
    assert "labels differ" not in capsys.readouterr().out
    assert main.main([*arguments, "--participant-label", "1", "02"]) == ExitCode.OK
    assert "no segmentation found for 1 participant (1)" in capsys.readouterr().out
    assert main.main([*arguments, "--participant-label", "1"]) == ExitCode.NOTHING_TO_DO
    assert "; did you mean 01?" in capsys.readouterr().err
    labels = bids / "derivatives" / "hippunfold" / "sub-01" / "anat"
    labels.mkdir(parents=True)
    name = "sub-01_hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz"
    (labels / name).touch()
    assert main.main(arguments) == ExitCode.OK
    said = capsys.readouterr().out
    assert "note: several protocols: freesurfer (6), hippunfold (1); group takes one: --seg" in said


def test_two_folders_of_one_visit_in_the_table_are_refused(study, capsys):
    people = study / "people.tsv"
    people.write_text(
        "folder\tparticipant_id\nP001\t01\nAD_05\t01\n20230117_1203\t02\nsub-04\t04\n"
    )
    said = call(capsys, study, "--participants-map", people, code=ExitCode.SOME_FAILED).err
    assert said.count("[same-label] AD_05 and P001 would all be sub-01;") == 2


def test_where_labels_come_from(tmp_path, capsys):
    bids, out = tmp_path / "bids", tmp_path / "out"
    fs = bids / "derivatives" / "fs"
    places = {
        "sub-01/mri/lh.hippoAmygLabels-T1-T2.v21.mgz": "freesurfer v21 T1-T2 n/a full n/a cross",
        "sub-02/mri/lh.hippoAmygLabels.FS60.mgz": "freesurfer 8.1.0 unnamed n/a FS60+HBT n/a cross",
        "sub-03_ses-1.long.sub-03/mri/lh.hippoAmygLabels-T1.v22.FSvoxelSpace.mgz": (
            "freesurfer v22 T1 n/a full FSvoxelSpace long"
        ),
        "sub-04/final/x_left_lfseg_corr_nogray.nii.gz": (
            "ashs n/a corr_nogray ashsPMC n/a n/a cross"
        ),
        "sub-05/anat/sub-05_hemi-L_space-cropT2w_desc-subfields_atlas-bigbrain_dseg.nii.gz": (
            "hippunfold n/a T2w bigbrain n/a cropT2w cross"
        ),
    }
    for place in (*places, "sub-02/mri/lh.hippoAmygLabels.HBT.mgz"):
        path = fs / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"ok {place}")
    stamp = fs / "sub-02" / "scripts" / "build-stamp.txt"
    stamp.parent.mkdir()
    stamp.write_text("freesurfer-linux-ubuntu22_x86_64-8.1.0-20250806-aaaaaaa\n")
    arguments = [bids, out, "participant", "--no-reports", "--ashs-atlas", "ashsPMC"]
    assert main.main([str(word) for word in arguments]) == ExitCode.OK
    capsys.readouterr()
    names = ("tool", "version", "analysis", "atlas", "hierarchy", "space", "design")
    rows = {row["path"]: row for row in files.read_tsv(out / "inputs.tsv")}
    records = [files.read_json(path)["provenance"] for path in out.rglob("*_desc-qc_metrics.json")]
    frame = load(out, protocol="freesurfer").measures.set_index("participant_id")
    for place, expected in places.items():
        row = rows[f"derivatives/fs/{place}"]
        cells = [row[name] for name in names]
        cells[-1] = cells[-1].removesuffix("-sectional").removesuffix("itudinal")
        assert " ".join(cells) == expected
        assert (row["edited"], row["voxel_size"]) == ("n/a", "0.4 x 0.4 x 1.2")
        assert {name: row[name] for name in records[0]} in records
        if row["seg"] == "freesurfer":
            assert [frame.loc[row["subject"], f"labels_{name}"] for name in names] == [
                row[n] for n in names
            ]


def test_what_a_name_must_not_decide_is_a_question(tmp_path, capsys):
    command = (tmp_path / "bids", tmp_path / "out", "participant", "--no-reports")
    for dataset in ("a", "b"):
        path = tmp_path / "bids/derivatives" / dataset / "sub-01/mri/lh.hippoAmygLabels-T1.v22.mgz"
        path.parent.mkdir(parents=True)
        path.write_text(f"ok {dataset}")
    said = said_of(capsys, *command, code=ExitCode.BAD_DATA)
    first = tmp_path / "bids" / "derivatives" / "a"
    assert (
        f"[several-pipelines] a and b both have labels of freesurfer; choose one: -d a={first}"
        in said
    )
    assert "1 use" in said_of(capsys, *command, "-d", f"a={first}")
    unfolded = tmp_path / "bids/derivatives/h/sub-02/anat"
    unfolded.mkdir(parents=True)
    for run in ("01", "02"):
        name = f"sub-02_run-{run}_hemi-L_space-cropT1w_desc-subfields_dseg.nii.gz"
        (unfolded / name).write_text(f"ok {run}")
    options = ("--participant-label", "02", "--bids-filter-file", tmp_path / "filter.json")
    said = said_of(capsys, *command, *options[:2], code=ExitCode.BAD_DATA)
    assert "[several-files]" in said
    assert "choose by entities with --bids-filter-file" in said
    options[-1].write_text('{"dseg": {"run": 1}}')
    assert "run-01_hemi-L" in said_of(capsys, *command, *options, "--dry-run")
    options[-1].write_text('{"t1w": {"run": 1}}')
    said = said_of(capsys, *command, *options, code=ExitCode.USAGE)
    assert "restricts nothing" in said


def test_content_that_was_not_fetched(tmp_path, capsys):
    path = tmp_path / "bids" / "derivatives/fs/sub-01/mri/rh.hippoAmygLabels.mgz"
    path.parent.mkdir(parents=True)
    path.symlink_to("../.git/annex/objects/x")
    command = (tmp_path / "bids", tmp_path / "out", "participant", "--no-reports")
    assert f"run `datalad get {path}`" in said_of(capsys, *command, "--dry-run")
    said = said_of(capsys, *command, code=ExitCode.BAD_DATA)
    assert f"[not-fetched] {path}: its content was not fetched; run `datalad get {path}`" in said
    (row,) = (r for r in files.read_tsv(tmp_path / "out" / "inputs.tsv") if r["hemi"] == "R")
    assert (row["status"], row["tool"]) == ("failed", "freesurfer")


def test_a_part_notes_its_own_participants_without_labels(tmp_path, capsys):
    bids = tmp_path / "bids"
    for subject in ("sub-01", "sub-02", "sub-03", "sub-04"):
        (bids / subject / "anat").mkdir(parents=True)
    for subject in ("sub-01", "sub-02", "sub-03"):
        (bids / "derivatives" / "fs" / subject / "mri").mkdir(parents=True)
    for subject in ("sub-01", "sub-02"):
        (bids / f"derivatives/fs/{subject}/mri/lh.hippoAmygLabels-T1.v22.mgz").touch()
    notes = []
    for part in ([], ["--shard", "1/2"], ["--shard", "2/2"]):
        arguments = [str(bids), str(tmp_path / "out"), "participant", "--dry-run", *part]
        assert main.main(arguments) == ExitCode.OK
        lines = capsys.readouterr().out.splitlines()
        notes.append([line for line in lines if "no segmentation" in line])
    numbers = ("2 participants (03, 04)", "1 participant (03)", "1 participant (04)")
    assert notes == [[f"note: no segmentation found for {text}"] for text in numbers]


def test_sessions_of_the_dataset_are_named_where_none_matches(tmp_path, capsys):
    put_visits(tmp_path / "bids", "sub-01_ses-m00", "sub-01_ses-m12", "sub-02_ses-m12")
    command = (tmp_path / "bids", tmp_path / "out", "participant", "--session-label")
    text = said_of(capsys, *command, "M12", code=ExitCode.NOTHING_TO_DO)
    assert "--session-label M12" in text
    assert "2 subjects (01, 02) and 2 sessions (m00, m12); looked for" in text
    assert "; did you mean m12?" in text
    text = said_of(capsys, *command, "baseline", code=ExitCode.NOTHING_TO_DO)
    assert "2 sessions (m00, m12)" in text
    assert "did you mean" not in text


@pytest.mark.parametrize("is_relative", [False, True])
def test_files_passed_over_in_another_folder_have_one_row(
    tmp_path, capsys, monkeypatch, is_relative
):
    put_visits(tmp_path / "bids", "sub-01_ses-1", "sub-01_ses-1.long.sub-01")
    monkeypatch.chdir(tmp_path)
    bids_dir = "bids" if is_relative else tmp_path / "bids"
    command = (bids_dir, tmp_path / "out", "participant", "--no-reports")
    text = said_of(capsys, *command, "--dry-run")
    assert "inputs: 2 used, 0 failed, 2 not used, 0 not a segmentation" in text
    assert text.count("sub-01_ses-1.long.sub-01/mri/lh.") == 1
    assert "no _dseg.tsv" not in text
    said_of(capsys, *command)
    rows = table(tmp_path)
    folder = "derivatives/freesurfer/sub-01_ses-1.long.sub-01/mri"
    passed = [row for row in rows.values() if row["status"] == "not used"]
    assert [row["path"].rpartition("/")[0] for row in passed] == 2 * [folder]
