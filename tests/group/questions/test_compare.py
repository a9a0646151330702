"""The group level from files to files, on sheets with a planted effect."""

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from pyarrow import parquet
from small_cohorts import GROUPS, NODES, PLAN, methods_of, place_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.group.cohort import read
from hipsta_bids.group.cohort.collect import GroupRequest
from hipsta_bids.group.model import ModelRequest
from hipsta_bids.group.output import pages, write
from hipsta_bids.group.output.tables import COLUMNS
from hipsta_bids.group.questions import study
from hipsta_bids.io import files
from hipsta_bids.stats import arrays
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings

MODEL = "group-age-sex"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("group"))


@pytest.fixture(scope="module")
def results(dataset, quick):
    data, out = dataset
    assert main([str(data), str(out), "group", *quick, "--figures"]) == 0
    return out / "group" / MODEL


@pytest.fixture
def with_figures():
    """Marks tests that look at figures."""


@pytest.fixture(autouse=True)
def _quick_figures(request, monkeypatch):
    """Figures take longer than all else; the module's own run draws them."""
    if "with_figures" not in request.fixturenames:
        monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


_MAP_FIGURES = ("maps", "alignment")


def statmap(folder, hemi):
    return table(folder / f"hemi-{hemi}_contrast-CNAD_desc-thickness_statmap.tsv")


def test_planted_thinning_is_the_peak_of_both_hemispheres(results):
    peaks = table(results / "peaks.tsv")
    for hemi in "LR":
        first = peaks[(peaks.measure == "thickness") & (peaks.hemi == hemi)].iloc[0]
        assert first.contrast == "CN-AD"
        assert first.statistic > 0
        assert first.p_corrected < 0.05
        # Two nodes are what registration of 30 noisy profiles on 21 nodes may be off.
        node = (first.x + 0.9) / 1.8 * (NODES[0] - 1)
        assert node == pytest.approx(PLAN.center[0], abs=2.0)


@pytest.mark.parametrize(
    ("maps", "statistic"),
    [("thickness_registered", "statistic"), ("thickness", "statistic_unregistered")],
)
def test_map_is_what_the_written_maps_and_covariates_give(results, maps, statistic):
    """Anybody can repeat the fit from the hand-over file alone."""
    long = parquet.read_table(results / "maps.parquet").to_pandas()
    people = table(results / "covariates.tsv")
    own = long[long.hemi == "L"]
    wide = own.pivot_table(
        index="participant_id",
        columns=["node_x", "node_y"],
        values=maps,
        observed=True,
        dropna=False,
    ).loc[people.participant_id]
    matrix = np.column_stack(
        [np.ones(len(people)), people.group == "CN", people.age, people.sex == "F"]
    ).astype(float)
    contrast = Contrast("CN-AD", np.array([0.0, 1, 0, 0]))
    values = wide.to_numpy(dtype=float)
    (test,) = fit_points(values, matrix, [contrast], GlmSettings()).tests
    # Maps are handed over in single precision.
    np.testing.assert_allclose(statmap(results, "L")[statistic], test.statistic, rtol=1e-3)


def test_tables_say_what_their_columns_are(results):
    found = sorted(results.glob("*.tsv"))
    assert {path.stem for path in found} >= {
        "peaks",
        "maps",
        "measures",
        "registration",
        "warps",
        "descriptives",
        "shifts",
        "alignment",
        "classification",
        "excluded",
        "means",
        "profiles",
        "roc",
        "design",
    }
    for path in found:
        if path.stem in {"covariates", "design"}:
            continue
        columns = path.read_text().split("\n", 1)[0].split("\t")
        described = json.loads(path.with_suffix(".json").read_text())
        assert list(described) == columns, path.name
        unknown = [c for c in columns if c not in COLUMNS and not c.startswith("node_")]
        assert not unknown, path.name


