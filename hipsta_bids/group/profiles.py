"""Profiles along x before registration, and displacements of groups after it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.registration import Registration
from hipsta_bids.group_settings import RegistrationSettings

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class GroupShift:
    """By how much a group was displaced."""

    mean: FloatArray
    """(nodes,) registered minus original position, in grid nodes; positive is lateral."""
    se: FloatArray
    """(nodes,)"""
    n: int


def mean_profiles(maps: FloatArray, settings: RegistrationSettings) -> FloatArray:
    """Profiles along x: means over y, with gaps filled linearly.

    Parameters
    ----------
    maps : ndarray, shape (subjects, x, y)
        Curvature, NaN where missing.
    settings : RegistrationSettings
        How much may be missing.

    Raises
    ------
    ModelError
        If too much of a profile is missing; names the rows.
    """
    present = np.isfinite(maps)
    counts = present.sum(axis=2)
    sums = np.where(present, maps, 0.0).sum(axis=2)
    profiles = sums / np.maximum(counts, 1)
    empty = counts == 0
    bad = np.flatnonzero(empty.mean(axis=1) > settings.max_gap)
    if len(bad):
        raise ModelError(
            f"registration: rows {', '.join(map(str, bad[:10]))} of the maps lack more than"
            f" {settings.max_gap:.0%} of the profile; leave them out",
            reason="profile-missing",
        )
    nodes = np.arange(maps.shape[1])
    for row in np.flatnonzero(empty.any(axis=1)):  # few
        gaps = empty[row]
        profiles[row, gaps] = np.interp(nodes[gaps], nodes[~gaps], profiles[row, ~gaps])
    return np.asarray(profiles, dtype=np.float64)


def shift_by_group(
    registration: Registration, groups: Sequence[str] | NDArray[np.str_]
) -> Mapping[str, GroupShift]:
    """Mean displacement of each group along x (figure A5 of the paper).

    Parameters
    ----------
    registration : Registration
        Of all subjects.
    groups : sequence of str, length (subjects,)
        Group of each.
    """
    names = np.asarray(groups)
    nodes = registration.warps.shape[1]
    shift = (registration.warps - np.linspace(0, 1, nodes)) * (nodes - 1)
    result = {}
    for name in np.unique(names):
        part = shift[names == name]
        spread = part.std(axis=0, ddof=1) if len(part) > 1 else np.full(nodes, np.nan)
        result[str(name)] = GroupShift(part.mean(axis=0), spread / np.sqrt(len(part)), len(part))
    return result
