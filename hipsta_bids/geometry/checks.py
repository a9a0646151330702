"""What must hold before a map is handed out."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Coordinates, Flag, Float, LabelVolume, Surface, TetMesh
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.grid import in_plane_voxel
from hipsta_bids.geometry.slices import points_of_ends
from hipsta_bids.geometry.surface import mean_wall_thickness
from hipsta_bids.schemes import Part, Tissue, lateral_rank
from hipsta_bids.settings import CheckSettings, TopologySettings


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
        In-plane voxels across the sheet, whose thickness is taken as 2 volume / wall area. Where
        the longest edge of the voxels lies across the long axis, it is what counts.

    Raises
    ------
    GeometryError
        ``sheet-too-thin``.
    """
    thickness, voxel = mean_wall_thickness(surface), _voxel_across(body, settings)
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
    rank = lateral_rank(body.tissue[tuple(index[thin].T)])
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


def _swapped(medians: list[float], rank: NDArray[np.int8], kinds: NDArray[np.int8]) -> bool:
    """Whether subfields of a fair size lie in another order than their names say."""
    fair = [m for m, kind in zip(medians, kinds, strict=True) if (rank == kind).mean() > 0.03]  # noqa: PLR2004
    return any(b < a for a, b in pairwise(fair))


def _rank_correlation(x: Float, y: NDArray[np.int8]) -> float:
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


def name_subfields(body: Body) -> Callable[[Float], str]:
    """Make a function that names the subfields at (N, 3) points, RAS mm, medial first."""
    index, points = body.inside_points()
    tree, tissue = cKDTree(points), body.tissue[tuple(index.T)]

    def names(at: Float) -> str:
        found = np.unique(tissue[tree.query(at)[1]])
        return ", ".join(Tissue(int(kind)).name for kind in found)

    return names


def find_contacts(body: Body, settings: TopologySettings) -> Callable[[Float], bool]:
    """Make a function that says whether the two ends of the sheet touch at (N, 3) points, RAS mm.

    The subiculum and CA2 or CA3 are no neighbors on the sheet: where both are near, two of its
    turns touch.
    """
    trees = [cKDTree(points) for points in points_of_ends(body)]

    def touch(at: Float) -> bool:
        middle = at.mean(axis=0)
        return all(tree.n and tree.query(middle)[0] < settings.contact_reach for tree in trees)

    return touch


def name_place(points: Float, body: Body) -> str:
    """Spell the middle of (N, 3) points, RAS mm, and the subfields there."""
    middle = " ".join(f"{value:.1f}" for value in points.mean(axis=0))
    return f"RAS {middle} mm ({name_subfields(body)(points)})"


def check_image(body: Body, settings: CheckSettings) -> list[Flag]:
    """Flag images whose voxels or borders do not suit the body.

    Returns
    -------
    list of Flag
        ``slices-along-axis`` where the longest edge of the voxels lies across the long axis,
        ``image-border`` where the body reaches the border of the image.
    """
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    flags = []
    if _sliced_lengthwise(body, settings):
        flags.append(
            Flag(
                reason="slices-along-axis",
                message=f"the longest voxel edge ({edges.max():.2f} mm) lies across the long axis: "
                "check the header of the image; slices should lie across the hippocampus",
            )
        )
    index, points = body.inside_points()
    rim = ((index == 0) | (index == np.array(body.inside.shape) - 1)).any(axis=1)
    if rim.any():
        place = " ".join(f"{value:.1f}" for value in points[rim].mean(axis=0))
        flags.append(
            Flag(
                reason="image-border",
                message=f"{np.count_nonzero(rim)} voxels of the body lie at the border of the "
                f"image, near RAS {place} mm: check that the image holds all of it",
            )
        )
    return flags


def _sliced_lengthwise(body: Body, settings: CheckSettings) -> bool:
    """Whether the longest edge of the voxels is long, and lies across the long axis."""
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    longest = int(np.argmax(edges))
    along = abs(float(body.ends.axis @ body.affine[:3, longest])) / float(edges[longest])
    return bool(edges.max() > settings.slice_ratio * edges.min() and along < 0.5)  # noqa: PLR2004 -- 60 degrees


def _voxel_across(body: Body, settings: CheckSettings) -> float:
    """Edge of the voxels across the sheet, mm."""
    if _sliced_lengthwise(body, settings):
        return float(np.linalg.norm(body.affine[:3, :3], axis=0).max())
    return in_plane_voxel(body.affine)


def check_end_labels(volume: LabelVolume, body: Body, settings: CheckSettings) -> list[Flag]:
    """Flag head or tail labels in the middle of the body, and ends beyond which nothing is labeled.

    Returns
    -------
    list of Flag
        ``end-labels-inside``, ``labels-end``.
    """
    labeled = np.isin(volume.part, (Part.HEAD, Part.TAIL)) & (volume.tissue > 0)
    points = np.argwhere(labeled) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    depth = np.minimum(body.ends.height(points, "posterior"), -body.ends.height(points, "anterior"))
    inside = points[depth > settings.end_label_depth]
    flags = []
    if len(inside) > settings.end_label_share * max(len(body.inside_points()[0]), 1):
        flags.append(
            Flag(
                reason="end-labels-inside",
                message=f"{len(inside)} head or tail voxels lie inside the body, near "
                f"{name_place(inside, body)}: correct these labels",
            )
        )
    return flags + _check_beyond(volume, body, settings)


def _check_beyond(volume: LabelVolume, body: Body, settings: CheckSettings) -> list[Flag]:
    """Flag ends without head or tail labels at which all labels end."""
    labeled = (volume.tissue > 0) & (volume.tissue <= Tissue.HIPPOCAMPUS)
    points = np.argwhere(labeled) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    flags = []
    ends = body.ends
    for end, rule, height in (
        ("posterior", ends.posterior_rule, ends.height(points, "posterior")),
        ("anterior", ends.anterior_rule, -ends.height(points, "anterior")),
    ):
        if rule == "labels":
            continue
        near = points[(height > 0) & (height < settings.beyond_reach)]
        beyond = np.count_nonzero((height < 0) & (height > -settings.beyond_reach))
        if beyond < settings.beyond_share * len(near):
            flags.append(
                Flag(
                    reason="labels-end",
                    message=f"the labels end where the body does, at its {end} end near "
                    f"{name_place(near, body)}: it may be cut short there; label the whole "
                    "hippocampus",
                )
            )
    return flags
