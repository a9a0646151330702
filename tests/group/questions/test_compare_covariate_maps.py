"""Models with ``map(NAME)``: a covariate with a value at each point."""

import json

import numpy as np
import pytest
import statsmodels.api as sm
import statsmodels.formula.api as smf
from extension_marks import needs
from small_cohorts import (
    NODES,
    PLAN,
    begin_dataset,
    place_of,
    table,
    write_dataset,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ExitCode

FAST = ("--align", "none", "--no-classification", "--no-reports")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("maps"))


def sheets(out, measure, hemi="L"):
    """(participants, points) of the sheets of a side, as they were written."""
    places = [place_of(out, f"{i + 1:02d}", hemi) for i in range(sum(PLAN.sizes))]
    return np.array([table(place.path("sheet"))[measure].to_numpy() for place in places])


def test_a_map_is_a_covariate_at_each_point(study):
    data, out = study
    command = [str(data), str(out), "group", "--formula", "thickness ~ group + map(curvature)"]
    assert main([*command, "--name", "maps", *FAST]) == ExitCode.OK
    folder = out / "group" / "maps"
    record = json.loads((folder / "analysis.json").read_text())
    assert set(record["contrasts"]) == {"CN-AD", "map(curvature)"}
    people = table(data / "participants.tsv")
    thickness, curvature = sheets(out, "thickness"), sheets(out, "curvature")
    found = {
        name: table(folder / f"hemi-L_contrast-{name}_desc-thickness_statmap.tsv")
        for name in ("CNAD", "MapCurvature")
    }
    for point in (0, 40, 100, 146):
        rows = people.assign(y=thickness[:, point], c=curvature[:, point])
        fit = smf.ols("y ~ C(group, Treatment('CN')) + c", rows).fit()
        expected = {"CNAD": -fit.params.iloc[1], "MapCurvature": fit.params.iloc[2]}
        for name, estimate in expected.items():
            assert found[name]["estimate"][point] == pytest.approx(estimate, rel=1e-5), name
        assert found["MapCurvature"]["p"][point] == pytest.approx(fit.pvalues.iloc[2], rel=1e-4)
    assert not (folder / "summaries.tsv").exists()
    methods = (folder / "methods.md").read_text()
    assert "`group + map(curvature)`, was fitted" in methods
    assert "Casanova R" in methods
    assert record["formula"] == "group + map(curvature)"
    notes = "\n".join(record["notes"])
    assert "summary measures are not tested: map(curvature) has values at points only" in notes


def test_permutations_and_asymmetry_have_the_map(study):
    """Left minus right is explained by the covariate's left minus right; p are permuted."""
    data, out = study
    command = [str(data), str(out), "group", "--formula", "thickness ~ group + map(curvature)"]
    options = ["--correction", "permutation-max", "--permutations", "200", "--asymmetry"]
    assert main([*command, *options, "--name", "permuted", *FAST]) == ExitCode.OK
    folder = out / "group" / "permuted"
    people = table(data / "participants.tsv")
    maps = {
        measure: [sheets(out, measure, hemi) for hemi in "LR"]
        for measure in ("thickness", "curvature")
    }
    left, right = maps["thickness"]
    asymmetry = 2 * (left - right) / (left + right)
    bend = maps["curvature"][0] - maps["curvature"][1]
    found = table(folder / "contrast-MapCurvature_desc-thicknessAsymmetry_statmap.tsv")
    for point in (0, 70, 146):
        rows = people.assign(y=asymmetry[:, point], c=bend[:, point])
        fit = smf.ols("y ~ C(group, Treatment('CN')) + c", rows).fit()
        assert found["estimate"][point] == pytest.approx(fit.params.iloc[2], rel=1e-4)
        assert found["p"][point] == pytest.approx(fit.pvalues.iloc[2], rel=1e-3)
    left_group = table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    assert left_group["p_corrected"].min() >= 1 / 200
    # The largest t has the smallest p: the correction is monotone.
    order = left_group["statistic"].abs().argsort()
    assert (np.diff(left_group["p_corrected"].to_numpy()[order]) <= 0).all()
    assert "200 permutations" in (folder / "methods.md").read_text()


