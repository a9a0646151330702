"""What must hold before a map is handed out."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Coordinates, Flag, Float, Surface, TetMesh
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.grid import in_plane_voxel
from hipsta_bids.geometry.surface import mean_wall_thickness
from hipsta_bids.settings import CheckSettings


def check_voxels_across(surface: Surface, body: Body, settings: CheckSettings) -> float:
    """Refuse a sheet that is too thin for its voxels.

    Parameters
    ----------
    surface : Surface
    body : Body
    settings : CheckSettings

    Returns
    -------
    float
        In-plane voxels across the sheet, whose thickness is taken as 2 volume / wall area.

    Raises
    ------
    GeometryError
        ``sheet-too-thin``.
    """
    thickness, voxel = mean_wall_thickness(surface), in_plane_voxel(body.affine)
    across = thickness / voxel
    if across < settings.min_voxels_across:
        raise GeometryError(
            f"the sheet is about {thickness:.1f} mm thick, {across:.1f} voxels of {voxel:.2f} mm; "
            f"{settings.min_voxels_across:g} are needed: use a finer segmentation",
            reason="sheet-too-thin",
        )
    return across


def check_label_order(
    mesh: TetMesh, coordinates: Coordinates, body: Body, settings: CheckSettings
) -> float:
    """Refuse coordinates that do not follow the medial-to-lateral order of the subfields.

    Returns
    -------
    float
        Spearman correlation of x with the labels' rank over voxels; NaN with one subfield.

    Raises
    ------
    GeometryError
        ``label-order``.
    """
    index, points = body.inside_points()
    thin = slice(None, None, max(len(points) // 5000, 1))  # some thousand voxels are plenty
    rank = body.tissue[tuple(index[thin].T)]
    kinds = np.unique(rank)
    if len(kinds) == 1:
        return float("nan")
    _, nearest = cKDTree(mesh.vertices).query(points[thin])
    x = coordinates.values[nearest, 0]
    order = _rank_correlation(x, rank)
    medians = [float(np.median(x[rank == kind])) for kind in kinds]
    if not order >= settings.min_label_order or _swapped(medians, rank, kinds):
        raise GeometryError(
            f"the subfields do not follow each other from medial to lateral (rank correlation "
            f"{order:.2f}): check that the scheme fits the labels",
            reason="label-order",
        )
    return order


def _swapped(medians: list[float], rank: NDArray[np.uint8], kinds: NDArray[np.uint8]) -> bool:
    """Whether subfields of a fair size lie in another order than their names say."""
    fair = [m for m, kind in zip(medians, kinds, strict=True) if (rank == kind).mean() > 0.03]  # noqa: PLR2004
    return any(b < a for a, b in pairwise(fair))


def _rank_correlation(x: Float, y: NDArray[np.uint8]) -> float:
    """Spearman's rank correlation, ties at their mean rank (scipy.stats takes 1.6 s to import)."""
    ranks = []
    for values in (x, y):
        _, place, count = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(count) - 0.5 * (count - 1))[place])
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def check_thickness(thickness: Float, expected: float, settings: CheckSettings) -> list[Flag]:
    """Compare the mean thickness with 2 volume / area of the two sides.

    Parameters
    ----------
    thickness : (Nx, Ny) array, mm
    expected : float
        mm

    Returns
    -------
    list of Flag

    Raises
    ------
    GeometryError
        ``thickness-implausible``.
    """
    mean = float(np.nanmean(thickness))
    ratio = abs(mean / expected - 1)
    text = f"mean thickness {mean:.2f} mm, but 2 volume / area is {expected:.2f} mm"
    if not ratio <= settings.max_thickness_ratio:
        raise GeometryError(
            f"{text}: the map would be wrong; check the labels for bridges and missing parts",
            reason="thickness-implausible",
        )
    if ratio > settings.flag_thickness_ratio:
        return [Flag(reason="thickness-doubtful", message=f"{text}: look at the map")]
    return []
