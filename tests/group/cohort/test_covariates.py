"""Covariates from several tables, and intracranial volume from other programs' files."""

import pandas as pd
import pytest

from hipsta_bids.errors import InputError
from hipsta_bids.group.cohort.covariates import read_covariates, read_icv, relocate
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files

VISITS = pd.DataFrame(
    {"participant_id": ["sub-1", "sub-1", "sub-2"], "session_id": ["ses-a", "ses-b", "ses-a"]},
    index=["sub-1_ses-a", "sub-1_ses-b", "sub-2_ses-a"],
)


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text.replace(" ", "\t"))
    return path


def test_tables_are_joined_by_participant_and_by_session(tmp_path):
    write(tmp_path / "participants.tsv", "participant_id sex age\nsub-1 F 70\n2 M 60\nsub-9 F 1\n")
    write(tmp_path / "sub-1" / "sub-1_sessions.tsv", "session_id age\na 70.5\nses-b 72\n")
    write(tmp_path / "phenotype" / "tests.tsv", "participant_id session_id score\n1 b 12\n")
    extra = write(tmp_path / "more.tsv", "participant_id sex\nsub-2 n/a\nsub-1 female\n")
    table, absent, spelled = read_covariates(VISITS, tmp_path, [extra], GroupSettings())
    assert not absent
    assert not spelled
    assert table["age"].tolist() == ["70.5", "72", "60"]
    assert table["sex"].tolist() == ["female", "female", "M"]  # n/a replaces nothing
    assert table["score"].tolist() == [None, "12", None]
    assert table.index.tolist() == VISITS.index.tolist()


def test_tables_without_participants_or_with_one_twice_are_refused(tmp_path):
    bad = write(tmp_path / "a.tsv", "subject age\nsub-1 3\n")
    with pytest.raises(InputError, match="no column participant_id"):
        read_covariates(VISITS, tmp_path, [bad], GroupSettings())
    twice = write(tmp_path / "b.tsv", "participant_id age\nsub-1 3\n1 4\n")
    with pytest.raises(InputError, match="sub-1 occur more than once"):
        read_covariates(VISITS, tmp_path, [twice], GroupSettings())
    # Those who are not in the cohort may stand there as they like.
    others = write(tmp_path / "c.tsv", "participant_id age\nsub-8 3\nsub-8 4\n")
    table, *_ = read_covariates(VISITS, tmp_path, [others], GroupSettings())
    assert table["age"].isna().all()


def test_intracranial_volume_of_freesurfer_and_ashs(tmp_path):
    links = {"fs": (tmp_path / "f s").as_uri(), "ashs": (tmp_path / "ashs").as_uri()}
    files.write_json(tmp_path / "dataset_description.json", {"DatasetLinks": links})
    stats = tmp_path / "f s" / "sub-1" / "stats" / "aseg.stats"
    stats.parent.mkdir(parents=True)
    stats.write_text(
        "# Measure BrainSeg, BrainSegVol, Brain Segmentation Volume, 1100000.0, mm^3\n"
        "# Measure EstimatedTotalIntraCranialVol, eTIV, Estimated Total Intracranial Volume,"
        " 1567890.5, mm^3\n"
    )
    icv = tmp_path / "ashs" / "sub-2" / "final" / "sub-2_icv.txt"
    icv.parent.mkdir(parents=True)
    icv.write_text("sub-2 1400000.25\n")
    sources = [
        "bids:fs:sub-1/mri/lh.hippoAmygLabels-T1.v22.mgz",
        "bids:ashs:sub-2/final/sub-2_left_lfseg_heur.nii.gz",
        "bids:fs:sub-3/mri/lh.hippoAmygLabels-T1.v22.mgz",
        "bids:other:sub-3/x.nii.gz",
    ]
    assert read_icv(sources, [tmp_path] * 4) == [1567890.5, 1400000.25, None, None]
    # The same folders elsewhere, in whatever order they are named.
    (tmp_path / "f s").rename(tmp_path / "new fs")
    (tmp_path / "ashs").rename(tmp_path / "new ashs")
    assert read_icv(sources, [tmp_path] * 4) == [None] * 4
    moved = [relocate(each, [tmp_path / "new ashs", tmp_path / "new fs"]) for each in sources]
    assert moved[2:] == sources[2:]
    assert read_icv(moved, [tmp_path] * 4) == [1567890.5, 1400000.25, None, None]
