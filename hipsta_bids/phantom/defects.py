"""Damage to labels, as segmentations show it, at known places of any hippocampal body.

Places are given in sheet coordinates of the undamaged body, so that the same defect can be put
into a phantom and into a real segmentation.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from scipy import ndimage

from hipsta_bids.artifacts import Bool
from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom.site import Defect, Place, Site
from hipsta_bids.schemes import Part, Tissue

#: mm beyond either wall up to which a hole is cut, so that it opens on both sides.
_THROUGH = 1.0


def make_defect(site: Site, kind: str, size: float, place: Place = (0.5, 0.5)) -> Defect:
    """Damage a segmentation.

    Parameters
    ----------
    site : Site
    kind : str
        One of :data:`DEFECTS`.
    size : float
        mm; what it measures is in the kind's own description.
    place : tuple of float
        Where on the sheet, (u, v).

    Raises
    ------
    SettingsError
        If the kind is unknown, or makes no change at this size and place.
    """
    if kind not in DEFECTS:
        raise SettingsError(
            f"defect {kind!r} is unknown; choose one of {', '.join(DEFECTS)}", reason="defect-kind"
        )
    defect = DEFECTS[kind](site, size, place)
    if not len(defect.changed):
        raise SettingsError(
            f"defect {kind} of size {size:g} at {place} changes no voxel: make it larger",
            reason="defect-empty",
        )
    return defect


def _hole(site: Site, size: float, place: Place) -> Defect:
    """Open a round hole through the wall; size is its radius."""
    column, normal = site.column(place), site.normal(place)
    line = np.vstack(
        [
            column,
            column[-1] + np.linspace(0, _THROUGH, 5)[:, None] * normal,
            column[0] - np.linspace(0, _THROUGH, 5)[:, None] * normal,
        ]
    )
    return site.erased(site.wall & site.within(line, size))


def _cavity(site: Site, size: float, place: Place) -> Defect:
    """Hollow the wall out; size is the radius."""
    middle = site.column(place).mean(axis=0, keepdims=True)
    return site.erased(site.wall & site.within(middle, size))


def _bridge_across(site: Site, size: float, places: tuple[Place, Place]) -> Defect:
    """Join the interior sides of two places by a bar; size is its radius."""
    first, last = (site.column(place)[0] for place in places)
    bar = first + np.linspace(0, 1, 101)[:, None] * (last - first)
    return site.added(site.within(bar, size), places[0])


def _bridge_far(site: Site, size: float, place: Place) -> Defect:
    """Join CA3 to the subiculum; size is the bar's radius, and only v counts of the place."""
    return _bridge_across(site, size, ((0.92, place[1]), (0.2, place[1])))


def _bridge_near(site: Site, size: float, place: Place) -> Defect:
    """Join two places of CA1 by a bar; size is its radius, and only v counts of the place."""
    return _bridge_across(site, size, ((0.72, place[1]), (0.4, place[1])))


def _island(site: Site, size: float, place: Place) -> Defect:
    """Add a ball that touches nothing; size is its radius."""
    middle = site.beside(place, size + 1.0)[None]
    return site.added(site.within(middle, size), place)


def _salt(site: Site, size: float, place: Place) -> Defect:
    """Flip voxels at random, the wall's and those within 1.5 mm; size is their share."""
    generator = np.random.default_rng(round(1000 * size + 100 * place[0] + 10 * place[1]))
    spots = generator.random(site.wall.shape) < size
    near = site.within(site.columns.reshape(-1, 3), 1.5)
    hit = spots & near
    added = site.added(hit, place)
    tissue = np.where(hit & site.wall, np.uint8(Tissue.BACKGROUND), added.volume.tissue)
    return Defect(volume=replace(added.volume, tissue=tissue), changed=site.points[hit])


def _protrusion(site: Site, size: float, place: Place) -> Defect:
    """Let a spike 2.5 mm long stand on the exterior wall; size is its radius."""
    spike = np.array([site.beside(place, step) for step in np.linspace(-0.3, 2.5, 15)])
    return site.added(site.within(spike, size), place)


def _leak(site: Site, size: float, place: Place) -> Defect:
    """Let the label leak out of the exterior wall as a ball; size is its radius."""
    return site.added(site.within(site.beside(place, 0.6 * size)[None], size), place)


def _slit(site: Site, size: float, place: Place) -> Defect:
    """Slit the wall along 4 mm of the long axis; size is the slit's width."""
    return site.erased(_gap_voxels(site, size, place[0]) & site.slab(place, 4.0))


def _gap(site: Site, size: float, place: Place) -> Defect:
    """Part two neighboring subfields from end to end; size is the gap's width."""
    return site.erased(_gap_voxels(site, size, place[0]))


def _gap_voxels(site: Site, width: float, u: float) -> Bool:
    """Voxels of the wall within half a width of the columns at ``u``, and beyond both ends."""
    row = round(u * (site.columns.shape[0] - 1))
    cut = site.columns[row]
    over = np.linspace(0.0, 0.5 * site.length, 20)[:, None, None] * site.axis
    longer = [cut.reshape(-1, 3), (cut[-1] + over).reshape(-1, 3), (cut[0] - over).reshape(-1, 3)]
    return site.wall & site.within(np.vstack(longer), 0.5 * width)


