"""Permutations, sessions and sides of the group level, from files to files."""

import json

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from small_cohorts import (
    PLAN,
    methods_of,
    place_of,
    run_named,
    table,
    write_dataset,
)

from hipsta_bids.cli.main import main

ALIGNED = ["--align", "none"]
PLAIN = [*ALIGNED, "--no-classification"]
pytestmark = pytest.mark.usefixtures("without_figures")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("one-session"))


def test_permutations_are_in_the_tables_of_the_map(dataset, quick):
    corrected = {}
    for method in ("permutation-tfce", "permutation-max"):
        options = [*quick, *PLAIN, "--correction", method, "--permutations", "100"]
        folder = run_named(dataset, *options)
        found = table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
        assert found.p_corrected.min() == pytest.approx(1 / 100)
        assert (found.significant == (found.p_corrected <= 0.05)).all()
        peak = table(folder / "peaks.tsv").query("measure == 'thickness' and hemi == 'L'").iloc[0]
        here = found[(found.x == peak.x) & (found.y == peak.y)].iloc[0]
        assert here.p_corrected == peak.p_corrected
        text = methods_of(folder)
        assert "100 permutations" in text
        assert "seed 3" in text
        enhanced = "the largest threshold-free cluster enhancement [" in text
        assert enhanced == (method == "permutation-tfce")
        corrected[method] = found
    maximum = corrected["permutation-max"]
    # The largest t has the smallest p: the correction is monotone.
    order = maximum.statistic.abs().argsort()
    assert (np.diff(maximum.p_corrected.to_numpy()[order]) <= 0).all()
    overview = table(folder / "maps.tsv").set_index(["measure", "hemi"])
    largest = maximum.p[maximum.significant].max()
    assert overview.loc[("thickness", "L"), "p_cutoff"] == pytest.approx(largest)
    again = run_named(dataset, *options)
    pd.testing.assert_frame_equal(
        maximum, table(again / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    )


def test_statistics_of_both_sides_are_one_cifti_file(dataset, quick):
    folder = run_named(dataset, *quick, *PLAIN, "--measures", "thickness")
    image = nib.load(folder / "contrast-CNAD_desc-thickness_statmap.dscalar.nii")
    assert image.nifti_header.get_intent()[0] == "ConnDenseScalar"
    assert list(image.header.get_axis(0).name) == ["t", "d", "pcorrected"]
    parts = list(image.header.get_axis(1).iter_structures())
    names = [name for name, *_ in parts]
    assert names == [f"CIFTI_STRUCTURE_HIPPOCAMPUS_{side}" for side in ("LEFT", "RIGHT")]
    for hemi, (_, part, model) in zip("LR", parts, strict=True):
        surface = nib.load(folder / f"hemi-{hemi}_space-unfold_midthickness.surf.gii")
        assert list(model.nvertices.values()) == [len(surface.darrays[0].data)]
        own = nib.load(
            folder / f"hemi-{hemi}_contrast-CNAD_stat-d_desc-thickness_statmap.shape.gii"
        )
        np.testing.assert_array_equal(image.get_fdata()[1, part], own.darrays[0].data)


def test_pooled_family_is_no_less_strict(dataset, quick):
    options = [*quick, *PLAIN, "--correction", "permutation-max", "--permutations", "100"]
    single = run_named(dataset, *options)
    pooled = run_named(dataset, *options, "--fdr-scope", "hemispheres")
    every = run_named(dataset, *options, "--fdr-scope", "all")
    overview = table(every / "maps.tsv").query("contrast == 'CN-AD'")
    assert len(set(overview.n_tests)) == 1
    assert overview.n_tests.iloc[0] == len(overview) * 147
    assert "all maps of a contrast" in (every / "methods.md").read_text()
    name = "hemi-{}_contrast-CNAD_desc-thickness_statmap.tsv"
    for hemi in "LR":
        one, both = (table(folder / name.format(hemi)) for folder in (single, pooled))
        # Everybody has both hemispheres, so that both runs shuffle alike.
        assert (both.p_corrected >= one.p_corrected).all()
        assert (both.p_corrected > one.p_corrected).any()


def test_blocks_are_a_column_inside_which_the_contrast_varies(dataset, quick, capsys):
    data, out = dataset
    options = [*quick, *PLAIN, "--correction", "permutation-max", "--permutations", "20"]
    folder = run_named(dataset, *options, "--blocks", "sex")
    assert "within levels of sex" in (folder / "methods.md").read_text()
    arguments = [str(data), str(out), "group", *options]
    assert main([*arguments, "--blocks", "group"]) == 65
    assert "does not vary inside the blocks" in capsys.readouterr().err
    assert main([*arguments, "--blocks", "sexx"]) == 65
    assert "did you mean sex" in capsys.readouterr().err


def test_first_session_is_the_default_and_says_so(sessions, quick, capsys):
    folder = run_named(sessions, *quick, *PLAIN, "--formula", "group + age")
    assert "60 later sessions are not in it" in capsys.readouterr().out
    assert json.loads((folder / "analysis.json").read_text())["rows"] == 30


def test_asymmetry_is_left_minus_right_in_the_same_model(dataset, quick):
    folder = run_named(dataset, *quick, *PLAIN, "--asymmetry")
    _, out = dataset
    wall = {
        hemi: np.array(
            [
                table(place_of(out, f"{i + 1:02d}", hemi).path("sheet")).thickness
                for i in range(sum(PLAN.sizes))
            ]
        )
        for hemi in "LR"
    }
    relative = (wall["L"] - wall["R"]) / ((wall["L"] + wall["R"]) / 2)
    found = table(folder / "contrast-Mean_desc-thicknessAsymmetry_statmap.tsv")
    # The model's mean over all rows is the mean.
    np.testing.assert_allclose(found.estimate, relative.mean(axis=0), rtol=1e-7)
    assert (folder / "contrast-CNAD_desc-curvatureAsymmetry_statmap.tsv").is_file()
    assert (folder / "contrast-CNAD_stat-t_desc-curvatureAsymmetry_statmap.shape.gii").is_file()
    peaks = table(folder / "peaks.tsv")
    assert set(peaks.contrast[peaks.hemi == "LR"]) == {"mean", "CN-AD"}
    assert "(L - R) / ((L + R) / 2)" in (folder / "methods.md").read_text()


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--correction", "permutation-max", "--permutations", "1"], 64, "at least 2"),
        (["--correction", "permutation-max", "--permutations", "19"], 64, "at least 20 are"),
        (["--blocks", "sex"], 64, "--blocks: has no effect without permutations"),
        (["--permutations", "99"], 64, "--permutations: has no effect without"),
        (["--formula", "group + age", "--age-model", "spline"], 64, "of the default model"),
        (["--formula", "group + age", "--contrast", "nonlinear(age)"], 65, "poly(age, 2)"),
    ],
)
def test_refusals(sessions, capsys, options, code, message):
    data, out = sessions
    before = sorted((out / "group").glob("*")) if (out / "group").exists() else []
    assert main([str(data), str(out), "group", *ALIGNED, *options]) == code
    assert message in capsys.readouterr().err
    assert (sorted((out / "group").glob("*")) if (out / "group").exists() else []) == before
