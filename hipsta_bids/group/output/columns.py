"""Columns of the tables of tests: places of points, tests, effects, clusters and peaks."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.io.files import MISSING
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.clusters import label_regions
from hipsta_bids.stats.glm import FittedMaps, PointTest
from hipsta_bids.types import parts_of

if TYPE_CHECKING:
    from hipsta_bids.stats.inference import Discoveries, MapKey


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
    average: Mapping[str, Float] = field(default_factory=dict)
    """``x_mm``, ``y_mm`` and ``z_mm`` on the average surface, for tables of peaks."""

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of tables of points."""
        return {**self.number, **self.position, "subfield": self.subfield}

    def at(self, point: int) -> dict[str, Any]:
        """Locate a point, in tables of peaks."""
        return {name: values[point] for name, values in {**self.columns, **self.average}.items()}

    @classmethod
    def of_sheet(cls, x: Float, y: Float, subfield: NDArray[np.str_]) -> "Frame":
        """Points of a grid; ``subfield`` (x, y)."""
        i, j = np.indices(subfield.shape).reshape(2, -1)
        parts = parts_of(y)
        position = {"x": x[i], "y": y[j]} | ({} if parts is None else {"part": parts[j]})
        return cls({"node_x": i + 1, "node_y": j + 1}, position, subfield.ravel())


def frame_of(cohort: Cohort, fitted: FittedMaps, average: Float | None = None) -> Frame:
    """Locate points, and name the subfield in which most participants have them.

    ``average`` (points, 3) is where they are on the average surface.
    """
    subfield = np.array([*fitted.maps.names, MISSING])[fitted.subfield]
    if (mesh := fitted.maps.mesh) is None:
        frame = Frame.of_sheet(cohort.x, cohort.y, subfield)
        points = {} if average is None else zip("xyz", average.T.round(3), strict=True)
        return replace(
            frame, average={f"{axis}_mm": values for axis, values in dict(points).items()}
        )
    position = {f"surface_{axis}": mesh.points[:, i] for i, axis in enumerate("xyz")}
    return Frame({"vertex": np.arange(len(mesh.points))}, position, subfield.ravel())


def test_columns(test: PointTest) -> dict[str, str | Float]:
    """Columns of a test in tables of points; of an F test without estimate."""
    missing = np.full(test.p.shape, np.nan)
    single = test.kind == "t"
    return {
        "estimate": test.estimate[0] if single else missing,
        "se": test.se[0] if single else missing,
        "statistic": test.statistic,
        "df": test.df,
        "p": test.p,
        **({"alternative": test.contrast.hypothesis} if test.contrast.side else {}),
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
        **test.further,
    }


def point_columns(
    test: PointTest, discoveries: "Discoveries", frame: Frame, n: Int
) -> dict[str, object]:
    """Columns of a map of statistics, with the participants (points,) of each point."""
    return {
        **frame.columns,
        "n": n,
        **test_columns(test),
        "p_corrected": discoveries.adjusted,
        "significant": discoveries.rejected,
        "cohen_d": test.cohen_d,
        "cohen_d_low": test.cohen_d_limits[0],
        "cohen_d_high": test.cohen_d_limits[1],
        "eta_squared": test.eta_squared,
        "eta_squared_low": test.eta_squared_limits[0],
        "eta_squared_high": test.eta_squared_limits[1],
        **test.further,
    }


def overview_row(name: str, key: "MapKey", discoveries: "Discoveries") -> dict[str, object]:
    """Count the points of a map in the file ``name`` that survive, with their p."""
    return {
        "measure": key.measure,
        "contrast": key.contrast,
        "hemi": key.hemi,
        "file": name,
        "n_tests": discoveries.n_tests,
        "n_significant": int(discoveries.rejected.sum()),
        "p_cutoff": discoveries.cutoff,
        "lenient": discoveries.lenient,
    }


def peak_table(
    test: PointTest, discoveries: "Discoveries", frame: Frame, edges: Int
) -> pd.DataFrame:
    """List the peak of each significant cluster, largest first; of the whole map if there is none.

    Effect sizes are Cohen's d for t, else partial eta squared.
    """
    values = {
        **test_columns(test),
        "p_corrected": discoveries.adjusted.ravel(),
        **effect_columns(test),
    }
    del values["estimate"], values["se"]
    clusters = find_clusters(
        discoveries.rejected.ravel(),
        test.statistic,
        frame.subfield,
        edges,
        evidence=test.contrast.evidence(test.statistic),
    )
    return pd.DataFrame(
        [
            {
                "contrast": test.contrast.name,
                "test": test.kind,
                **frame.at(peak),
                **{name: v if isinstance(v, str) else v[peak] for name, v in values.items()},
                **cluster,
            }
            for peak, cluster in clusters
        ]
    )


def find_clusters(
    significant: Bool,
    statistic: Float,
    subfield: NDArray[np.str_],
    edges: Int,
    *,
    evidence: Float | None = None,
) -> list[tuple[int, dict[str, object]]]:
    """Find connected regions of one sign among points, largest first.

    Returns the point with most ``evidence``, which is the size of the statistic unless given, and
    the columns of tables of peaks. Without any region, the peak of the whole map, if it has one,
    is a cluster of no points.
    """
    evidence = np.abs(statistic) if evidence is None else evidence
    clusters: list[tuple[int, int, str]] = []
    for sign in (1, -1):
        labels, count = label_regions(significant & (sign * statistic > 0), edges)
        for number in range(1, count + 1):
            members = np.flatnonzero(labels == number)
            peak = int(members[np.argmax(evidence[members])])
            codes = subfield[members]
            names, counts = np.unique(codes[codes != MISSING], return_counts=True)
            shares = [f"{n} {c / len(members):.0%}" for n, c in zip(names, counts, strict=True)]
            clusters.append((len(members), peak, "; ".join(shares)))
    if not clusters and np.isfinite(statistic).any():
        clusters = [(0, int(np.nanargmax(evidence)), "")]
    clusters.sort(key=lambda cluster: -cluster[0])
    return [(peak, {"extent": extent, "shares": shares}) for extent, peak, shares in clusters]
