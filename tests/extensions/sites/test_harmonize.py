"""Harmonization at the command line: what is taken out and kept, files, and refusals."""

import json
import shutil
from functools import partial

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from hippunfold_like import PATTERNS, flat_surface, names, write_map, write_surface
from pyarrow import parquet
from small_cohorts import (
    NODES,
    begin_dataset,
    methods_of,
    place_of,
    read_participants,
    table,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.sites.harmonize import harmonize_cohort
from hipsta_bids.extensions.sites.output import draw_sites
from hipsta_bids.extensions.sites.planning import plan_sites
from hipsta_bids.group.cohort.data import Cohort, Measures
from hipsta_bids.group.output import write
from hipsta_bids.group.request import Request
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings

SHIFT, SCALE, EFFECT = 0.3, 1.6, 0.25
N = 36
MODEL = "group-age-sex-site"
TABLE = ("participant_id", "group", "age", "sex", "site")


def write_study(folder, *, sessions=(None,), seed=0):
    """Site B is thicker by SHIFT and varies SCALE times as much; AD is thinner by EFFECT.

    Two of three of AD are at site B.
    """
    data, out = begin_dataset(folder)
    random = np.random.default_rng(seed)
    rows = []
    x = np.linspace(0, 1, NODES[0])[:, None] + np.zeros(NODES)
    for i in range(N):
        case, other = i % 2, (i % 6 in {0, 1, 3})
        age, sex = 60 + 20 * random.random(), "FM"[int(random.integers(2))]
        subject = f"{i + 1:02d}"
        own = random.normal(0, 0.05)
        for session in sessions:
            for hemi in "LR":
                noise = 0.08 * random.standard_normal(NODES) + own
                wall = 1.8 - 0.005 * (age - 70) - EFFECT * case + (SCALE if other else 1) * noise
                bend = 0.1 + 0.2 * np.exp(-(((x - 0.4) / 0.15) ** 2))
                bend = bend + 0.01 * random.standard_normal(NODES)
                place = place_of(out, subject, hemi, session=session)
                volume = 500 - 20 * case + 10 * random.standard_normal() + 40 * other
                write_hemisphere(place, wall + SHIFT * other, bend, volume=volume)
        rows.append([f"sub-{subject}", ("CN", "AD")[case], f"{age:.1f}", sex, "AB"[other]])
    write_participants(data, rows, TABLE)
    return data, out


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("sites"))


@pytest.fixture(scope="module")
def results(study, quick):
    """With the figure of sites alone, since figures take longer than all else."""
    data, out = study
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            write,
            "draw_figures",
            lambda _, cohorts, analyses, *__: [
                ("sites", partial(draw_sites, cohorts[""], analyses[""]))
            ],
        )
        assert main([str(data), str(out), "group", "--harmonize", "site", *quick]) == 0
    return out / "group" / MODEL


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


def test_planted_shift_and_scale_are_found(results):
    sites = table(results / "sites.tsv")
    own = sites[(sites.measure == "thickness") & (sites.hemi == "L")].set_index("site")
    # Known to .05 * sqrt(1 / 18 + 2.6 / 18) = .02 mm, by what participants have of their own.
    assert own.site_shift["B"] - own.site_shift["A"] == pytest.approx(SHIFT, abs=0.06)
    assert own.site_scale["B"] / own.site_scale["A"] == pytest.approx(SCALE, abs=0.25)
    assert (own.offset_after < own.offset_before / 3).all()
    np.testing.assert_allclose(own.spread_after, 1, atol=0.03)
    assert set(own.estimated) == {True}
    summary = sites[(sites.measure == "volume") & (sites.hemi == "R")].set_index("site")
    assert summary.site_shift["B"] - summary.site_shift["A"] == pytest.approx(40, abs=10)
    np.testing.assert_allclose(summary.offset_after, 0, atol=1e-9)


