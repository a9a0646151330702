"""Neighbors among the points of a map, cluster enhancement, clusters and tables of their peaks.

The grid of a sheet and a triangle mesh are both graphs, and differ in nothing but their edges.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hipsta_bids.group.data import Bool, Cohort, Float, Int, SideMaps
from hipsta_bids.group.glm import FittedMaps, PointTest
from hipsta_bids.group.settings import MultiplicitySettings
from hipsta_bids.io.files import MISSING
from hipsta_bids.reports.display import parts_of

if TYPE_CHECKING:
    from hipsta_bids.group.inference import Discoveries, MapKey


def sheet_edges(nx: int, ny: int, neighbors: int = 8) -> Int:
    """List the edges (edges, 2) between 4 or 8 neighbors of a grid, each once; y runs fastest."""
    node = np.arange(nx * ny).reshape(nx, ny)
    pairs = [(node[:-1], node[1:]), (node[:, :-1], node[:, 1:])]
    if neighbors == 8:  # noqa: PLR2004 -- of the setting
        pairs += [(node[:-1, :-1], node[1:, 1:]), (node[:-1, 1:], node[1:, :-1])]
    return np.concatenate([np.column_stack([one.ravel(), two.ravel()]) for one, two in pairs])


def mesh_edges(triangles: Int) -> Int:
    """List the edges (edges, 2) of a mesh, each once."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0), dtype=np.int64)


def edges_of(maps: SideMaps, neighbors: int) -> Int:
    """List the edges between the points of maps; on a mesh its triangles define the neighbors."""
    if maps.mesh is not None:
        return mesh_edges(maps.mesh.triangles)
    return sheet_edges(*maps.shape, neighbors)


def label_regions(mask: Bool, edges: Int) -> tuple[Int, int]:
    """Find the connected regions of a mask, numbered from 1 (0 is outside), and their count."""
    inside = np.flatnonzero(mask)
    own = (np.cumsum(mask) - 1)[edges[mask[edges].all(axis=1)]]
    count, numbers = _components(own, len(inside))
    labels = np.zeros(len(mask), dtype=np.int64)
    labels[inside] = numbers + 1
    return labels, count


def _components(edges: Int, n: int) -> tuple[int, Int]:
    """Count the connected components of n nodes, and number them from 0 by their first node."""
    ones = np.ones(len(edges), dtype=bool)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, numbers = connected_components(graph, directed=False)
    return int(count), numbers.astype(np.int64)


def enhance(statistic: Float, edges: Int, settings: MultiplicitySettings) -> Float:
    """Threshold-free cluster enhancement of maps (maps, points) (Smith and Nichols 2009).

    NaN is outside; positive and negative clusters are separate. From the highest threshold down,
    regions only grow: each threshold joins those of the one above.
    """
    values = np.nan_to_num(statistic, nan=0.0)
    size = np.abs(values).ravel()
    steps = int(size.max(initial=0.0) / settings.tfce_step) + 2
    heights = np.cumsum(np.full(steps, settings.tfce_step))
    level = np.searchsorted(heights, size, side="right")  # thresholds that a point reaches
    # All maps together are one graph without edges between maps.
    ends = (edges + values.shape[1] * np.arange(len(values))[:, None, None]).reshape(-1, 2)
    sign = values.ravel() > 0
    ends = ends[sign[ends[:, 0]] == sign[ends[:, 1]]]
    joined_at = level[ends].min(axis=1)
    order = np.argsort(joined_at, kind="stable")
    ends, start = ends[order], np.searchsorted(joined_at[order], np.arange(steps + 2))
    points = np.argsort(level, kind="stable")
    first = np.searchsorted(level[points], np.arange(steps + 1))
    result = np.zeros(len(size))
    region, count = np.arange(len(size)), len(size)
    for number in range(int(level.max(initial=0)), 0, -1):
        count, merged = _components(region[ends[start[number] : start[number + 1]]], count)
        region = merged[region]
        above = points[first[number] :]
        own = region[above]
        extent = np.bincount(own, minlength=count).astype(np.float64)[own]
        height = heights[number - 1]
        result[above] += extent**settings.tfce_extent * (
            height**settings.tfce_height * settings.tfce_step
        )
    return np.asarray(np.copysign(result, values.ravel()).reshape(values.shape), dtype=np.float64)


@dataclass(frozen=True)
class Cluster:
    """Adjacent points that survive, with effects of one sign."""

    extent: int
    """Points."""
    peak: int
    """Point with the largest statistic."""
    shares: Mapping[str, float]
    """Fraction of the points in each subfield."""

    @property
    def columns(self) -> dict[str, object]:
        """Columns of tables of peaks."""
        shares = (f"{name} {share:.0%}" for name, share in self.shares.items())
        return {"extent": self.extent, "shares": "; ".join(shares)}


