"""Damage to labels, as segmentations show it, at known positions of any hippocampal body.

Positions are sheet coordinates of the undamaged body, so that the same defect can be put into a
phantom and into a real segmentation.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import SettingsError
from hipsta_bids.geometry.digital import CUBE, to_ras
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END, Part, Tissue
from hipsta_bids.types import Bool, Float, LabelVolume, Sheet

Position = tuple[float, float]
"""Sheet coordinates (u, v), each from 0 to 1: medial to lateral, posterior to anterior."""

Injury = tuple[str, float, Position]
"""Kind of damage, its size (see the kind's description) and position."""

#: Refinement of the sheet's grid along x, y and z, so that its points lie closer than voxels.
_FINER = (3, 3, 2)

#: mm beyond either wall up to which a hole is cut, so that it opens on both sides.
_THROUGH = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Defect:
    """A damaged segmentation."""

    volume: LabelVolume
    changed: Float
    """(N, 3) centers of the changed voxels, RAS mm (where the undamaged image has them)."""


class Site:
    """A body whose labels can be damaged."""

    def __init__(self, volume: LabelVolume, sheet: Sheet) -> None:
        self.volume = volume
        self.columns = _refined(sheet.points)
        index = np.indices(volume.tissue.shape).reshape(3, -1).T
        points = to_ras(index, volume.affine)
        self.points: Float = points.reshape(*volume.tissue.shape, 3)
        owners = (*volume.protocol.sheet, *volume.protocol.layer)
        self.wall: Bool = np.isin(volume.tissue, owners)
        """(I, J, K) voxels that become the ribbon, anywhere along the hippocampus."""
        first, last = sheet.points[:, [0, -1]].mean(axis=(0, 2))
        self.length = float(np.linalg.norm(last - first))
        """mm between the middles of the two end planes."""
        self.axis: Float = (last - first) / self.length
        """(3,) unit vector from posterior to anterior."""
        self.v: Float = (self.points - first) @ self.axis / self.length
        """(I, J, K) share of the way from the posterior to the anterior end."""
        body = self.wall & (self.v > -0.2) & (self.v < 1.2)  # noqa: PLR2004 -- oblique ends too
        self.voxels = np.argwhere(body)
        """(N, 3) indices of the wall's voxels in and near the body."""
        count = np.array(self.columns.shape[:2])
        tree = cKDTree(self.columns.reshape(-1, 3))
        _, nearest = tree.query(self.points[body])
        column = np.unravel_index(nearest, self.columns.shape[:3])[:2]
        self.sheet_position: Float = np.stack(column, axis=1) / (count - 1)
        """(N, 2) sheet coordinates of these voxels."""

    def column(self, position: Position) -> Float:
        """Points (Nz, 3), RAS mm, of the column at a position, interior to exterior."""
        count = np.array(self.columns.shape[:2])
        i, j = np.rint(np.array(position) * (count - 1)).astype(int)
        return np.asarray(self.columns[i, j])

    def normal(self, position: Position) -> Float:
        """Compute the unit vector (3,) from interior to exterior."""
        column = self.column(position)
        return np.asarray((column[-1] - column[0]) / np.linalg.norm(column[-1] - column[0]))

    def beside(self, position: Position, distance: float) -> Float:
        """Point (3,) at a distance (mm) outside the exterior wall; inside of it if negative."""
        return np.asarray(self.column(position)[-1] + distance * self.normal(position))

    def within(self, points: Float, radius: float) -> Bool:
        """Voxels (I, J, K) within a radius (mm) of any of (N, 3) points."""
        low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
        box = ((self.points >= low) & (self.points <= high)).all(axis=-1)
        found = np.zeros(box.shape, dtype=bool)
        distance, _ = cKDTree(points).query(self.points[box])
        found[box] = distance <= radius
        return found

    def among(self, chosen: Bool) -> Bool:
        """Voxels (I, J, K) of the wall, chosen by a mask (N,) of :attr:`voxels`."""
        found = np.zeros(self.wall.shape, dtype=bool)
        found[tuple(self.voxels[chosen].T)] = True
        return found

    def slab(self, position: Position, thickness: float) -> Bool:
        """Voxels (I, J, K) of whole cross-sections, ``thickness`` mm along the axis."""
        return np.abs(self.v - position[1]) * self.length <= thickness / 2

    def voxel_axes(self) -> tuple[Float, Float]:
        """Edges (3,) of a voxel, mm, and the cosines of their angles to the long axis, absolute."""
        linear = self.volume.affine[:3, :3]
        edges = np.linalg.norm(linear, axis=0)
        return np.asarray(edges), np.abs(self.axis @ (linear / edges))

    def erased(self, where: Bool) -> Defect:
        """Make voxels background."""
        return self.relabeled(where, Tissue.BACKGROUND, Part.UNKNOWN)

    def relabeled(self, where: Bool, tissue: Tissue | None, part: Part) -> Defect:
        """Give voxels another label; ``None`` keeps the tissue."""
        old = self.volume
        codes = old.tissue if tissue is None else np.where(where, np.uint8(tissue), old.tissue)
        parts = np.where(where, np.uint8(part), old.part)
        changed = (codes != old.tissue) | (parts != old.part)
        return Defect(volume=replace(old, tissue=codes, part=parts), changed=self.points[changed])

    def added(self, where: Bool, position: Position) -> Defect:
        """Give voxels outside the wall the label of the wall at a position."""
        tissue, part = self.label(position, self.wall)
        return self.relabeled(where & ~self.wall, tissue, part)

    def label(self, position: Position, among: Bool) -> tuple[Tissue, Part]:
        """Look up the label nearest to a position among some voxels (I, J, K)."""
        middle = self.column(position)[self.columns.shape[2] // 2]
        nearest = np.argmin(np.linalg.norm(self.points[among] - middle, axis=1))
        tissue, part = self.volume.tissue[among], self.volume.part[among]
        return Tissue(int(tissue[nearest])), Part(int(part[nearest]))


def _refined(points: Float) -> NDArray[np.float64]:
    """Refine the sheet's grid linearly, (Nx, Ny, Nz, 3) to a denser one."""
    nodes = [
        np.linspace(0, n - 1, (n - 1) * by + 1)
        for n, by in zip(points.shape[:3], _FINER, strict=True)
    ]
    where = np.stack(np.meshgrid(*nodes, indexing="ij"))
    filled = np.where(np.isfinite(points), points, np.nanmean(points, axis=(0, 1), keepdims=True))
    return np.stack(
        [ndimage.map_coordinates(filled[..., k], where, order=1) for k in range(3)], axis=-1
    )


def make_defect(site: Site, kind: str, size: float, position: Position = (0.5, 0.5)) -> Defect:
    """Damage a segmentation; the unit of ``size`` is that of the kind."""
    if kind not in DEFECTS:
        raise SettingsError(
            f"defect {kind!r} is unknown; choose one of {', '.join(DEFECTS)}", reason="defect-kind"
        )
    defect = DEFECTS[kind](site, size, position)
    if not len(defect.changed):
        raise SettingsError(
            f"defect {kind} of size {size:g} at {position} changes no voxel: make it larger",
            reason="defect-empty",
        )
    return defect


def _hole(site: Site, size: float, position: Position) -> Defect:
    """Open a round hole through the wall; size is its radius."""
    column, normal = site.column(position), site.normal(position)
    beyond = np.linspace(0, _THROUGH, 5)[:, None] * normal
    line = np.vstack([column, column[-1] + beyond, column[0] - beyond])
    return site.erased(site.wall & site.within(line, size))


def _cavity(site: Site, size: float, position: Position) -> Defect:
    """Hollow the wall out; size is the radius."""
    middle = site.column(position).mean(axis=0, keepdims=True)
    return site.erased(site.wall & site.within(middle, size))


def _bridge(site: Site, size: float, position: Position, *, ends: tuple[float, float]) -> Defect:
    """Join the interior sides at two u by a bar; size is its radius."""
    first, last = (site.column((u, position[1]))[0] for u in ends)
    bar = first + np.linspace(0, 1, 101)[:, None] * (last - first)
    return site.added(site.within(bar, size), (ends[0], position[1]))


def _island(site: Site, size: float, position: Position) -> Defect:
    """Add a ball that touches nothing; size is its radius."""
    middle = site.beside(position, size + 1.0)[None]
    return site.added(site.within(middle, size), position)


def _salt(site: Site, size: float, position: Position) -> Defect:
    """Flip voxels at random, the wall's and those within 1.5 mm; size is their share."""
    generator = np.random.default_rng(round(1000 * size + 100 * position[0] + 10 * position[1]))
    spots = generator.random(site.wall.shape) < size
    near = site.within(site.columns.reshape(-1, 3), 1.5)
    hit = spots & near
    added = site.added(hit, position)
    tissue = np.where(hit & site.wall, np.uint8(Tissue.BACKGROUND), added.volume.tissue)
    return Defect(volume=replace(added.volume, tissue=tissue), changed=site.points[hit])


def _protrusion(site: Site, size: float, position: Position) -> Defect:
    """Let a spike 2.5 mm long stand on the exterior wall; size is its radius."""
    spike = np.array([site.beside(position, step) for step in np.linspace(-0.3, 2.5, 15)])
    return site.added(site.within(spike, size), position)


def _leak(site: Site, size: float, position: Position, *, interior: bool = False) -> Defect:
    """Let the label leak out of a wall as a ball; size is its radius."""
    middle = site.beside(position, 0.6 * size)
    if interior:
        middle = site.column(position)[0] - 0.6 * size * site.normal(position)
    return site.added(site.within(middle[None], size), position)


def _slit(site: Site, size: float, position: Position) -> Defect:
    """Slit the wall along 4 mm of the long axis; size is the slit's width."""
    return site.erased(_gap_voxels(site, size, position[0]) & site.slab(position, 4.0))


def _gap(site: Site, size: float, position: Position) -> Defect:
    """Separate two neighboring subfields from end to end; size is the gap's width."""
    return site.erased(_gap_voxels(site, size, position[0]))


def _gap_voxels(site: Site, width: float, u: float) -> Bool:
    """Voxels of the wall within half a width of the columns at ``u``, and beyond both ends."""
    row = round(u * (site.columns.shape[0] - 1))
    cut = site.columns[row]
    over = np.linspace(0.0, 0.5 * site.length, 20)[:, None, None] * site.axis
    longer = [cut.reshape(-1, 3), (cut[-1] + over).reshape(-1, 3), (cut[0] - over).reshape(-1, 3)]
    return site.wall & site.within(np.vstack(longer), 0.5 * width)


def _missing_subfield(site: Site, size: float, position: Position) -> Defect:
    """Erase the subfield at the position; size is the length along the axis that lacks it."""
    tissue, _ = site.label(position, np.isin(site.volume.tissue, site.volume.protocol.sheet))
    return site.erased((site.volume.tissue == tissue) & site.slab(position, size))


def _missing_slices(site: Site, size: float, position: Position) -> Defect:
    """Erase all labels in the image's own slices; size is the thickness of the gap."""
    edges, along = site.voxel_axes()
    across = int(np.argmax(along))
    affine = site.volume.affine
    middle = site.column(position).mean(axis=0)
    index = np.linalg.solve(affine[:3, :3], middle - affine[:3, 3])[across]
    half = max(0.5 * size / float(edges[across]), 0.5)
    gone = np.abs(np.indices(site.wall.shape)[across] - index) <= half
    return site.erased(gone & (site.volume.tissue > 0))


def _part_inside(site: Site, size: float, position: Position, *, part: Part) -> Defect:
    """Label cross-sections in the middle as head or tail; size is their thickness."""
    where = site.slab(position, size) & (site.volume.tissue > 0)
    whole = any(
        label.part is part and label.tissue is Tissue.HIPPOCAMPUS
        for label in site.volume.protocol.labels
    )
    return site.relabeled(where, Tissue.HIPPOCAMPUS if whole else None, part)


def _cut_short(site: Site, size: float, _: Position) -> Defect:
    """Erase all labels anterior of a cross-section; size is what remains of the body, mm."""
    return site.erased((site.v * site.length > size) & (site.volume.tissue > 0))


def _notch(site: Site, size: float, position: Position) -> Defect:
    """Erase the ribbon lateral of the position; size is the notch's length along the axis."""
    lateral = site.among(site.sheet_position[:, 0] > position[0])
    return site.erased(lateral & site.slab(position, size))


def _waist(site: Site, size: float, position: Position) -> Defect:
    """Peel voxels off the wall over 4 mm of the long axis; size is the depth on each side."""
    depth = ndimage.distance_transform_edt(site.wall, sampling=site.voxel_axes()[0])
    return site.erased(site.wall & (depth <= size) & site.slab(position, 4.0))


def _wrong_voxels(site: Site, size: float, _: Position) -> Defect:
    """Stretch the voxels across the long axis, as a wrong header does; size is the factor."""
    affine = site.volume.affine.copy()
    affine[:, int(np.argmin(site.voxel_axes()[1]))] *= size
    return Defect(volume=replace(site.volume, affine=affine), changed=site.points[site.wall])


def _at_border(site: Site, size: float, _: Position) -> Defect:
    """Let the image end inside the body; size is what the body loses, mm (0: it just touches)."""
    edges, along = site.voxel_axes()
    across = int(np.argmin(along))
    last = int(site.voxels[:, across].max()) - round(size / float(edges[across]))
    box = (slice(None),) * across + (slice(0, last + 1),)
    return Defect(
        volume=replace(site.volume, tissue=site.volume.tissue[box], part=site.volume.part[box]),
        changed=site.points[(np.indices(site.wall.shape)[across] >= last) & site.wall],
    )


def _pits(site: Site, size: float, position: Position) -> Defect:
    """Drill holes of 3 x 3 x 3 voxels into the wall at random places; size is their number."""
    generator = np.random.default_rng(round(100 * position[0] + 10 * position[1]))
    inner = site.voxels[(site.v[tuple(site.voxels.T)] > 0) & (site.v[tuple(site.voxels.T)] < 1)]
    chosen = inner[generator.choice(len(inner), min(round(size), len(inner)), replace=False)]
    spots = np.zeros(site.wall.shape, dtype=bool)
    spots[tuple(chosen.T)] = True
    return site.erased(site.wall & ndimage.binary_dilation(spots, structure=CUBE))


def _rim_notch(site: Site, size: float, position: Position) -> Defect:
    """Cut a round notch into the nearer edge of the sheet; size is its radius."""
    u = 0.0 if position[0] < 0.5 else 1.0  # noqa: PLR2004 -- the middle
    column = site.column((u, position[1]))
    aside = column.mean(axis=0) - site.column((abs(u - 0.1), position[1])).mean(axis=0)
    aside /= np.linalg.norm(aside)
    rim = column[None] + np.linspace(0.0, 3.0, 13)[:, None, None] * aside
    return site.erased(site.wall & site.within(rim.reshape(-1, 3), size))


def _relabeled_tip(site: Site, size: float, position: Position) -> Defect:
    """Label the nearer edge as tissue outside over 4 mm of the axis; size is its width, mm."""
    u = site.sheet_position[:, 0]
    extent = np.linalg.norm(np.diff(site.columns.mean(axis=2), axis=0), axis=-1).sum(axis=0)
    share = size / float(np.nanmean(extent))
    tip = u < share if position[0] < 0.5 else u > 1 - share  # noqa: PLR2004 -- the middle
    return site.relabeled(site.among(tip) & site.slab(position, 4.0), Tissue.OTHER, Part.UNKNOWN)


def _ends_flush(site: Site, _size: float, _position: Position) -> Defect:
    """Erase head and tail, so that the labels end where the body does; size is ignored."""
    return site.erased(np.isin(site.volume.part, (Part.HEAD, Part.TAIL)))


def _vessel(site: Site, size: float, position: Position) -> Defect:
    """Leave a tube along 6 mm of the inner wall without a label; size is its radius."""
    half = 3.0 / site.length
    steps = np.linspace(max(position[1] - half, 0.0), min(position[1] + half, 1.0), 41)
    line = np.array([site.column((position[0], v))[0] for v in steps])
    return site.erased(site.within(line, size) & (site.volume.tissue > 0))


def _cyst(site: Site, size: float, position: Position) -> Defect:
    """Leave a ball at the inner wall without a label; size is its radius."""
    middle = site.column(position)[:1]
    return site.erased(site.within(middle, size) & (site.volume.tissue > 0))


def _stratum(site: Site, size: float, position: Position) -> Defect:
    """Leave the molecular layer within 0.15 of u without a label; size is its length, mm."""
    near = site.among(np.abs(site.sheet_position[:, 0] - position[0]) < 0.15)  # noqa: PLR2004
    layer = site.volume.tissue == Tissue.MOLECULAR_LAYER
    return site.erased(near & layer & site.slab(position, size))


def _ragged_end(site: Site, size: float, position: Position) -> Defect:
    """Let the tail label reach into the body within 0.15 of u; size is how far, mm."""
    u, v = site.sheet_position.T
    inside = site.v[tuple(site.voxels.T)] > 0
    tongue = (np.abs(u - position[0]) < 0.15) & inside & (v * site.length < size)  # noqa: PLR2004
    return site.relabeled(site.among(tongue), Tissue.HIPPOCAMPUS, Part.TAIL)


def _uncus(site: Site, size: float, _: Position, *, bridge: float) -> Defect:
    """Add CA2/3 medially of the front, joined by CA1 over ``bridge`` mm; size is its reach, mm.

    A round bar 3 mm thick, from 2 mm before the anterior end to ``size`` behind it.
    """
    medial, front = (site.column((u, 1.0)).mean(axis=0) for u in (0.0, 0.5))
    away = medial - front
    away -= (away @ site.axis) * site.axis
    away /= np.linalg.norm(away)
    offset = site.points - medial - 4.0 * away
    along = offset @ site.axis
    across = offset - along[..., None] * site.axis
    inward = -across @ away
    free = (along > -size) & (along < 2.0) & (site.volume.tissue == 0)  # noqa: PLR2004
    bar = free & (np.linalg.norm(across, axis=-1) < 1.5)  # noqa: PLR2004
    beside = np.linalg.norm(across + inward[..., None] * away, axis=-1)
    joined = free & ~bar & (beside < 1.0) & (inward > 0) & (inward < bridge)
    part = np.where(along > 0, np.uint8(Part.HEAD), np.uint8(Part.BODY))
    old, both = site.volume, bar | joined
    tissue = np.where(
        bar, np.uint8(Tissue.CA2_3), np.where(joined, np.uint8(Tissue.CA1), old.tissue)
    )
    volume = replace(old, tissue=tissue, part=np.where(both, part, old.part))
    return Defect(volume=volume, changed=site.points[both])


def _thin_edge(site: Site, size: float, position: Position) -> Defect:
    """Leave a wall of some thickness within 0.17 of the nearer edge; size is the thickness, mm."""
    u = site.sheet_position[:, 0]
    edge = u < 0.17 if position[0] < 0.5 else u > 0.83  # noqa: PLR2004 -- the middle
    middle = site.columns[:, :, site.columns.shape[2] // 2].reshape(-1, 3)
    return site.erased(site.among(edge) & ~site.within(middle, 0.5 * size))


def _half_subfield(site: Site, size: float, position: Position) -> Defect:
    """Erase the subfields of the nearer edge from the nearer end on; size is the share of v."""
    edge = MEDIAL_END if position[0] < 0.5 else LATERAL_END  # noqa: PLR2004 -- the middle
    v = site.v if position[1] < 0.5 else 1 - site.v  # noqa: PLR2004 -- the middle
    return site.erased(np.isin(site.volume.tissue, edge) & (v > -0.5) & (v < size))  # noqa: PLR2004


def _moved_end(site: Site, size: float, position: Position) -> Defect:
    """Move the border to tail or head inward, or outward if negative; size is the step, mm."""
    at_tail = position[1] < 0.5  # noqa: PLR2004 -- the middle
    depth = site.v * site.length if at_tail else (1 - site.v) * site.length
    labeled, body = site.volume.tissue > 0, site.volume.part == Part.BODY
    if size > 0:
        beyond = Part.TAIL if at_tail else Part.HEAD
        return site.relabeled(body & labeled & (depth < size), Tissue.HIPPOCAMPUS, beyond)
    nearest = ndimage.distance_transform_edt(
        ~(body & labeled),
        sampling=site.voxel_axes()[0],
        return_distances=False,
        return_indices=True,
    )
    where = ~body & labeled & (depth < 0) & (depth > size)
    at, old = tuple(nearest), site.volume
    tissue, part = (
        np.where(where, old.tissue[at], old.tissue),
        np.where(where, old.part[at], old.part),
    )
    return Defect(volume=replace(old, tissue=tissue, part=part), changed=site.points[where])


def _fissure(site: Site, size: float, position: Position) -> Defect:
    """Label what lies along 6 mm of the interior wall as CA1; size is the layer's thickness, mm."""
    count = site.columns.shape[0] - 1
    rows = slice(round((position[0] - 0.12) * count), round((position[0] + 0.12) * count))
    near = site.within(site.columns[rows, :, 0].reshape(-1, 3), size)
    where = near & ~site.wall & site.slab(position, 6.0)
    return site.relabeled(where, Tissue.CA1, Part.BODY)


#: Functions by kind of damage; their docstrings say what the size means.
DEFECTS: Mapping[str, Callable[[Site, float, Position], Defect]] = MappingProxyType(
    {
        "hole": _hole,
        "cavity": _cavity,
        "bridge-ca3-subiculum": partial(_bridge, ends=(0.92, 0.2)),
        "bridge-ca1-ca1": partial(_bridge, ends=(0.72, 0.4)),
        "island": _island,
        "salt": _salt,
        "protrusion": _protrusion,
        "leak": _leak,
        "leak-interior": partial(_leak, interior=True),
        "slit": _slit,
        "gap": _gap,
        "missing-subfield": _missing_subfield,
        "missing-slices": _missing_slices,
        "tail-inside": partial(_part_inside, part=Part.TAIL),
        "head-inside": partial(_part_inside, part=Part.HEAD),
        "cut-short": _cut_short,
        "notch": _notch,
        "waist": _waist,
        "wrong-voxels": _wrong_voxels,
        "at-border": _at_border,
        "ends-flush": _ends_flush,
        "pits": _pits,
        "rim-notch": _rim_notch,
        "relabeled-tip": _relabeled_tip,
        "vessel": _vessel,
        "cyst": _cyst,
        "stratum": _stratum,
        "ragged-end": _ragged_end,
        "thin-edge": _thin_edge,
        "half-subfield": _half_subfield,
        "moved-end": _moved_end,
        "fissure": _fissure,
        "uncus": partial(_uncus, bridge=0.0),
        "attached-uncus": partial(_uncus, bridge=3.8),
    }
)
