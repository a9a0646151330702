"""Tests of several measures, or of both sides, together."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.combination import NAME
from hipsta_bids.extensions.combination.output import JointMap
from hipsta_bids.extensions.combination.settings import JointSettings
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort.data import SHEET
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.request import Request
from hipsta_bids.progress import tell
from hipsta_bids.stats import inference
from hipsta_bids.stats.clusters import edges_of
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import FittedMaps
from hipsta_bids.types import BOTH_SIDES, JOINT, SIDES


def is_asked(request: Request) -> bool:
    """Check whether anything is tested together."""
    joint = request.settings.of(JointSettings)
    return bool(joint.measures) or joint.sides


def plan_joint(request: Request) -> JointSettings:
    """Refuse measures that cannot be tested together, before anything is fitted."""
    joint = request.settings.of(JointSettings)
    names, sides = joint.measures, joint.sides
    available = [*request.measures.maps, *request.surfaces]
    if request.comparison.asymmetry:
        available += map(modeling.asymmetry_name, available.copy())
    problem = None
    if unknown := [name for name in names if name not in available]:
        problem = f"no map is called {unknown[0]!r}; there are {', '.join(available)}"
    elif names and JOINT in available:
        problem = f"a map is called {JOINT}, as its results would be; give it another name"
    elif len(set(names)) < len(names):
        problem = "a measure is named twice; remove it"
    elif len(names) < 1 + (not sides):
        problem = "name two measures, or one and --joint-sides"
    if problem is not None:
        raise ModelError(f"--joint {' '.join(names)}".strip() + f": {problem}")
    return joint


def combine_surfaces(
    analyses: Mapping[str, Analysis], joint: JointSettings
) -> Mapping[str, Analysis]:
    """Test measures together, and add the discoveries to the analysis of the sheets.

    This analysis has the model; further ones may have maps of other programs.
    """
    sheets, names = analyses[SHEET], joint.measures
    cohort = next(
        analysis.compared
        for analysis in analyses.values()
        if any(names[0] in maps.fits for maps in analysis.fitted.values())
    )
    groups, contrasts = _groups(list(analyses.values()), names, sides=joint.sides)
    if not groups:
        raise ModelError(f"--joint {' '.join(names)}: no side has them all; remove one")
    tests = inference.correct_joint(
        groups,
        contrasts,
        sheets.row_model,
        sheets.compared.table,
        sheets.request.settings.multiplicity,
        combine=joint.combine,
        report=partial(tell, "permutations"),
    )
    maps = [
        JointMap(key=key, parts=groups[key], cohort=cohort, test=test, discoveries=discoveries)
        for key, (test, discoveries) in tests.items()
    ]
    discoveries_of = {**sheets.found, **{part.key: part.discoveries for part in maps}}
    sheets = replace(sheets, found=discoveries_of, parts={**sheets.parts, NAME: maps})
    return {**analyses, SHEET: sheets}


def _groups(
    analyses: Sequence[Analysis], names: Sequence[str], *, sides: bool
) -> tuple[dict[inference.MapKey, dict[str, tuple[FittedMaps, str]]], dict[str, Contrast]]:
    """Find the maps that are tested together, by the key of their test; and contrasts by name."""
    fits = {
        (measure, hemi): maps
        for analysis in analyses
        for hemi, maps in analysis.fitted.items()
        for measure in maps.fits
    }
    groups: dict[inference.MapKey, dict[str, tuple[FittedMaps, str]]] = {}
    contrasts: dict[str, Contrast] = {}
    for hemis in [("L", "R")] if sides else [("L",), ("R",), (modeling.BOTH,)]:
        if not all((name, hemi) in fits for hemi, name in product(hemis, names)):
            continue
        parts = {
            name if len(hemis) == 1 else f"{name} {SIDES[hemi]}": (
                fits[name, hemi],
                name,
            )
            for hemi, name in product(hemis, names)
        }
        _check_points(names, [maps for maps, _ in parts.values()])
        for test in fits[names[0], hemis[0]].fits[names[0]].tests:
            key = inference.MapKey(
                JOINT,
                test.contrast.name,
                BOTH_SIDES if len(hemis) > 1 else hemis[0],
            )
            groups[key], contrasts[test.contrast.name] = parts, test.contrast
    return groups, contrasts


def _check_points(names: Sequence[str], parts: Sequence[FittedMaps]) -> None:
    """Refuse maps whose points do not correspond."""
    first, *remaining = [one.maps for one in parts]
    equal = [
        one.shape == first.shape
        and np.array_equal(edges_of(one, 4), edges_of(first, 4))  # the triangles of meshes
        for one in remaining
    ]
    if not all(equal):
        counts = ", ".join(str(np.prod(one.maps.shape)) for one in parts)
        raise ModelError(
            f"--joint {' '.join(names)}: maps lie on different surfaces ({counts} points); choose"
            " maps of one surface" + (", or leave --joint-sides out" if len(names) == 1 else "")
        )
