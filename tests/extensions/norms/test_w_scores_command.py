"""Scores of participants against a group of their cohort, at the command line."""

import nibabel as nib
import numpy as np
import pytest
from pyarrow import parquet
from small_cohorts import methods_of, place_of, table, write_dataset

from hipsta_bids.cli.main import main

ALIGNED = ["--align", "none"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("scored"))


@pytest.mark.usefixtures("without_figures")
def test_w_scores_are_those_of_a_model_without_the_participant(dataset, quick):
    data, out = dataset
    options = ["--no-classification", "--normative", "group=CN", "--name", "scored"]
    assert main([str(data), str(out), "group", *quick, *ALIGNED, *options]) == 0
    folder = out / "group" / "scored"
    people = table(folder / "covariates.tsv")
    wall = np.array(
        [
            table(place_of(out, p.removeprefix("sub-"), "L").path("sheet")).thickness
            for p in people.participant_id
        ]
    )
    matrix = np.column_stack([np.ones(len(people)), people.age, people.sex == "M"]).astype(float)
    healthy = (people.group == "CN").to_numpy()
    scored = parquet.read_table(folder / "wscores.parquet").to_pandas()
    for i in (0, len(people) - 1):  # a member of the reference group, and a patient
        others = healthy & (np.arange(len(people)) != i)
        beta, squares, *_ = np.linalg.lstsq(matrix[others], wall[others], rcond=None)
        sigma = np.sqrt(squares / (others.sum() - 3))
        expected = (wall[i] - matrix[i] @ beta) / sigma
        own = scored[(scored.participant_id == people.participant_id[i]) & (scored.hemi == "L")]
        np.testing.assert_allclose(own.thickness_w, expected, rtol=1e-5)  # single precision
        image = nib.load(folder / "hemi-L_stat-w_desc-thickness_statmap.shape.gii")
        np.testing.assert_allclose(image.darrays[i].data, expected, rtol=1e-5)
        assert image.darrays[i].meta["Name"] == people.participant_id[i]
        row = table(folder / "wscores.tsv").query(
            "participant_id == @people.participant_id[@i] and hemi == 'L' and region == 'all'"
            " and measure == 'thickness'"
        )
        assert row.w.item() == pytest.approx(expected.mean())
    found = table(folder / "wscores.tsv").query("region == 'all' and measure == 'thickness'")
    members = found[found.reference]
    # What counts as low is one in forty of a healthy participant's points.
    assert members.low.mean() == pytest.approx(0.025, abs=0.025)
    assert found[~found.reference].low.mean() > members.low.mean() + 0.02
    text = methods_of(folder)
    assert "against 16 participants with group CN." in text
    assert "including the uncertainty of the model, was below 0.05." in text


def test_w_scores_say_what_is_wrong_with_their_reference(dataset, capsys):
    data, out = dataset
    for option, code, message in (
        ("group=XY", 65, "there are AD, CN"),
        ("grp=CN", 65, "did you mean group"),
        ("CN", 64, "FACTOR=LEVEL"),
    ):
        arguments = [str(data), str(out), "group", *ALIGNED, "--normative", option]
        assert main(arguments) == code
        assert message in capsys.readouterr().err