def test_anybody_can_repeat_the_fit_from_the_harmonized_maps(results):
    long = parquet.read_table(results / "maps.parquet").to_pandas()
    people = table(results / "covariates.tsv")
    own = long[long.hemi == "L"]
    wide = own.pivot_table(
        index="participant_id", columns="vertex", values="thickness_harmonized", observed=True
    ).loc[people.participant_id]
    columns = [np.ones(N), people.group == "CN", people.age, people.sex == "F", people.site == "B"]
    contrast = Contrast("CN-AD", np.array([0.0, 1, 0, 0, 0]))
    matrix = np.column_stack(columns).astype(float)
    (test,) = fit_points(wide.to_numpy(float), matrix, [contrast], GlmSettings()).tests
    written = table(results / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    # Maps are handed over in single precision.
    np.testing.assert_allclose(written.statistic, test.statistic, rtol=1e-3)
    assert written.df.iloc[0] == N - 5
    assert written.estimate.mean() == pytest.approx(EFFECT, abs=0.08)


def test_record_text_and_page_say_what_was_done(results):
    record = json.loads((results / "analysis.json").read_text())["harmonization"]
    assert record["column"] == "site"
    assert record["participants"] == {"A": 18, "B": 18}
    assert record["formula"] == "group + age + sex"
    assert record["classified"] is False
    text = methods_of(results)
    assert "and preserved `group + age + sex`." in text
    assert "site was also a factor of the model, at a cost of 1 degree of freedom" in text
    assert "Classifiers used the measures before harmonization" in text
    page = group_page(results)
    assert 'id="group-harmonization"' in page
    assert "Sites before and after harmonization" in page


def test_classifiers_do_not_see_harmonized_measures(results, study, quick):
    """Otherwise the parameters of left out participants would hold their groups."""
    data, out = study
    assert main([str(data), str(out), "group", "--name", "plain", "--no-reports", *quick]) == 0
    names = ["control", "case", "hemi", "added", "auc_base_cv", "auc_full_cv"]
    plain = table(out / "group" / "plain" / "classification.tsv")
    pd.testing.assert_frame_equal(table(results / "classification.tsv")[names], plain[names])


def test_columns_of_sites_are_not_tested_by_themselves(study, quick):
    data, out = study
    model = ["--formula", "thickness ~ age + sex + site", "--name", "columns"]
    assert main([str(data), str(out), "group", "--harmonize", "site", *model, *quick]) == 0
    record = json.loads((out / "group" / "columns" / "analysis.json").read_text())
    assert set(record["contrasts"]) == {"age", "F-M"}
    assert "site[T.B]" in record["columns"]


def test_saved_effects_give_the_same_maps_again(results, study, quick):
    data, out = study
    given = ["--harmonize-model", str(results / "harmonization.json")]
    given += ["--template", str(results / "template.json"), "--name", "again", "--no-reports"]
    assert main([str(data), str(out), "group", *given, *quick]) == 0
    again = out / "group" / "again"
    name = "hemi-R_contrast-CNAD_desc-thickness_statmap.tsv"
    # Warps to a given template are fitted once more, and the file has nine digits.
    np.testing.assert_allclose(
        table(again / name).estimate, table(results / name).estimate, atol=0.02
    )
    assert set(table(again / "sites.tsv").estimated) == {False}
    text = methods_of(again)
    assert "Parameters of 2 levels were taken from an earlier analysis." in text
    assert "at a cost of" not in text
    assert files.read_json(again / "harmonization.json")["Sites"] == {"A": 18, "B": 18}


def test_other_people_of_known_and_new_sites(results, tmp_path, quick):
    data, out = write_study(tmp_path, seed=5)
    rows = read_participants(data)
    write_participants(data, [[*row[:4], {"A": "A", "B": "C"}[row[4]]] for row in rows], TABLE)
    given = ["--harmonize-model", str(results / "harmonization.json"), "--no-reports"]
    given += ["--template", str(results / "template.json")]
    assert main([str(data), str(out), "group", *given, *quick]) == 0
    sites = table(out / "group" / MODEL / "sites.tsv")
    own = sites[(sites.measure == "thickness") & (sites.hemi == "L")].set_index("site")
    assert own.estimated.to_dict() == {"A": False, "C": True}
    assert own.site_shift["C"] - own.site_shift["A"] == pytest.approx(SHIFT, abs=0.1)
    saved = files.read_json(out / "group" / MODEL / "harmonization.json")
    assert saved["Sites"] == {"A": 18, "B": 18, "C": 18}
    # A site that is estimated from these participants has to be in the model.
    given += ["--formula", "group + age", "--name", "without"]
    assert main([str(data), str(out), "group", *given, *quick]) == 65


@needs("repeated")
def test_repeated_sessions(tmp_path, quick, capsys):
    data, out = write_study(tmp_path, sessions=("1", "2"))
    for row in read_participants(data):
        rows = [["ses-1", "0"], ["ses-2", "1.5"]]
        path = data / row[0] / f"{row[0]}_sessions.tsv"
        path.parent.mkdir()
        files.write_tsv(path, ["session_id", "years"], rows)
    call = [str(data), str(out), "group", "--harmonize", "site", "--no-reports", *quick]
    call += ["--no-classification", "--measures", "thickness"]
    assert main([*call, "--longitudinal"]) == 0
    (folder,) = (out / "group").glob("*_longitudinal")
    sites = table(folder / "sites.tsv")
    own = sites[(sites.measure == "thickness") & (sites.hemi == "L")].set_index("site")
    assert own.site_shift["B"] - own.site_shift["A"] == pytest.approx(SHIFT, abs=0.06)
    text = methods_of(folder)
    assert "Random intercepts of participants were preserved" in text
    assert json.loads((folder / "harmonization.json").read_text())["Repeated"] is True

    assert main([*call, "--paired", "1", "2"]) == 0
    (folder,) = (out / "group").glob("*_change-1-2")
    assert not (folder / "harmonization.json").exists()
    capsys.readouterr()
    move = data / "sub-01" / "sub-01_sessions.tsv"
    files.write_tsv(
        move, ["session_id", "years", "place"], [["ses-1", "0", "A"], ["ses-2", "1", "B"]]
    )
    for row in read_participants(data)[1:]:
        path = data / row[0] / f"{row[0]}_sessions.tsv"
        files.write_tsv(
            path,
            ["session_id", "years", "place"],
            [["ses-1", "0", row[4]], ["ses-2", "1", row[4]]],
        )
    call[call.index("site")] = "place"
    assert main([*call, "--paired", "1", "2"]) == 65
    assert "sub-01 changed place between sessions" in capsys.readouterr().err


def relabel(rows, sites):
    return [[*row[:4], site] for row, site in zip(rows, sites, strict=True)]


REFUSED = {
    "groups are sites": (
        lambda rows: relabel(rows, [row[1] for row in rows]),
        [],
        "group[T.AD] does not vary within sites",
    ),
    "one of few": (
        lambda rows: relabel(rows, ["C", *(row[4] for row in rows[1:])]),
        [],
        "too few participants in C (1) (least 10)",
    ),
    "one site": (lambda rows: relabel(rows, ["A"] * N), [], "have site A; remove --harmonize"),
    "no site in the model": (
        lambda rows: rows,
        ["--formula", "group + age"],
        "add + C(site) to the formula",
    ),
    "interaction": (
        lambda rows: rows,
        ["--formula", "group * site"],
        "the model has group:site",
    ),
    "what is tested": (
        lambda rows: rows,
        ["--harmonize", "group"],
        "contrast CN-AD tests an effect that is removed",
    ),
    "sites alone": (
        lambda rows: rows,
        ["--formula", "site"],
        "contrast A-B tests an effect that is removed",
    ),
    "unknown column": (
        lambda rows: rows,
        ["--harmonize", "scannr"],
        "the table has no column 'scannr'",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refuses_what_cannot_be_told_apart(case, study, tmp_path, quick, capsys):
    data, out = study
    change, options, words = REFUSED[case]
    copy = tmp_path / "bids"
    shutil.copytree(data, copy)
    write_participants(copy, change(read_participants(data)), TABLE)
    call = [str(copy), str(out), "group", "--harmonize", "site", "--name", "refused", *quick]
    assert main([*call, *options]) == 65
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (out / "group" / "refused").exists()


def without_point(entry):
    """Parameters of a map with one point less."""
    return {
        name: [row[:-1] for row in values]
        if values and isinstance(values[0], list)
        else values[:-1]
        for name, values in entry.items()
    }


def thickness(content, **arrays):
    content["Maps"]["L"]["thickness"] |= arrays


def fewer_points(content):
    for measures in content["Maps"].values():
        measures |= {name: without_point(entry) for name, entry in measures.items()}


SPOILED = {
    "format": (lambda c: c.update(Format=2), 65, "Format is 2, but has to be 1"),
    "shape": (
        lambda c: thickness(c, shift=c["Maps"]["L"]["thickness"]["shift"][:1]),
        65,
        "shift of thickness, L, has (1, 147)",
    ),
    "points": (fewer_points, 65, "has 146 points, these participants 147"),
    "text": (lambda c: thickness(c, mean="os"), 65, "mean is 'os', but has to be a list"),
    "negative": (
        lambda c: thickness(c, sd=[-1.0] * 147),
        65,
        "sd of thickness, L, is not positive",
    ),
    "point": (
        lambda c: c["Maps"]["L"]["thickness"]["mean"].__setitem__(3, {}),
        65,
        "no numbers of thickness, L",
    ),
    "formula": (lambda c: c.update(Formula="__import__('os')"), 64, "is not allowed"),
    "level": (
        lambda c: c["Levels"].update(group=["CN", "MCI"]),
        65,
        "has no 'group' AD, only CN, MCI",
    ),
    "measure": (
        lambda c: c["Maps"]["R"].pop("curvature"),
        65,
        "has no map of curvature of hemisphere R",
    ),
    "template": (
        lambda c: c["Templates"].update(L="0" * 64),
        65,
        "hemisphere L was registered to another template there",
    ),
}


@pytest.mark.parametrize("case", SPOILED)
def test_refuses_files_that_do_not_fit(case, results, tmp_path, quick, capsys):
    spoil, code, words = SPOILED[case]
    content = files.read_json(results / "harmonization.json")
    spoil(content)
    files.write_json(tmp_path / "h.json", content)
    out = results.parents[1]
    given = ["--harmonize-model", str(tmp_path / "h.json"), "--name", "refused"]
    given += ["--template", str(results / "template.json")]
    assert main([str(out.parent / "bids"), str(out), "group", *given, *quick]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_variables_that_sites_explain_are_noted():
    random = np.random.default_rng(4)
    n, shape = 60, (6, 5)
    sites = np.repeat(["A", "B"], n // 2)
    ages = random.normal(70, 5, n) + 30 * (sites == "B")
    people = {"participant_id": [f"sub-{i}" for i in range(n)], "age": ages, "site": sites}
    walls = 1.8 + np.where(sites == "B", SCALE, 1)[:, None, None] * random.normal(
        0, 0.1, (n, *shape)
    )
    side = SideMaps(
        rows=np.arange(n),
        maps={"thickness": walls},
        subfield=np.zeros((n, *shape), np.int8),
        names=("all",),
        summary=pd.DataFrame(index=range(n)),
    )
    cohort = Cohort(
        table=pd.DataFrame(people), sides={"L": side}, x=np.arange(6), y=np.arange(5), units={}
    )
    settings = GroupSettings().changed(harmonization={"column": "site"})
    model = parse_model(model_from_shortcut("age + site", [], "test"))
    measures = Measures(maps=("thickness",))
    request = Request(
        cohort=cohort,
        model=model,
        groups=None,
        settings=settings,
        measures=measures,
        references={},
    )
    plan = plan_sites(request)
    done = harmonize_cohort(cohort, plan, settings, measures, {})
    # Ages of the sites are 30 years apart, and vary by 5.
    assert plan.explained == {"age": pytest.approx(0.9, abs=0.03)}
    assert any("site explains 9" in note and "of age" in note for note in done.notes)


@needs("maps")
def test_maps_of_other_programs(study, tmp_path, quick):
    data, _ = study
    random = np.random.default_rng(2)
    points, triangles = flat_surface(120, 1)
    for row in read_participants(data):
        for hemi in "LR":
            path, surface = names(tmp_path / "hippunfold", row[0][4:], hemi, version=1)
            other = row[4] == "B"
            noise = (SCALE if other else 1) * 0.1 * random.standard_normal(len(points))
            write_map(path, 1.5 + noise + SHIFT * other - EFFECT * (row[1] == "AD"))
            write_surface(surface, points, triangles)
    out = tmp_path / "out"
    maps = str(tmp_path / PATTERNS[1])
    call = [str(data), str(out), "group", "--maps", f"hipp={maps}", "--no-reports", *quick]
    assert main([*call, "--harmonize", "site"]) == 0
    sites = table(out / "group" / MODEL / "hipp_sites.tsv")
    own = sites[sites.hemi == "L"].set_index("site")
    assert own.site_shift["B"] - own.site_shift["A"] == pytest.approx(SHIFT, abs=0.02)
    assert own.site_scale["B"] / own.site_scale["A"] == pytest.approx(SCALE, abs=0.1)
    name = "hemi-L_contrast-CNAD_desc-hipp_statmap.tsv"
    first = table(out / "group" / MODEL / name)
    assert first.estimate.mean() == pytest.approx(EFFECT, abs=0.02)
    page = group_page(out / "group" / MODEL)
    assert '<th scope="row">hipp' in page[page.index('id="group-harmonization"') :]
    saved = str(out / "group" / MODEL / "harmonization.json")
    assert main([*call, "--harmonize-model", saved, "--name", "again"]) == 0
    again = table(out / "group" / "again" / name)
    np.testing.assert_allclose(again.statistic, first.statistic, rtol=1e-6)


def test_classifiers_get_measures_whose_parameters_do_not_know_the_groups(study, results, quick):
    data, out = study
    call = [str(data), str(out), "group", "--align", "none", "--no-reports", *quick]
    without = ["--formula", "age + site", "--contrast", "age", "--name", "ages"]
    assert main([*call, "--harmonize", "site", *without]) == 0
    saved = str(out / "group" / "ages" / "harmonization.json")
    assert main([*call, "--harmonize-model", saved, "--name", "fair"]) == 0
    fair = out / "group" / "fair"
    assert json.loads((fair / "analysis.json").read_text())["harmonization"]["classified"] is True
    assert "Classifiers used" not in (fair / "methods.md").read_text()
    areas = [table(folder / "classification.tsv").auc_base for folder in (fair, results)]
    # Volumes are larger at site B, which has most of AD, whose volumes are smaller.
    assert (areas[0] > areas[1]).all()