def test_maps_of_statistics_have_sidecars(results):
    """As of NeuroVault and BIDS Stats Models: kind of map, contrast, model, degrees of freedom."""
    record = json.loads((results / "analysis.json").read_text())
    for stat, kind in (("t", "T"), ("d", "Other"), ("pcorrected", "P")):
        stem = f"hemi-L_contrast-CNAD_stat-{stat}_desc-thickness_statmap"
        assert (results / f"{stem}.shape.gii").exists()
        about = json.loads((results / f"{stem}.json").read_text())
        assert about["StatMapType"] == kind
        assert (about["Contrast"], about["Measure"]) == ("CN-AD", "thickness")
        assert about["Model"] == record["formula"]
        assert list(about["ContrastWeights"]) == record["columns"]
        df = statmap(results, "L").df
        assert about["DegreesOfFreedom"] == [df.min(), df.max()]
        assert about["NumberOfParticipants"] == record["participants"]
        rules = record["settings"]["multiplicity"]
        assert (about["Correction"], about["Level"]) == (rules["method"], rules["alpha"])
        assert about["Family"] == "all points of equal measure, contrast, hemi"


def test_findings_are_counted_with_and_without_registration(results):
    with_it = pd.read_table(results / "alignment.tsv")
    maps = pd.read_table(results / "maps.tsv")
    columns = ["measure", "contrast", "hemi", "n_tests", "n_significant"]
    pd.testing.assert_frame_equal(with_it[columns], maps[columns])
    assert (with_it.n_both <= with_it[["n_significant", "n_unregistered"]].min(axis=1)).all()
    for hemi, row in with_it[with_it.measure == "thickness"].set_index("hemi").iterrows():
        points = statmap(results, hemi)
        after, before = points.significant, points.significant_unregistered
        assert (before.sum(), (after & before).sum()) == (row.n_unregistered, row.n_both)
        assert row.dice == pytest.approx(2 * row.n_both / (after.sum() + before.sum()))
        expected = np.corrcoef(points.statistic, points.statistic_unregistered)[0, 1]
        assert row.statistic_r == pytest.approx(expected)
        assert 0.5 < row.statistic_r < 0.99  # moved by two nodes, but the same thinning
    # The cohort's groups are apart, so that the maps differ.
    assert (with_it.n_unregistered != with_it.n_significant).any()
    moved = pd.read_table(results / "registration.tsv")
    assert (moved.difference_p < 0.05).all()
    assert "largest difference of mean displacement between groups was" in (
        (results / "methods.md").read_text()
    )


def test_maps_file_is_typed_and_has_units(results):
    schema = parquet.read_schema(results / "maps.parquet")
    assert schema.field("thickness").metadata[b"unit"] == b"mm"
    assert schema.field("curvature_registered").metadata[b"unit"] == b"1/mm"
    assert str(schema.field("thickness").type) == "float"
    rows = parquet.read_metadata(results / "maps.parquet").num_rows
    assert rows == 2 * sum(PLAN.sizes) * NODES[0] * NODES[1]


def test_record_and_methods_have_the_numbers(results, dataset, quick):
    record = json.loads((results / "analysis.json").read_text())
    data, out = dataset
    command = ["hipsta-bids", str(data), str(out), "group", *quick, "--figures"]
    assert record["command"] == command
    assert record["participants"] == sum(PLAN.sizes)
    assert record["references"]["group"] == GROUPS[0]
    assert record["settings"]["classification"]["repeats"] == 2
    text = methods_of(results)
    registration = table(results / "registration.tsv").set_index("hemi").loc["L"]
    explained = registration.explained_before, registration.explained_after
    assert f"{PLAN.sizes[0]} CN, {PLAN.sizes[1]} AD" in text
    significant = int(statmap(results, "L").significant.sum())
    assert f"thickness, CN-AD, L: {significant} of" in text
    assert "sheet (reference levels: group CN, sex F). The contrast was CN-AD." in text
    procedure = "the two-stage procedure of Benjamini, Krieger and Yekutieli [3]"
    n_maps = len(table(results / "maps.tsv"))
    assert f"by {procedure}, over the points of each map ({n_maps} families of tests)." in text
    n_families = table(results / "measures.tsv").contrast.nunique()
    assert f"models of a contrast (families of tests: {n_families})." in text
    assert "B-spline warps were estimated alternately [2]" in text
    assert "with a penalty" not in text
    assert f"{explained[0]:.0%} before and {explained[1]:.0%} after registration (left)" in text
    model = json.loads((results / "model.json").read_text())
    assert model["BIDSModelVersion"] == "1.0.0"


