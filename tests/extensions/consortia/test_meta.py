"""Summaries of sites from files to files: what is in them, what is refused, and what they give."""

import json
import re
import shutil
from dataclasses import replace

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from page_outline import Outline
from small_cohorts import (
    PLAN,
    place_of,
    read_participants,
    write_dataset,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.output import write
from hipsta_bids.group.questions import analysis
from hipsta_bids.io import files
from hipsta_bids.joints import is_present

#: Twelve of each group at each site, six of each sex.
SITES = {
    "a": [f"{i:02d}" for i in (*range(1, 13), *range(25, 37))],
    "b": [f"{i:02d}" for i in (*range(13, 25), *range(37, 49))],
}
#: What draws figures, which most tests here go without.
DRAW = write.write_figures
EVIL = "<script>document.title='owned'</script>"


@pytest.fixture(scope="module", autouse=True)
def _only_what_counts():
    """Figures and classifiers take longer than all else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", lambda *_: iter(()))
        patch.setattr(write, "write_figures", lambda *_, **__: [])
        patch.setattr(analysis, "classify_groups", lambda *_: ([], []))
        yield


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """A dataset of two sites, and its output."""
    plan = replace(PLAN, sizes=(24, 24))
    data, out = write_dataset(tmp_path_factory.mktemp("sites"), plan=plan)
    people = read_participants(data)
    write_participants(data, [[*row[:3], "FM"[i % 2]] for i, row in enumerate(people)])
    rows = [[f"sub-{label}", site] for site, labels in SITES.items() for label in labels]
    files.write_tsv(data.parent / "site.tsv", ["participant_id", "site"], rows)
    return data, out


def run(cohort, name, *options, site=None):
    data, out = cohort
    chosen = ["--participant-label", *SITES[site]] if site else []
    arguments = [str(data), str(out), "group", "--name", name, *chosen, *options]
    return main(arguments), out / "group" / name


def export(cohort, site, *options, name=None):
    code, folder = run(cohort, name or site, "--export-summary", site, *options, site=site)
    assert code == 0
    return folder / "summary.json"


@pytest.fixture(scope="module")
def plain(cohort):
    """Summaries of both sites, without registration."""
    return [export(cohort, site, "--align", "none") for site in SITES]


@pytest.fixture(scope="module")
def registered(cohort):
    """Summaries of both sites, registered to the template of the first."""
    first = export(cohort, "a", name="a-registered")
    return [first, export(cohort, "b", "--template", str(first), name="b-registered")]


@pytest.fixture(scope="module")
def combined(plain, tmp_path_factory):
    """Results of both, with figures."""
    out = tmp_path_factory.mktemp("meta")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "write_figures", DRAW)
        assert main(["meta", *map(str, plain), str(out)]) == 0
    return out


def edited(path, target, **changes):
    """A copy with other entries, or with what a function makes of it."""
    content = json.loads(path.read_text())
    for key, value in changes.items():
        content[key] = value(content[key]) if callable(value) else value
    target.write_text(json.dumps(content))
    return target


def table(path):
    return pd.read_csv(path, sep="\t", na_values="n/a", keep_default_na=False)


def statmap(folder, effects, hemi="L"):
    return table(folder / f"hemi-{hemi}_contrast-CNAD{effects}_desc-thickness_statmap.tsv")


def test_the_fixed_effect_is_the_mean_of_the_sites_own_estimates(cohort, combined):
    """As their analyses have them in their tables, weighted by inverse variances."""
    name = "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv"
    own = [table(cohort[1] / "group" / site / name) for site in SITES]
    ours = statmap(combined / "meta", "FixedEffect")
    estimates, errors = (np.stack([one[column] for one in own]) for column in ("estimate", "se"))
    weights = errors**-2
    # Tables have six digits.
    expected = np.sum(weights * estimates, axis=0) / weights.sum(axis=0)
    np.testing.assert_allclose(ours.estimate, expected, atol=1e-5)
    np.testing.assert_allclose(ours.se, weights.sum(axis=0) ** -0.5, rtol=1e-4)
    q = np.sum(weights * (estimates - expected) ** 2, axis=0)
    np.testing.assert_allclose(ours.q, q, rtol=1e-3, atol=1e-5)
    assert np.isinf(ours.df).all()
    assert ours.significant.sum() > 5


def test_a_summary_has_no_value_of_a_participant(cohort, plain):
    text = plain[0].read_text()
    content = json.loads(text)
    assert "sub-" not in text
    assert content["participants"] == 24
    assert content["groups"] == {"CN": 12, "AD": 12}
    (maps,) = (m for m in content["models"] if m["hemi"] == "L" and m["measures"] == ["thickness"])
    assert maps["df"] == 20
    assert len(maps["sd"]) == 147
    # No number of a participant's sheet or summary occurs.
    sheet = files.read_tsv(place_of(cohort[1], "01", "L").path("sheet"))
    numbers = set(re.findall(r"-?\d+\.\d{3,}", text))
    assert not numbers & {row["thickness"] for row in sheet}


def test_a_point_that_nobody_may_know_of_is_left_out(plain, tmp_path):
    """Where one site has nothing, the other alone is no meta-analysis."""

    def empty(models):
        for model in models:
            if model["hemi"] == "L" and model["measures"] == ["thickness"]:
                none = [None] * len(model["sd"])
                model |= {"sd": none, "estimate": {"CN-AD": none}, "se": {"CN-AD": none}}
        return models

    other = edited(plain[1], tmp_path / "other.json", models=empty)
    assert main(["meta", str(plain[0]), str(other), str(tmp_path / "out")]) == 0
    assert statmap(tmp_path / "out" / "meta", "FixedEffect").estimate.isna().all()
    assert statmap(tmp_path / "out" / "meta", "FixedEffect", "R").estimate.notna().all()
    assert "could not be" not in (tmp_path / "out" / "meta.html").read_text()


def test_every_number_is_about_the_same_participants(cohort, tmp_path, capsys):
    """Who lacks a hemisphere is in neither, and a point that one lacks is in none."""
    excluded = tmp_path / "exclude.tsv"
    files.write_tsv(excluded, ["participant_id", "hemi"], [["sub-01", "R"]])
    summary = export(cohort, "a", "--align", "none", "--exclude", str(excluded), name="lacking")
    content = json.loads(summary.read_text())
    assert content["participants"] == 23
    assert {model["df"] for model in content["models"]} == {19}
    assert "without 1 participants who lack a hemisphere" in capsys.readouterr().out


def test_five_with_most_missing_points_are_omitted_unless_cells_get_small(cohort, tmp_path, capsys):
    """All numbers are then about the others; with cells of six, all participants stay."""
    data, out = cohort
    results = tmp_path / "out"
    shutil.copytree(out, results, ignore=shutil.ignore_patterns("group"))
    for number, label in enumerate(("01", "02", "03", "25", "26")):
        for hemi in "LR":
            path = place_of(results, label, hemi).path("sheet")
            sheet = pd.read_csv(path, sep="\t", dtype=str, keep_default_na=False)
            maps = [name for name in sheet if name in {row.name for row in MAPS}]
            sheet.loc[range(20 * number, 20 * number + 20), maps] = "n/a"
            sheet.to_csv(path, sep="\t", index=False)
    options = ("--align", "none", "--formula")
    path = export((data, results), "a", *options, "group", name="holes")
    content = json.loads(path.read_text())
    assert "without 5 participants who lack values at many points" in capsys.readouterr().out
    assert content["participants"] == 19
    assert content["factors"] == {"group": {"CN": 9, "AD": 10}}
    left = next(
        m for m in content["models"] if m["hemi"] == "L" and m["measures"][0] == "thickness"
    )
    assert left["sd"].count(None) == 0
    assert left["df"] == 17
    path = export((data, results), "a", *options, "group * sex", name="small")
    content = json.loads(path.read_text())
    assert content["participants"] == 24
    left = next(
        m for m in content["models"] if m["hemi"] == "L" and m["measures"][0] == "thickness"
    )
    assert left["sd"].count(None) == 100


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "group=AD holds fewer than 13 participants; merge levels, or remove group"),
        (("--formula", "group + scale(age)"), "with scale() has other columns at each site"),
        (("--formula", "group", "--contrast", "g = group[CN], group[AD]"), "contrast"),
    ],
)
def test_what_could_be_traced_or_not_combined_is_refused(cohort, tmp_path, capsys, options, said):
    strict = tmp_path / "strict.toml"
    strict.write_text("[exchange]\nmin_cell = 13\n")
    options = ["--align", "none", "--settings", str(strict), *options]
    code, folder = run(cohort, "refused", "--export-summary", "a", *options, site="a")
    assert code == 65
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert not folder.exists()


@pytest.mark.parametrize("formula", ["group + age + hand", "group*age + hand", "hand + age"])
def test_one_participant_in_a_cell_is_refused(cohort, tmp_path, capsys, formula):
    """Of a single left-handed patient the sums of products hold the exact age."""
    left = [*SITES["a"][:6], SITES["a"][12]]
    rows = [[f"sub-{i}", "left" if i in left else "right"] for i in SITES["a"]]
    files.write_tsv(tmp_path / "hand.tsv", ["participant_id", "hand"], rows)
    options = ["--align", "none", "--covariates", str(tmp_path / "hand.tsv"), "--formula", formula]
    code, folder = run(cohort, "hand", "--export-summary", "a", *options, site="a")
    if "group" not in formula:
        assert code == 0
        assert "group" not in (folder / "summary.json").read_text().partition('"models"')[2]
        return
    assert code == 65
    error = capsys.readouterr().err.strip()
    assert "hand=left in group=AD holds fewer than 5 participants; merge levels, or" in error
    assert "\n" not in error
    assert not folder.exists()


def test_small_counts_of_earlier_summaries_are_not_shown(plain, tmp_path):
    old = edited(plain[0], tmp_path / "old.json", factors=lambda f: f | {"sex": {"F": 21, "M": 3}})
    hidden = edited(
        plain[1], tmp_path / "hidden.json", factors=lambda f: f | {"sex": {"F": 20, "M": "<5"}}
    )
    assert main(["meta", str(old), str(hidden), str(tmp_path / "out")]) == 0
    sites = pd.read_csv(tmp_path / "out" / "meta" / "sites.tsv", sep="\t")
    assert sites.sex_M.tolist() == ["<5", "<5"]
    assert sites.sex_F.tolist() == ["5+", "5+"]
    assert sites.group_CN.tolist() == [12, 12]
    page = (tmp_path / "out" / "meta.html").read_text(encoding="utf-8")
    assert page.count("&lt;5</td>") == 2
    assert "24 CN, 24 AD" in (tmp_path / "out" / "meta" / "methods.md").read_text()
    small = edited(plain[0], tmp_path / "small.json", groups={"CN": 20, "AD": "<5"})
    assert main(["meta", str(small), str(plain[1]), str(tmp_path / "out")]) == 0
    methods = (tmp_path / "out" / "meta" / "methods.md").read_text()
    assert "48 participants at 2 sites" in methods


@needs("sites")
def test_harmonized_values_are_refused(cohort, tmp_path, capsys):
    loose = tmp_path / "loose.toml"
    loose.write_text("[harmonization]\nleast_participants = 5\n")
    options = ["--covariates", str(cohort[0].parent / "site.tsv"), "--align", "none"]
    options += ["--harmonize", "site", "--settings", str(loose)]
    code, folder = run(cohort, "harmonized", *options, "--export-summary", "all")
    assert code == 65
    error = capsys.readouterr().err.strip()
    assert error.splitlines()[-1].endswith("cannot be combined; leave --harmonize out")
    assert not folder.exists()


def test_a_value_that_decides_alone_is_refused(cohort, tmp_path, capsys):
    rows = [[f"sub-{label}", "1000" if label == "01" else label] for label in SITES["a"]]
    extra = tmp_path / "dose.tsv"
    files.write_tsv(extra, ["participant_id", "dose"], rows)
    options = ["--align", "none", "--covariates", str(extra), "--formula", "group + dose"]
    code, _ = run(cohort, "dose", "--export-summary", "a", *options, site="a")
    assert code == 65
    assert "one participant determines its own fitted value by" in capsys.readouterr().err


def test_other_sites_register_to_the_template_in_a_summary(registered, plain, tmp_path, capsys):
    first, second = (json.loads(path.read_text()) for path in registered)
    assert first["template"] == second["template"]
    assert main(["meta", *map(str, registered), str(tmp_path / "out")]) == 0
    assert (
        "registered their maps to one template"
        in (tmp_path / "out" / "meta" / "methods.md").read_text()
    )
    capsys.readouterr()
    assert main(["meta", str(registered[0]), str(plain[1]), str(tmp_path / "no")]) == 65
    assert "site b: registration: none, but at a registr" in capsys.readouterr().err
    moved = edited(
        registered[1],
        tmp_path / "moved.json",
        template=lambda t: json.loads(json.dumps(t).replace("0.", "0.1", 1)),
    )
    assert main(["meta", str(registered[0]), str(moved), str(tmp_path / "no")]) == 65
    assert "hash of the template of registration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seg": "other"}, "site b: segmentation protocol: other, but at a demo"),
        ({"settings_hash": "1234"}, "hash of the participant level's settings"),
        ({"axes": "x from lateral to medial"}, "direction of the axes"),
        ({"x": lambda x: [*x[:-1], 0.95]}, "grid of the sheet: 21 nodes from -0.9 to 0.95"),
        ({"models": lambda m: m[1:]}, "site b: lacks thickness, L (map); give all sites the same"),
        (
            {"models": lambda m: json.loads(json.dumps(m).replace('"sex[T.M]"', '"sex[T.F]"'))},
            "columns: Intercept, group[T.AD], age, sex[T.F], but at a Intercept, group[T.AD], age",
        ),
        (
            {"models": lambda m: json.loads(json.dumps(m).replace('"CN-AD"', '"AD-CN"'))},
            "contrasts: AD-CN, but at a CN-AD",
        ),
    ],
)
def test_sites_that_differ_are_refused_by_name(plain, tmp_path, capsys, change, said):
    other = edited(plain[1], tmp_path / "other.json", **change)
    assert main(["meta", str(plain[0]), str(other), str(tmp_path / "out")]) == 65
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_sites_with_other_segmentations_are_named(plain, tmp_path, capsys):
    kinds = [json.loads(path.read_text())["labels"]["version"] for path in plain]
    assert kinds[0] == kinds[1], "no note without a reason"
    other = edited(plain[1], tmp_path / "other.json", labels=lambda kind: kind | {"version": ["9"]})
    for summary, expected in ((plain[1], 0), (other, 1)):
        assert main(["meta", str(plain[0]), str(summary), str(tmp_path / "out")]) == 0
        note = f"labels of sites differ in version: {kinds[0][0]} at a; 9 at b"
        assert capsys.readouterr().out.count(note) == expected
    record = (tmp_path / "out" / "meta" / "meta.json").read_text()
    assert note in record


def test_contrasts_that_mean_something_else_are_refused(plain, tmp_path, capsys):
    """As those of an interaction do, where they hold the mean age of a site."""

    def doubled(models):
        for model in models:
            for name in ("contrasts", "estimate", "se"):
                model[name]["CN-AD"] = [v and 2 * v for v in model[name]["CN-AD"]]
        return models

    other = edited(plain[1], tmp_path / "other.json", models=doubled)
    assert main(["meta", str(plain[0]), str(other), str(tmp_path / "out")]) == 65
    error = capsys.readouterr().err
    assert "thickness, L: weights of CN-AD on Intercept, group[T.AD], age, sex[T.M]: 0, -2" in error
    assert "write the contrast by columns" in error


def spoiled(change):
    def make(models):
        change(models[0])
        return models

    return {"models": make}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"site": "../../etc"}, "site is '../../etc'"),
        ({"site": "\x1b[31mred"}, "not a summary"),
        ({"format": 1}, "format is 1"),
        ({"people": [1]}, "unknown key people"),
        (spoiled(lambda m: m["sd"].append(1.0)), "numbers of points that are not 147"),
        (spoiled(lambda m: m["sd"].__setitem__(0, "1")), "has to be a number"),
        (spoiled(lambda m: m["se"]["CN-AD"].__setitem__(0, 0.0)), "that are not positive"),
        # Their squares, and the weights by them, are beyond the range of floats.
        (spoiled(lambda m: m["se"]["CN-AD"].__setitem__(0, 1e308)), "has to be at most 1e+40"),
        (spoiled(lambda m: m["se"]["CN-AD"].__setitem__(0, 1e-170)), "errors too close to zero"),
        (spoiled(lambda m: m["estimate"]["CN-AD"].__setitem__(0, -1e200)), "at least -1e+40"),
        (spoiled(lambda m: m["contrasts"].clear()), "contrasts"),
        (spoiled(lambda m: m["measures"].__setitem__(0, "../x")), "measures"),
        (spoiled(lambda m: m.__setitem__("df", 400)), "other degrees of freedom"),
        (spoiled(lambda m: m["units"].append("mm")), "measures without units"),
    ],
)
def test_files_of_other_sites_are_checked(plain, tmp_path, capsys, change, said):
    other = edited(plain[1], tmp_path / "other.json", **change)
    assert main(["meta", str(plain[0]), str(other), str(tmp_path / "out")]) == 65
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert "\x1b" not in error


@pytest.mark.parametrize("content", ["{", "[" * 100_000, "[1]", '{"site": NaN}', ""])
def test_other_files_are_no_summaries(plain, tmp_path, capsys, content):
    path = tmp_path / "file.json"
    path.write_text(content)
    assert main(["meta", str(plain[0]), str(path), str(tmp_path / "out")]) == 65
    assert str(path) in capsys.readouterr().err


def test_wrong_use_is_one_line(plain, tmp_path, capsys):
    first, second = map(str, plain)
    permuted = tmp_path / "permuted.toml"
    permuted.write_text('[multiplicity]\nmethod = "permutation-max"\n')
    for arguments, code, said in (
        ([first], 64, "two sites or more"),
        ([first, first], 64, "are the same summary"),
        ([f"x={first}", f"x={second}"], 64, "two sites are called x"),
        (
            [first, second, "--settings", str(permuted)],
            64,
            "summaries have no participants to permute",
        ),
        ([first, str(tmp_path / "none.json")], 65, "file not found; check its name"),
        *[(["--norms", first, second], 65, "not a file of norms (it is a summary of")]
        * is_present("norms"),
        ([first, str(tmp_path)], 65, "no summary; it is written by `group --export-summary`"),
    ):
        assert main(["meta", *arguments, str(tmp_path / "out")]) == code
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    (tmp_path / "taken" / "meta").mkdir(parents=True)
    assert main(["meta", first, second, str(tmp_path / "taken")]) == 73
    assert "choose another output folder" in capsys.readouterr().err


def test_forest_rows_are_the_sites_own_estimates(combined, plain):
    forest = table(combined / "meta" / "forest.tsv")
    own = forest[(forest.measure == "volume") & (forest.hemi == "LR")].set_index("site")
    for path in plain:
        content = json.loads(path.read_text())
        (model,) = (m for m in content["models"] if m["kind"] == "summary" and m["hemi"] == "LR")
        at = model["measures"].index("volume")
        row = own.loc[content["site"]]
        assert float(row.estimate) == pytest.approx(model["estimate"]["CN-AD"][at])
        assert float(row.se) == pytest.approx(model["se"]["CN-AD"][at])
    assert list(own.kind) == ["site", "site", "fixed effect", "random effects", "prediction"]
    assert own.weight[:2].astype(float).sum() == pytest.approx(1)


def test_the_page_is_whole_and_escapes_what_sites_send(plain, tmp_path):
    hostile = [
        edited(
            path,
            tmp_path / f"{i}.json",
            models=lambda m: json.loads(json.dumps(m).replace("CN-AD", EVIL)),
        )
        for i, path in enumerate(plain)
    ]
    assert main(["meta", *map(str, hostile), "--random", "dl", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "meta.html").read_text(encoding="utf-8")
    outline = Outline(page)
    assert outline.open == []
    assert outline.unlabeled == []
    assert max(np.diff(outline.headings)) <= 1
    assert len(outline.ids) == len(set(outline.ids))
    assert "could not be" not in page
    assert EVIL not in page
    assert "&lt;script&gt;document" in page
    assert page.count('<figure class="forest">') > 4
    assert "DerSimonian" in page


def test_the_page_has_the_maps_of_both_models_and_of_heterogeneity(combined):
    drawing = (combined / "meta" / "figures" / "thickness_maps.svg").read_text(encoding="utf-8")
    for title in ("CN-AD (fixed effect)", "CN-AD (random effects)", "Heterogeneity, CN-AD"):
        assert title in drawing
    page = (combined / "meta.html").read_text(encoding="utf-8")
    assert page.count('data-kind="effect"') == page.count('data-kind="significance"') > 0
    assert "not drawn" not in page
    assert page.index("What was found") < page.index("Fixed and random effects")
    assert re.search(r"\d+ of 147 points survive", page)
    n_families = len(table(combined / "meta" / "maps.tsv"))
    assert f"{n_families} families of points, each map" in page
    text = (combined / "meta" / "methods.md").read_text()
    assert f"over the points of each map ({n_families} families of tests)" in text


def test_maps_are_written_for_viewers_of_surfaces(combined):
    folder = combined / "meta"
    stem = "contrast-CNADRandomEffects_desc-thickness_statmap"
    sheet = nib.load(folder / "hemi-L_space-unfold_midthickness.surf.gii")
    points = table(folder / f"hemi-L_{stem}.tsv")
    assert len(sheet.darrays[0].data) == len(points)
    names = {"t": "statistic", "d": "cohen_d", "pcorrected": "p_corrected"}
    for stat, column in names.items():
        name = f"hemi-L_{stem}.shape.gii".replace("_desc-", f"_stat-{stat}_desc-")
        values = nib.load(folder / name).darrays[0].data
        np.testing.assert_allclose(values, points[column], rtol=1e-4)  # digits of the table
    maps = nib.load(folder / f"{stem}.dscalar.nii")
    assert maps.shape == (3, 2 * len(points))


def test_tables_say_what_their_columns_are(combined):
    for path in sorted((combined / "meta").glob("*.tsv")):
        if path.stem == "sites":
            continue
        columns = path.read_text().split("\n", 1)[0].split("\t")
        described = json.loads(path.with_suffix(".json").read_text())
        assert list(described) == columns
        wrong = [
            c for c, about in described.items() if "registered coordinate" in about["Description"]
        ]
        assert wrong == [], path.name
