"""Tables and figures of tests of several measures at once."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output.columns import find_clusters, frame_of
from hipsta_bids.group.output.panels import Row, Views, draw_pages
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.stats.clusters import edges_of
from hipsta_bids.group.stats.glm import FittedMaps, PointTest
from hipsta_bids.group.stats.inference import Discoveries, MapKey, PermutationTest
from hipsta_bids.reports import cells, display
from hipsta_bids.reports.group_maps import EFFECT_NAMES, signed_logarithm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_EFFECTS = {"t": "cohen_d", "F": "partial_eta_squared"}
_LEAST_Z = 4.0  # at the end of the colors


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMap:
    """One contrast of one side, or of both, tested in several measures together."""

    key: MapKey
    parts: Mapping[str, tuple[FittedMaps, str]]
    """Fit and measure of each map, by its title."""
    cohort: Cohort
    """What has the coordinates of the points."""
    test: PermutationTest
    found: Discoveries

    @property
    def fitted(self) -> FittedMaps:
        """What tells where the points are."""
        return next(iter(self.parts.values()))[0]

    @property
    def tests(self) -> dict[str, PointTest]:
        """The test of each map by itself, by its title."""
        return {
            title: next(
                test for test in one.fits[measure].tests if test.contrast.name == self.key.contrast
            )
            for title, (one, measure) in self.parts.items()
        }


def joint_points(joint_map: JointMap) -> pd.DataFrame:
    """List all points of a map, with the p-value of each measure by itself."""
    frame = frame_of(joint_map.cohort, joint_map.fitted)
    columns = {
        **frame.columns,
        "n": np.min([fit.fits[measure].n for fit, measure in joint_map.parts.values()], axis=0),
        "statistic": joint_map.test.statistic,
        "p": joint_map.test.p_uncorrected,
        "p_corrected": joint_map.found.adjusted,
        "significant": joint_map.found.rejected,
        **{f"p_{title.replace(' ', '_')}": test.p for title, test in joint_map.tests.items()},
    }
    return pd.DataFrame(columns)


def joint_peaks(joint: Sequence[JointMap], neighbors: int) -> pd.DataFrame:
    """List clusters with their peaks; of a map without findings its strongest point."""
    rows = []
    for joint_map in joint:
        frame, tests, z = (
            frame_of(joint_map.cohort, joint_map.fitted),
            joint_map.tests,
            joint_map.test.statistic,
        )
        edges = edges_of(joint_map.fitted.maps, neighbors)
        for cluster in find_clusters(joint_map.found.rejected, z, frame.subfield, edges):
            at = cluster.peak
            words = [
                f"{title} {cells.effect_name(_EFFECTS[test.kind])}"
                f" {cells.number_text(test.effect[at])},"
                f" p {cells.p_text(test.p[at])}"
                for title, test in tests.items()
            ]
            rows.append(
                {
                    "measure": cells.JOINT,
                    "contrast": joint_map.key.contrast,
                    "hemi": joint_map.key.hemi,
                    **frame.at(at),
                    "test": "z",
                    "statistic": z[at],
                    "p": joint_map.test.p_uncorrected[at],
                    "p_corrected": joint_map.found.adjusted[at],
                    **cluster.columns,
                    "measures": "; ".join(words),
                }
            )
    return pd.DataFrame(rows)


def draw_joint(
    joint: Sequence[JointMap], shapes: Mapping[str, AverageShape], views: Views
) -> "list[Figure]":
    """Draw combined evidence and corrected p of each contrast."""
    by_contrast: dict[str, dict[str, JointMap]] = {}
    for joint_map in joint:
        by_contrast.setdefault(joint_map.key.contrast, {})[joint_map.key.hemi] = joint_map
    places = {joint_map.key.hemi: joint_map.fitted for joint_map in joint}
    blocks = [list(_rows(i, name, own)) for i, (name, own) in enumerate(by_contrast.items())]
    return draw_pages(joint[0].cohort, places, shapes, views, blocks)


def _rows(number: int, contrast: str, maps: Mapping[str, JointMap]) -> Iterator[Row]:
    _, colors, p_colors = display.effect_colors("F")
    z = {hemi: one.test.statistic for hemi, one in maps.items()}
    survive = {hemi: one.found.rejected for hemi, one in maps.items()}
    logs = {hemi: signed_logarithm(one.found.adjusted, z[hemi]) for hemi, one in maps.items()}
    sides = {hemi: "" if hemi == cells.BOTH_SIDES else f" {cells.SIDES[hemi]}" for hemi in maps}
    counts = ", ".join(f"{int(found.sum())}{sides[hemi]}" for hemi, found in survive.items())
    tested = "/".join(dict.fromkeys(str(int(np.isfinite(one).sum())) for one in z.values()))
    first = next(iter(maps.values()))
    yield Row(
        kind="effect",
        index=number,
        title=f"Joint evidence, {contrast}",
        label=EFFECT_NAMES["z"],
        scale={"cmap": colors, "vmin": 0.0, "vmax": max(_LEAST_Z, *map(np.nanmax, z.values()))},
        values=z,
        survive=survive,
    )
    yield Row(
        kind="significance",
        index=number,
        title=f"Significant: {counts} of {tested} points",
        label="corrected p",
        scale={
            "cmap": p_colors,
            "vmin": 0.0,
            "vmax": display.significance_reach(list(logs.values())),
        },
        values=logs,
        survive=survive,
        level=first.found.alpha,
    )
