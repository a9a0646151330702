"""Several measures together, from files to files, and refusals."""

from types import SimpleNamespace

import numpy as np
import pytest
from extension_marks import needs
from small_cohorts import table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ModelError
from hipsta_bids.group.output import figures, write
from hipsta_bids.group.output.steps import plan_steps
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.inference import combine_evidence


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("joint"))


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    """Figures of single measures take longer than all else."""
    monkeypatch.setattr(write, "draw_figures", only_joint)


def only_joint(*given):
    return ((name, draw) for name, draw in figures.draw_figures(*given) if name == "joint_maps")


def run(dataset, quick, *options):
    data, out = dataset
    few = ["--no-classification", "--name", "j"]
    few += ["--permutations", "200"] if "--joint" in options else []
    assert main([str(data), str(out), "group", *quick, *few, *options]) == 0
    return out / "group" / "j"


def test_joint_test_is_in_all_results(dataset, quick):
    folder = run(dataset, quick, "--joint", "thickness", "curvature")
    maps = table(folder / "maps.tsv").set_index(["measure", "hemi"])
    assert maps.n_significant["joint", "L"] > 0
    rows = table(folder / f"{maps.file['joint', 'L']}.tsv")
    for name in ("thickness", "curvature"):
        own = table(folder / f"{maps.file[name, 'L']}.tsv")
        np.testing.assert_allclose(rows[f"p_{name}"], own.p, rtol=1e-8)
    np.testing.assert_allclose(
        rows.statistic,
        combine_evidence(rows[["p_thickness", "p_curvature"]].to_numpy().T, "fisher"),
        rtol=1e-6,
    )
    assert (rows.significant == (rows.p_corrected <= 0.05)).all()
    assert rows.p_corrected.min() == 1 / 200
    peak = table(folder / "joint_peaks.tsv").iloc[0]
    assert "thickness d " in peak.measures
    assert "curvature d " in peak.measures
    assert (peak.test, peak.hemi) == ("z", "L")
    text = (folder / "methods.md").read_text()
    assert "non-parametric combination" in text
    assert "10.1002/hbm.23115" in text
    page = group_page(folder)
    assert "thickness and curvature are tested together, by 200 permutations" in page
    assert "together corrected p" in page
    assert list((folder / "figures").glob("joint_maps.*"))


def test_both_sides_of_a_measure_together(dataset, quick):
    how = ["--correction", "permutation-tfce", "--joint-sides"]
    folder = run(dataset, quick, "--joint", "thickness", *how)
    maps = table(folder / "maps.tsv").set_index(["measure", "hemi"])
    assert maps.file["joint", "both"] == "contrast-CNAD_desc-joint_statmap"
    rows = table(folder / f"{maps.file['joint', 'both']}.tsv")
    assert {"p_thickness_left", "p_thickness_right"} <= set(rows)
    assert maps.n_significant["joint", "both"] > 0
    assert "Both sides:" in group_page(folder)
    drawing = (folder / "figures" / "joint_maps.svg").read_text()
    n, tested = maps.n_significant["joint", "both"], maps.n_tests["joint", "both"]
    assert f">Significant: {n} of {tested} points<" in drawing
    assert ">Joint evidence, CN-AD<" in drawing


def test_maps_of_left_minus_right_together(dataset, quick):
    names = ["thickness_asymmetry", "curvature_asymmetry"]
    folder = run(dataset, quick, "--asymmetry", "--align", "none", "--joint", *names)
    maps = table(folder / "maps.tsv").set_index(["measure", "hemi", "contrast"])
    rows = table(folder / f"{maps.file['joint', 'LR', 'mean']}.tsv")
    p = [table(folder / f"{maps.file[name, 'LR', 'mean']}.tsv").p for name in names]
    np.testing.assert_allclose(rows.statistic, combine_evidence(np.array(p), "fisher"), rtol=1e-6)
    assert set(table(folder / "joint_peaks.tsv").contrast) == {"CN-AD", "mean"}
    assert "left minus right" in group_page(folder)
    assert list((folder / "figures").glob("joint_maps.*"))


def test_sides_with_a_covariate_at_each_point_together(dataset, quick):
    how = ["--formula", "thickness ~ group + map(curvature)", "--align", "none"]
    folder = run(dataset, quick, *how, "--joint", "thickness", "--joint-sides")
    joint = table(folder / "contrast-MapCurvature_desc-joint_statmap.tsv")
    sides = [f"hemi-{hemi}_contrast-MapCurvature_desc-thickness_statmap.tsv" for hemi in "LR"]
    p = np.stack([table(folder / name)["p"] for name in sides])
    np.testing.assert_allclose(joint["statistic"], combine_evidence(p, "fisher"), rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--joint", "thickness", "thick"], "no map is called 'thick'; there are thickness, curv"),
        (["--joint", "thickness"], "name two measures"),
        (["--joint-sides"], "name two measures"),
        (["--joint", "thickness", "thickness"], "named twice"),
        (
            ["--joint", "thickness", "curvature", "--contrast", "group[AD]-group[CN] > 0"],
            "one-sided tests are not permuted; use --correction fdr2, without --joint",
        ),
    ],
)
def test_refusals(dataset, capsys, options, words):
    data, out = dataset
    assert main([str(data), str(out), "group", "--name", "no", *options]) == 65
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (out / "group" / "no").exists()


def test_permutations_have_no_effect_without_a_test_that_permutes(dataset, capsys):
    data, out = dataset
    assert main([str(data), str(out), "group", "--permutations", "99"]) == 64
    assert "without permutations, by --correction or --joint; remove" in capsys.readouterr().err


def test_refused_where_residuals_cannot_be_permuted(dataset, capsys, tmp_path):
    path = tmp_path / "hc3.toml"
    path.write_text('[glm]\ncovariance = "hc3"\n[joint]\nmeasures = ["thickness", "curvature"]\n')
    data, out = dataset
    assert main([str(data), str(out), "group", "--settings", str(path)]) == 65
    assert "permutations assume equal variances" in capsys.readouterr().err


@needs("repeated")
def test_visits_as_categories_are_not_tested_together():
    from hipsta_bids.extensions.repeated.sessions import Visits  # noqa: PLC0415  (may be deleted)

    request = SimpleNamespace(
        settings=GroupSettings().changed(joint={"measures": ("a", "b")}),
        options={},
        contrasts=(),
        model=SimpleNamespace(maps=(), summaries=(), random=""),
        measures=SimpleNamespace(maps=("a", "b")),
        comparison=SimpleNamespace(sessions=Visits()),
    )
    with pytest.raises(ModelError, match="--longitudinal visits: not with --joint"):
        plan_steps(request)