@needs("repeated")
def test_change_by_the_map_at_baseline(tmp_path):
    """A change that depends on the baseline is found where it does; other maps have no effect."""
    data, out = begin_dataset(tmp_path)
    random, rows = np.random.default_rng(2), []
    for i in range(40):
        base = 2 + 0.3 * random.standard_normal(NODES)
        loss = 0.4 * (base - 2) * (np.arange(NODES[0])[:, None] < 10)
        after = base - loss + 0.05 * random.standard_normal(NODES)
        bend = 0.1 * random.standard_normal(NODES)
        for session, wall in (("1", base), ("2", after)):
            for hemi in "LR":
                place = place_of(out, f"{i + 1:02d}", hemi, session=session)
                write_hemisphere(place, wall, bend)
        rows.append([f"sub-{i + 1:02d}", "CN", f"{60 + i % 20}", "FM"[i % 2]])
    write_participants(data, rows)
    command = [str(data), str(out), "group", "--paired", "1", "2", "--name", "change", *FAST]
    formula = "thickness ~ age + map(thickness)"
    assert main([*command, "--formula", formula]) == ExitCode.OK
    folder = out / "group" / "change"
    slope = table(folder / "hemi-L_contrast-MapThickness_desc-thickness_statmap.tsv")
    medial = slope["node_x"] <= 10
    np.testing.assert_allclose(slope["estimate"][medial].mean(), -0.4, atol=0.03)
    assert (slope["p"][medial] < 0.05).mean() > 0.95
    assert (slope["p"][~medial] < 0.05).mean() < 0.15
    command = [str(data), str(out), "group", "--longitudinal", "intercept", "--name", "long", *FAST]
    assert main([*command, "--formula", "thickness ~ age + map(curvature)"]) == ExitCode.OK
    found = table(
        out / "group" / "long" / "hemi-L_contrast-MapCurvature_desc-thickness_statmap.tsv"
    )
    places = [place_of(out, f"{i + 1:02d}", "L", session=s) for i in range(40) for s in "12"]
    sheet = [table(place.path("sheet")) for place in places]
    for point in (3, 120):
        y, bend = (
            np.array([one[name][point] for one in sheet]) for name in ("thickness", "curvature")
        )
        people = np.repeat(np.arange(40), 2)
        design = np.column_stack([np.ones(80), 60 + people % 20, bend])
        model = sm.MixedLM(y, design, people).fit(reml=True, method="lbfgs")
        # The accuracy of that optimizer, and maps in single precision.
        assert found["estimate"][point] == pytest.approx(model.fe_params[2], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["thickness ~ group * map(curvature)"], 65, "add map(NAME) to other terms"),
        (["thickness ~ group + map(thickness)"], 65, "map(thickness) in the formula explains"),
        (["thickness ~ group + map(curvatur)"], 65, "did you mean curvature?"),
        (["thickness ~ group + map(volume)"], 65, "map(volume) in the formula: it is no map"),
        (["volume ~ group + map(curvature)"], 65, "not with summary measures alone"),
        pytest.param(
            ["thickness ~ group + map(curvature)", "--normative", "group=CN"],
            65,
            "--normative: not with map()",
            marks=needs("norms"),
        ),
        pytest.param(
            ["thickness ~ group + map(curvature)", "--harmonize", "sex"],
            65,
            "--harmonize: not with map()",
            marks=needs("sites"),
        ),
    ],
)
def test_what_maps_cannot_do_is_one_line(study, capsys, options, code, said):
    data, out = study
    formula, *more = options
    command = [str(data), str(out), "group", "--formula", formula, "--name", "refused", *FAST]
    assert main([*command, *more]) == code
    error = capsys.readouterr().err
    assert said in error, error
    assert error.count("\n") == 1


def summaries_of(out, measure, hemi="L"):
    places = [place_of(out, f"{i + 1:02d}", hemi) for i in range(sum(PLAN.sizes))]
    return np.array([table(place.path("summary"))[measure].iloc[0] for place in places])


