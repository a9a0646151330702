"""Tests of several measures, or of both sides, together."""

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.output import results
from hipsta_bids.group.output.tables import JointMap
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.progress import tell
from hipsta_bids.stats import inference
from hipsta_bids.stats.clusters import edges_of
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import FittedMaps
from hipsta_bids.types import BOTH_SIDES, JOINT, SIDES


def check_joint(
    available: Sequence[str], comparison: modeling.Comparison, settings: GroupSettings
) -> None:
    """Refuse measures that cannot be tested together, before anything is fitted."""
    available = [
        *available,
        *(modeling.asymmetry_name(name) for name in available if comparison.asymmetry),
    ]
    names, sides = settings.joint.measures, settings.joint.sides
    problem = None
    if unknown := [name for name in names if name not in available]:
        problem = f"no map is called {unknown[0]!r}; there are {', '.join(available)}"
    elif names and JOINT in available:
        problem = f"a map is called {JOINT}, as its results would be; give it another name"
    elif len(set(names)) < len(names):
        problem = "a measure is named twice; remove it"
    elif len(names) < 1 + (not sides) and (names or sides):
        problem = "name two measures, or one and --joint-sides"
    if problem is not None:
        raise ModelError(f"--joint {' '.join(names)}".strip() + f": {problem}")


def combine_maps(
    analyses: Sequence[results.Analysis], settings: GroupSettings
) -> dict[inference.MapKey, JointMap]:
    """Test the measures of the setting ``joint`` together; empty without any.

    The first analysis has the model; further ones may have maps of other programs.
    """
    names, sides = settings.joint.measures, settings.joint.sides
    if not names:
        return {}
    cohort = next(
        analysis.compared
        for analysis in analyses
        if any(names[0] in maps.fits for maps in analysis.fitted.values())
    )
    groups, contrasts = _groups(analyses, names, sides=sides)
    if not groups:
        raise ModelError(f"--joint {' '.join(names)}: no side has them all; remove one")
    tests_found = inference.correct_joint(
        groups,
        contrasts,
        analyses[0].row_model,
        analyses[0].compared.table,
        settings.multiplicity,
        combine=settings.joint.combine,
        report=partial(tell, "permutations"),
    )
    return {
        key: JointMap(key=key, parts=groups[key], cohort=cohort, test=test, found=discoveries)
        for key, (test, discoveries) in tests_found.items()
    }


def _groups(
    analyses: Sequence[results.Analysis], names: Sequence[str], *, sides: bool
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