def test_classification_and_measures_are_tables_of_the_paper(results):
    pairs = table(results / "classification.tsv")
    assert set(pairs.hemi) == {"L", "R", "LR"}
    assert (pairs.base == "volume").all()
    assert (pairs.added == "thickness_mean").all()  # the only other measure with values
    measures = table(results / "measures.tsv")
    volume = measures[(measures.measure == "volume") & (measures.hemi == "L")].iloc[0]
    assert volume.estimate > 0  # 5 mm^3 were taken off patients
    means = table(results / "descriptives.tsv")
    assert set(means.n[means.measure == "volume"]) == set(PLAN.sizes)


def test_frozen_template_gives_the_same_warps_to_a_part_of_the_subjects(results, dataset, quick):
    data, out = dataset
    some = [f"{i:02d}" for i in (*range(1, 9), *range(20, 29))]
    arguments = [str(data), str(out), "group", *quick, "--template", str(results / "template.json")]
    assert main([*arguments, "--name", "all"]) == 0
    assert main([*arguments, "--name", "part", "--participant-label", *some]) == 0
    keys = ["participant_id", "hemi"]
    whole = table(out / "group" / "all" / "warps.tsv").set_index(keys)
    part = table(out / "group" / "part" / "warps.tsv").set_index(keys)
    nodes = [f"node_{i + 1}" for i in range(NODES[0])]
    # Ten digits are written.
    np.testing.assert_allclose(part[nodes], whole.loc[part.index, nodes], atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("turns", 10**9, "turns is 1000000000, but has to be at most 1000"),  # it would never end
        ("noise", -1, "noise is -1, but has to be above 0"),
        ("noise", float("nan"), "noise is nan, but has to be a finite number"),
        ("mean", [1.0], "knots, mean and components do not fit each other"),
        ("knots", [0.9, 0.1, 0.2, 0.3], "numbers that rise"),
        ("knots", [0.1, 0.2, 0.2, 0.3], "but has to be different numbers that rise"),
        ("knots", [0, 0.1, 0.2, 0.3], "entry 1 of knots is 0, but has to be above 0"),
        ("center", [0.2, 1.0], "center does not run from 0 to 1"),
        ("center", [0.0, 1.0], "the template has 2 nodes along x"),
        (None, [], "it has no Hemispheres"),
    ],
)
def test_templates_of_others_may_hold_anything(  # noqa: PLR0917 -- cases
    results, dataset, quick, tmp_path, capsys, field, value, said
):
    content = json.loads((results / "template.json").read_text())
    if field is None:
        content["Hemispheres"] = value
    else:
        content["Hemispheres"]["R"][field] = value
    path = tmp_path / "template.json"
    path.write_text(json.dumps(content))
    where = [str(each) for each in dataset]
    assert main([*where, "group", *quick, "--template", str(path), "--name", "bad"]) == 65
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert said in line


