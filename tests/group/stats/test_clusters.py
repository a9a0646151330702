"""Edges, cluster enhancement and clusters on grids and meshes, and tables of peaks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from hipsta_bids.group.design.contrasts import Contrast
from hipsta_bids.group.design.settings import GlmSettings, MultiplicitySettings
from hipsta_bids.group.output.columns import Frame, find_clusters, peak_table
from hipsta_bids.group.stats import clusters
from hipsta_bids.group.stats.clusters import (
    TFCE_STEP,
    enhance,
    label_regions,
    mesh_edges,
    sheet_edges,
)
from hipsta_bids.group.stats.glm import fit_points
from hipsta_bids.group.stats.inference import Discoveries, MapKey, control_fdr, discover
from hipsta_bids.io.gifti import sheet_triangles

SHAPE = (12, 8)
EDGES = sheet_edges(*SHAPE)
FRAME = Frame.of_sheet(
    np.linspace(-0.95, 0.95, 12),
    np.linspace(-1, 1, 8),
    np.where(np.arange(12)[:, None] < 5, "SUB", "CA1") + np.zeros(8, dtype="U1"),
)


def test_edges_of_a_small_grid():
    """Nodes 0 1 / 2 3 / 4 5, y along rows."""
    four = [[0, 2], [1, 3], [2, 4], [3, 5], [0, 1], [2, 3], [4, 5]]
    assert sheet_edges(3, 2, 4).tolist() == four
    assert sheet_edges(3, 2, 8).tolist() == [*four, [0, 3], [2, 5], [1, 2], [3, 4]]
    assert sheet_edges(1, 3).tolist() == [[0, 1], [1, 2]]


def test_each_edge_of_a_mesh_stands_once():
    triangles = np.array([[0, 1, 2], [2, 1, 3]])
    assert mesh_edges(triangles).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    # A grid of n x m nodes with one diagonal per cell: Euler's formula counts its edges.
    nx, ny = SHAPE
    edges = mesh_edges(sheet_triangles(nx, ny))
    assert len(edges) == nx * ny + 2 * (nx - 1) * (ny - 1) - 1


def test_regions_are_those_that_edges_connect():
    edges = np.array([[0, 1], [1, 2], [3, 4]])
    labels, count = label_regions(np.array([True, False, True, True, True]), edges)
    assert count == 3
    assert labels.tolist() == [1, 0, 2, 3, 3]
    assert label_regions(np.zeros(5, dtype=bool), edges)[1] == 0


def structure(neighbors):
    return ndimage.generate_binary_structure(2, 1 if neighbors == 4 else 2)


@pytest.mark.parametrize("neighbors", [4, 8])
def test_regions_of_a_grid_are_those_of_scipy(neighbors):
    mask = np.random.default_rng(0).random(SHAPE) < 0.5
    labels, count = label_regions(mask.ravel(), sheet_edges(*SHAPE, neighbors))
    expected, number = ndimage.label(mask, structure(neighbors))
    assert count == number
    np.testing.assert_array_equal(labels.reshape(SHAPE), expected)


@pytest.mark.parametrize("neighbors", [4, 8])
def test_enhancement_is_its_definition(neighbors):
    """Height by height, each sign and each map by itself, with regions of scipy."""
    t = np.random.default_rng(0).normal(0, 2, (3, *SHAPE))
    t[0, :2] = np.nan
    t[1] = 0.05  # below the first height
    expected = np.zeros(t.shape)
    for sign in (1, -1):
        for own, values in zip(expected, sign * np.nan_to_num(t), strict=True):
            height = TFCE_STEP
            while (above := values >= height).any():
                labels, _ = ndimage.label(above, structure(neighbors))
                extent = np.bincount(labels.ravel())[labels]
                own[:] += sign * above * extent**0.5 * height**2 * TFCE_STEP
                height += TFCE_STEP
    found = enhance(t.reshape(3, -1), sheet_edges(*SHAPE, neighbors))
    np.testing.assert_allclose(found, expected.reshape(3, -1), rtol=1e-12)  # order of sums


def test_enhancement_of_a_plateau_is_the_sum_of_its_heights(monkeypatch):
    sheet = np.zeros((6, 5))
    sheet[1:3, 1:4] = 1.0  # six points of height 1
    sheet[4, 0] = -0.5
    monkeypatch.setattr(clusters, "TFCE_STEP", 0.25)
    raised = enhance(sheet.reshape(1, -1), sheet_edges(6, 5)).reshape(6, 5)
    heights = np.array([0.25, 0.5, 0.75, 1.0])
    assert raised[1, 1] == pytest.approx(np.sqrt(6) * (heights**2).sum() * 0.25)
    assert raised[4, 0] == pytest.approx(-(heights[:2] ** 2).sum() * 0.25)
    assert np.count_nonzero(raised) == 7


@pytest.mark.parametrize("count", range(1, 31))
def test_enhancement_reaches_the_height_that_a_point_has(count):
    """Sums of steps are rounded: a tenth, ten times, is less than 1 and counts as ten heights."""
    heights = np.cumsum(np.full(count, 0.1))
    (found,) = enhance(heights[None, -1:], np.zeros((0, 2), dtype=int))
    assert found.item() == pytest.approx((heights**2).sum() * 0.1, rel=1e-12)  # order of sums


def test_clusters_are_split_by_sign_and_by_neighbors():
    significant = np.zeros((5, 5), dtype=bool)
    significant[[0, 1, 2, 2], [0, 1, 1, 2]] = True
    statistic = np.ones((5, 5))
    statistic[2, 2] = -4
    statistic[1, 1] = 3
    names = np.where(np.arange(25) < 5, "CA1", "CA2")

    def found(neighbors):
        edges = sheet_edges(5, 5, neighbors)
        return find_clusters(significant.ravel(), statistic.ravel(), names, edges)

    assert found(8) == [
        (6, {"extent": 3, "shares": "CA1 33%; CA2 67%"}),
        (12, {"extent": 1, "shares": "CA2 100%"}),
    ]
    assert [(one["extent"], peak) for peak, one in found(4)] == [(2, 6), (1, 0), (1, 12)]


def test_clusters_on_a_mesh():
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    statistic = np.array([3.0, 4.0, -5.0, -2.5, 6.0])
    significant = np.array([True, True, True, False, True])
    names = np.array(["a", "b", "b", "b", "b"])
    first, *others = find_clusters(significant, statistic, names, edges)
    assert first == (1, {"extent": 2, "shares": "a 50%; b 50%"})
    assert [(one["extent"], peak) for peak, one in others] == [(1, 4), (1, 2)]


def planted(effect):
    random = np.random.default_rng(0)
    matrix = np.column_stack([np.ones(60), np.arange(60) % 2])
    maps = random.standard_normal((60, *SHAPE))
    maps[1::2, 3:6, 2:5] -= effect
    maps[1::2, 4, 3] -= effect
    contrasts = [Contrast("patients", np.eye(2)[1]), Contrast("any", np.eye(2))]
    return fit_points(maps.reshape(60, -1), matrix, contrasts, GlmSettings()).tests


def test_planted_effect_is_the_first_row():
    test, _ = planted(2.0)
    found = control_fdr(test.p, 0.05)
    first = peak_table(test, found, FRAME, EDGES).iloc[0]
    point = 4 * 8 + 3
    assert (FRAME.number["node_x"][point], FRAME.number["node_y"][point]) == (5, 4)
    assert (first["x"], first["y"]) == (np.linspace(-0.95, 0.95, 12)[4], np.linspace(-1, 1, 8)[3])
    assert first["subfield"] == "SUB"
    assert first["extent"] >= 9
    shares = [float(part.split()[1].rstrip("%")) for part in first["shares"].split("; ")]
    assert sum(shares) == pytest.approx(100, abs=1)  # each is rounded
    assert first["statistic"] == test.statistic[point] < -5
    assert first["p"] == test.p[point]
    assert first["p_corrected"] == found.adjusted[point]
    assert first["effect"] == "cohen_d"
    assert first["effect_low"] < first["effect_size"] == test.cohen_d[point] < first["effect_high"]


def test_rows_of_a_table_of_peaks_are_exact():
    """Two clusters on a sheet of 3 x 2 nodes: every cell is known."""
    test, _ = planted(0.0)
    numbers = np.arange(6.0)
    test = replace(
        test,
        statistic=np.array([5.0, 4.0, 0.5, 0.1, -6.0, 0.2]),
        **{name: numbers / 10**i for i, name in enumerate(("p", "df", "cohen_d"))},
        cohen_d_limits=np.stack([numbers - 1, numbers + 1]),
    )
    rejected = np.array([1, 1, 0, 0, 1, 0], dtype=bool)
    found = Discoveries(numbers / 7, rejected, 0.01, 6, 0.05)
    names = np.array([["a", "b"], ["b", "b"], ["c", "c"]])
    frame = Frame.of_sheet(np.array([-1.0, 0.0, 1.0]), np.array([-0.5, 0.5]), names)
    assert frame.number["node_x"].tolist() == [1, 1, 2, 2, 3, 3]
    assert frame.number["node_y"].tolist() == [1, 2, 1, 2, 1, 2]
    first, second = peak_table(test, found, frame, sheet_edges(3, 2)).to_dict("records")
    common = {"contrast": "patients", "test": "t", "effect": "cohen_d"}
    assert first == common | {
        "node_x": 1,
        "node_y": 1,
        "x": -1.0,
        "y": -0.5,
        "subfield": "a",
        "statistic": 5.0,
        "p": 0.0,
        "df": 0.0,
        "p_corrected": 0.0,
        "effect_size": 0.0,
        "effect_low": -1.0,
        "effect_high": 1.0,
        "extent": 2,
        "shares": "a 50%; b 50%",
    }
    assert second == common | {
        "node_x": 3,
        "node_y": 1,
        "x": 1.0,
        "y": -0.5,
        "subfield": "c",
        "statistic": -6.0,
        "p": 4.0,
        "df": 0.4,
        "p_corrected": 4 / 7,
        "effect_size": 0.04,
        "effect_low": 3.0,
        "effect_high": 5.0,
        "extent": 1,
        "shares": "c 100%",
    }
    points = np.arange(18.0).reshape(6, 3)
    position = {f"surface_{axis}": points[:, i] for i, axis in enumerate("xyz")}
    mesh = Frame({"vertex": np.arange(6)}, position, names.ravel())
    row = peak_table(test, found, mesh, np.array([[0, 1]])).iloc[1]
    assert [row["vertex"], *row[list(position)]] == [4, 12.0, 13.0, 14.0]


def test_without_findings_the_largest_statistic_is_reported():
    test, _ = planted(0.0)
    found = control_fdr(test.p, 0.001)
    (row,) = peak_table(test, found, FRAME, EDGES).to_dict("records")
    assert row["extent"] == 0
    assert abs(row["statistic"]) == np.abs(test.statistic).max()


def test_f_tests_report_eta_squared_and_empty_maps_nothing():
    _, test = planted(2.0)
    found = control_fdr(test.p, 0.05)
    table = peak_table(test, found, FRAME, EDGES)
    assert set(table["effect"]) == {"partial_eta_squared"}
    assert set(table["effect_size"]) <= set(test.eta_squared)
    blank = replace(test, statistic=np.full(96, np.nan), p=np.full(96, np.nan))
    assert peak_table(blank, control_fdr(blank.p, 0.05), FRAME, EDGES).empty


def test_families_are_maps_hemispheres_or_all_maps_of_a_contrast():
    random = np.random.default_rng(1)
    maps = {
        MapKey("thickness", "group", "L"): random.random(np.prod(SHAPE)) * 1e-4,
        MapKey("thickness", "group", "R"): random.random(np.prod(SHAPE)),
        MapKey("thickness", "age", "R"): random.random(np.prod(SHAPE)),
    }
    each = discover(maps, MultiplicitySettings())
    both = discover(maps, MultiplicitySettings(scope="hemispheres"))
    assert list(each) == list(maps)
    for key, p in maps.items():
        alone = control_fdr(p, 0.05)
        np.testing.assert_array_equal(each[key].adjusted, alone.adjusted)
    left, right, age = maps
    pooled = control_fdr(np.stack([maps[left], maps[right]]), 0.05)
    np.testing.assert_array_equal(both[left].adjusted, pooled.adjusted[0])
    np.testing.assert_array_equal(both[right].rejected, pooled.rejected[1])
    assert both[right].cutoff == pooled.cutoff
    np.testing.assert_array_equal(both[age].adjusted, each[age].adjusted)
    more = maps | {MapKey("curvature", "group", "L"): random.random(np.prod(SHAPE))}
    every = discover(more, MultiplicitySettings(scope="all"))
    of_group = [key for key in more if key.contrast == "group"]
    pooled = control_fdr(np.stack([more[key] for key in of_group]), 0.05)
    for key, adjusted in zip(of_group, pooled.adjusted, strict=True):
        np.testing.assert_array_equal(every[key].adjusted, adjusted)
    np.testing.assert_array_equal(every[age].adjusted, each[age].adjusted)
    single = discover(maps, MultiplicitySettings(method="bh"))
    expected = control_fdr(maps[left], 0.05, "bh")
    np.testing.assert_array_equal(single[left].adjusted, expected.adjusted)


def test_shares_leave_out_points_without_a_subfield():
    significant = np.ones(4, dtype=bool)
    edges = sheet_edges(4, 1)
    for words, shares in ((["n/a"] * 4, ""), (["SUB", "n/a", "n/a", "SUB"], "SUB 50%")):
        ((_, cluster),) = find_clusters(significant, np.ones(4), np.array(words), edges)
        assert cluster == {"extent": 4, "shares": shares}
