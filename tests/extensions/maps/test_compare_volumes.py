"""Volumes of other programs beside the participant level's own, and intracranial volume."""

import json
import shutil
from html import unescape

import numpy as np
import pandas as pd
import pytest
from small_cohorts import (
    GROUPS,
    PLAN,
    place_of,
    read_participants,
    write_dataset,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.group.output import write
from hipsta_bids.io import files
from hipsta_bids.reports.cells import number_text
from hipsta_bids.reports.group import group_page

SIDES = {"L": ("lh", "left"), "R": ("rh", "right")}
COUNT = sum(PLAN.sizes)


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes")
    write_dataset(folder)
    for path in (folder / "out").rglob("*_desc-summary_morph.tsv"):
        header, row = path.read_text().splitlines()
        path.write_text(f"{header}\tvolume_CA1\n{row}\t{float(row.split()[1]) / 2}\n")
    (folder / "group.toml").write_text("[classification]\nrepeats = 2\nfolds = 3\n")
    return folder


@pytest.fixture
def study(written, tmp_path):
    shutil.copytree(written, tmp_path / "s")
    return tmp_path / "s"


def run(study, *options):
    settings = ["--settings", str(study / "group.toml"), "--align", "none"]
    return main([str(study / "bids"), str(study / "out"), "group", *settings, *options])


def measures(study, name="group-age-sex"):
    path = study / "out" / "group" / name / "measures.tsv"
    return pd.read_csv(path, sep="\t", na_values="n/a")


def subjects(missing=()):
    return [f"{i + 1:02d}" for i in range(COUNT) if f"{i + 1:02d}" not in missing]


def volume(subject):
    """Three more in each patient, and something that varies."""
    return 100.0 + int(subject) % 4 - 3 * (int(subject) > PLAN.sizes[0])


def write_freesurfer(study, missing=()):
    """FreeSurfer's folder as the participant level saw it: records name lh files of all."""
    mri = {subject: study / "fs" / f"sub-{subject}" / "mri" for subject in subjects(missing)}
    for subject, folder in mri.items():
        for hemi, (side, _) in SIDES.items():
            place = place_of(study / "out", subject, hemi)
            labels = f"bids:fs:sub-{subject}/mri/{side}.hippoAmygLabels-T1.v22.FS60.mgz"
            record = json.loads(place.path("qc").read_text()) | {"inputs": [{"file": labels}]}
            files.write_json(place.path("qc"), record)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{side}.hippoSfVolumes-T1.v22.txt").write_text(
                f"CA1-body {volume(subject)}\nWhole_hippocampus {30 * volume(subject)}\n"
            )
    link_sources(study, study / "fs")
    return mri


def link_sources(study, folder):
    content = {"DatasetLinks": {"fs": folder.as_uri()}, "GeneratedBy": [{"Name": "hipsta_bids"}]}
    files.write_json(study / "out" / "dataset_description.json", content)


def write_ashs(study):
    for subject in subjects():
        for _, side in SIDES.values():
            folder = study / "bids" / "ashs" / f"sub-{subject}" / "final"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"x_{side}_corr_usegray_volumes.txt").write_text(
                f"x {side} CA1 15 {volume(subject)}\nx {side} SUB 9 {2 * volume(subject)}\n"
            )
        (folder / "x_icv.txt").write_text(f"x {1e6 + 1e4 * int(subject)}\n")


def test_freesurfer_volumes_join_by_themselves(study, capsys):
    mri = write_freesurfer(study, missing=["30"])
    (mri["04"] / "lh.hippoSfVolumes-T1.v22.txt").write_text("")  # a run that was stopped
    assert run(study) == 0
    said = capsys.readouterr().out
    assert "note: volumes freesurfer: 58 tables" in said
    assert "volumes of sub-04 are excluded" in said
    rows = measures(study)
    own = rows[rows.measure == "volume_freesurfer_CA1_body"].set_index("hemi")
    assert own.n.to_dict() == {"L": COUNT - 2, "R": COUNT - 1, "LR": COUNT - 2}
    assert (own.unit == "mm^3").all()
    assert own.estimate["R"] == pytest.approx(3, abs=1)  # covariates take or give a little
    assert set(rows.measure) >= {"volume", "volume_freesurfer_Whole_hippocampus"}


