"""Conjunctions and equivalence by the command: tables, text, page, and what is refused."""

import json

import numpy as np
import pytest
from extension_marks import needs
from small_cohorts import (
    NODES,
    begin_dataset,
    methods_of,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.reports.group import group_page

GROUPS = ("CN", "MCI", "AD")
PLAIN = ("--align", "none", "--measures", "thickness", "thickness_mean", "--no-classification")
BOTH = "group[CN] - group[AD] & group[CN] - group[MCI]"
SAME = "|group[CN]-group[MCI]| < 0.1"


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Three groups: AD is 0.3 mm thinner, MCI too, but in the first third of the sheet only."""
    data, out = begin_dataset(tmp_path_factory.mktemp("three"))
    random, rows = np.random.default_rng(1), []
    loss = {name: np.zeros(NODES) for name in GROUPS}
    loss["AD"] += 0.3
    loss["MCI"][: NODES[0] // 3] += 0.3
    for i in range(36):
        group = GROUPS[i % 3]
        for hemi in "LR":
            wall = 1.8 - loss[group] + 0.06 * random.standard_normal(NODES)
            place = place_of(out, f"{i + 1:02d}", hemi)
            write_hemisphere(place, wall, 0.1 + 0.01 * random.standard_normal(NODES))
        rows.append([f"sub-{i + 1:02d}", group, f"{random.uniform(60, 80):.1f}", f"m{i // 3 % 2}"])
    write_participants(data, rows, ("participant_id", "group", "age", "machine"))
    return data, out


def run(cohort, *options, name):
    data, out = cohort
    assert main([str(data), str(out), "group", *PLAIN, "--name", name, *options]) == 0
    return out / "group" / name


@pytest.fixture(scope="module")
def results(cohort):
    return run(cohort, "--contrast", f"both = {BOTH}", f"same={SAME}", "group", name="together")


def points(folder, label, hemi="L"):
    return table(folder / f"hemi-{hemi}_contrast-{label}_desc-thickness_statmap.tsv")


def test_conjunction_is_where_both_differ(results):
    rows = points(results, "Both")
    thin = rows["node_x"] <= NODES[0] // 3
    assert rows.loc[thin, "significant"].all()
    assert rows.loc[~thin, "significant"].mean() < 0.1
    assert set(rows["alternative"]) == {"> 0 in each of 2 contrasts"}
    assert (rows["p_corrected"] >= rows["p"] * (1 - 1e-6)).all()


def test_equivalence_is_where_none_differs(results):
    rows = points(results, "Same")
    thin = rows["node_x"] <= NODES[0] // 3
    assert not rows.loc[thin, "significant"].any()
    assert rows.loc[~thin, "significant"].mean() > 0.5
    inside = (rows["limit_low"] > -0.1) & (rows["limit_high"] < 0.1)
    np.testing.assert_array_equal(inside, rows["p"] < 0.05)
    measures = table(results / "measures.tsv").set_index("contrast")
    same = measures.loc["same"]
    assert (same["limit_low"] < same["estimate"]).all()
    assert (same["p_fdr"] > 0.05).all()  # the means differ by 0.1 mm
    assert measures["limit_low"].isna()["group"].all()
    described = json.loads((results / "measures.json").read_text())
    assert "equivalence" in described["limit_low"]["Description"]


def test_parts_are_no_results(results):
    maps = table(results / "maps.tsv")
    assert list(dict.fromkeys(maps["contrast"])) == ["group", "both", "same"]
    assert {"both", "same", "group"} == set(table(results / "peaks.tsv")["contrast"])
    record = json.loads((results / "analysis.json").read_text())
    assert list(record["contrasts"]) == ["group", "both", "same"]
    assert record["one_sided"]["same"] == "equivalent within 0.1"
    assert record["one_sided"]["both"] == "> 0 in each of 2 contrasts"


def test_page_and_methods_have_the_words(results):
    page = group_page(results)
    for words in (
        " equivalent within 0.1 mm, ",
        " not shown (",
        "above 0 in each of 2 contrasts",
        "Other points are not shown to be.",
    ):
        assert words in page
    assert "measures that differ" not in page
    text = methods_of(results)
    assert "Conjunctions were tested by the minimum statistic" in text
    assert "653-660" in text
    assert "by two one-sided tests" in text
    assert "90% limits" in text
    assert "no evidence of a difference" in text.replace("\n", " ")


def test_parts_of_the_command_stay(cohort):
    parts = ["group[CN] - group[AD] > 0", "group[CN] - group[MCI] > 0"]
    folder = run(cohort, "--contrast", *parts, BOTH, "--no-reports", name="asked")
    name = "group[CN] - group[AD] and group[CN] - group[MCI]"
    maps = table(folder / "maps.tsv")
    assert maps["contrast"].tolist() == [*parts, name] * 2
    first, second, both = (
        rows["p"] for _, rows in table(folder / "measures.tsv").groupby("contrast", sort=False)
    )
    np.testing.assert_allclose(both, np.maximum(first, second.to_numpy()))


def test_asymmetry_and_registration_have_conjunctions(cohort):
    options = ("--asymmetry", "--align", "registr", "--contrast", BOTH, "--no-reports")
    folder = run(cohort, *options, name="registered")
    assert set(table(folder / "maps.tsv")["hemi"]) == {"L", "R", "LR"}
    assert len(table(folder / "alignment.tsv"))


def test_without_findings_the_peak_has_the_smallest_p_and_a_second_run_is_noted(cohort, capsys):
    for margin, replaced in ((0.001, False), (0.002, True)):
        text = f"tight = |group[CN]-group[MCI]| < {margin}"
        folder = run(cohort, "--contrast", text, "--no-reports", name="tight")
        assert (
            "tight had another question (one_sided); keep both" in capsys.readouterr().out
        ) == replaced
        peaks = table(folder / "peaks.tsv").set_index("hemi")
        for hemi in "LR":
            assert peaks.loc[hemi, "extent"] == 0
            assert peaks.loc[hemi, "p"] == points(folder, "Tight", hemi)["p"].min()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--contrast", BOTH, "--correction", "permutation-max"], "not with --correction by perm"),
        (["--contrast", "group[CN] & group"], "no direction"),
        (["--contrast", "group[CN] &"], "cannot read"),
        (["--contrast", "group[CN] & group[XY]"], "group[XY]"),
        (["--contrast", "|age| < 0"], "write equivalence as"),
        (["--contrast", r"\|age\| > 1"], "contrast '|age| > 1': write equivalence as"),
        (["--contrast", "age & group[AD]", "age and group[AD]=age"], "same name"),
        (["--contrast", SAME, "--measures", "thickness", "curvature"], "a margin has one unit"),
    ],
)
def test_refusals_are_one_line(cohort, capsys, options, words):
    data, out = cohort
    assert main([str(data), str(out), "group", *PLAIN, "--name", "wrong", *options]) == 65
    message = capsys.readouterr().err
    assert words in " ".join(message.split())
    assert "Traceback" not in message
    assert not (out / "group" / "wrong").exists()


@needs("sites")
def test_harmonized_maps_have_conjunctions(cohort):
    options = ("--harmonize", "machine", "--contrast", f"both={BOTH}", "--no-reports")
    folder = run(cohort, *options, name="harmonized")
    assert set(table(folder / "maps.tsv")["contrast"]) == {"both"}


@needs("percent")
def test_percent_is_of_plain_contrasts(cohort):
    options = ("--percent", "--contrast", "group[CN]-group[AD]", BOTH, "--no-reports")
    measures = table(run(cohort, *options, name="percent") / "measures.tsv").set_index("contrast")
    assert set(measures.index) == {"group[CN]-group[AD]", BOTH.replace("&", "and")}
    assert measures.loc[BOTH.replace("&", "and"), "percent"].isna().all()
