"""Peak tables, as in the paper: where a contrast is largest, and what lies around."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.adjacency import Cluster, find_clusters, find_mesh_clusters, mesh_edges
from hipsta_bids.group.data import Cohort
from hipsta_bids.group.fit import FittedMaps
from hipsta_bids.group.glm import PointTest
from hipsta_bids.group.inference import Discoveries

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SheetFrame:
    """Where the points of a map lie."""

    x: FloatArray
    """(x,) coordinates, medial to lateral, -1..1."""
    y: FloatArray
    """(y,) coordinates, posterior to anterior, -1..1."""
    subfield: NDArray[np.str_]
    """(x, y) names."""

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return len(self.x), len(self.y)

    def clusters(
        self, significant: NDArray[np.bool_], statistic: FloatArray, neighbors: int
    ) -> list[Cluster]:
        """Find connected regions of one sign; see :func:`find_clusters`."""
        return find_clusters(significant, statistic, self.subfield, neighbors)

    def place(self, point: NDArray[np.int64]) -> dict[str, FloatArray]:
        """Coordinates of points, by column."""
        x, y = np.divmod(point, len(self.y))
        return {"x": self.x[x], "y": self.y[y]}

    def number(self, point: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """Numbers of points, by column."""
        x, y = np.divmod(point, len(self.y))
        return {"node_x": x + 1, "node_y": y + 1}


@dataclass(frozen=True)
class MeshFrame:
    """Where the points of a map lie, if these are the vertices of a mesh."""

    points: FloatArray
    """(points, 3) coordinates of the surface."""
    edges: NDArray[np.int64]
    """(edges, 2)"""
    subfield: NDArray[np.str_]
    """(points, 1) names."""

    @property
    def shape(self) -> tuple[int, int]:
        """Points, and 1."""
        return len(self.points), 1

    def clusters(
        self,
        significant: NDArray[np.bool_],
        statistic: FloatArray,
        neighbors: int,  # noqa: ARG002 -- triangles say who is next to whom
    ) -> list[Cluster]:
        """Find connected regions of one sign; see :func:`find_mesh_clusters`."""
        return find_mesh_clusters(significant, statistic, self.subfield, self.edges)

    def place(self, point: NDArray[np.int64]) -> dict[str, FloatArray]:
        """Coordinates of points, by column."""
        return {f"surface_{axis}": self.points[point, i] for i, axis in enumerate("xyz")}

    def number(self, point: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """Numbers of points, by column."""
        return {"vertex": point}


Frame = SheetFrame | MeshFrame


def frame_of(cohort: Cohort, one: FittedMaps) -> Frame:
    """Where the points lie, and in which subfield most participants have them."""
    names = np.array([*one.maps.names, "n/a"])
    if (mesh := one.maps.mesh) is not None:
        return MeshFrame(mesh.points, mesh_edges(mesh.triangles), names[one.subfield])
    return SheetFrame(cohort.x, cohort.y, names[one.subfield])


def peak_table(test: PointTest, found: Discoveries, frame: Frame, neighbors: int) -> pd.DataFrame:
    """List the peak of each significant cluster; of the whole map if there is none.

    Returns One row per cluster, largest extent first: contrast, kind of statistic, place, subfield,
    statistic, df, p, corrected p, effect size (Cohen's d for t, else partial eta squared) with
    limits, extent in points and the share of each subfield.
    """
    statistic = test.statistic.reshape(frame.shape)
    rejected = found.rejected.reshape(frame.shape)
    clusters = frame.clusters(rejected, statistic, neighbors)
    if not clusters and np.isfinite(statistic).any():
        place = np.unravel_index(int(np.nanargmax(np.abs(statistic))), frame.shape)
        here = (int(place[0]), int(place[1]))
        clusters = [Cluster(0, here, np.zeros(frame.shape, dtype=bool), {})]
    adjusted = found.adjusted.reshape(-1)
    return pd.DataFrame([_row(test, adjusted, frame, cluster) for cluster in clusters])


def _row(
    test: PointTest, adjusted: FloatArray, frame: Frame, cluster: Cluster
) -> dict[str, object]:
    point = int(np.ravel_multi_index(cluster.peak, frame.shape))
    here = np.array([point])
    numbers = frame.number(here) if isinstance(frame, MeshFrame) else {}
    is_t = test.kind == "t"
    size = test.cohen_d if is_t else test.eta_squared
    limits = test.cohen_d_limits if is_t else test.eta_squared_limits
    return {
        "contrast": test.contrast.name,
        "test": test.kind,
        **{name: value[0] for name, value in {**numbers, **frame.place(here)}.items()},
        "subfield": frame.subfield[cluster.peak],
        "statistic": test.statistic[point],
        "df": test.df[point],
        "p": test.p[point],
        "p_corrected": adjusted[point],
        "effect": "cohen_d" if is_t else "partial_eta_squared",
        "effect_size": size[point],
        "effect_low": limits[0, point],
        "effect_high": limits[1, point],
        "extent": cluster.extent,
        "shares": "; ".join(f"{name} {share:.0%}" for name, share in cluster.shares.items()),
    }
