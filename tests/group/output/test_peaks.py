"""Clusters on grids and meshes, and tables of peaks."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.group.output.columns import Frame, find_clusters, peak_table
from hipsta_bids.group.output.tables import with_fdr
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.inference import Discoveries, control_fdr
from hipsta_bids.stats.settings import GlmSettings

SHAPE = (12, 8)
EDGES = sheet_edges(*SHAPE)
FRAME = Frame.of_sheet(
    np.linspace(-0.95, 0.95, 12),
    np.linspace(-1, 1, 8),
    np.where(np.arange(12)[:, None] < 5, "SUB", "CA1") + np.zeros(8, dtype="U1"),
)


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


@pytest.mark.parametrize("side", ["greater", "less"])
def test_the_peak_of_a_one_sided_map_has_its_smallest_p(side):
    random = np.random.default_rng(1)
    matrix = np.column_stack([np.ones(60), np.arange(60) % 2])
    maps = random.standard_normal((60, EDGES.max() + 1))
    maps[1::2, 7] += -3.0 if side == "greater" else 3.0  # the wrong direction
    contrast = Contrast("sided", [0, 1], side=side)
    (test,) = fit_points(maps, matrix, [contrast], GlmSettings()).tests
    nothing = control_fdr(np.ones_like(test.p), 0.05)
    (row,) = peak_table(test, nothing, FRAME, EDGES).to_dict("records")
    assert row["p"] == test.p.min() < 0.05
    assert row["extent"] == 0


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


def test_shares_leave_out_points_without_a_subfield():
    significant = np.ones(4, dtype=bool)
    edges = sheet_edges(4, 1)
    for words, shares in ((["n/a"] * 4, ""), (["SUB", "n/a", "n/a", "SUB"], "SUB 50%")):
        ((_, cluster),) = find_clusters(significant, np.ones(4), np.array(words), edges)
        assert cluster == {"extent": 4, "shares": shares}


def test_summary_measures_are_not_listed_for_the_effects_of_others():
    p = np.array([1e-6, 2e-6, 1e-5, 1e-4, 1e-3, 2e-3, 0.01, 0.069, np.nan])
    assert control_fdr(p, 0.05, "fdr2").adjusted[7] < 0.05  # as the procedure has it
    table = pd.DataFrame({"contrast": "CN-AD", "measure": [f"m{i}" for i in range(9)], "p": p})
    adjusted = with_fdr(table.assign(p_fdr=np.nan), GroupSettings())["p_fdr"]
    assert adjusted[7] == p[7]
    assert (adjusted[:7] >= p[:7]).all()
    assert (adjusted[:7] < 0.05).all()
    assert np.isnan(adjusted[8])
