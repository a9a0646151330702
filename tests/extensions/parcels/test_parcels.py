"""Means of maps over regions of the sheet as summary measures."""

import json

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from small_cohorts import COLUMNS, NODES, PLAN, place_of, table, write_dataset
from statsmodels.stats.multitest import multipletests

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.analyses import read_group
from hipsta_bids.errors import ExitCode
from hipsta_bids.extensions.parcels.figures import list_figures
from hipsta_bids.extensions.parcels.means import measure_regions
from hipsta_bids.group.cohort.collect import GroupRequest, collect_sheets
from hipsta_bids.group.cohort.read import read_sheets
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page

FAST = ("--align", "none", "--measures", "thickness", "--no-classification", "--no-reports")
COUNT = sum(PLAN.sizes)
ENDS = ("posterior", "middle", "anterior")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Sheets whose border of subfields differs, with missing values."""
    data, out = write_dataset(tmp_path_factory.mktemp("parcels"))
    random = np.random.default_rng(4)
    for i in range(COUNT):
        for hemi in "LR":
            path = place_of(out, f"{i + 1:02d}", hemi).path("sheet")
            rows, border = files.read_tsv(path), random.integers(6, 9)
            for row in rows:
                row["subfield"] = "Sub" if int(row["x"]) <= border else "CA2/3"
                if random.random() < 0.05:
                    row["thickness"] = "n/a"
            files.write_tsv(path, COLUMNS, [list(row.values()) for row in rows])
    return data, out


@pytest.fixture
def drawn(tmp_path):
    """Two regions that overlap."""
    path = tmp_path / "drawn.tsv"
    rows = [(x, y, "patch") for x in range(10, 15) for y in range(2, 5)]
    rows += [(x, y, "strip") for x in range(12, 22) for y in (4, 5)]
    files.write_tsv(path, ["x", "y", "region"], [[*map(str, row)] for row in rows])
    return path


def run(dataset, name, *options, fast=FAST):
    data, out = dataset
    code = main([str(data), str(out), "group", "--name", name, *fast, *map(str, options)])
    assert code == 0
    return out / "group" / name


def sheets(dataset):
    """All nodes of all sheets."""
    parts = []
    for i in range(COUNT):
        for hemi in "LR":
            sheet = table(place_of(dataset[1], f"{i + 1:02d}", hemi).path("sheet"))
            parts.append(sheet.assign(participant_id=f"sub-{i + 1:02d}", hemi=hemi))
    return pd.concat(parts, ignore_index=True)


def with_regions(nodes, choice, drawn):
    if choice == "drawn":
        return nodes.merge(table(drawn), on=["x", "y"])
    names = nodes["subfield"].str.replace("/", "_")
    thirds = np.array(ENDS)[[0, 0, 0, 1, 1, 2, 2]]  # of seven rows
    if choice == "subfields-axis":
        names = names + "_" + thirds[nodes["y"] - 1]
    return nodes.assign(region=names)


@pytest.mark.parametrize("choice", ["subfields", "subfields-axis", "drawn"])
def test_means_are_those_of_the_tables(dataset, drawn, choice):
    expected = with_regions(sheets(dataset), choice, drawn).groupby(
        ["hemi", "region", "participant_id"]
    )["thickness"]
    collection = collect_sheets(GroupRequest(roots=(dataset[1],)))
    cohort = read_sheets(collection.records, collection.grid, ["thickness"], max_gap=1)
    option = drawn if choice == "drawn" else choice
    seen = 0
    for hemi, side in cohort.sides.items():
        people = cohort.table["participant_id"].iloc[side.rows]
        for name, region, mean, count in measure_regions(side, str(option), ["thickness"]):
            assert name == "thickness"
            np.testing.assert_allclose(
                mean, expected.mean()[hemi, region][people], rtol=1e-12, atol=0
            )
            np.testing.assert_array_equal(count, expected.count()[hemi, region][people])
            seen += 1
    assert seen == 2 * {"subfields": 2, "subfields-axis": 6, "drawn": 2}[choice]


@pytest.mark.usefixtures("without_figures")
def test_table_for_other_programs(dataset, drawn):
    folder = run(dataset, "table", "--regions", drawn)
    rows = table(folder / "regions.tsv")
    assert list(rows) == [
        *("participant_id", "session_id", "hemi", "region", "measure", "mean", "n_nodes")
    ]
    assert len(rows) == COUNT * 2 * 2
    means = with_regions(sheets(dataset), "drawn", drawn).groupby(
        ["participant_id", "hemi", "region"]
    )["thickness"]
    found = rows.set_index(["participant_id", "hemi", "region"])
    np.testing.assert_allclose(found["mean"], means.mean().reindex(found.index), rtol=1e-9)
    meanings = json.loads((folder / "regions.json").read_text())
    assert set(meanings) == set(rows)
    assert "registration" in meanings["mean"]["Description"]
    assert set(json.loads((folder / "region_nodes.json").read_text())) == {
        *("hemi", "node_x", "node_y", "region")
    }


@pytest.mark.usefixtures("without_figures")
def test_p_values_and_families_are_those_of_statsmodels(dataset):
    folder = run(dataset, "tests", "--regions", "subfields-axis")
    rows = table(folder / "measures.tsv")
    regional = rows["measure"].str.contains("_region_")
    assert regional.sum() == 6 * 3  # left, right, mean of both
    nodes = with_regions(sheets(dataset), "subfields-axis", None)
    by_region = nodes.groupby(["hemi", "region"])
    means = {key: part.groupby("participant_id")["thickness"].mean() for key, part in by_region}
    people = table(dataset[0] / "participants.tsv").set_index("participant_id")
    for row in rows[regional].itertuples():
        region = row.measure.removeprefix("thickness_region_")
        sides = [means[hemi, region] for hemi in row.hemi]
        data = people.assign(y=sum(sides) / len(sides))
        fit = smf.ols("y ~ C(group, Treatment('AD')) + age + sex", data).fit()
        name = "C(group, Treatment('AD'))[T.CN]"
        assert row.p == pytest.approx(fit.pvalues[name], rel=1e-8)
        assert row.estimate == pytest.approx(fit.params[name], rel=1e-7)
        assert row.unit == "mm"
    for members in (regional, ~regional):
        corrected = multipletests(rows["p"][members], alpha=0.05, method="fdr_tsbky")[1]
        expected = np.maximum(np.minimum(corrected, 1), rows["p"][members])
        np.testing.assert_allclose(rows["p_fdr"][members], expected, rtol=1e-6)


@pytest.mark.usefixtures("without_figures")
def test_other_measures_do_not_change(dataset):
    plain = table(run(dataset, "plain") / "measures.tsv")
    rows = table(run(dataset, "more", "--regions", "subfields") / "measures.tsv")
    rows = rows[~rows["measure"].str.contains("_region_")].reset_index(drop=True)
    pd.testing.assert_frame_equal(rows, plain)


@pytest.mark.usefixtures("without_figures")
def test_other_maps_and_single_measures(dataset):
    fast = ("--align", "none", "--no-classification", "--no-reports")
    options = ("--measures", "curvature", "volume", "--regions", "subfields")
    rows = table(run(dataset, "chosen", *options, fast=fast) / "measures.tsv")
    assert set(rows["measure"]) == {*("volume", "curvature_region_Sub", "curvature_region_CA2_3")}
    options = ("--formula", "curvature ~ group", "--regions", "subfields")
    rows = table(run(dataset, "left", *options, fast=fast) / "measures.tsv")
    assert "curvature_region_Sub" in set(rows["measure"])
    rows = table(run(dataset, "default", "--regions", "subfields", fast=fast) / "regions.tsv")
    assert set(rows["measure"]) == {"thickness"}


@pytest.mark.usefixtures("without_figures")
def test_asymmetry_of_regions(dataset):
    folder = run(dataset, "asymmetry", "--regions", "subfields", "--asymmetry")
    rows = table(folder / "measures.tsv").set_index(["measure", "hemi"])["estimate"]
    for region in ("Sub", "CA2_3"):
        name = f"thickness_asymmetry_region_{region}"
        left, right = (rows[f"thickness_region_{region}", hemi] for hemi in "LR")
        assert rows[name].index.tolist() == ["LR"]
        assert rows[name, "LR"] == pytest.approx(left - right, abs=1e-8)


@pytest.mark.usefixtures("without_figures")
def test_changes_of_regions_are_those_of_the_cohort(sessions):
    """Patients lose 0.1 mm per year, others 0.02; sessions 1 and 3 are two years apart."""
    folder = run(sessions, "paired", "--regions", "subfields", "--paired", "1", "3")
    rows = table(folder / "measures.tsv").set_index(["contrast", "measure", "hemi"])["estimate"]
    for region in ("Sub", "CA1"):
        for hemi in "LR":
            change = rows["CN-AD", f"thickness_region_{region}", hemi]
            assert change == pytest.approx(2 * (0.1 - 0.02), abs=0.005)


@pytest.mark.usefixtures("without_figures")
def test_harmonized_regions(dataset):
    data, _ = dataset
    path = data / "participants.tsv"
    before = path.read_text()
    rows = files.read_tsv(path)
    sites = [[*row.values(), f"s{i % 2}"] for i, row in enumerate(rows)]
    files.write_tsv(path, [*rows[0], "site"], sites)
    try:
        folder = run(dataset, "sites", "--regions", "subfields", "--harmonize", "site")
    finally:
        path.write_text(before)
    rows = table(folder / "sites.tsv")
    assert {"thickness_region_Sub", "thickness_region_CA2_3"} <= set(rows["measure"])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(22, 1, "a")], "point x=22, y=1 lies off the sheet"),
        ([(1, 1, "a"), (1, 1, "a")], "occurs 2 times in region a"),
        ([(1, 1, "n/a")], "no point belongs to a region"),
        ([(1, 1, "a"), (3, 1, "empty")], "thickness_region_empty has no value on any sheet"),
    ],
)
@pytest.mark.usefixtures("without_figures")
def test_faulty_tables_are_refused_in_one_line(dataset, tmp_path, capsys, rows, message):
    path, mask = tmp_path / "faulty.tsv", tmp_path / "mask.tsv"
    files.write_tsv(path, ["x", "y", "region"], [[*map(str, row)] for row in rows])
    files.write_tsv(mask, ["x", "y"], [["3", "1"]])
    data, out = dataset
    options = [*FAST, "--regions", str(path), "--mask", str(mask)]
    assert main([str(data), str(out), "group", *options]) == ExitCode.BAD_DATA
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert str(path) in line


@pytest.mark.usefixtures("without_figures")
def test_missing_file_and_map(dataset, tmp_path, capsys):
    data, out = dataset
    call = [str(data), str(out), "group", *FAST, "--regions"]
    assert main([*call, str(tmp_path / "no.tsv")]) == ExitCode.BAD_DATA
    assert "file not found" in capsys.readouterr().err
    assert main([*call, "subfield"]) == ExitCode.USAGE
    assert "file does not exist; did you mean subfields?" in capsys.readouterr().err
    call = [str(data), str(out), "group", "--measures", "volume", "--regions", "subfields"]
    assert main(call) == ExitCode.BAD_DATA
    assert "no map or no subfield" in capsys.readouterr().err


def test_figure_and_page(dataset, drawn):
    fast = ("--align", "none", "--measures", "thickness", "--no-classification")
    folder = run(dataset, "figure", "--regions", drawn, fast=fast)
    picture = (folder / "figures" / "thickness_regions.svg").read_text()
    for text in ("patch", "strip", "Effect, CN-AD", "Significant regions: "):
        assert text in picture
    page = group_page(folder)
    assert "Thickness regions" in page
    assert "Means over regions of a map are separate families" in page
    assert "drawn regions" in (folder / "methods.md").read_text()
    nodes = table(folder / "region_nodes.tsv").set_index(["hemi", "node_x", "node_y"])["region"]
    assert len(nodes) == 2 * np.prod(NODES)
    assert nodes["L", 12, 4] == "patch"  # the first of two that have this node
    assert nodes["R", 21, 5] == "strip"
    assert nodes.isna().sum() == 2 * (np.prod(NODES) - 15 - 20 + 3)
    (figure,) = list_figures(read_group(folder))
    assert figure[0] == "thickness_regions"
