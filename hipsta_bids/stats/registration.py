"""Registration of curvature profiles, so that a grid node means the same position in all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import warps as warping
from hipsta_bids.stats.arrays import SHEETS, Bool, Float, blocks
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.inference import PermutationPart, permute
from hipsta_bids.stats.settings import MultiplicitySettings, RegistrationSettings

#: Displacements that vary less, as a share of the largest variance, are those of fixed ends.
_ROUNDING = 1e-12
#: Turns end when warps change by less than this, mean square, sheet = 1.
_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Registration:
    """Warps of all subjects, and their effect."""

    warps: Float
    """(subjects, nodes) registered coordinate of each node, 0..1."""
    template: warping.Template | None
    """None without registration."""
    iterations: int
    converged: bool
    explained_before: float
    """Share of the variance of all profile values that the mean profile explains."""
    explained_after: float
    displacement: Float
    """(subjects,) root mean square of warp minus identity, in grid nodes."""
    extreme: Bool
    """(subjects,) whose displacement is an outlier."""
    by_group: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Columns of shifts by group; empty without groups."""
    difference: Mapping[str, float] = field(default_factory=dict)
    """Columns of the largest difference between the groups; empty without groups."""

    @property
    def shifts(self) -> Float:
        """(subjects, nodes) registered minus original position, in nodes; positive is lateral."""
        return _shifts(self.warps)


def _shifts(warps: Float) -> Float:
    nodes = warps.shape[1]
    return np.asarray((warps - np.linspace(0.0, 1.0, nodes)) * (nodes - 1), dtype=np.float64)


def register(profiles: Float, settings: RegistrationSettings) -> Registration:
    """Register profiles to a template that is made from them.

    ``registr`` takes turns: each profile is warped onto its approximation by the mean and
    the principal components; these are estimated again from the warped profiles (Wrobel et al.
    2018, as in version 2.1.1 of the R package of that name). Unlike R, each profile is first
    standardized (setting ``standardize``; else all are divided by one standard deviation, since
    the algorithm is not free of scale), and the mean warp is kept at identity (``center``).
    """
    if settings.align == "none":
        return _finish(profiles, _identity(profiles), None, settings, 0, converged=True)
    scale = _check(profiles, settings)
    scaled = _scaled(profiles, scale)
    basis = warping.WarpBasis.make(profiles.shape[1], settings.warp_splines)
    warps = _identity(profiles)
    knots = warping.inner_knots(warps, settings.template_splines)
    mean = np.linalg.lstsq(warping.make_basis(knots)(warps[0]), scaled.mean(axis=0), rcond=None)[0]
    curves = np.tile(mean, (len(profiles), 1))
    parameters = np.zeros((len(profiles), len(basis.identity)))
    turn = 0
    while True:
        before = warps
        parameters, warps = warping.fit_warps(scaled, knots, curves, basis, parameters)
        if settings.center:
            warps = _after_inverse(warps, warps.mean(axis=0))
        template, curves = warping.fit_template(
            scaled, warps, settings.template_splines, settings.components
        )
        knots = template.knots
        change = float(np.mean((warps - before) ** 2))
        # The first warps are to the mean of profiles that were not registered.
        if turn == settings.iterations or (turn and change <= _TOLERANCE):
            break
        turn += 1
    template = replace(template, scale=scale, turns=turn)
    if settings.center:
        center = _fit_to(scaled, template, settings).mean(axis=0)
        template = replace(template, center=center)
    return _finish(profiles, warps, template, settings, turn, converged=change <= _TOLERANCE)


def register_to(
    profiles: Float, template: warping.Template, settings: RegistrationSettings
) -> Registration:
    """Register profiles to a template that does not change; subjects are independent."""
    if settings.align == "none":
        raise ModelError(
            "registration: the template was made with align registr, not none; use the same"
        )
    if (template.scale is None) != settings.standardize:
        raise ModelError(
            "registration: the template was made with another setting of"
            f" standardize, not {str(settings.standardize).lower()}; use the same"
        )
    if (nodes := profiles.shape[1]) != len(template.center):
        raise ModelError(
            f"registration: the template has {len(template.center)} nodes along x, the sheets have"
            f" {nodes}; use one of the same grid"
        )
    _check_profiles(profiles, settings)
    fitted = _fit_to(_scaled(profiles, template.scale), template, settings)
    warps = _after_inverse(fitted, template.center)
    return _finish(profiles, warps, template, settings, template.turns, converged=True)


