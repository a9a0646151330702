"""Several measures together: combined evidence, synchronized permutations, files and refusals."""

import nibabel as nib
import numpy as np
import pytest
from scipy import stats
from small_cohorts import table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.group.design.contrasts import Contrast
from hipsta_bids.group.design.settings import GlmSettings, MultiplicitySettings
from hipsta_bids.group.output import figures, write
from hipsta_bids.group.stats.clusters import sheet_edges
from hipsta_bids.group.stats.glm import fit_points
from hipsta_bids.group.stats.inference import PermutationPart, combine_evidence, permute
from hipsta_bids.reports.group import group_page

SHEET = (6, 4)
HOW = MultiplicitySettings(method="permutation-tfce", permutations=300)
GROUP = Contrast("group", np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("how", ["fisher", "tippett"])
def test_evidence_is_that_of_scipy(how):
    p = np.random.default_rng(0).uniform(0, 0.3, (3, 50))
    expected = stats.norm.isf(stats.combine_pvalues(p, method=how, axis=0).pvalue / 2)
    np.testing.assert_allclose(combine_evidence(p, how), expected, rtol=1e-9)


@pytest.mark.parametrize("how", ["fisher", "tippett"])
def test_evidence_of_extreme_and_missing_p_values(how):
    z = combine_evidence(np.array([[0.0, 1.0, np.nan, 1e-200], [0.0, 1.0, 0.1, 0.5]]), how)
    assert np.isfinite(z[[0, 3]]).all()
    assert z[0] >= z[3] > 20
    assert z[1] == pytest.approx(0, abs=1e-7)
    assert np.isnan(z[2])


def case(seed=0, subjects=30):
    random = np.random.default_rng(seed)
    matrix = np.column_stack(
        [np.ones(subjects), np.arange(subjects) % 2, random.normal(70, 5, subjects)]
    )
    maps = random.standard_normal((2, subjects, 24)) - 0.8 * matrix[:, 1:2]
    return matrix, [
        PermutationPart(own, matrix, np.arange(subjects), sheet_edges(*SHEET)) for own in maps
    ]


@pytest.mark.parametrize("contrast", [GROUP, Contrast("both", np.eye(3)[1:])])
def test_a_measure_with_itself_has_its_own_p(contrast):
    """Evidence rises with t, so that every permutation has the same rank."""
    _, (part, _) = case()
    (alone,) = permute([part], contrast, settings=HOW)
    for how in ("fisher", "tippett"):
        (twice,) = permute([[part, part]], contrast, settings=HOW, combine=how)
        np.testing.assert_array_equal(twice.p_uncorrected, alone.p_uncorrected)
        np.testing.assert_array_equal(twice.p_max, alone.p_max)


def test_evidence_of_a_part_is_that_of_its_t_tests():
    matrix, parts = case(1)
    parts[0].maps[3, 7] = np.nan  # other degrees of freedom
    (found,) = permute([parts], GROUP, settings=HOW, combine="fisher")
    p = [fit_points(one.maps, matrix, [GROUP], GlmSettings()).tests[0].p for one in parts]
    keep = np.arange(24) != 7
    np.testing.assert_allclose(
        found.statistic[keep], combine_evidence(np.array(p), "fisher")[keep], rtol=1e-9
    )
    assert found.p_max.min() < 0.05


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


def test_statistics_of_both_sides_are_one_cifti_file(dataset, quick):
    folder = run(dataset, quick, "--measures", "thickness", "--align", "none")
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


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--joint", "thickness", "thick"], "no map is called 'thick'; there are thickness, curv"),
        (["--joint", "thickness"], "name two measures"),
        (["--joint-sides"], "name two measures"),
        (["--joint", "thickness", "thickness"], "named twice"),
    ],
)
def test_refusals(dataset, capsys, options, words):
    data, out = dataset
    assert main([str(data), str(out), "group", "--name", "no", *options]) == 65
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (out / "group" / "no").exists()


def test_refused_where_residuals_cannot_be_permuted(dataset, capsys, tmp_path):
    path = tmp_path / "hc3.toml"
    path.write_text('[glm]\ncovariance = "hc3"\n[joint]\nmeasures = ["thickness", "curvature"]\n')
    data, out = dataset
    assert main([str(data), str(out), "group", "--settings", str(path)]) == 65
    assert "permutations assume equal variances" in capsys.readouterr().err