def test_summary_measures_are_covariates_of_their_hemisphere(study):
    data, out = study
    command = [str(data), str(out), "group", "--formula", "thickness ~ volume + group"]
    assert main([*command, "--contrast", "volume", *FAST]) == ExitCode.OK
    folder = out / "group" / "thickness_group-volume"
    people = table(data / "participants.tsv")
    for hemi in "LR":
        thickness, volume = (sheets(out, "thickness", hemi), summaries_of(out, "volume", hemi))
        result = table(folder / f"hemi-{hemi}_contrast-Volume_desc-thickness_statmap.tsv")
        for point in (0, 100, 146):
            rows = people.assign(y=thickness[:, point], v=volume)
            fit = smf.ols("y ~ C(group) + v", rows).fit()
            assert result["estimate"][point] == pytest.approx(fit.params["v"], rel=1e-5)
            assert result["p"][point] == pytest.approx(fit.pvalues["v"], rel=1e-5)
    record = json.loads((folder / "analysis.json").read_text())
    assert record["formula"] == "group + volume"
    notes = "\n".join(record["notes"])
    assert "volume in the formula contains thickness" in notes
    assert "covariates of the same hemisphere" in (folder / "methods.md").read_text()


def test_summary_measures_explain_the_others(study):
    """Of each side its own; of both together their mean."""
    data, out = study
    command = [str(data), str(out), "group", "--formula", "group + volume", "--name", "sizes"]
    command += ["--measures", "thickness", "volume", "thickness_mean"]
    assert main([*command, "--contrast", "CN-AD = group[CN] - group[AD]", *FAST]) == ExitCode.OK
    result = table(out / "group" / "sizes" / "measures.tsv")
    assert set(result["measure"]) == {"thickness_mean"}  # a covariate does not explain itself
    people = table(data / "participants.tsv")
    sides = {
        name: {hemi: summaries_of(out, name, hemi) for hemi in "LR"}
        for name in ("volume", "thickness_mean")
    }
    for name, of_sides in sides.items():
        people[f"{name}_LR"] = sum(of_sides.values()) / 2
        people = people.assign(**{f"{name}_{hemi}": of_sides[hemi] for hemi in "LR"})
    for row in result.to_dict("records"):
        hemi = row["hemi"]
        fit = smf.ols(f"thickness_mean_{hemi} ~ group + volume_{hemi}", people).fit()
        assert row["p"] == pytest.approx(fit.pvalues["group[T.CN]"], rel=1e-8), hemi
        assert row["estimate"] == pytest.approx(fit.params["group[T.CN]"], rel=1e-8), hemi
    assert set(result["hemi"]) == {"L", "R", "LR"}


@pytest.mark.parametrize("formula", ["group * volume", "group + poly(volume, 2)"])
def test_summary_measures_are_terms_of_their_own(study, capsys, formula):
    data, out = study
    assert main([str(data), str(out), "group", "--formula", formula, *FAST]) == ExitCode.BAD_DATA
    assert "volume is a summary measure; add it to other terms" in capsys.readouterr().err


def test_columns_of_the_table_come_before_summary_measures(study, tmp_path):
    data, out = study
    people = table(data / "participants.tsv").assign(volume=np.arange(sum(PLAN.sizes)) ** 2.0)
    people[["participant_id", "volume"]].to_csv(tmp_path / "own.tsv", sep="\t", index=False)
    command = [str(data), str(out), "group", "--formula", "group + volume", "--name", "own"]
    command += ["--covariates", str(tmp_path / "own.tsv"), "--measures", "thickness_mean"]
    assert main([*command, "--contrast", "volume", *FAST]) == ExitCode.OK
    (row,) = table(out / "group" / "own" / "measures.tsv").query("hemi == 'L'").to_dict("records")
    fit = smf.ols("y ~ group + volume", people.assign(y=summaries_of(out, "thickness_mean"))).fit()
    assert row["p"] == pytest.approx(fit.pvalues["volume"], rel=1e-8)
