"""Other programs' maps through the same models, with sheets of our own and without."""

import json
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from hippunfold_like import (
    PATTERNS,
    cifti_name,
    flat_surface,
    names,
    write_cifti,
    write_map,
    write_surface,
)
from pyarrow import parquet
from small_cohorts import (
    NODES,
    PLAN,
    place_of,
    read_participants,
    table,
    write_dataset,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.group.output import write
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings

#: One person and templates, where the shared data are present.
HIPPUNFOLD = Path(__file__).parents[3] / ".." / "shared" / "data" / "hippunfold"

COUNT = sum(PLAN.sizes)
MODEL = "group-age-sex"
#: Vertices left and right; the density is not the same number on both sides in the tests.
SURFACES = {"L": flat_surface(160, 1), "R": flat_surface(140, 2)}
#: Who lacks a map.
MISSING = ("03", "R")


def subjects():
    return [f"{i + 1:02d}" for i in range(COUNT)]


def thinned(hemi):
    """Where patients are thinner: the anterior fifth."""
    return SURFACES[hemi][0][:, 0] < 8


def thickness(subject, hemi):
    """A map with noise; two vertices are missing in some."""
    random = np.random.default_rng(int(subject) * 10 + (hemi == "R"))
    values = 1.5 + random.normal(0, 0.1, len(SURFACES[hemi][0]))
    values -= 0.3 * thinned(hemi) * (int(subject) > PLAN.sizes[0])
    if int(subject) % 5 == 0:
        values[:2] = np.nan
    return values


def write_hippunfold(data, version):
    for subject in subjects():
        for hemi in "LR":
            if (subject, hemi) != MISSING:
                path, surface = names(data / "hippunfold", subject, hemi, version=version)
                write_map(path, thickness(subject, hemi))
                if subject != "01":  # the surface may lie beside another participant's map only
                    write_surface(surface, *SURFACES[hemi])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("external")
    data, _ = write_dataset(folder)
    for version in (1, 2):
        write_hippunfold(data, version)
    (folder / "group.toml").write_text("[classification]\nrepeats = 2\nfolds = 3\n")
    return folder


@pytest.fixture
def study(written, tmp_path):
    """A copy that may be spoiled, without results."""
    shutil.copytree(written, tmp_path / "s", ignore=shutil.ignore_patterns("group", "alone"))
    return tmp_path / "s"


def run(folder, *options, out="out"):
    settings = ["--settings", str(folder / "group.toml")]
    return main([str(folder / "bids"), str(folder / out), "group", *settings, *options])


@pytest.fixture
def with_figures():
    """Marks tests that look at figures."""


@pytest.fixture(autouse=True)
def _quick_figures(request, monkeypatch):
    if "with_figures" not in request.fixturenames:
        monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


@pytest.fixture(scope="module")
def alone(written):
    """Results without any sheet; figures are drawn."""
    assert run(written, "--maps", f"hipp={PATTERNS[1]}", out="alone") == 0
    return written / "alone" / "group" / MODEL


def statmap(folder, hemi, name="hipp"):
    return table(folder / f"hemi-{hemi}_contrast-CNAD_desc-{name}_statmap.tsv")


def test_planted_thinning_is_found_where_it_is(alone):
    for hemi in "LR":
        rows = statmap(alone, hemi)
        inside = thinned(hemi)
        # Three standard deviations in 16 against 14: next to no misses, and few false ones.
        assert rows.significant[inside].mean() > 0.95
        assert rows.significant[~inside].mean() < 0.1
        points = SURFACES[hemi][0]
        np.testing.assert_allclose(rows[["surface_x", "surface_y"]], points[:, :2], rtol=1e-6)
    peaks = table(alone / "hipp_peaks.tsv")
    first = peaks[peaks.hemi == "L"].iloc[0]
    assert first.extent >= 0.8 * thinned("L").sum()  # neighbors by triangles make one cluster
    assert first.surface_x < 8
    n = statmap(alone, "R").n
    assert n.max() == COUNT - 1  # one lacks the file
    assert n[:2].max() == COUNT - 1 - COUNT // 5  # and some these vertices


def test_map_is_what_the_hand_over_gives(alone):
    long = parquet.read_table(alone / "maps.parquet").to_pandas()
    assert set(long.surface) == {"hipp"}
    people = table(alone / "covariates.tsv")
    own = long[long.hemi == "R"]
    wide = own.pivot_table(
        index="participant_id", columns="vertex", values="hipp", observed=True, dropna=False
    )
    people = people[people.participant_id.isin(wide.index)]
    matrix = np.column_stack(
        [np.ones(len(people)), people.group == "CN", people.age, people.sex == "F"]
    ).astype(float)
    values = wide.loc[people.participant_id].to_numpy(dtype=float)
    contrast = Contrast("CN-AD", np.array([0.0, 1, 0, 0]))
    (test,) = fit_points(values, matrix, [contrast], GlmSettings()).tests
    # Maps are handed over in single precision.
    np.testing.assert_allclose(statmap(alone, "R").statistic, test.statistic, rtol=1e-3)
    field = parquet.read_schema(alone / "maps.parquet").field("hipp")
    assert (field.metadata[b"unit"], str(field.type)) == (b"mm", "float")


def test_results_without_sheets_are_complete(alone):
    record = json.loads((alone / "analysis.json").read_text())
    assert record["participants"] == COUNT
    assert record["inputs"]["maps"] == {"hipp": PATTERNS[1]}
    assert record["inputs"]["seg"] is None
    assert any("30 L, 29 R of 30 visits, 160, 140 points" in note for note in record["notes"])
    text = (alone / "methods.md").read_text()
    assert "without registration" in text
    assert f"Maps of hipp of {COUNT} participants were analyzed" in text
    assert "Diers K" not in text  # whose sheets are not among the maps
    surface = nib.load(alone / "hemi-L_space-hipp_midthickness.surf.gii")
    assert surface.darrays[0].data.shape == (160, 3)
    shape = nib.load(alone / "hemi-L_contrast-CNAD_stat-t_desc-hipp_statmap.shape.gii")
    np.testing.assert_allclose(shape.darrays[0].data, statmap(alone, "L").statistic, rtol=1e-5)
    assert not (alone / "warps.tsv").exists()
    assert {path.stem for path in (alone / "figures").glob("*.svg")} == {"hipp_maps"}
    for path in alone.glob("*_contrast-CNAD_desc-*_statmap.json"):
        assert "vertex" in json.loads(path.read_text())
    page = group_page(alone)
    assert "could not be made" not in page
    assert "peak vertex " in page
    assert "Hipp: means, effects and significance" in page


def test_maps_come_beside_the_sheets(study, capsys):
    for hemi in "LR":  # no sheet, but a map
        shutil.rmtree(study / "out" / "sub-04", ignore_errors=True)
        assert not place_of(study / "out", "04", hemi).path("qc").exists()
    options = ["--correction", "permutation-tfce", "--name", "both"]
    settings = study / "group.toml"
    settings.write_text(settings.read_text() + "[multiplicity]\npermutations = 100\n")
    assert run(study, "--maps", f"hipp={PATTERNS[2]}", *options) == 0
    assert "note: maps hipp: 30 L, 29 R of 30 visits" in capsys.readouterr().out
    folder = study / "out" / "group" / "both"
    maps = table(folder / "maps.tsv").set_index(["measure", "hemi"])
    assert set(maps.index.get_level_values(0)) == {"thickness", "curvature", "hipp"}
    assert maps.n_significant["hipp", "L"] >= 0.9 * thinned("L").sum()
    n = {name: statmap(folder, "L", name).n.max() for name in ("thickness", "hipp")}
    assert n == {"thickness": COUNT - 1, "hipp": COUNT}
    long = parquet.read_table(folder / "maps.parquet").to_pandas()
    counts = long.groupby("surface", observed=True).size()
    assert counts["sheet"] == 2 * (COUNT - 1) * NODES[0] * NODES[1]
    assert counts["hipp"] == COUNT * 160 + (COUNT - 1) * 140
    sheet = long[long.surface == "sheet"]
    assert sheet.hipp.isna().all()
    assert sheet.thickness_registered.notna().any()
    assert long[long.surface == "hipp"].thickness.isna().all()


def test_left_side_and_exclusions_hold_for_other_maps(study):
    listed = study / "listed.tsv"
    listed.write_text("participant_id\themi\nsub-05\tn/a\nsub-06\tL\n")
    formula = ["--formula", "hipp ~ group", "--name", "one", "--exclude", str(listed)]
    few = ["--participant-label", *subjects()[:-2]]
    assert run(study, "--maps", f"hipp={PATTERNS[1]}", f"b={PATTERNS[2]}", *formula, *few) == 0
    folder = study / "out" / "group" / "one"
    assert set(table(folder / "maps.tsv").measure) == {"hipp"}
    # Two are not asked for, one is listed, and one side of another; one has no map of the right.
    assert [statmap(folder, hemi).n.max() for hemi in "LR"] == [COUNT - 4, COUNT - 4]


def write_tables(study, name, values):
    """Maps as the participant level samples them, in a dataset of another program."""
    x, y = np.divmod(np.arange(NODES[0] * NODES[1]), NODES[1])
    for subject in subjects():
        for hemi in "LR":
            cells = [f"{value:.6f}" for value in values(subject, hemi).ravel()]
            rows = zip(map(str, x + 1), map(str, y + 1), cells, strict=True)
            stem = f"sub-{subject}_hemi-{hemi}_desc-{name}_map"
            path = study / "bids" / "other" / f"{stem}.tsv"
            files.write_tsv(path, ["x", "y", name], rows)


def sheet_column(study, subject, hemi, name):
    path = place_of(study / "out", subject, hemi).path("sheet")
    return table(path)[name].to_numpy()


def test_maps_on_the_grid_are_registered_with_the_sheets(study):
    """The thickness of the sheets under another name gives the same result."""
    write_tables(
        study, "again", lambda subject, hemi: sheet_column(study, subject, hemi, "thickness")
    )
    pattern = "again=other/sub-{subject}_hemi-{hemi}_desc-again_map.tsv"
    assert run(study, "--maps", pattern) == 0
    folder = study / "out" / "group" / MODEL
    for hemi in "LR":
        one, other = statmap(folder, hemi, "thickness"), statmap(folder, hemi, "again")
        # Tables have four to six digits.
        np.testing.assert_allclose(one.statistic, other.statistic, atol=1e-2)
    assert set(statmap(folder, "L", "again").subfield) == {"Sub", "CA1"}


def test_curvature_among_the_maps_registers_them(study):
    """Without sheets, two maps on the grid give what the sheets had given."""
    for name in ("thickness", "curvature"):
        write_tables(study, name, lambda s, h, name=name: sheet_column(study, s, h, name))
    patterns = [
        f"{name}=other/sub-{{subject}}_hemi-{{hemi}}_desc-{name}_map.tsv"
        for name in ("thickness", "curvature")
    ]
    assert run(study) == 0
    assert run(study, "--maps", *patterns, out="new") == 0
    one, other = (study / name / "group" / MODEL for name in ("out", "new"))
    for hemi in "LR":
        first, second = statmap(one, hemi, "thickness"), statmap(other, hemi, "thickness")
        np.testing.assert_allclose(first.statistic, second.statistic, atol=1e-2)
    assert (other / "template.json").exists()
    assert run(study, "--maps", patterns[0], "--name", "flat", out="new") == 0
    assert not (study / "new" / "group" / "flat" / "warps.tsv").exists()


def other_density(study):
    path, surface = names(study / "bids" / "hippunfold", "09", "L", version=1)
    write_map(path, np.ones(99))
    surface.unlink()


def no_surface(study):
    for path in (study / "bids" / "hippunfold").rglob("*_midthickness.surf.gii"):
        path.unlink()


def damaged(study):
    path, _ = names(study / "bids" / "hippunfold", "09", "L", version=1)
    path.write_bytes(path.read_bytes()[:700])


def empty_maps(study):
    for subject in subjects():
        path, _ = names(study / "bids" / "hippunfold", subject, "L", version=1)
        write_map(path, np.full(160, np.nan))


def twice(study):
    rows = read_participants(study / "bids")
    write_participants(study / "bids", [*rows, rows[0]])


@pytest.mark.parametrize(
    ("spoil", "options", "code", "words"),
    [
        (other_density, [f"hipp={PATTERNS[1]}"], 65, "29 with 160"),
        (no_surface, [f"hipp={PATTERNS[1]}"], 65, "--maps-surface"),
        (damaged, [f"hipp={PATTERNS[1]}"], 65, "sub-09_hemi-L"),
        (empty_maps, [f"hipp={PATTERNS[1]}"], 65, "no point of the hipp maps"),
        (twice, [f"hipp={PATTERNS[1]}"], 65, "occur more than once"),
        (None, ["hipp=nothing/{subject}_{hemi}.gii"], 66, "no file matches"),
        (None, [f"hipp={PATTERNS[1]}", "--maps-surface", "none.gii"], 65, "no file none.gii"),
        (None, [f"thickness={PATTERNS[1]}"], 64, "belongs to the sheets"),
        (None, [f"hipp={PATTERNS[1]}", "--measures", "hip"], 65, "did you mean hipp?"),
        (None, ["hipp=x/{subject}.gii"], 64, "{hemi} or {side}"),
    ],
)
def test_refused_in_one_line(study, capsys, spoil, options, code, words):  # noqa: PLR0917 -- cases
    if spoil is not None:
        spoil(study)
    assert run(study, "--align", "none", "--maps", *options) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not list((study / "out").glob("group/*"))


@needs("repeated")
def test_change_between_sessions_of_other_maps(study):
    data = study / "bids" / "two"
    for subject in subjects():
        person = np.random.default_rng(int(subject)).normal(1.5, 0.3)  # cancels
        for session in (1, 2):
            path, surface = names(data, subject, "L", version=2, session=str(session))
            noise = np.random.default_rng(int(subject) * 10 + session).normal(0, 0.1, 160)
            thinning = 0.5 * thinned("L") * (session == 2) * (int(subject) > PLAN.sizes[0])
            write_map(path, person + noise - thinning)
            write_surface(surface, *SURFACES["L"])
    pattern = "two/sub-{subject}/ses-{session}/metric/*_hemi-{hemi}_*_thickness.shape.gii"
    options = ["--maps", f"hipp={pattern}", "--paired", "1", "2", "--name", "change"]
    assert run(study, *options, out="new") == 0
    rows = statmap(study / "new" / "group" / "change", "L")
    assert set(rows.n) == {COUNT}
    assert rows.significant[thinned("L")].mean() > 0.95
    assert rows.significant[~thinned("L")].mean() < 0.1
    assert rows.estimate[thinned("L")].mean() == pytest.approx(0.5, abs=0.05)


def test_refused_without_sheets_too(study, capsys):
    assert run(study, "--maps", "hipp=nothing/{subject}_{hemi}.gii", out="new") == 66
    assert capsys.readouterr().err.count("\n") == 1
    assert not (study / "new").exists()


def test_thickness_that_nobody_has_is_left_out_by_file(study, capsys):
    path, _ = names(study / "bids" / "hippunfold", "07", "L", version=1)
    write_map(path, np.full(len(SURFACES["L"][0]), -1.0))
    options = ["--maps", f"thickness={PATTERNS[1]}", "--no-reports", "--name", "few"]
    assert run(study, *options, out="alone") == 0
    said = capsys.readouterr().out
    assert f"note: {path}: thickness reaches -1 mm, which no sheet does; excluded" in said
    assert statmap(study / "alone" / "group" / "few", "L", "thickness").n.max() == COUNT - 1


def test_maps_of_others_are_scored_against_a_reference_group(written):
    options = ["--maps", f"hipp={PATTERNS[1]}", "--normative", "group=CN", "--name", "scored"]
    assert run(written, *options, out="alone") == 0
    folder = written / "alone" / "group" / "scored"
    image = nib.load(folder / "hemi-L_stat-w_desc-hipp_statmap.shape.gii")
    assert len(image.darrays) == COUNT
    patient = image.darrays[-1].data
    # Three standard deviations thinner; the mean of a fifth of 160 vertices is .2 off.
    assert np.nanmean(patient[thinned("L")]) == pytest.approx(-3, abs=0.7)
    assert abs(np.nanmean(patient[~thinned("L")])) < 0.5
    rows = table(folder / "hipp_wscores.tsv")
    assert set(rows.region) == {"all"}
    assert rows[~rows.reference].low.mean() > rows[rows.reference].low.mean()


@needs("combination")
def test_cifti_files_give_what_gifti_files_give_and_go_together(study, alone):
    for subject in subjects():
        both = {hemi: thickness(subject, hemi) for hemi in "LR" if (subject, hemi) != MISSING}
        write_cifti(cifti_name(study / "bids" / "hippunfold", subject, version=1), both)
    cifti = "hippunfold/sub-{subject}/surf/*_label-hipp_thickness.dscalar.nii"
    options = ["--maps", f"hipp={PATTERNS[1]}", f"dense={cifti}", "--joint", "hipp", "dense"]
    assert run(study, *options, "--permutations", "50", "--name", "two", out="new") == 0
    folder = study / "new" / "group" / "two"
    for hemi in "LR":
        expected = statmap(alone, hemi)
        # Both formats have single precision.
        for name in ("hipp", "dense"):
            np.testing.assert_allclose(statmap(folder, hemi, name).p, expected.p, rtol=1e-6)
        joint = statmap(folder, hemi, "joint")
        assert joint.significant[thinned(hemi)].mean() > 0.8
        assert joint.significant[~thinned(hemi)].mean() < 0.1
        np.testing.assert_allclose(joint.p_dense, expected.p, rtol=1e-6)
    assert "peak vertex " in group_page(folder)


@needs("combination")
def test_joint_maps_have_to_lie_on_one_surface(study, capsys):
    options = ["--maps", f"hipp={PATTERNS[1]}", "--joint", "thickness", "hipp", "--align", "none"]
    assert run(study, *options, "--measures", "thickness", "hipp", "--name", "no") == 65
    error = capsys.readouterr().err
    assert "different surfaces" in error
    assert error.count("\n") == 1


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Twelve participants on HippUnfold's template: its thickness, noise, and thinning in CA1."""
    if not HIPPUNFOLD.is_dir():
        pytest.skip("surfaces of HippUnfold not found")
    folder = tmp_path_factory.mktemp("template")
    name = "tpl-MNI152NLin2009bAsym"
    surface = str(
        HIPPUNFOLD / f"templates/{name}/{name}_hemi-{{hemi}}_space-T1w_den-0p5mm_label-hipp_"
    )
    data, random = folder / "bids", np.random.default_rng(0)
    for hemi in "LR":
        inner, outer = (
            nib.load(f"{surface.format(hemi=hemi)}{wall}.surf.gii").agg_data("pointset")
            for wall in ("inner", "outer")
        )
        labels = HIPPUNFOLD / "templates" / f"hemi-{hemi}_den-0p5mm_label-hipp_subfields.label.gii"
        thin = nib.load(labels).darrays[0].data == 2  # CA1
        np.save(folder / f"{hemi}.npy", thin)
        wall = np.linalg.norm(inner - outer, axis=1)
        for i in range(12):
            path, _ = names(data / "hippunfold", f"{i + 1:02d}", hemi, version=1)
            write_map(path, wall + random.normal(0, 0.1, len(wall)) - 0.4 * thin * (i >= 6))
    rows = [[f"sub-{i + 1:02d}", "AD" if i >= 6 else "CN"] for i in range(12)]
    files.write_tsv(data / "participants.tsv", ["participant_id", "group"], rows)
    options = ["--maps", f"hipp={PATTERNS[1]}", "--maps-surface", f"{surface}midthickness.surf.gii"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", lambda *_: iter(()))
        assert main([str(data), str(folder / "out"), "group", *options, "--name", "t"]) == 0
    return folder


def test_real_surfaces_of_hippunfold(template):
    folder = template / "out" / "group" / "t"
    image = nib.load(folder / "contrast-CNAD_desc-hipp_statmap.dscalar.nii")
    parts = list(image.header.get_axis(1).iter_structures())
    for hemi, (structure, part, _) in zip("LR", parts, strict=True):
        assert structure.startswith("CIFTI_STRUCTURE_HIPPOCAMPUS_")
        thin, rows = np.load(template / f"{hemi}.npy"), statmap(folder, hemi)
        assert len(rows) == len(thin) == 7262
        # Four standard deviations, in six against six.
        assert rows.significant[thin].mean() > 0.9
        assert rows.significant[~thin].mean() < 0.08
        np.testing.assert_allclose(image.get_fdata()[0, part], rows.statistic, rtol=1e-5)
        surface = nib.load(folder / f"hemi-{hemi}_space-hipp_midthickness.surf.gii")
        assert surface.darrays[0].meta["GeometricType"] == "Anatomical"
