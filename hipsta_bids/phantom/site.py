"""A hippocampal body with known places on its sheet, whose labels can be changed."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, LabelVolume, Sheet
from hipsta_bids.schemes import Part, Tissue

Place = tuple[float, float]
"""Sheet coordinates (u, v), each from 0 to 1: medial to lateral, posterior to anterior."""

#: Refinement of the sheet's grid along x, y and z, so that its points lie closer than voxels.
_FINER = (3, 3, 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class Defect:
    """A damaged segmentation."""

    volume: LabelVolume
    changed: Float
    """(N, 3) centers of the changed voxels, RAS mm (where the undamaged image has them)."""


class Site:
    """A body whose labels can be damaged.

    Parameters
    ----------
    volume : LabelVolume
        Undamaged labels.
    sheet : Sheet
        Measured in them; it tells where (u, v) is.
    """

    def __init__(self, volume: LabelVolume, sheet: Sheet) -> None:
        self.volume = volume
        self.columns = _refined(sheet.points)
        index = np.indices(volume.tissue.shape).reshape(3, -1).T
        points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
        self.points: Float = points.reshape(*volume.tissue.shape, 3)
        owners = (*volume.scheme.sheet, *volume.scheme.layer)
        self.wall: Bool = np.isin(volume.tissue, owners)
        """(I, J, K) voxels that become the ribbon, anywhere along the hippocampus."""
        ends = sheet.points[:, [0, -1]].mean(axis=(0, 2))
        self.axis: Float = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        """(3,) unit vector from posterior to anterior."""
        self.length = float(np.linalg.norm(ends[1] - ends[0]))
        """mm between the middles of the two end planes."""
        along = (self.points - ends[0]) @ self.axis
        self.v: Float = along / self.length
        """(I, J, K) share of the way from the posterior to the anterior end."""
        body = self.wall & (self.v > -0.2) & (self.v < 1.2)  # noqa: PLR2004 -- oblique ends too
        self.voxels = np.argwhere(body)
        """(N, 3) indices of the wall's voxels in and near the body."""
        count = np.array(self.columns.shape[:2])
        tree = cKDTree(self.columns.reshape(-1, 3))
        _, nearest = tree.query(self.points[body])
        column = np.unravel_index(nearest, self.columns.shape[:3])[:2]
        self.sheet_place: Float = np.stack(column, axis=1) / (count - 1)
        """(N, 2) sheet coordinates of these voxels."""

    def column(self, place: Place) -> Float:
        """Points (Nz, 3), RAS mm, of the column at a place, interior to exterior."""
        count = np.array(self.columns.shape[:2])
        i, j = np.rint(np.array(place) * (count - 1)).astype(int)
        return np.asarray(self.columns[i, j])

    def normal(self, place: Place) -> Float:
        """Find the unit vector (3,) from interior to exterior."""
        column = self.column(place)
        return np.asarray((column[-1] - column[0]) / np.linalg.norm(column[-1] - column[0]))

    def beside(self, place: Place, distance: float) -> Float:
        """Point (3,) at a distance (mm) outside the exterior wall; inside of it if negative."""
        return np.asarray(self.column(place)[-1] + distance * self.normal(place))

    def within(self, points: Float, radius: float) -> Bool:
        """Voxels (I, J, K) within a radius (mm) of any of (N, 3) points."""
        low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
        box = ((self.points >= low) & (self.points <= high)).all(axis=-1)
        found = np.zeros(box.shape, dtype=bool)
        distance, _ = cKDTree(points).query(self.points[box])
        found[box] = distance <= radius
        return found

    def among(self, chosen: Bool) -> Bool:
        """Voxels (I, J, K) of the wall chosen by a mask (N,) over :attr:`voxels`."""
        found = np.zeros(self.wall.shape, dtype=bool)
        found[tuple(self.voxels[chosen].T)] = True
        return found

    def slab(self, place: Place, thickness: float) -> Bool:
        """Voxels (I, J, K) of whole cross-sections, ``thickness`` mm along the axis."""
        return np.abs(self.v - place[1]) * self.length <= thickness / 2

    def erased(self, where: Bool) -> Defect:
        """Turn voxels into background."""
        return self.relabeled(where, Tissue.BACKGROUND, Part.UNKNOWN)

    def relabeled(self, where: Bool, tissue: Tissue | None, part: Part) -> Defect:
        """Give voxels another label; ``None`` keeps the tissue."""
        old = self.volume
        codes = old.tissue if tissue is None else np.where(where, np.uint8(tissue), old.tissue)
        parts = np.where(where, np.uint8(part), old.part)
        changed = (codes != old.tissue) | (parts != old.part)
        return Defect(volume=replace(old, tissue=codes, part=parts), changed=self.points[changed])

    def added(self, where: Bool, place: Place) -> Defect:
        """Give voxels outside the wall the label of the wall at a place."""
        middle = self.column(place)[len(self.columns[0, 0]) // 2]
        nearest = np.argmin(np.linalg.norm(self.points[self.wall] - middle, axis=1))
        tissue = Tissue(int(self.volume.tissue[self.wall][nearest]))
        part = Part(int(self.volume.part[self.wall][nearest]))
        return self.relabeled(where & ~self.wall, tissue, part)


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