def test_formula_contrast_reference_and_options(dataset, quick):
    data, out = dataset
    code = main(
        [
            *(str(data), str(out), "group", *quick, "--name", "mine"),
            *("--formula", "thickness ~ group + age", "--contrast", "slope = age"),
            *("group[AD]-group[CN]", "--reference", "group=AD", "--align", "none"),
            *("--fdr-scope", "hemispheres", "--base", "thickness_mean", "age"),
            *("--correction", "bh"),
        ]
    )
    assert code == 0
    folder = out / "group" / "mine"
    record = json.loads((folder / "analysis.json").read_text())
    assert record["formula"] == "group + age"
    assert record["references"] == {"group": "AD"}
    assert set(record["contrasts"]) == {"slope", "group[AD]-group[CN]"}
    assert not (folder / "template.json").exists()
    text = methods_of(folder)
    assert "Maps were not registered to each other." in text
    assert "Wrobel" not in text  # who is not referred to
    maps = table(folder / "maps.tsv")
    assert set(maps.n_tests) == {2 * NODES[0] * NODES[1]}
    n_families = len(maps[["measure", "contrast"]].drop_duplicates())
    procedure = "Benjamini and Hochberg [2], over the points of both hemispheres"
    assert f"{procedure} ({n_families} families of tests)." in text
    again = [*(str(data), str(out), "group", *quick), "--model", str(folder / "model.json")]
    assert main([*again, "--align", "none", "--name", "again"]) == 0
    first, second = (table(out / "group" / name / "peaks.tsv") for name in ("mine", "again"))
    assert set(first.contrast) == set(second.contrast)


@pytest.mark.parametrize("problem", [None, "kept.html: not made (no space)"])
def test_the_page_is_named_unless_it_could_not_be_made(tmp_path, monkeypatch, problem):
    monkeypatch.setattr(pages, "write_group_report", lambda *_: problem)
    sheets = GroupRequest(roots=(tmp_path,))
    given = study.GroupOptions(
        bids_dir=tmp_path, out_dir=tmp_path, sheets=sheets, model=ModelRequest()
    )
    written = study.GroupResult(
        folder=tmp_path / "group" / "kept", n_participants=2, n_excluded=0, notes=(), warnings=()
    )
    result = study.with_page(given, written)
    page = tmp_path / "group" / "kept.html"
    assert (result.page, result.problem) == (None if problem else page, problem)


def test_hemispheres_to_look_at_are_told(dataset, quick, capsys):
    data, out = dataset
    path = place_of(out, "02", "R").path("qc")
    before = path.read_bytes()
    files.write_json(path, json.loads(before) | {"decision": "look"})
    assert main([str(data), str(out), "group", *quick, "--name", "flagged"]) == 0
    said = capsys.readouterr().out
    assert "note: 1 hemispheres to look at first are included without a rating" in said
    assert f"report: {out / 'group' / 'flagged.html'}\n" in said
    # The time of each stage, as it ends.
    timed = re.findall(r"^  ([\w -]+?) +\d+\.\d s$", said, re.MULTILINE)
    assert timed[:3] == ["reading", "registration", "models"]
    assert timed[-3:] == ["tables and maps", "figures", "page"]
    assert len(timed) <= 12
    path.write_bytes(before)


def test_a_quiet_run_prints_nothing(dataset, quick, capsys):
    data, out = dataset
    options = ["--measures", "thickness_mean", "--no-reports", "--name", "quiet", "-q"]
    assert main([str(data), str(out), "group", *quick, *options]) == 0
    assert capsys.readouterr() == ("", "")
    assert (out / "group" / "quiet" / "measures.tsv").exists()


