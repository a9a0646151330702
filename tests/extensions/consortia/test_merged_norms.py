"""Norms of sites that merge without values of participants, from files to files."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from norm_cohorts import COLUMNS, write_people
from small_cohorts import read_participants, table, write_participants

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms import norming
from hipsta_bids.extensions.norms.centiles import NORM_ARRAYS, People
from hipsta_bids.extensions.norms.file import _digest, load_norms
from hipsta_bids.extensions.norms.sums import columns_of
from hipsta_bids.stats.disclosure import check_sums
from hipsta_bids.stats.settings import ExchangeSettings

MEASURES = ("--measures", "thickness", "thickness_mean", "volume")
SHARED = "[norms]\nshared_knots = [20.0, 50.0, 85.0]\n"


@pytest.fixture(autouse=True, scope="module")
def _no_figures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(norming, "_figures", lambda *_: iter(()))
        yield


@pytest.fixture(scope="module")
def sites(tmp_path_factory):
    """Datasets of two sites, and the norms of each; both register to a template of the first."""
    folder = tmp_path_factory.mktemp("sites")
    (folder / "shared.toml").write_text(SHARED)
    data = {
        name: write_people(folder / name, {name: 60}, number)
        for number, name in enumerate("AB", start=1)
    }
    options = ["--fit-norms", *MEASURES, "--settings", str(folder / "shared.toml")]
    norms = {name: out / "group" / "norms" / "norms.json" for name, (_, out) in data.items()}
    assert main([*map(str, data["A"]), "group", *options]) == 0
    shutil.copy(norms["A"], folder / "template.json")
    for folders in data.values():
        template = ["--template", str(folder / "template.json")]
        assert main([*map(str, folders), "group", *options, *template]) == 0
    return folder, list(norms.values())


@pytest.fixture(scope="module")
def merged(sites):
    folder, norms = sites
    assert main(["meta", "--norms", *map(str, norms), str(folder / "merged")]) == 0
    return folder / "merged" / "norms.json"


def refused(capsys, arguments, *texts, code=65):
    assert main([str(argument) for argument in arguments]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    for text in texts:
        assert text in lines[0]


def test_merged_norms_are_those_of_all_participants(sites, merged):
    folder = sites[0]
    rows = [row for name in "AB" for row in read_participants(folder / name / "bids")]
    (folder / "all").mkdir()
    write_participants(folder / "all", rows, COLUMNS)
    outs = [str(folder / name / "out") for name in "AB"]
    options = [
        "--fit-norms",
        *MEASURES,
        "--template",
        str(folder / "template.json"),
        "--derivatives",
        *outs,
    ]
    options += ["--settings", str(folder / "shared.toml")]
    assert main([str(folder / "all"), str(folder / "pooled"), "group", *options]) == 0
    pooled_file, pooled = load_norms(folder / "pooled" / "group" / "norms" / "norms.json")
    file, found = load_norms(merged)
    assert file.sites == pooled_file.sites == {"A": 60, "B": 60}
    assert set(found) == set(pooled)
    for key, norm in found.items():
        for name in NORM_ARRAYS:
            ours, theirs = getattr(norm, name), getattr(pooled[key], name)
            # Files have nine digits.
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6, err_msg=f"{key} {name}")
    assert np.isfinite(found["L", "thickness"].mean).all(axis=0).mean() > 0.8
    # B is 0.15 mm thicker, with an SD of 1.2 times that of A.
    thickness = found["L", "thickness_mean"]
    assert thickness.shift[1, 0] - thickness.shift[0, 0] == pytest.approx(0.15, abs=0.05)


def test_merged_norms_score_participants_of_a_new_site(merged, tmp_path):
    data, out = write_people(tmp_path, {"D": 40}, 5, cases=10)
    options = ["--norms", str(merged), "--controls", "group=CN"]
    assert main([str(data), str(out), "group", *options]) == 0
    scores = out / "group" / "scores"
    z = table(scores / "zscores.tsv").query("measure == 'volume' and hemi == 'L'")
    group = table(scores / "covariates.tsv").set_index("participant_id").group
    z = z.set_index("participant_id").z
    assert z[group == "CN"].mean() == pytest.approx(0, abs=0.05)
    assert z[group == "AD"].mean() < -1
    text = (scores / "methods.md").read_text()
    assert "no value of a participant left its site" in text
    assert "sinh-arcsinh" not in text


def test_norms_with_sums_hold_no_number_about_fewer_participants(sites):
    """All sums are about the same participants: a point that one lacks has no sums."""
    content = json.loads(sites[1][0].read_text())
    assert "sub-" not in json.dumps(content)
    n = content["columns"][0][0][0][0]
    assert n == content["participants"] == 60
    for measures in content["norms"].values():
        for arrays in measures.values():
            assert set(arrays["n"][0]) <= {0, 60}


def small(tmp_path, change):
    """A site whose table of participants a function changed."""
    data, out = write_people(tmp_path, {"A": 60}, 3)
    rows = read_participants(data)
    change(rows)
    write_participants(data, rows, COLUMNS)
    (tmp_path / "shared.toml").write_text(SHARED.replace("50.0", "40.0, 60.0"))
    options = ["--settings", tmp_path / "shared.toml", "--allow-missing"]
    return [data, out, "group", "--fit-norms", *MEASURES, *options]


def few_men(rows):
    for i, row in enumerate(rows):
        row[3] = "M" if i < 4 else "F"


def nothing(_):
    """The cohort as it is."""


def few_participants(rows):
    del rows[16:]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (few_men, "--fit-norms, site A: sex=M holds fewer than 5 participants"),
        (few_participants, "participants are too few for 5 columns"),
    ],
)
def test_sums_of_few_participants_are_refused(tmp_path, capsys, change, said):
    refused(capsys, small(tmp_path, change), said)


def test_sixty_participants_are_enough_for_four_knots(tmp_path):
    assert main([str(argument) for argument in small(tmp_path, nothing)]) == 0


def test_a_site_of_one_sex_can_send_sums():
    """Its column of sex is zero, and says nothing."""
    age = np.random.default_rng(2).uniform(20, 85, 60)
    people = People(age=age, sex=np.zeros((60, 1)), site=np.zeros(60, dtype=int))
    columns = columns_of(people, np.array([20.0, 50, 85]))
    variables = {"sex": pd.Series(["F"] * 60), "age": pd.Series(age)}
    names = ["constant", "age 1", "age 2", "M"]
    limits = ExchangeSettings()
    cells = check_sums([(columns, names)], {"sex"}, variables, limits, weights=[columns[:, 1]])
    assert [len(rows) for rows in cells] == [60]


@pytest.mark.parametrize("n_old", [4, 30])
def test_few_participants_beyond_a_knot_are_refused(n_old):
    """From five knots on, a combination of columns is zero below the middle knot."""
    random, knots = np.random.default_rng(1), np.array([20.0, 35, 50, 65, 85])
    age = np.round(np.r_[random.uniform(20, 50, 100 - n_old), np.linspace(53, 84, n_old)], 1)
    people = People(age=age, sex=np.zeros((100, 0)), site=np.zeros(100, dtype=int))
    columns = columns_of(people, knots)
    names = ["constant", "spline 1", "spline 2", "spline 3", "spline 4"]

    def check():
        limits = ExchangeSettings(max_leverage=0.999)
        variables = {"age": pd.Series(age)}
        return check_sums([(columns, names)], set(), variables, limits, weights=[columns[:, 1]])

    if n_old == 30:
        assert [len(rows) for rows in check()] == [100]
        return
    with pytest.raises(ModelError, match=r"sums of spline . are about fewer than 5 participants"):
        check()


def test_what_does_not_fit_together_is_refused(sites, tmp_path, capsys):
    first, second = sites[1]
    out = tmp_path / "out"

    def edited(**changes):
        content = json.loads(second.read_text()) | changes
        path = tmp_path / "edited.json"
        path.write_text(json.dumps(content | {"hash": _digest(content)}))
        return path

    refused(capsys, ["meta", "--norms", first, out], "two sites or more", code=64)
    refused(capsys, ["meta", "--norms", first, first, out], "site A is in two files")
    other = edited(knots=[20.0, 51.0, 85.0])
    refused(capsys, ["meta", "--norms", first, other, out], "knots differs from")
    refused(capsys, ["meta", "--norms", first, edited(columns=[]), out], "has no sums")
    refused(capsys, ["meta", "--norms", first, edited(columns=[[[[1.0]]]]), out], "do not fit")
    settings = tmp_path / "many.toml"
    settings.write_text("[norms]\nleast_participants = 121\n")
    options = ["--settings", settings]
    refused(capsys, ["meta", "--norms", first, second, *options, out], "120 participants, 121 are")
    assert not out.exists()
