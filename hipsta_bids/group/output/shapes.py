"""Average shapes: sheets of many participants averaged without scaling."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.derivatives.hemisphere import fill_from_nearest
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.sheet import is_left_handed
from hipsta_bids.group.cohort.collect import SheetRecord
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import visit_name
from hipsta_bids.group.output.results import Analysis, members_of
from hipsta_bids.group.settings import ShapeSettings
from hipsta_bids.io import files, gifti
from hipsta_bids.stats.arrays import Float, mean_of_known
from hipsta_bids.stats.warps import warp_values
from hipsta_bids.types import PARTICIPANT, Mesh, parts_of

#: Most turns of alignment to the mean and of the mean.
ALIGNMENT_TURNS = 50
#: They end when no point of the mean moves by more than this, mm.
ALIGNMENT_TOLERANCE = 1e-6

#: Surfaces of a sheet, in the order of the arrays here.
LAYERS = ("interior", "midthickness", "exterior")
_MIDDLE = 1
_KEYS = ("interior_surface", "midthickness_surface", "exterior_surface")


@dataclass(frozen=True, eq=False, kw_only=True)
class AverageShape:
    """Average surfaces of one hemisphere, in mm."""

    mean: Float
    """(3, x, y, 3) interior, middle and exterior, of all; axes are those of the scanner."""
    by_group: Mapping[str, Float]
    """The same of each group, aligned to ``mean``."""
    counts: Mapping[str, int]
    """Sheets by group."""

    @property
    def middle(self) -> Mesh:
        """Mean middle surface of all, closed where points are missing; y is the faster axis."""
        points = fill_from_nearest(self.mean[_MIDDLE])
        flip = is_left_handed(np.moveaxis(self.mean, 0, 2))
        triangles = gifti.sheet_triangles(*points.shape[:2], flip=flip).astype(np.int64)
        return Mesh(points=points.reshape(-1, 3), triangles=triangles)


def average_shape(
    layers: Float,
    warps: Float,
    members: Mapping[str, NDArray[np.bool_]],
    *,
    visible: NDArray[np.bool_] | None = None,
) -> AverageShape:
    """Average surfaces at registered nodes, after rigid alignment (generalized Procrustes).

    Each middle surface is rotated and moved to the mean of all, iteratively (Gower 1975), and the
    walls with it; nothing is scaled or mirrored. ``layers`` (sheets, 3, x, y, 3) are the surfaces
    in mm, NaN where missing; ``visible`` (sheets, x, y) marks registered nodes with a value.
    """
    n, _, nx, ny, _ = layers.shape
    # Along x, so that all other axes count as one.
    flat = np.moveaxis(layers, 2, 1).reshape(n, nx, -1)
    registered = np.moveaxis(warp_values(flat, warps).reshape(n, nx, len(LAYERS), ny, 3), 1, 2)
    if visible is not None:
        registered = np.where(visible[:, None, :, :, None], registered, np.nan)
    middle = registered[:, _MIDDLE].reshape(n, -1, 3)
    rotations, centers, center = align_rigidly(middle)
    moved = registered.reshape(n, -1, 3) - centers[:, None]
    moved = (moved @ np.swapaxes(rotations, 1, 2) + center).reshape(registered.shape)
    return AverageShape(
        mean=mean_of_known(moved, 0),
        by_group={
            name: mean_of_known(moved[rows], 0) for name, rows in members.items() if rows.any()
        },
        counts={name: int(rows.sum()) for name, rows in members.items() if rows.any()},
    )


def align_rigidly(points: Float) -> tuple[Float, Float, Float]:
    """Rotations (shapes, 3, 3) and centers (shapes, 3) of shapes, and the mean center.

    ``points`` is (shapes, points, 3) in mm, NaN where missing.
    """
    present: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=2))
    common = present.all(axis=0)
    # Centers of the same points, if there are any that all have.
    weights = (present & common if common.any() else present).astype(np.float64)
    values = np.where(present[:, :, None], points, 0.0)
    centers = np.einsum("sp,spi->si", weights, values) / weights.sum(axis=1)[:, None]
    values = np.where(present[:, :, None], values - centers[:, None], 0.0)
    mean = values[0]
    rotations = np.tile(np.eye(3), (len(values), 1, 1))
    count = np.maximum(present.sum(axis=0), 1)[:, None]
    for _ in range(ALIGNMENT_TURNS):
        # Rotations of each shape that bring it closest to the mean (Kabsch 1976).
        rotations = _nearest_rotation(np.einsum("pi,spj->sij", mean, values))
        before, mean = mean, np.einsum("sij,spj->pi", rotations, values) / count
        if np.abs(mean - before).max() < ALIGNMENT_TOLERANCE:
            break
    # Undo the mean rotation, so that the mean is oriented as the shapes were.
    inverse = _nearest_rotation(rotations.mean(axis=0))
    return inverse.T @ rotations, centers, centers.mean(axis=0)


def _nearest_rotation(matrix: Float) -> Float:
    left, _, right = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.linalg.det(left @ right)
    return np.asarray((left * sign[..., None, :]) @ right, dtype=np.float64)


def _read_layers(places: Sequence[ResultPlace], shape: tuple[int, int]) -> tuple[list[int], Float]:
    """Read the surfaces (sheets, 3, x, y, 3) in mm of the sheets that have all of them."""
    read_rows, layers = [], []
    for i, result in enumerate(places):
        try:
            surfaces = [gifti.read_mesh(result.path(key)).points for key in _KEYS]
        except InputError:  # maps and statistics do without it
            continue
        if all(surface.shape == (shape[0] * shape[1], 3) for surface in surfaces):
            read_rows.append(i)
            layers.append(np.stack(surfaces).reshape(len(_KEYS), *shape, 3))
    return read_rows, np.array(layers, dtype=np.float64).reshape(-1, len(_KEYS), *shape, 3)


def average_shapes(
    records: Sequence[SheetRecord], cohort: Cohort, analysis: Analysis, settings: ShapeSettings
) -> dict[str, AverageShape]:
    """Average the surfaces of each hemisphere, of the first visit of each participant."""
    names = [(record.result.name, record.result) for record in records]
    result_of = {
        (visit_name(name.subject, name.session), name.hemi): result for name, result in names
    }
    shapes = {}
    for hemi, side in analysis.registered.items() if records else ():
        visits = cohort.table.iloc[side.rows]
        first = np.flatnonzero(~visits[PARTICIPANT].duplicated().to_numpy())
        count = min(len(first), settings.most)
        rows = first[np.linspace(0, len(first) - 1, count).round().astype(np.int64)]
        keys = [(str(name), hemi) for name in visits.index[rows]]
        rows = rows[[key in result_of for key in keys]]
        places = [result_of[key] for key in keys if key in result_of]
        read, layers = _read_layers(places, side.shape)
        if not read:
            continue
        rows_read = rows[read]
        members = members_of(analysis, visits.iloc[rows_read])
        warps = analysis.registrations[hemi].warps[rows_read]
        visible = None
        if parts_of(cohort.y) is not None:  # nodes without values have positions for display alone
            visible = np.isfinite(next(iter(side.maps.values()))[rows_read])
        shapes[hemi] = average_shape(layers, warps, members, visible=visible)
    return shapes


def write_shapes(folder: Path, shapes: Mapping[str, AverageShape]) -> None:
    """Write the average middle surfaces, on which maps of statistics can be drawn."""
    for hemi, shape in shapes.items():
        mesh = shape.middle
        content = gifti.surface_bytes(
            mesh.points,
            mesh.triangles.astype(np.int32),
            hemi=hemi,
            secondary="MidThickness",
            unfolded=False,
        )
        files.write_bytes(folder / f"hemi-{hemi}_desc-average_midthickness.surf.gii", content)
