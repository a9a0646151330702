"""The term (1|site) at the command line: results, texts, notes and refusals."""

import json

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from small_cohorts import FAST, methods_of, read_participants, run_named, table, write_participants

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.errors import ModelError
from hipsta_bids.group.output import write
from hipsta_bids.reports.group import group_page

pytestmark = pytest.mark.usefixtures("without_figures")
COLUMNS = ("participant_id", "group", "age", "sex", "site", "one", "arm", "pair", "half")
FORMULA = "group + age + (1|site)"


def add_sites(data):
    """Six sites; site F has one participant, and the last participant has none."""
    rows = read_participants(data)
    for i, row in enumerate(rows):
        site = "n/a" if i == len(rows) - 1 else "F" if i == 3 else "ABCDE"[i % 5]
        row += [site, "X", "PQ"[i % 2], "PQ"[i % 2], "KL"[i // 15]]
    write_participants(data, rows, COLUMNS)


@pytest.fixture(scope="module")
def sites(written):
    add_sites(written / "bids")
    return written / "bids", written / "out"


@pytest.fixture(scope="module")
def results(sites, quick):
    data, out = sites
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", lambda *_: iter(()))
        assert main([str(data), str(out), "group", "--formula", FORMULA, *quick]) == 0
    return out / "group" / "group-age-1-site"


def test_tables_have_the_variance_between_sites(results):
    random = table(results / "random.tsv").set_index(["measure", "hemi"])
    assert set(random.levels) == {6}
    assert set(random.model) == {FORMULA}
    assert set(random.index.get_level_values("measure")) >= {"thickness", "volume"}
    share = random.level_sd**2 / (random.level_sd**2 + random.residual_sd**2)
    single = random.kind == "summary"
    np.testing.assert_allclose(random.level_icc[single], share[single], rtol=1e-6)
    measures = table(results / "measures.tsv").set_index(["measure", "hemi"])
    # 29 participants and three columns; no variance between sites leaves the linear model.
    zero = random.level_zero[single] == 1
    df = measures.df[zero.index]
    np.testing.assert_allclose(df[zero], 29 - 3)
    assert (df[~zero] < 26).all()
    assert zero.any()
    assert not zero.all()


def test_a_participant_without_a_site_is_excluded(results):
    assert len(table(results / "covariates.tsv")) == 29
    excluded = table(results / "excluded.tsv")
    assert list(excluded.message) == ["site is missing"]


def test_texts_name_the_random_intercept(results):
    text = methods_of(results)
    assert f"A linear mixed model, `{FORMULA}`, was fitted" in text
    assert "The 6 levels of site, with 1 to 6 participants, had random intercepts" in text
    assert "restricted maximum likelihood" in text
    assert "Satterthwaite" in text
    record = json.loads((results / "analysis.json").read_text())
    assert record["formula"] == FORMULA
    assert not any("fixed effect" in note for note in record["notes"])
    assert "The 6 levels of site, with 1 to 6 participants, had random intercepts" in group_page(
        results
    )
    assert (
        json.loads((results / "model.json").read_text())["Nodes"][0]["Model"]["Formula"] == FORMULA
    )


def test_few_sites_give_a_note(sites, capsys):
    folder = run_named(sites, "--formula", "group + (1|half)", *FAST)
    assert "Of fewer than 5 levels, the variance between them is uncertain" in methods_of(folder)
    assert "half has 2 levels; with fewer than 5, a fixed effect (+ half) is safer" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("options", "message"),
    {
        ("--formula", "group + (age|site)"): "only one (1|NAME) can be added",
        ("--formula", "group + (1|site) + (1|sex)"): "only one (1|NAME) can be added",
        ("--formula", "group + (1|sites)"): "no column 'sites'",
        ("--formula", "group + site + (1|site)"): "site is also a fixed term",
        ("--formula", "group + (1|one)"): "all 30 complete rows have one X",
        ("--formula", "group + (1|participant_id)"): "no level of participant_id has two",
        ("--formula", "arm + (1|pair)"): "fixed terms explain all differences between levels",
        ("--formula", FORMULA, "--correction", "permutation-max"): "not with --correction by",
    }.items(),
)
def test_refusals_are_one_line(sites, options, message, capsys):
    data, out = sites
    assert main([str(data), str(out), "group", *options, *FAST]) != 0
    problem = capsys.readouterr().err.strip().splitlines()
    assert message in problem[-1]
    assert "Traceback" not in problem


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param(("--joint", "thickness", "curvature"), "--joint"),
        pytest.param(("--harmonize", "site"), "--harmonize", marks=needs("sites")),
        pytest.param(("--normative", "group=CN"), "--normative", marks=needs("norms")),
        pytest.param(("--export-summary", "here"), "(1|site)", marks=needs("consortia")),
        pytest.param(("--longitudinal",), "--paired", marks=needs("repeated")),
        pytest.param(("--power", "thinning=5%"), "(1|site)", marks=needs("trials")),
    ],
)
def test_other_questions_refuse_it_in_one_line(sites, options, message, capsys):
    data, out = sites
    arguments = [str(data), str(out), "group", "--formula", FORMULA, "--no-reports"]
    assert main([*arguments, *options]) != 0
    problem = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in problem
    assert "(1|" in problem


def test_unequal_variances_are_refused(sites, tmp_path, capsys):
    settings = tmp_path / "hc3.toml"
    settings.write_text('[glm]\ncovariance = "hc3"\n')
    data, out = sites
    options = ["--formula", FORMULA, "--settings", str(settings), *FAST]
    assert main([str(data), str(out), "group", *options]) != 0
    assert "it assumes equal variances" in capsys.readouterr().err


@needs("repeated")
def test_changes_have_sites_too(sessions):
    data, _ = sessions
    add_sites(data)
    folder = run_named(sessions, "--paired", "1", "3", "--formula", FORMULA, *FAST)
    random = table(folder / "random.tsv")
    assert set(random.levels) == {6}
    text = methods_of(folder)
    assert "to the change from ses-1 to ses-3" in text
    assert "levels of site, with" in text


def test_left_minus_right_has_sites_too(sites):
    folder = run_named(sites, "--formula", FORMULA, "--asymmetry", *FAST)
    assert "LR" in set(table(folder / "random.tsv").hemi)


def test_the_python_interface_refuses_it():
    people = pd.DataFrame({"group": ["CN", "AD"] * 6, "site": list("ABC") * 4})
    maps = np.random.default_rng(0).normal(2, 0.1, (12, 3, 4))
    with pytest.raises(ModelError, match=r"\(1\|site\) cannot be fitted here; remove it"):
        hb.group(maps, people, "group + (1|site)")