def _fit_to(scaled: Float, template: warping.Template, settings: RegistrationSettings) -> Float:
    """Warps to a template that does not change, by as many turns as it was made with."""
    basis = warping.WarpBasis.make(scaled.shape[1], settings.warp_splines)
    curves = np.tile(template.mean, (len(scaled), 1))
    parameters = np.zeros((len(scaled), len(basis.identity)))
    for turn in range(template.turns + 1):
        parameters, warps = warping.fit_warps(scaled, template.knots, curves, basis, parameters)
        if turn < template.turns:
            curves = warping.subject_curves(template, scaled, warps)
    return warps


def _identity(profiles: Float) -> Float:
    return np.tile(np.linspace(0.0, 1.0, profiles.shape[1]), (len(profiles), 1))


def _after_inverse(warps: Float, common: Float) -> Float:
    """Follow all warps by the inverse of one; by their mean's, it becomes the identity."""
    grid = np.linspace(0.0, 1.0, warps.shape[1])
    inverse = np.interp(warps.ravel(), common, grid)
    return np.asarray(inverse.reshape(warps.shape), dtype=np.float64)


def _scaled(profiles: Float, scale: float | None) -> Float:
    """Profiles over one standard deviation, or each less its mean over its standard deviation."""
    if scale is not None:
        return profiles / scale
    centered = profiles - profiles.mean(axis=1, keepdims=True)
    return np.asarray(centered / profiles.std(axis=1, keepdims=True), dtype=np.float64)


def _check_profiles(profiles: Float, settings: RegistrationSettings) -> None:
    """Refuse single profiles that cannot be registered."""
    rows = np.flatnonzero(~np.isfinite(profiles).all(axis=1))
    if len(rows):
        raise ModelError(
            f"registration: profiles {', '.join(map(str, rows[:10]))} have missing values"
        )
    constant = profiles.std(axis=1) <= np.finfo(np.float64).eps * np.abs(profiles).max(axis=1)
    if settings.standardize and constant.any() and not constant.all():
        raise ModelError(
            f"registration: profiles {', '.join(map(str, np.flatnonzero(constant)[:10]))} "
            "are constant; exclude them"
        )


def _check(profiles: Float, settings: RegistrationSettings) -> float | None:
    """Refuse what makes no template; else return what to divide all profiles by, if anything."""
    _check_profiles(profiles, settings)
    if len(profiles) < settings.min_subjects:
        raise ModelError(
            f"registration: {len(profiles)} profiles are too few for a template (least"
            f" {settings.min_subjects}); add sheets or lower min_subjects"
        )
    scale = float(profiles.std())
    if scale <= np.finfo(np.float64).eps * float(np.abs(profiles).max()):
        raise ModelError("registration: all profiles are the same constant; use align none")
    return None if settings.standardize else scale


def _finish(
    profiles: Float,
    warps: Float,
    template: warping.Template | None,
    settings: RegistrationSettings,
    iterations: int,
    *,
    converged: bool,
) -> Registration:
    displacement = np.sqrt(np.mean(_shifts(warps) ** 2, axis=1))
    spread = float(stats.median_abs_deviation(displacement, scale="normal"))
    limit = float(np.median(displacement)) + settings.extreme * spread
    return Registration(
        warps=warps,
        template=template,
        iterations=iterations,
        converged=converged,
        explained_before=_explained(profiles),
        explained_after=_explained(warping.warp_values(profiles[:, :, None], warps)[:, :, 0]),
        displacement=displacement,
        extreme=(displacement > limit) & (spread > 0),
    )


def _explained(profiles: Float) -> float:
    """Share of the variance that the mean profile explains."""
    return 1 - float(np.mean(profiles.var(axis=0))) / max(float(profiles.var()), 1e-300)


