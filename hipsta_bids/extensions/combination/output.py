"""Tables and maps of joint tests."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.extensions.combination import EXTENSION, NAME
from hipsta_bids.group.cohort.data import SHEET, Cohort
from hipsta_bids.group.output.columns import find_clusters, frame_of
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import Averages, map_name, read_columns
from hipsta_bids.group.output.write import write_stats, write_table
from hipsta_bids.joints import Writer
from hipsta_bids.reports import cells
from hipsta_bids.stats.clusters import edges_of
from hipsta_bids.stats.glm import FittedMaps, PointTest
from hipsta_bids.stats.inference import Discoveries, MapKey, PermutationTest
from hipsta_bids.types import JOINT, p_text

_EFFECTS = {"t": "cohen_d", "F": "partial_eta_squared"}


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMap:
    """One contrast of one side, or of both, tested in several measures together."""

    key: MapKey
    parts: Mapping[str, tuple[FittedMaps, str]]
    """Fit and measure of each map, by its title."""
    cohort: Cohort
    """What has the coordinates of the points."""
    test: PermutationTest
    discoveries: Discoveries

    @property
    def fitted(self) -> FittedMaps:
        """The columns that locate the points."""
        return next(iter(self.parts.values()))[0]

    @property
    def tests(self) -> dict[str, PointTest]:
        """The test of each map by itself, by its title."""
        return {
            title: next(
                test for test in side.fits[measure].tests if test.contrast.name == self.key.contrast
            )
            for title, (side, measure) in self.parts.items()
        }


def joint_points(joint_map: JointMap) -> pd.DataFrame:
    """List all points of a map, with the p-value of each measure by itself."""
    frame = frame_of(joint_map.cohort, joint_map.fitted)
    columns = {
        **frame.columns,
        "n": np.min([fit.fits[measure].n for fit, measure in joint_map.parts.values()], axis=0),
        "statistic": joint_map.test.statistic,
        "p": joint_map.test.p_uncorrected,
        "p_corrected": joint_map.discoveries.adjusted,
        "significant": joint_map.discoveries.rejected,
        **{f"p_{title.replace(' ', '_')}": test.p for title, test in joint_map.tests.items()},
    }
    return pd.DataFrame(columns)


def joint_peaks(joint: Sequence[JointMap], neighbors: int, averages: Averages) -> pd.DataFrame:
    """List clusters with their peaks; of a map without findings its strongest point."""
    rows = []
    for joint_map in joint:
        frame, tests, z = (
            frame_of(joint_map.cohort, joint_map.fitted, averages.get(joint_map.key.hemi)),
            joint_map.tests,
            joint_map.test.statistic,
        )
        edges = edges_of(joint_map.fitted.maps, neighbors)
        for at, cluster in find_clusters(joint_map.discoveries.rejected, z, frame.subfield, edges):
            words = [
                f"{title} {cells.effect_name(_EFFECTS[test.kind])}"
                f" {cells.number_text(test.effect[at])},"
                f" p {p_text(test.p[at])}"
                for title, test in tests.items()
            ]
            rows.append(
                {
                    "measure": JOINT,
                    "contrast": joint_map.key.contrast,
                    "hemi": joint_map.key.hemi,
                    **frame.at(at),
                    "test": "z",
                    "statistic": z[at],
                    "p": joint_map.test.p_uncorrected[at],
                    "p_corrected": joint_map.discoveries.adjusted[at],
                    **cluster,
                    "measures": "; ".join(words),
                }
            )
    return pd.DataFrame(rows)


def joint_files(
    cohorts: Mapping[str, Cohort],  # noqa: ARG001  (as of all steps)
    analyses: Mapping[str, Analysis],
    labels: Mapping[str, list[str]],  # noqa: ARG001  (as of all steps)
    averages: Averages,
) -> Iterator[Writer]:
    """Write tables and maps of statistics."""
    sheets = analyses[SHEET]
    neighbors = sheets.request.settings.multiplicity.neighbors
    yield partial(_write, joint=sheets.parts[NAME], neighbors=neighbors, averages=averages)


def _write(folder: Path, joint: Sequence[JointMap], neighbors: int, averages: Averages) -> None:
    meaning = read_columns(EXTENSION.package)
    write_table(folder, f"{JOINT}_peaks", joint_peaks(joint, neighbors, averages), meaning=meaning)
    for joint_map in joint:
        name = map_name(joint_map.key.hemi, joint_map.key.measure, joint_map.key.contrast)
        parts = {
            f"p_{title.replace(' ', '_')}": f"p-value of {title} alone, not corrected"
            for title in joint_map.parts
        }
        write_table(folder, name, joint_points(joint_map), meaning={**meaning, **parts})
    stats = {
        joint_map.key: {"z": joint_map.test.statistic, "pcorrected": joint_map.discoveries.adjusted}
        for joint_map in joint
    }
    write_stats(folder, stats)