def test_volumes_by_pattern_are_measures_like_others(study):
    write_ashs(study)
    pattern = "ashs=ashs/sub-{subject}/final/*_corr_usegray_volumes.txt"
    formula = "volume_ashs_SUB + volume ~ group + age"
    options = ["--volumes", pattern, "--formula", formula, "--name", "sub"]
    assert run(study, *options, "--base", "volume_ashs_CA1") == 0
    rows = measures(study, "sub")
    assert set(rows.measure) == {"volume_ashs_SUB", "volume"}
    assert set(rows.hemi) == {"L", "R", "LR"}
    means = pd.read_csv(study / "out" / "group" / "sub" / "descriptives.tsv", sep="\t")
    means = means[(means.measure == "volume_ashs_SUB") & (means.hemi == "L")]
    expected = pd.Series([2 * volume(subject) for subject in subjects()[: PLAN.sizes[0]]])
    assert means["mean"][means.group == GROUPS[0]].iloc[0] == pytest.approx(expected.mean())


@pytest.mark.parametrize("source", ["column", "freesurfer", "ashs"])
def test_sizes_are_adjusted_for_intracranial_volume_of_each_source(study, source, capsys):
    for path in (study / "out").rglob("*_desc-summary_morph.tsv"):
        header, row = path.read_text().splitlines()
        volume = float(row.split()[1])
        sizes = f"{volume ** (2 / 3)}\t{1 + volume / 1e4}\t{volume ** (1 / 3)}"
        path.write_text(f"{header}\tarea_CA1\tarea_ratio\textent_y\n{row}\t{sizes}\n")
    if source == "column":
        people = read_participants(study / "bids")
        rows = [[*row, f"{1.4e6 + 1e4 * k}" if k else "n/a"] for k, row in enumerate(people)]
        write_participants(study / "bids", rows, ("participant_id", "group", "age", "sex", "eTIV"))
    elif source == "freesurfer":
        for subject, mri in write_freesurfer(study).items():
            stats = mri.parent / "stats" / "aseg.stats"
            stats.parent.mkdir()
            stats.write_text(
                "# Measure EstimatedTotalIntraCranialVol, eTIV, Estimated Total Intracranial"
                f" Volume, {1.4e6 + 1e4 * int(subject)}, mm^3\n"
            )
    else:
        write_ashs(study)
        for subject in subjects():
            for hemi, (_, side) in SIDES.items():
                place = place_of(study / "out", subject, hemi)
                labels = f"bids:fs:sub-{subject}/final/x_{side}_lfseg_corr_usegray.nii.gz"
                record = json.loads(place.path("qc").read_text()) | {"inputs": [{"file": labels}]}
                files.write_json(place.path("qc"), record)
        link_sources(study, study / "bids" / "ashs")
    assert run(study) == 0
    rows = measures(study)
    name = "eTIV" if source == "column" else "icv"
    adjusted = rows[rows.model == f"group + age + sex + {name}"]
    # The participant level's own, but for thickness and the ratio of areas.
    expected = {"volume", "volume_CA1", "area_CA1", "extent_y"}
    assert set(rows.measure) >= {*expected, "area_ratio", "thickness_mean"}
    if source == "freesurfer":
        expected |= {"volume_freesurfer_CA1_body", "volume_freesurfer_Whole_hippocampus"}
    if source == "ashs":
        expected |= {"volume_ashs_CA1", "volume_ashs_SUB"}
    assert set(adjusted.measure) == expected
    # One degree of freedom goes to it, and the participant without it.
    assert (adjusted.df == COUNT - 5 - (source == "column")).all()
    note = f"volumes, areas and extents are also tested with head size ({name})"
    note += f", which is not known for 1 of {COUNT} rows" * (source == "column")
    assert note in capsys.readouterr().out
    folder = study / "out" / "group" / "group-age-sex"
    assert note in group_page(folder)
    assert "volumes, areas and extents were also adjusted" in (folder / "methods.md").read_text()


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--volumes", "ashs=ashs/sub-{subject}/none.txt"], 66, "no file matches"),
        (["--volumes", "ashs=ashs/*.txt"], 64, "needs {subject}"),
        (["--volumes", "a b=ashs/{subject}.txt"], 64, "letters and digits"),
        (["--volumes", "x=ashs/sub-{subject}/final/*_icv.txt"], 65, "not readable as a table"),
        (["--volumes", "ashs"], 64, "NAME=PATTERN"),
        (["--formula", "volume_fs_CA1 ~ group"], 65, "no measure is called"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(study, capsys, options, code, words):
    write_ashs(study)
    assert run(study, *options) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not (study / "out" / "group").exists()


def with_summaries(study, changes):
    """Plant differences of the patients: (mm, mm3) by hemisphere, of thickness and volume."""
    random = np.random.default_rng(5)
    for subject, group, *_ in read_participants(study / "bids"):
        for hemi, (thicker, larger) in changes.items():
            path = place_of(study / "out", subject.removeprefix("sub-"), hemi).path("summary")
            header, row = (line.split("\t") for line in path.read_text().splitlines())
            cells = dict(zip(header, row, strict=True))
            patient = group == GROUPS[1]
            thickness = 1.8 + 0.05 * random.standard_normal() + thicker * patient
            volume = 500.0 + 20.0 * random.standard_normal() + larger * patient
            cells |= {"thickness_mean": f"{thickness:.4f}", "volume": f"{volume:.2f}"}
            files.write_tsv(path, header, [list(cells.values())])


def opposite(study, capsys):
    """Return notes on opposite changes, which record, methods text, page and output share."""
    folder, words = study / "out" / "group" / "group-age-sex", "change in opposite directions"
    notes = [n for n in files.read_json(folder / "analysis.json")["notes"] if words in n]
    page = group_page(folder)
    start = page.index('<section id="group-found"')
    texts = [
        (folder / "methods.md").read_text(),
        unescape(page[start : page.index("</section>", start)]),
        capsys.readouterr().out,
    ]
    for text in texts:
        assert text.count(words) == len(notes)
        assert all(note in text for note in notes)
    return notes


def test_a_thicker_sheet_of_less_volume_is_noted_with_possible_causes(study, capsys):
    with_summaries(study, {"L": (0.1, -40.0), "R": (0.0, -40.0)})
    assert run(study, "--no-classification") == 0
    rows = measures(study).set_index(["measure", "hemi"])
    assert (rows.p_fdr["volume"] < 0.05).all()
    assert rows.p_fdr["thickness_mean", "L"] < 0.05 <= rows.p_fdr["thickness_mean", "R"]
    (note,) = opposite(study, capsys)
    volume, thickness = (rows.effect_size[name, "L"] for name in ("volume", "thickness_mean"))
    assert volume > 0 > thickness
    assert note.startswith("CN-AD: volume and mean thickness change in opposite directions (left")
    sizes = [number_text(size) for size in (volume, thickness)]
    assert f"(left: volume d {sizes[0]}, thickness_mean d {sizes[1]}" in note
    assert "right" not in note
    assert "Possible causes: labels that miss thin edges" in note


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param((-0.1, -40.0), id="both fall"),
        pytest.param((0.1, 40.0), id="both rise"),
        pytest.param((0.0, -40.0), id="thickness stays"),
        pytest.param((0.1, 0.0), id="volume stays"),
    ],
)
def test_no_note_on_opposite_changes_otherwise(study, capsys, changes):
    with_summaries(study, dict.fromkeys("LR", changes))
    assert run(study, "--no-classification") == 0
    rows = measures(study).set_index(["measure", "hemi"])
    for name, change in zip(("thickness_mean", "volume"), changes, strict=True):
        assert ((rows.p_fdr[name] < 0.05) == (change != 0.0)).all()
    assert opposite(study, capsys) == []