def _missing_subfield(site: Site, size: float, place: Place) -> Defect:
    """Erase the subfield at the place; size is of no account."""
    del size
    middle = site.column(place)[site.columns.shape[2] // 2]
    own = np.isin(site.volume.tissue, site.volume.scheme.sheet)
    nearest = np.argmin(np.linalg.norm(site.points[own] - middle, axis=1))
    return site.erased(site.volume.tissue == site.volume.tissue[own][nearest])


def _missing_slices(site: Site, size: float, place: Place) -> Defect:
    """Erase all labels in the image's own slices; size is the thickness of the gap."""
    linear = site.volume.affine[:3, :3]
    edges = np.linalg.norm(linear, axis=0)
    across = int(np.argmax(np.abs(site.axis @ (linear / edges))))
    middle = site.column(place).mean(axis=0)
    index = np.linalg.solve(linear, middle - site.volume.affine[:3, 3])[across]
    number = np.arange(site.wall.shape[across])
    half = max(0.5 * size / float(edges[across]), 0.5)
    chosen = np.abs(number - index) <= half
    shape = [1, 1, 1]
    shape[across] = -1
    gone = np.broadcast_to(chosen.reshape(shape), site.wall.shape)
    return site.erased(gone & (site.volume.tissue > 0))


def _tail_inside(site: Site, size: float, place: Place) -> Defect:
    """Label cross-sections in the middle as tail; size is their thickness."""
    return _part_inside(site, size, place, Part.TAIL)


def _head_inside(site: Site, size: float, place: Place) -> Defect:
    """Label cross-sections in the middle as head; size is their thickness."""
    return _part_inside(site, size, place, Part.HEAD)


def _part_inside(site: Site, size: float, place: Place, part: Part) -> Defect:
    where = site.slab(place, size) & (site.volume.tissue > 0)
    whole = any(
        label.part is part and label.tissue is Tissue.HIPPOCAMPUS
        for label in site.volume.scheme.labels
    )
    return site.relabeled(where, Tissue.HIPPOCAMPUS if whole else None, part)


def _cut_short(site: Site, size: float, place: Place) -> Defect:
    """Erase all from a cross-section on to the front; size is what stays of the body, mm."""
    del place
    return site.erased((site.v * site.length > size) & (site.volume.tissue > 0))


def _notch(site: Site, size: float, place: Place) -> Defect:
    """Erase the ribbon lateral of the place; size is the notch's length along the axis."""
    lateral = site.among(site.sheet_place[:, 0] > place[0])
    return site.erased(lateral & site.slab(place, size))


def _waist(site: Site, size: float, place: Place) -> Defect:
    """Peel voxels off the wall over 4 mm of the long axis; size is the depth on each side."""
    depth = ndimage.distance_transform_edt(
        site.wall, sampling=np.linalg.norm(site.volume.affine[:3, :3], axis=0)
    )
    return site.erased(site.wall & (depth <= size) & site.slab(place, 4.0))


def _wrong_voxels(site: Site, size: float, place: Place) -> Defect:
    """Stretch the voxels across the long axis, as a wrong header does; size is the factor.

    The image keeps its labels; what changes is where they lie.
    """
    del place
    affine = site.volume.affine.copy()
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    along = np.abs(site.axis @ (affine[:3, :3] / edges))
    affine[:, int(np.argmin(along))] *= size
    return Defect(volume=replace(site.volume, affine=affine), changed=site.points[site.wall])


def _at_border(site: Site, size: float, place: Place) -> Defect:
    """Let the image end inside the body; size is what it loses of it, mm (0: it just touches)."""
    del place
    linear = site.volume.affine[:3, :3]
    edges = np.linalg.norm(linear, axis=0)
    across = int(np.argmin(np.abs(site.axis @ (linear / edges))))
    last = int(site.voxels[:, across].max()) - round(size / float(edges[across]))
    keep: list[slice] = [slice(None)] * 3
    keep[across] = slice(0, last + 1)
    box = tuple(keep)
    lost = np.ones(site.wall.shape, dtype=bool)
    lost[box] = False
    rim = np.zeros(site.wall.shape, dtype=bool)
    keep[across] = slice(last, last + 1)
    rim[tuple(keep)] = True
    return Defect(
        volume=replace(site.volume, tissue=site.volume.tissue[box], part=site.volume.part[box]),
        changed=site.points[(lost | rim) & site.wall],
    )


def _ends_flush(site: Site, size: float, place: Place) -> Defect:
    """Erase head and tail, so that the labels end where the body does; size is of no account."""
    del size, place
    return site.erased(np.isin(site.volume.part, (Part.HEAD, Part.TAIL)))


#: How each kind of damage is done. The first line of each function says what its size means.
DEFECTS: Mapping[str, Callable[[Site, float, Place], Defect]] = MappingProxyType(
    {
        "hole": _hole,
        "cavity": _cavity,
        "bridge-ca3-subiculum": _bridge_far,
        "bridge-ca1-ca1": _bridge_near,
        "island": _island,
        "salt": _salt,
        "protrusion": _protrusion,
        "leak": _leak,
        "slit": _slit,
        "gap": _gap,
        "missing-subfield": _missing_subfield,
        "missing-slices": _missing_slices,
        "tail-inside": _tail_inside,
        "head-inside": _head_inside,
        "cut-short": _cut_short,
        "notch": _notch,
        "waist": _waist,
        "wrong-voxels": _wrong_voxels,
        "at-border": _at_border,
        "ends-flush": _ends_flush,
    }
)