def test_left_out_hemispheres_are_listed_with_the_reason(tmp_path, quick):
    data, out = write_dataset(tmp_path)
    record = place_of(out, "01", "L").path("qc")
    files.write_json(record, {"decision": "failed", "reason": "too-thin", "message": "2 voxels"})
    flagged = place_of(out, "02", "R").path("qc")
    content = json.loads(flagged.read_text())
    files.write_json(flagged, content | {"decision": "look", "reason": "notch"})
    filled = place_of(out, "03", "L").path("qc")
    content = json.loads(filled.read_text())
    files.write_json(filled, content | {"metrics": {"filled_fraction": 0.1, "rule": "labels"}})
    listed = tmp_path / "listed.tsv"
    listed.write_text("participant_id\themi\treason\nsub-04\tR\tmoved\n05\tn/a\twithdrew\n")
    rows = [line.split("\t") for line in (data / "participants.tsv").read_text().splitlines()]
    rows[6][2] = "n/a"  # age of sub-06
    (data / "participants.tsv").write_text("\n".join("\t".join(row) for row in rows) + "\n")
    arguments = [
        str(data),
        str(out),
        "group",
        *quick,
        "--exclude-look",
        "--exclude",
        str(listed),
    ]
    conditions = ["filled_fraction > 0.05", "filled_fraction < 0"]
    assert main([*arguments, "--exclude-qc", *conditions]) == 0
    folder = out / "group" / MODEL
    left_out = table(folder / "excluded.tsv")
    found = {(r.participant_id, r.hemi, r.reason, r.message) for r in left_out.itertuples()}
    assert ("sub-03", "L", "quality", "filled_fraction > 0.05") in found
    assert ("sub-01", "L", "failed: too-thin", "2 voxels") in found
    assert ("sub-04", "R", "listed", "moved") in found
    assert {one[:2] for one in found if one[0] == "sub-05"} == {("sub-05", "L"), ("sub-05", "R")}
    assert {(a, c) for a, _, c, _ in found} >= {
        ("sub-02", "look: notch"),
        ("sub-03", "quality"),
        ("sub-06", "incomplete"),
    }
    n = table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv").n
    assert set(n) == {sum(PLAN.sizes) - 4}  # without 01, 03, 05, 06


def test_figures_are_drawn_as_pictures_and_drawings(results):
    names = {path.stem for path in (results / "figures").glob("*.png")}
    shown = {f"{name}_{kind}" for name in ("thickness", "curvature") for kind in _MAP_FIGURES}
    assert names == shown | {"registration", "roc"}
    compared = (results / "figures" / "thickness_alignment.svg").read_text()
    assert ">Registered: CN-AD<" in compared
    assert ">Not registered: CN-AD<" in compared
    for name in names:
        drawing = (results / "figures" / f"{name}.svg").read_text()
        # Words stay words, so that they can be searched and edited.
        assert ">medial<" in drawing or name == "roc"
        assert not re.search(r"font-size: (?![789](\.0)?px)", drawing)
        with Image.open(results / "figures" / f"{name}.png") as picture:
            assert picture.info["dpi"] == pytest.approx((300, 300), rel=1e-3)
            widths = pytest.approx(85, abs=0.1), pytest.approx(180, abs=0.1)
            assert picture.width / 300 * 25.4 in widths
        printed = (results / "figures" / f"{name}.pdf").read_bytes()
        assert b"/FontFile2" in printed  # TrueType, whole letters
        assert b"/Type3" not in printed
        assert b"CreationDate" not in printed
        assert len(printed) < 2e6
    maps = (results / "figures" / "thickness_maps.svg").read_text()
    assert ">Effect, CN-AD<" in maps
    assert maps.count(">0.05<") == 2  # on the bar of significance, on both sides of zero
    assert ">CA1<" in maps
    assert maps.count(">Left<") == maps.count(">Right<") == 1


@pytest.mark.usefixtures("with_figures")
def test_same_run_gives_the_same_files(results, dataset, quick):
    data, out = dataset
    before = {path.name: path.read_bytes() for path in results.rglob("*") if path.is_file()}
    assert main([str(data), str(out), "group", *quick, "--figures"]) == 0
    after = {path.name: path.read_bytes() for path in results.rglob("*") if path.is_file()}
    assert before == after