def mean_profiles(maps: Float, settings: RegistrationSettings) -> Float:
    """Profiles of curvature along x: means over y, with gaps filled linearly."""
    counts, profiles = np.empty(maps.shape[:2], dtype=np.int64), np.empty(maps.shape[:2])
    for part in blocks(len(maps), SHEETS):
        present = np.isfinite(maps[part])
        counts[part] = present.sum(axis=2)
        sums = np.where(present, maps[part], 0.0).sum(axis=2, dtype=np.float64)
        profiles[part] = sums / np.maximum(counts[part], 1)
    empty = counts == 0
    bad = np.flatnonzero(empty.mean(axis=1) > settings.max_gap)
    if len(bad):
        raise ModelError(
            f"registration: rows {', '.join(map(str, bad[:10]))} of the maps lack more than "
            f"{settings.max_gap:.0%} of the profile; exclude them"
        )
    nodes = np.arange(maps.shape[1])
    for row in np.flatnonzero(empty.any(axis=1)):  # few
        gaps = empty[row]
        profiles[row, gaps] = np.interp(nodes[gaps], nodes[~gaps], profiles[row, ~gaps])
    return profiles


def shift_difference(
    registration: Registration,
    groups: Sequence[str] | NDArray[np.str_],
    people: NDArray[np.generic],
    *,
    permutations: int,
    seed: int,
) -> dict[str, float | int]:
    """Compare displacements between groups, at all nodes along x at once.

    Warps of one participant are averaged first. F of a one-way analysis of variance at each node;
    the largest is compared with the largest after permuting participants over the groups, so that
    the error rate holds for the whole sheet (Westfall and Young 1993).

    Parameters
    ----------
    registration : Registration
        Warps (sheets, nodes).
    groups : sequence of str
        Group of each sheet.
    people : ndarray
        (sheets,) participant of each sheet; all sheets of a participant have one group.
    permutations : int
    seed : int
    """
    _, first, index = np.unique(people, return_index=True, return_inverse=True)
    totals = [np.bincount(index, column) for column in registration.shifts.T]
    means: Float = np.stack(totals, axis=1) / np.bincount(index)[:, None]
    names, member = np.unique(np.asarray(groups)[first], return_inverse=True)
    matrix = np.eye(len(names))[member]
    counts = matrix.sum(axis=0)
    spread = np.ptp(matrix.T @ means / counts[:, None], axis=0)
    node, p = int(np.argmax(spread)), float("nan")
    varied = means.var(axis=0)
    varying = varied > _ROUNDING * varied.max()
    if len(names) > 1 and counts.min() > 1 and varying.any():
        part = PermutationPart(
            maps=means[:, varying],
            matrix=matrix,
            subjects=np.arange(len(means)),
            edges=np.empty((0, 2), dtype=np.int64),
        )
        contrast = Contrast("groups", np.diff(np.eye(len(names)), axis=0))
        rules = MultiplicitySettings(
            method="permutation-max", permutations=permutations + 1, seed=seed
        )
        (test,) = permute([part], contrast, settings=rules)
        finite = test.p_max[np.isfinite(test.p_max)]  # none where groups leave no residuals
        p = float(finite.min()) if len(finite) else p
    largest = float(spread[node])
    return {"difference": largest, "difference_node": node + 1, "difference_p": p}


def shift_by_group(
    registration: Registration, groups: Sequence[str] | NDArray[np.str_]
) -> Mapping[str, Mapping[str, Any]]:
    """Return the columns of the table of shifts of each group (figure A5 of the paper)."""
    names, shifts = np.asarray(groups), registration.shifts
    result = {}
    for name in np.unique(names):
        part = shifts[names == name]
        spread = part.std(axis=0, ddof=1) if len(part) > 1 else np.full(part.shape[1], np.nan)
        result[str(name)] = {
            "node_x": np.arange(part.shape[1]) + 1,
            "n": len(part),
            "shift": part.mean(axis=0),
            "shift_se": spread / np.sqrt(len(part)),
        }
    return result
