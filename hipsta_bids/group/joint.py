"""Tests of several measures, or sides, together at each point: non-parametric combination."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.clusters import edges_of, find_clusters, frame_of
from hipsta_bids.group.comparison import BOTH, Comparison, asymmetry_name
from hipsta_bids.group.data import Cohort
from hipsta_bids.group.glm import FittedMaps, PointTest
from hipsta_bids.group.inference import Discoveries, MapKey, PermutationTest, correct_joint
from hipsta_bids.group.panels import Row, Views, draw_pages
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.reports import display
from hipsta_bids.reports.group_maps import EFFECT_NAMES, signed_logarithm
from hipsta_bids.reports.group_tables import (
    BOTH_SIDES,
    JOINT,
    SIDES,
    effect_name,
    number_text,
    p_text,
)

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
    def place(self) -> FittedMaps:
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


def check_joint(known: Sequence[str], comparison: Comparison, settings: GroupSettings) -> None:
    """Refuse measures that cannot be tested together, before anything is fitted."""
    known = [*known, *(asymmetry_name(name) for name in known if comparison.asymmetry)]
    names, sides = settings.joint.measures, settings.joint.sides
    what = None
    if unknown := [name for name in names if name not in known]:
        what = f"no map is called {unknown[0]!r}; there are {', '.join(known)}"
    elif names and JOINT in known:
        what = f"a map is called {JOINT}, as its results would be; give it another name"
    elif len(set(names)) < len(names):
        what = "a measure is named twice; leave it out"
    elif len(names) < 1 + (not sides) and (names or sides):
        what = "name two measures, or one and --joint-sides"
    if what is not None:
        raise ModelError(f"--joint {' '.join(names)}".strip() + f": {what}", reason="joint-maps")


def combine_maps(analyses: Sequence[Analysis], settings: GroupSettings) -> dict[MapKey, JointMap]:
    """Test the measures of the setting ``joint`` together; empty without any.

    The first analysis has the model; further ones may have maps of other programs.
    """
    names, sides = settings.joint.measures, settings.joint.sides
    if not names:
        return {}
    fits = {
        (m, hemi): one for each in analyses for hemi, one in each.fitted.items() for m in one.fits
    }
    cohort = next(
        each.compared
        for each in analyses
        if any(names[0] in one.fits for one in each.fitted.values())
    )
    groups: dict[MapKey, dict[str, tuple[FittedMaps, str]]] = {}
    contrasts = {}
    for hemis in [("L", "R")] if sides else [("L",), ("R",), (BOTH,)]:
        if not all((name, hemi) in fits for hemi, name in product(hemis, names)):
            continue
        parts = {
            name if len(hemis) == 1 else f"{name} {SIDES[hemi]}": (fits[name, hemi], name)
            for hemi, name in product(hemis, names)
        }
        _check_points(names, [one for one, _ in parts.values()])
        for test in fits[names[0], hemis[0]].fits[names[0]].tests:
            key = MapKey(JOINT, test.contrast.name, BOTH_SIDES if len(hemis) > 1 else hemis[0])
            groups[key], contrasts[test.contrast.name] = parts, test.contrast
    if not groups:
        raise ModelError(
            f"--joint {' '.join(names)}: no side has them all; leave one out", reason="joint-maps"
        )
    model = analyses[0].row_model
    found = correct_joint(groups, contrasts, model, analyses[0].compared.table, settings)
    return {
        key: JointMap(key=key, parts=groups[key], cohort=cohort, test=test, found=own)
        for key, (test, own) in found.items()
    }


def _check_points(names: Sequence[str], parts: Sequence[FittedMaps]) -> None:
    """Refuse maps whose points do not correspond."""
    first, *others = [one.maps for one in parts]
    same = [
        one.shape == first.shape
        and np.array_equal(edges_of(one, 4), edges_of(first, 4))  # the triangles of meshes
        for one in others
    ]
    if not all(same):
        counts = ", ".join(str(np.prod(one.maps.shape)) for one in parts)
        raise ModelError(
            f"--joint {' '.join(names)}: maps lie on different surfaces ({counts} points); choose"
            " maps of one surface" + (", or leave --joint-sides out" if len(names) == 1 else ""),
            reason="joint-maps",
        )


def joint_points(one: JointMap) -> pd.DataFrame:
    """List all points of a map, with the p-value of each measure by itself."""
    frame = frame_of(one.cohort, one.place)
    columns = {
        **frame.columns,
        "n": np.min([fit.fits[measure].n for fit, measure in one.parts.values()], axis=0),
        "statistic": one.test.statistic,
        "p": one.test.p_uncorrected,
        "p_corrected": one.found.adjusted,
        "significant": one.found.rejected,
        **{f"p_{title.replace(' ', '_')}": test.p for title, test in one.tests.items()},
    }
    return pd.DataFrame(columns)


def joint_peaks(joint: Sequence[JointMap], settings: GroupSettings) -> pd.DataFrame:
    """List clusters with their peaks; of a map without findings its strongest point."""
    rows = []
    for one in joint:
        frame, tests, z = frame_of(one.cohort, one.place), one.tests, one.test.statistic
        edges = edges_of(one.place.maps, settings.multiplicity.neighbors)
        for cluster in find_clusters(one.found.rejected, z, frame.subfield, edges):
            at = cluster.peak
            words = [
                f"{title} {effect_name(_EFFECTS[test.kind])} {number_text(test.effect[at])},"
                f" p {p_text(test.p[at])}"
                for title, test in tests.items()
            ]
            rows.append(
                {
                    "measure": JOINT,
                    "contrast": one.key.contrast,
                    "hemi": one.key.hemi,
                    **frame.at(at),
                    "test": "z",
                    "statistic": z[at],
                    "p": one.test.p_uncorrected[at],
                    "p_corrected": one.found.adjusted[at],
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
    for one in joint:
        by_contrast.setdefault(one.key.contrast, {})[one.key.hemi] = one
    places = {one.key.hemi: one.place for one in joint}
    blocks = [list(_rows(i, name, own)) for i, (name, own) in enumerate(by_contrast.items())]
    return draw_pages(joint[0].cohort, places, shapes, views, blocks)


def _rows(number: int, contrast: str, own: Mapping[str, JointMap]) -> Iterator[Row]:
    _, colors, p_colors = display.effect_colors("F")
    z = {hemi: one.test.statistic for hemi, one in own.items()}
    survive = {hemi: one.found.rejected for hemi, one in own.items()}
    logs = {hemi: signed_logarithm(one.found.adjusted, z[hemi]) for hemi, one in own.items()}
    sides = {hemi: "" if hemi == BOTH_SIDES else f" {SIDES[hemi]}" for hemi in own}
    counts = ", ".join(f"{int(found.sum())}{sides[hemi]}" for hemi, found in survive.items())
    tested = "/".join(dict.fromkeys(str(int(np.isfinite(one).sum())) for one in z.values()))
    first = next(iter(own.values()))
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
