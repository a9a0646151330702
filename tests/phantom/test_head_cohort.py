"""Cohorts of phantoms with a head, from the command line to their measures."""

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import find_hemispheres
from hipsta_bids.phantom.head import HeadPhantom, HeadSpec
from hipsta_bids.protocols.load import load_protocol

OPTIONS = ("--head", "0", "--n-subjects", "2", "--site", "Oslo")
BODY = slice(0, 21)
FREESURFER = load_protocol("freesurfer")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("heads") / "bids"
    assert main(["phantom", str(out), *OPTIONS]) == ExitCode.OK
    return out


@pytest.fixture(scope="module")
def patient(dataset):
    """Table of truth of the left side of the participant with a thinner head, by region."""
    truth = pd.read_csv(dataset / "phantom_truth.tsv", sep="\t")
    return truth[(truth.subject == "sub-Oslo02") & (truth.hemi == "L")].set_index("region")


@pytest.mark.parametrize("digitations", [0, 2])
def test_labels_have_the_volume_of_the_truth(digitations):
    phantom = HeadPhantom(HeadSpec(digitations=digitations, straight=32.0, thinning=0.2, taper=5.0))
    size = (0.5, 0.5, 0.5)
    drawn = phantom.label_volume(FREESURFER, hemi="L", pose=None, voxel_size=size, axes="LIA")
    wall = np.isin(drawn.tissue, FREESURFER.sheet).sum() * np.prod(size)
    assert wall == pytest.approx(phantom.region_summary("headbody")["volume"], rel=0.01)


@needs("regions")
def test_head_is_measured_and_has_the_planted_difference(dataset, patient, tmp_path):
    where = ["--participant-label", "Oslo02", "--hemi", "L", "--n-procs", "1", "--no-reports"]
    where += ["--region", "headbody", "--ends", str(dataset / "phantom_ends.tsv")]
    assert main([str(dataset), str(tmp_path), "participant", *where]) == ExitCode.OK
    stem = "sub-Oslo02/anat/sub-Oslo02_hemi-L_seg-freesurfer_label-headbody_desc-{}_morph.tsv"
    (summary,) = pd.read_csv(tmp_path / stem.format("summary"), sep="\t").itertuples()
    assert summary.thickness_mean == pytest.approx(patient.thickness_mean["headbody"], abs=0.02)
    assert summary.extent_x == pytest.approx(patient.extent_x["headbody"], rel=0.03)
    assert summary.extent_y == pytest.approx(patient.extent_y["headbody"], rel=0.03)
    sheet = pd.read_csv(tmp_path / stem.format("sheet"), sep="\t")
    rows = sheet.groupby("y").thickness.mean().to_numpy()
    assert np.nanmean(rows[BODY]) == pytest.approx(patient.thickness_mean["body"], abs=0.02)
    effect = pd.read_csv(dataset / "phantom_effect.tsv", sep="\t").set_index("part")
    assert effect.difference[["tail", "body"]].tolist() == [0, 0]
    found = np.nanmean(rows[BODY.stop :]) - np.nanmean(rows[BODY])
    assert found == pytest.approx(effect.difference["head"], abs=0.03)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--layout", "ashs"], "ashs has no subfields in the head; choose from freesurfer"),
        (["--head", "5"], "0 to 4 digitations, not 5"),
        (["--region", "CA1"], "region 'CA1' is unknown; choose from head"),
        (["--shift", "1"], "remove shift, cortex, kind, probabilities"),
        (["--thinning", "1.5"], "a wall of 1."),
        (["--thinning", "nan"], "nan mm thinner"),
    ],
)
def test_what_a_head_cannot_have_is_refused_in_one_line(tmp_path, capsys, options, words):
    code = main(["phantom", str(tmp_path / "out"), *OPTIONS, *options])
    assert code == ExitCode.USAGE
    text = capsys.readouterr().err
    assert words in text
    assert text.count("\n") == 1


def test_heads_in_the_layout_of_hippunfold_are_found(tmp_path):
    options = ["--layout", "hippunfold", "--n-subjects", "1"]
    options += ["--voxel-size", "1", "1", "1"]
    assert main(["phantom", str(tmp_path), *OPTIONS, *options]) == ExitCode.OK
    found = find_hemispheres(InputRequest(bids_dir=tmp_path))
    assert [(item.hemi, item.protocol.name) for item in found] == [
        ("L", "hippunfold"),
        ("R", "hippunfold"),
    ]
