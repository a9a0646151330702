"""Protocols, datasets and programs side by side: one table, one figure, and their agreement."""

import shutil

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from page_outline import Outline
from scipy import stats
from sklearn.metrics import f1_score
from small_cohorts import (
    GROUPS,
    NODES,
    PLAN,
    begin_dataset,
    methods_of,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from validation.group import simulate_cohort

#: The loss of the second group lies elsewhere in the last protocol.
PROTOCOLS = ("ashs", "fs", "other")
MAPS = ("--align", "none", "--measures", "thickness", "volume")
MODEL = "thickness-volume_group-age-sex"
CONTRAST = "CN-AD"
FAILED = ("03", "R", "fs")


def rename(path, names):
    """Give the subfields of a sheet the names of a protocol."""
    text = path.read_text()
    path.write_text(text.replace("\tSub\n", f"\t{names[0]}\n").replace("\tCA1", f"\t{names[1]}"))


def write_protocols(folder):
    """Three protocols of the same participants; walls differ by noise of .01 mm between two."""
    data, out = begin_dataset(folder)
    cohorts = {hemi: simulate_cohort(PLAN, seed) for seed, hemi in enumerate("LR")}
    people = cohorts["L"]
    random = np.random.default_rng(5)
    for i in range(len(people.age)):
        for hemi, cohort in cohorts.items():
            for seg in PROTOCOLS:
                wall = cohort.thickness[i] + 0.01 * random.standard_normal(NODES)
                if seg == "other":
                    wall = np.roll(wall, 8, axis=0)
                place = place_of(out, f"{i + 1:02d}", hemi, seg=seg)
                failed = (f"{i + 1:02d}", hemi, seg) == FAILED
                names = ("SUB", "CA") if seg == "ashs" else ("Sub", "CA1")
                record = {"decision": "failed", "reason": "no-body"} if failed else {}
                volume = 500 + 10 * np.sin(i) - 5 * people.group[i] + 100 * (seg == "ashs")
                write_hemisphere(place, wall, cohort.curvature[i], volume=volume, **record)
                rename(place.path("sheet"), names)
    rows = [
        [f"sub-{i + 1:02d}", GROUPS[int(group)], f"{age:.1f}", "F" if sex else "M"]
        for i, (group, age, sex) in enumerate(
            zip(people.group, people.age, people.sex, strict=True)
        )
    ]
    write_participants(data, rows)
    return data, out


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let the page link those of the analyses."""


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The output of the group level for three protocols at once."""
    folder = tmp_path_factory.mktemp("protocols")
    data, out = write_protocols(folder)
    settings = folder / "quick.toml"
    settings.write_text("[classification]\nrepeats = 2\nfolds = 3\n")
    options = (*MAPS, "--settings", str(settings))
    assert main([str(data), str(out), "group", "--seg", *PROTOCOLS, *options]) == 0
    return data, out, options


def statmap(folder, hemi, measure="thickness"):
    return table(folder / f"hemi-{hemi}_contrast-CNAD_desc-{measure}_statmap.tsv")


def test_agreement_of_the_same_effect_and_of_another(compared):
    group = compared[1] / "group"
    rows = table(group / MODEL / "agreement.tsv").query("contrast == @CONTRAST")
    assert len(rows) == 6  # two sides of three pairs
    for row in rows.to_dict("records"):
        first, second = (
            statmap(group / f"{MODEL}_seg-{row[name]}", row["hemi"])
            for name in ("analysis", "other")
        )
        known = first["cohen_d"].notna() & second["cohen_d"].notna()
        first, second = first[known], second[known]
        assert row["n_points"] == known.sum()
        r = stats.pearsonr(first["cohen_d"], second["cohen_d"]).statistic
        assert row["r"] == pytest.approx(r, abs=1e-6)  # tables have ten digits
        # All effects that survive are losses here, so that directions do not matter.
        assert (first["statistic"][first["significant"]] > 0).all()
        assert row["n_significant"] == first["significant"].sum()
        assert row["dice"] == pytest.approx(f1_score(first["significant"], second["significant"]))
        if {row["analysis"], row["other"]} == {"ashs", "fs"}:
            assert row["r"] > 0.97
            assert row["dice"] > 0.9
        else:
            assert row["r"] < 0
            assert row["n_both"] == row["dice"] == 0
    assert (rows["n_shared"] == sum(PLAN.sizes)).all()


def test_opposite_effects_do_not_overlap(compared, tmp_path):
    """Reverse the second analysis' contrast: r is -1, and no significant point agrees."""
    data, out, options = compared
    reverse = ("--contrast", "AD-CN = group[AD] - group[CN]", "--name", "reversed", "--seg", "ashs")
    formula = ("--formula", "group + age + sex", "--no-classification")
    assert main([str(data), str(out), "group", *options, *formula, *reverse]) == 0
    folder = out / "group" / "reversed"
    for path in folder.glob("*.tsv"):  # the same name as in the first
        path.write_text(path.read_text().replace("AD-CN", CONTRAST))
    first = out / "group" / f"{MODEL}_seg-ashs"
    assert main(["compare", f"a={first}", f"b={folder}", str(tmp_path / "both")]) == 0
    rows = table(tmp_path / "both" / "agreement.tsv")
    np.testing.assert_allclose(rows["r"], -1)
    assert (rows["n_significant"] == rows["n_significant_other"]).all()
    assert (rows["n_significant"] > 0).all()
    assert (rows["dice"] == 0).all()


def test_table_of_all_effects_has_what_each_analysis_has(compared):
    group = compared[1] / "group"
    for name, file in (("effects", "measures"), ("classification", "classification")):
        joined = table(group / MODEL / f"{name}.tsv")
        for seg in PROTOCOLS:
            alone = table(group / f"{MODEL}_seg-{seg}" / f"{file}.tsv")
            rows = joined[joined["analysis"] == seg]
            keys = ["contrast", "measure", "hemi", "model"]
            keys = keys if name == "effects" else ["control", "case", "hemi", "added"]
            expected = alone.sort_values(keys).reset_index(drop=True)
            shared = rows[expected.columns].sort_values(keys).reset_index(drop=True)
            pd.testing.assert_frame_equal(shared, expected)
    effects = table(group / MODEL / "effects.tsv")
    # The limits are those of t with the model's degrees of freedom.
    low, high = stats.t.interval(0.95, effects["df"], effects["estimate"], effects["se"])
    np.testing.assert_allclose(effects[["estimate_low", "estimate_high"]], np.c_[low, high])


def test_each_protocol_is_a_family_of_its_own(compared):
    """The correction of a protocol does not depend on others beside it."""
    data, out, options = compared
    alone = (str(data), str(out), "group", "--seg", "fs", *options, "--name", "alone")
    assert main(alone) == 0
    for hemi in "LR":
        pd.testing.assert_frame_equal(
            statmap(out / "group" / "alone", hemi), statmap(out / "group" / f"{MODEL}_seg-fs", hemi)
        )
    text = methods_of(out / "group" / MODEL)
    assert "within an analysis, not over all" in " ".join(text.split())
    assert "thickness, CN-AD, left, ashs and fs: r 1.00" in text
    page = (out / "group" / f"{MODEL}.html").read_text()
    assert "within an analysis, not over all analyses" in page


def test_participants_and_failures_of_each_protocol(compared):
    rows = table(compared[1] / "group" / MODEL / "analyses.tsv").set_index("analysis")
    assert rows["n"].tolist() == [30, 30, 30]
    assert rows["groups"].tolist() == ["16 CN, 14 AD"] * 3
    assert rows[["n_L", "n_R", "n_failed"]].loc["fs"].tolist() == [30, 29, 1]
    assert rows[["n_L", "n_R", "n_failed"]].loc["ashs"].tolist() == [30, 30, 0]


def test_page_links_analyses_and_figure_names_subfields_of_each(compared):
    group = compared[1] / "group"
    text = (group / f"{MODEL}.html").read_text()
    page = Outline(text)
    assert not page.open
    assert not page.unlabeled
    assert "could not be" not in text
    assert "<h3>Thickness: effect maps</h3>" in text
    lead = text[text.index('id="comparison-found-title"') : text.index('id="comparison-analyses"')]
    agreement = table(group / MODEL / "agreement.tsv")
    for row in agreement.itertuples():
        assert (
            f"{row.n_significant:.0f} of {row.n_points:.0f} points are significant in"
            f" {row.analysis}, {row.n_significant_other:.0f} in {row.other},"
            f" {row.n_both:.0f} in both"
        ) in lead
    assert lead.count("<li>") == len(agreement) == 6
    for seg in PROTOCOLS:
        assert f"{MODEL}_seg-{seg}.html" in page.addresses
    figure = (group / MODEL / "figures" / "thickness_maps.svg").read_text()
    assert "CN-AD: ashs (n = 30); SUB, CA" in figure
    assert "CN-AD: fs (n = 30); Sub, CA1" in figure


def test_maps_of_one_analysis_are_compared_by_name(compared, tmp_path):
    """A map against itself: all agrees; nothing else of the analyses is listed."""
    folder = compared[1] / "group" / f"{MODEL}_seg-fs"
    maps = [f"own={folder}:thickness", f"again={folder}:thickness"]
    assert main(["compare", *maps, str(tmp_path / "maps"), "--figures"]) == 0
    rows = table(tmp_path / "maps" / "agreement.tsv")
    np.testing.assert_allclose(rows[["r", "dice"]], 1)
    assert rows["measure"].unique().tolist() == ["thickness"]
    assert not (tmp_path / "maps" / "effects.tsv").exists()
    assert (tmp_path / "maps" / "figures" / "thickness_maps.pdf").stat().st_size > 1000
    assert "own, map thickness" in (tmp_path / "maps.html").read_text()


def test_pages_of_comparisons_are_made_again_from_their_files(compared, tmp_path, capsys):
    data, out, _ = compared
    copy = tmp_path / "out"
    shutil.copytree(out, copy)
    maps = [f"{seg}={copy}/group/{MODEL}_seg-{seg}:thickness" for seg in ("fs", "other")]
    assert main(["compare", *maps, str(copy / "group" / "two")]) == 0
    names = [MODEL, "two", *(f"{MODEL}_seg-{seg}" for seg in PROTOCOLS)]
    pages = {name: copy / "group" / f"{name}.html" for name in names}
    before = {name: path.read_text() for name, path in pages.items()}
    for path in pages.values():
        path.unlink()
    capsys.readouterr()
    command = [str(data), str(copy), "group", "--reports-only"]
    assert main([*command, "--name", "two"]) == 0
    assert capsys.readouterr().out == f"report: {pages['two']}\n"
    assert "_seg-fs.html" not in pages["two"].read_text()  # a page that does not exist yet
    assert main(command) == 0
    assert {name: path.read_text() for name, path in pages.items()} == before
    (copy / "group" / "two" / "comparison.json").write_text("{")
    assert main([*command, "--name", "two"]) == 70
    assert "two.html: not made (" in capsys.readouterr().err
    assert not pages["two"].exists()


def test_refusals_name_the_problem(compared, tmp_path, capsys):
    group = compared[1] / "group"
    first = str(group / f"{MODEL}_seg-fs")
    taken = tmp_path / "taken"
    taken.mkdir()
    for words, code, text in (
        ([first, str(tmp_path / "out")], 64, "two analyses or more"),
        ([first, first, str(tmp_path / "out")], 64, "two analyses are called"),
        ([first, str(group), str(tmp_path / "out")], 65, "no analysis of the group level"),
        ([first, f"b={first}:fa", str(tmp_path / "out")], 64, "has no map fa; there is thickness"),
        (
            [first, f"b={first}:thickness", str(tmp_path / "out")],
            64,
            "of each analysis, or of none",
        ),
        ([first, f"b={first}", str(taken)], 73, "no earlier comparison"),
    ):
        assert main(["compare", *words]) == code
        assert text in capsys.readouterr().err
    data, out, options = compared
    age = ("--formula", "group + age + sex", "--contrast", "age", "--no-classification")
    call = (*options, *age, "--seg", "fs", "--name", "age")
    assert main([str(data), str(out), "group", *call]) == 0
    assert main(["compare", first, str(group / "age"), str(tmp_path / "out")]) == 65
    assert "no contrast of one name" in capsys.readouterr().err


@needs("norms")
def test_norms_are_of_one_protocol(compared, capsys):
    data, out, _ = compared
    assert main([str(data), str(out), "group", "--fit-norms", "--seg", "ashs", "fs"]) == 64
    assert "name one protocol with --fit-norms" in capsys.readouterr().err
