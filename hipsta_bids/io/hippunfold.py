"""HippUnfold's files: what their names say, and where vertices of unfolded surfaces lie.

Both versions have one rectangle, 40 mm from the posterior to the anterior end and 20 mm from the
subiculum to CA3 (5 mm of the dentate gyrus). Version 1 has the long axis along x (DeKraker et al.
2022, eLife 11:e77945), as early versions 2 do; later ones have it along y, and x of the left side
has the opposite sign (https://github.com/khanlab/hippunfold/pull/534, MICA-MNI/z-brains issue 81).
"""

import re
from pathlib import Path

import numpy as np

from hipsta_bids.io.files import entities
from hipsta_bids.types import Float, Mesh

_LOW, _LENGTH = np.array([-40.0, -200.0]), 40.0  # mm
#: mm, of the hippocampus.
SHEET_SIZE = np.array([40.0, 20.0])
_WIDTHS = {"hipp": 20.0, "dentate": 5.0}  # mm
_ROOM = 0.5  # mm by which vertices may lie outside the rectangle
#: Columns of the long and the short axis, and their signs: x first, y first, y first on the left.
_ORDERS = (([0, 1], [1, 1]), ([1, 0], [1, 1]), ([1, 0], [1, -1]))
#: Share of the rectangle that a surface covers; outer vertices may lie a spacing inside of it.
_COVERED = 0.9, 0.7

#: Names in ``T1w/HippUnfold`` and ``MNINonLinear/HippUnfold`` of the HCP's pipelines, by
#: https://github.com/Washington-University/HCPpipelines (``HippUnfoldHCP``).
_HCP = re.compile(
    r"(?P<subject>[^.]+)\.(?:(?P<hemi>[LR])\.)?(?P<label>hipp|dentate|hippocampus)"
    r"_(?P<suffix>[^.]+)\.(?P<mesh>[^.]+)\..+"
)


def unfolded_shares(flat: Mesh) -> tuple[str, Float] | None:
    """Compute where the vertices of an unfolded surface lie; None for other surfaces.

    Returns the surface's label, ``hipp`` or ``dentate``, and shares (V, 2) of the way from the
    posterior to the anterior end, and from the subiculum to CA3, or across the dentate gyrus.
    The ranges of x and y differ, so that they decide which of them is the long axis.
    """
    for label, width in _WIDTHS.items():
        size = np.array([_LENGTH, width])
        for axes, signs in _ORDERS:
            shares = (flat.points[:, axes] * signs - _LOW) / size
            low, high = shares.min(axis=0), shares.max(axis=0)
            inside = (low >= -_ROOM / size).all() and (high <= 1 + _ROOM / size).all()
            if flat.flat and inside and (high - low >= _COVERED).all():
                return label, shares
    return None


def has_opposite_sign(path: Path, hemi: str) -> bool:
    """Return whether a file has the curvature of the right side of HippUnfold 1.

    Its sign is opposite to the left side's (https://github.com/khanlab/hippunfold/issues/552).
    Version 1 names densities in mm, version 2 by the number of vertices.
    """
    name = entities(path.name)
    version1 = name.get("den", "").endswith("mm") and "seg" not in name
    return hemi == "R" and version1 and name["suffix"] == "curvature"


def suffix(path: Path) -> str:
    """Return what a file holds by its name, as ``thickness``."""
    match = _HCP.fullmatch(path.name)
    return match["suffix"] if match else entities(path.name)["suffix"]


def surfaces_beside(path: Path, hemi: str, *, flat: bool = True) -> list[Path]:
    """List unfolded surfaces of a map, or others: next to it, or in version 2 in ``surf/``."""
    if match := _HCP.fullmatch(path.name):
        label = match["label"].removesuffix("ocampus") if match["hemi"] is None else match["label"]
        kind = "flat" if flat else "midthickness"
        name = f"{match['subject']}.{hemi}.{label}_{kind}.{match['mesh']}.surf.gii"
        return [surface] if (surface := path.with_name(name)).is_file() else []
    labels = {**entities(path.name), "hemi": hemi}
    keys = ("sub", "ses", "hemi", "den", "label")
    names = {
        surface: entities(surface.name)
        for folder in (path.parent, path.parent.parent / "surf")
        for surface in sorted(folder.glob("*_midthickness.surf.gii"))
        if ("_space-unfold" in surface.name) == flat
    }
    # Sheets of this program have an unfolded surface too, but their maps have their grid.
    return [
        surface
        for surface, name in names.items()
        if "seg" not in name and all(labels.get(key) == name.get(key) for key in keys)
    ]