def find_clusters(
    significant: Bool, statistic: Float, subfield: NDArray[np.str_], edges: Int
) -> list[Cluster]:
    """Find connected regions of one sign among points, largest first.

    Without any, the peak of the whole map, if it has one, is a cluster of no points.
    """
    clusters = []
    for sign in (1, -1):
        labels, count = label_regions(significant & (sign * statistic > 0), edges)
        for number in range(1, count + 1):
            members = np.flatnonzero(labels == number)
            peak = int(members[np.argmax(np.abs(statistic[members]))])
            own = subfield[members]
            names, counts = np.unique(own[own != MISSING], return_counts=True)
            shares = dict(zip(names.tolist(), (counts / len(members)).tolist(), strict=True))
            clusters.append(Cluster(len(members), peak, shares))
    if not clusters and np.isfinite(statistic).any():
        return [Cluster(0, int(np.nanargmax(np.abs(statistic))), {})]
    return sorted(clusters, key=lambda cluster: -cluster.extent)


@dataclass(frozen=True, eq=False)
class Frame:
    """Where the points of a map are."""

    number: Mapping[str, Int]
    """By column: ``node_x`` and ``node_y`` on the sheet, from 1; ``vertex`` on a mesh, from 0."""
    position: Mapping[str, NDArray[Any]]
    """By column: ``x`` (medial to lateral) and ``y`` (posterior to anterior) on the sheet, in the
    body -1..1, and ``part`` where there is more than the body; ``surface_x``, ``surface_y`` and
    ``surface_z`` on a mesh."""
    subfield: NDArray[np.str_]
    """(points,) names."""

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of tables of points."""
        return {**self.number, **self.position, "subfield": self.subfield}

    def at(self, point: int) -> dict[str, Any]:
        """Say where a point is, in tables of peaks; a node of the sheet by its coordinates."""
        number = self.number if "vertex" in self.number else {}
        where = {**number, **self.position, "subfield": self.subfield}
        return {name: values[point] for name, values in where.items()}

    @classmethod
    def of_sheet(cls, x: Float, y: Float, subfield: NDArray[np.str_]) -> "Frame":
        """Points of a grid; ``subfield`` (x, y)."""
        i, j = np.indices(subfield.shape).reshape(2, -1)
        parts = parts_of(y)
        position = {"x": x[i], "y": y[j]} | ({} if parts is None else {"part": parts[j]})
        return cls({"node_x": i + 1, "node_y": j + 1}, position, subfield.ravel())


def frame_of(cohort: Cohort, one: FittedMaps) -> Frame:
    """Locate points, and name the subfield in which most participants have them."""
    subfield = np.array([*one.maps.names, MISSING])[one.subfield]
    if (mesh := one.maps.mesh) is None:
        return Frame.of_sheet(cohort.x, cohort.y, subfield)
    position = {f"surface_{axis}": mesh.points[:, i] for i, axis in enumerate("xyz")}
    return Frame({"vertex": np.arange(len(mesh.points))}, position, subfield.ravel())


def test_columns(test: PointTest) -> dict[str, Float]:
    """Columns of a test in tables of points; of an F test without estimate."""
    none = np.full(test.p.shape, np.nan)
    single = test.kind == "t"
    return {
        "estimate": test.estimate[0] if single else none,
        "se": test.se[0] if single else none,
        "statistic": test.statistic,
        "df": test.df,
        "p": test.p,
    }


def effect_columns(test: PointTest) -> dict[str, str | Float]:
    """Columns of the effect size: Cohen's d for t, else partial eta squared."""
    single = test.kind == "t"
    limits = test.cohen_d_limits if single else test.eta_squared_limits
    return {
        "effect": "cohen_d" if single else "partial_eta_squared",
        "effect_size": test.effect,
        "effect_low": limits[0],
        "effect_high": limits[1],
    }


def point_columns(test: PointTest, found: "Discoveries", frame: Frame, n: Int) -> dict[str, object]:
    """Columns of a map of statistics, with the participants (points,) of each point."""
    return {
        **frame.columns,
        "n": n,
        **test_columns(test),
        "p_corrected": found.adjusted,
        "significant": found.rejected,
        "cohen_d": test.cohen_d,
        "cohen_d_low": test.cohen_d_limits[0],
        "cohen_d_high": test.cohen_d_limits[1],
        "eta_squared": test.eta_squared,
        "eta_squared_low": test.eta_squared_limits[0],
        "eta_squared_high": test.eta_squared_limits[1],
    }


def overview_row(name: str, key: "MapKey", found: "Discoveries") -> dict[str, object]:
    """Say of a map in the file ``name`` how many points survive, and at which p."""
    return {
        "measure": key.measure,
        "contrast": key.contrast,
        "hemi": key.hemi,
        "file": name,
        "n_tests": found.n_tests,
        "n_significant": int(found.rejected.sum()),
        "p_cutoff": found.cutoff,
        "lenient": found.lenient,
    }


def peak_table(test: PointTest, found: "Discoveries", frame: Frame, edges: Int) -> pd.DataFrame:
    """List the peak of each significant cluster, largest first; of the whole map if there is none.

    Effect sizes are Cohen's d for t, else partial eta squared.
    """
    values = {**test_columns(test), "p_corrected": found.adjusted.ravel(), **effect_columns(test)}
    del values["estimate"], values["se"]
    return pd.DataFrame(
        [
            {
                "contrast": test.contrast.name,
                "test": test.kind,
                **frame.at(one.peak),
                **{
                    name: own if isinstance(own, str) else own[one.peak]
                    for name, own in values.items()
                },
                **one.columns,
            }
            for one in find_clusters(found.rejected.ravel(), test.statistic, frame.subfield, edges)
        ]
    )