def test_large_cohorts_take_single_precision_and_no_copies(results, dataset, quick, monkeypatch):
    """Only numbers too small for the tables' decimals change."""
    for module in (arrays, read):
        monkeypatch.setattr(module, "MOST_KEPT", 3)
    data, out = dataset
    assert main([str(data), str(out), "group", *quick, "--name", "large", "--no-reports"]) == 0
    large = out / "group" / "large"
    names = sorted(path.name for path in results.glob("*.tsv"))
    assert names == sorted(path.name for path in large.glob("*.tsv"))
    for name in names:
        pd.testing.assert_frame_equal(
            table(large / name), table(results / name), rtol=1e-4, atol=1e-5
        )
    maps = [parquet.read_table(folder / "maps.parquet").to_pandas() for folder in (large, results)]
    pd.testing.assert_frame_equal(*maps, rtol=1e-6)
    assert not maps[0].equals(maps[1])


def test_without_pyarrow_only_parquet_files_are_missing(results, dataset, quick):
    """In a process of its own: pandas uses pyarrow where it is installed."""
    program = """
import sys
from importlib.machinery import PathFinder
class Without(PathFinder):
    def find_spec(name, *arguments):
        return None if name == "pyarrow" else PathFinder.find_spec(name, *arguments)
sys.meta_path = [Without if finder is PathFinder else finder for finder in sys.meta_path]
from hipsta_bids.cli.main import main
from hipsta_bids.group.output import write
write.draw_figures = lambda *_: iter(())
sys.exit(main(sys.argv[1:]))
"""
    data, out = dataset
    command = [data, out, "group", *quick, "--name", "bare", "--no-reports"]
    run = subprocess.run(
        [sys.executable, "-c", program, *map(str, command)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert not run.stderr
    before, after = (
        {
            path.name: path.read_bytes()
            for path in folder.iterdir()
            if path.suffix in {".tsv", ".gii", ".parquet"}
        }
        for folder in (results, out / "group" / "bare")
    )
    assert before.pop("maps.parquet")
    assert before == after


def test_first_of_several_sessions_is_analyzed(tmp_path, quick):
    data, out = write_dataset(tmp_path, session="1")
    for hemi in "LR":
        first, later = (place_of(out, "01", hemi, session=one) for one in ("1", "2"))
        for key in ("sheet", "summary", "qc"):
            later.path(key).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(first.path(key), later.path(key))
    assert main([str(data), str(out), "group", *quick]) == 0
    left_out = table(out / "group" / MODEL / "excluded.tsv")
    kept = left_out[["participant_id", "session_id", "reason"]]
    assert kept.to_numpy().tolist() == [["sub-01", "ses-2", "later-session"]]


def test_means_and_design_are_those_of_maps_and_covariates(results):
    means = table(results / "means.tsv")
    long = parquet.read_table(results / "maps.parquet").to_pandas()
    people = table(results / "covariates.tsv")
    cases = people[people.group == "AD"].participant_id
    own = long[(long.hemi == "R") & long.participant_id.isin(cases)]
    wanted = own.groupby(["node_x", "node_y"]).thickness_registered.agg(["mean", "std"])
    found = means[(means.hemi == "R") & (means.measure == "thickness") & (means.group == "AD")]
    # Maps are handed over in single precision.
    np.testing.assert_allclose(found["mean"], wanted["mean"], rtol=1e-5)
    np.testing.assert_allclose(found["sd"], wanted["std"], rtol=1e-4)
    design = table(results / "design.tsv")
    assert list(design.participant_id) == list(people.participant_id)
    np.testing.assert_array_equal(design["group[T.AD]"], people.group == "AD")
    np.testing.assert_allclose(design["age"], people.age)


def test_curves_are_those_of_the_classifiers(results):
    curves, areas = table(results / "roc.tsv"), table(results / "classification.tsv")
    for row in areas.itertuples():
        same = (curves.hemi == row.hemi) & (curves.added == row.added)
        for which, area in (("base", row.auc_base), ("full", row.auc_full)):
            one = curves[same & (curves.classifier == which)]
            under = np.trapezoid(one.true_positives, one.false_positives)
            assert under == pytest.approx(area, abs=1e-9)
