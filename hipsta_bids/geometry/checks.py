"""What must hold before a map is written, and what a person should look at.

Labels with noise or thin gaps, cross-sections that do not resemble their neighbors, and coordinates
that contradict the labels. What the sheet itself shows is in ``sheet_checks``. Findings
become flags here, with their place and what they mean for the map.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from hipsta_bids import types
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import digital
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.grid import Field, cut_across, in_plane_voxel
from hipsta_bids.geometry.label_checks import border_sides
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.geometry.mesh import mean_wall_thickness
from hipsta_bids.geometry.slices import points_of_ends
from hipsta_bids.protocols.protocol import Part, Tissue, lateral_rank
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import Bool, Finding, Flag, Float, Sheet

#: A flag concerns the columns within this distance of a finding, mm.
FLAG_REACH = 1.0

#: A cut this near, mm, to both the subiculum and CA2 or CA3 severs but turns that touch.
CONTACT_REACH = 1.2
#: Probabilities that contradict this share of the body's voxels, away from its border, are flagged.
UNLIKE_SHARE = 0.02
#: Voxels are long if their longest edge is more than this many times the shortest.
LONG_VOXEL_RATIO = 1.5
#: Head or tail labels farther inside the body than this are out of place, mm.
END_LABEL_DEPTH = 2.0
#: Labels are counted within this distance on both sides of an end plane, mm.
BEYOND_REACH = 3.0
#: Flag an end without a label if fewer lie beyond it than this share of those before it.
BEYOND_SHARE = 0.7
#: A cross-section is compared with those at these distances on both sides, mm.
NOTCH_REACH = (1.0, 2.0, 3.0)
#: Cross-sections are compared without nodes this near to a bridge that was cut, grid nodes.
STUB_NODES = 6.0
#: Share of the area by which cross-sections usually differ, per mm (interior: in all); and so many
#: times more as a slice is thicker than a millimeter, since a person draws each slice anew.
SECTION_NOISE = 0.02


def check_voxels_across(surface: types.Surface, body: Body, settings: CheckSettings) -> float:
    """Refuse a sheet that is too thin for its voxels; return its thickness in voxels."""
    thickness, voxel = mean_wall_thickness(surface), voxel_across(body)
    across = thickness / voxel
    if across < settings.min_voxels_across:
        raise GeometryError(
            f"the sheet is about {thickness:.1f} mm thick, {across:.1f} voxels of {voxel:.2f} mm; "
            f"{settings.min_voxels_across:g} are needed: use a finer segmentation",
            reason="sheet-too-thin",
        )
    return across


def check_label_order(
    mesh: types.TetMesh, coordinates: types.Coordinates, body: Body, settings: CheckSettings
) -> float:
    """Refuse coordinates that do not follow the medial-to-lateral order of the subfields.

    The rank correlation is returned; NaN with one subfield.
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
    # Subfields with a few voxels only may lie anywhere.
    fair = [kind for kind in kinds if (rank == kind).mean() > 0.03]  # noqa: PLR2004
    medians = [float(np.median(x[rank == kind])) for kind in fair]
    swapped = any(b < a for a, b in pairwise(medians))
    if not order >= settings.min_label_order or swapped:
        raise GeometryError(
            "the subfields are not in order from medial to lateral (rank correlation "
            f"{order:.2f}); check the protocol",
            reason="label-order",
        )
    return order


def _rank_correlation(x: Float, y: NDArray[np.int8]) -> float:
    """Spearman's rank correlation, ties at their mean rank (scipy.stats takes 1.6 s to import)."""
    ranks = []
    for values in (x, y):
        _, inverse, count = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(count) - 0.5 * (count - 1))[inverse])
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def check_thickness(thickness: Float, expected: float, settings: CheckSettings) -> list[Finding]:
    """Compare the mean thickness with 2 volume / area of the two sides, ``expected`` mm."""
    mean = float(np.nanmean(thickness))
    ratio = abs(mean / expected - 1)
    text = f"mean thickness {mean:.2f} mm, but 2 volume / area is {expected:.2f} mm"
    if not ratio <= settings.max_thickness_ratio:
        raise GeometryError(
            f"{text}: the map would be wrong; check the labels for bridges and missing parts",
            reason="thickness-implausible",
        )
    return [
        Finding(
            reason="thickness-doubtful",
            value=ratio,
            limit=settings.flag_thickness_ratio,
            text=text,
            remedy="look at the map",
            share=1.0,
            change=mean - expected,
        )
    ]


def name_subfields(body: Body) -> Callable[[Float], str]:
    """Make a function that names the subfields at (N, 3) points, RAS mm, medial first."""
    tissue = body.tissue[body.inside]

    def names(at: Float) -> str:
        kinds = np.unique(tissue[body.nearest(at)])
        return ", ".join(Tissue(int(kind)).name for kind in kinds)

    return names


def find_contacts(body: Body) -> Callable[[Float], bool]:
    """Make a function that checks whether the two ends of the sheet touch at (N, 3) points, RAS mm.

    The subiculum and CA2 or CA3 are no neighbors on the sheet: where both are near, two of its
    turns touch.
    """
    trees = [cKDTree(points) for points in points_of_ends(body)]

    def touch(at: Float) -> bool:
        middle = at.mean(axis=0)
        return all(tree.n and tree.query(middle)[0] < CONTACT_REACH for tree in trees)

    return touch


def name_place(points: Float, body: Body) -> str:
    """Write the middle of (N, 3) points, RAS mm, and the subfields there."""
    return types.position_text(points.mean(axis=0), name_subfields(body)(points))


def check_image(body: Body) -> list[Finding]:
    """Flag images whose voxels or borders do not suit the body."""
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    index, points = body.inside_points()
    outer = ((index == 0) | (index == np.array(body.inside.shape) - 1)).any(axis=1)
    return [
        Finding(
            reason="slices-along-axis",
            value=0.0 if cut_across(body) else float(edges.max() / edges.min()),
            limit=LONG_VOXEL_RATIO,
            text=f"the longest voxel edge ({edges.max():.2f} mm) lies across the long axis",
            remedy="check the header of the image; slices should lie across the hippocampus",
            share=1.0,
        ),
        Finding(
            reason="image-border",
            value=float(np.count_nonzero(outer)),
            limit=0,
            text=f"{np.count_nonzero(outer)} voxels of the body lie at the "
            f"{border_sides(body.inside, body.affine)} border of the image",
            remedy="if it cuts them, use a larger image",
            points=points[outer],
        ),
        *([_check_probabilities(body, body.soft.unlike)] if body.soft else []),
    ]


def _check_probabilities(body: Body, unlike: digital.Index) -> Finding:
    """Flag probabilities that contradict the labels (N, 3) away from their border."""
    share = len(unlike) / max(int(np.count_nonzero(body.inside)), 1)
    return Finding(
        reason="probabilities-unlike",
        value=share,
        limit=UNLIKE_SHARE,
        text=f"probabilities contradict {share:.1%} of the labels, more than a voxel from the wall",
        remedy="check that one run made labels and probabilities",
        points=digital.to_ras(unlike, body.affine),
    )


def voxel_across(body: Body) -> float:
    """Edge of the voxels across the sheet, mm: the longest one if slices lie along the axis."""
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    if edges.max() > LONG_VOXEL_RATIO * edges.min() and not cut_across(body):
        return float(edges.max())
    return in_plane_voxel(body.affine)


def check_end_labels(
    volume: types.LabelVolume, body: Body, settings: CheckSettings
) -> list[Finding]:
    """Flag head or tail labels amid the body, and ends beyond which nothing is labeled."""
    labeled = np.isin(volume.part, (Part.HEAD, Part.TAIL)) & (volume.tissue > 0)
    points = digital.voxel_points(labeled, volume.affine)
    inside = points[body.ends.depth(points) > END_LABEL_DEPTH]
    amid = Finding(
        reason="end-labels-inside",
        value=len(inside) / max(len(body.inside_points()[0]), 1),
        limit=settings.end_label_share,
        text=f"{len(inside)} head or tail voxels lie inside the body",
        remedy="correct these labels",
        points=inside,
    )
    return [amid, *_check_beyond(volume, body)]


def _check_beyond(volume: types.LabelVolume, body: Body) -> list[Finding]:
    """Flag ends without head or tail labels at which the labels of the sheet end.

    The dentate gyrus and CA4 end before the sheet does, which closes behind them in the tail.
    """
    labeled = (volume.tissue > 0) & (volume.tissue <= Tissue.HIPPOCAMPUS)
    protocol = volume.protocol
    labeled &= ~np.isin(volume.tissue, list({*protocol.interior} - {*protocol.layer}))
    points = digital.voxel_points(labeled, volume.affine)
    ends = body.ends
    sides: tuple[types.End, ...] = ("posterior", "anterior")
    return [
        Finding(
            reason="labels-end",
            value=1 - _share_beyond(depth, ends.half_slice),
            limit=1 - BEYOND_SHARE,
            text=f"the labels of the sheet end at the {end} end of the body",
            remedy="label the whole hippocampus, or check where the labels were cut",
            points=points[(depth > 0) & (depth < BEYOND_REACH)],
        )
        for end, depth in zip(sides, ends.depths(points), strict=True)
        if ends[end].rule not in ("labels", "user")
    ]


def _share_beyond(depth: Float, half_slice: float) -> float:
    """Volume beyond a plane over that before it, near it, of voxels at depths (N,), mm.

    A voxel reaches ``half_slice`` to both sides: a thick slice lies partly within reach.
    """
    beyond, before = (
        np.clip(
            np.minimum(way * depth + half_slice, BEYOND_REACH)
            - np.maximum(way * depth - half_slice, 0),
            0,
            None,
        ).sum()
        for way in (-1, 1)
    )
    return float(beyond / before) if before else 0.0


def describe_uncus(body: Body, settings: CheckSettings) -> list[str]:
    """Note that the uncus was excluded from the sheet; warn if it begins far behind the head."""
    if not len(body.uncus):
        return []
    points = digital.to_ras(body.uncus, body.affine)
    volume = len(points) * body.voxel_volume
    reach = float(-body.ends.height(points, "anterior").min())
    far = f"; it begins {reach:.1f} mm behind the anterior end: check where the head begins"
    warning = far if reach > settings.uncus_reach else ""
    return [f"the uncus was excluded, {volume:.0f} mm3 at {name_place(points, body)}{warning}"]


def check_cavities(body: Body, settings: CheckSettings) -> list[Finding]:
    """Flag large cavities that were too wide to assign to one side."""
    size = max(len(body.inside_points()[0]), 1)
    return [
        Finding(
            reason="wide-cavity",
            value=len(cavity) / size,
            limit=settings.flag_cavity,
            text=f"a cavity of {len(cavity) * body.voxel_volume:.0f} mm3 without a label was "
            f"divided; the mean may be off by {len(cavity) / size / 2:.0%}",
            remedy="label the cavity",
            points=digital.to_ras(cavity, body.affine),
        )
        for cavity in body.cavities.wide
    ]


def check_labels(body: Body, settings: CheckSettings) -> list[Finding]:
    """Flag noise and thin gaps in the labels, which smoothing hides from the later steps."""
    around = digital.box_around(body.inside_points()[0])
    low = digital.low_corner(around) - 1
    sheet = np.pad(body.tissue[around] > 0, 1)
    within = np.pad(body.inside[around], 1)
    # Single voxels with the sheet on five or six of their sides, next to voxels of the body.
    sides = sum(
        np.roll(within, step, axis).astype(np.int8) for axis in range(3) for step in (-1, 1)
    )
    near = digital.widened(within)
    pinholes = digital.positions(~sheet & near & (sides >= 5))  # noqa: PLR2004 -- of six faces
    noise = len(pinholes) / int(np.count_nonzero(within))
    # The second piece of voxels that share faces.
    pieces, _ = ndimage.label(within, structure=digital.FACES)
    sizes = digital.piece_sizes(pieces)
    second = int(np.argsort(sizes)[-2])
    loose = float(sizes[second]) / float(sizes.sum())
    rows = (
        (
            "noisy-labels",
            (noise, settings.flag_pinholes),
            f"the labels are noisy: {noise:.1%} of the sheet are single voxels without a label",
            pinholes + low,
            "smooth or correct the labels",
        ),
        (
            "thin-gap",
            (float(len(body.gap)), float(settings.flag_gap)),
            f"a thin gap of {len(body.gap)} voxels without a label divides the sheet",
            body.gap,
            "fill the gap in the labels",
        ),
        (
            "loose-part",
            (loose, settings.flag_loose_part),
            f"{loose:.0%} of the sheet touches the rest at no face of a voxel",
            digital.positions(pieces == second) + low if loose else np.zeros((0, 3)),
            "fill the gap in the labels",
        ),
    )
    return [
        Finding(
            reason=reason,
            value=value,
            limit=limit,
            text=text,
            remedy=remedy,
            points=digital.to_ras(voxels, body.affine),
        )
        for reason, (value, limit), text, voxels, remedy in rows
    ]


#: What is wrong with a cross-section, and the remedy, by reason.
_SECTIONS = {
    "section-notch": ("lacks a part that its neighbors have", "complete the labels there"),
    "section-bump": ("has a part that its neighbors lack", "look for leaks and bridges there"),
    "section-intrusion": (
        "has the sheet between interior labels of its neighbors",
        "look for bridges there",
    ),
}


def check_cross_sections(
    field: Field, slice_step: float, settings: CheckSettings, cuts: Bool | None = None
) -> list[Finding]:
    """Flag a body of which a part is missing between cross-sections that have it, or added.

    Each cross-section is compared with two others, at a distance on both sides. What both lack, or
    where both have interior labels, is compared with the same body's other cross-sections: a bent
    ribbon moves sideways everywhere, a leak is in one position. ``slice_step`` is the distance of
    slices, mm; ``cuts`` are nodes of bridges that were cut, whose stumps do not count, nor do
    cavities that were filled.
    """
    solid = field.values > 0
    interior = np.zeros_like(solid) if field.interior is None else field.interior
    counted = np.ones_like(solid)
    if cuts is not None and cuts.any():
        counted = ndimage.distance_transform_edt(~cuts) > STUB_NODES
    if field.cavities is not None:
        counted &= ~digital.widened(digital.widened(field.cavities))
    levels = slice(field.beyond, solid.shape[2] - field.beyond)
    solid, interior, counted = (part[:, :, levels] for part in (solid, interior, counted))
    step = field.grid.step
    area = float(np.median(solid.sum(axis=(0, 1))))
    notch, bump, intrusion = _Outlier(), _Outlier(), _Outlier()
    for reach, limit in zip(NOTCH_REACH, settings.notch_share, strict=True):
        k = max(round(reach / step), 1)
        if 2 * k >= solid.shape[2]:
            continue
        before, current, after = solid[:, :, : -2 * k], solid[:, :, k:-k], solid[:, :, 2 * k :]
        missing = before & after & ~current
        lacking = missing.sum(axis=(0, 1)) / current.sum(axis=(0, 1))
        notch.update(missing, lacking, limit, k + field.beyond)
        unexplained = current & counted[:, :, k:-k]
        enclosed = unexplained & interior[:, :, : -2 * k] & interior[:, :, 2 * k :]
        added = unexplained & ~before & ~after
        noise = SECTION_NOISE * max(slice_step, 1.0)
        for outlier, part, least, contrast in (
            (bump, added, noise * reach, settings.bump_contrast),
            (intrusion, enclosed, noise, settings.intrusion_contrast),
        ):
            share = part.sum(axis=(0, 1)) / area
            usual = contrast * (float(np.median(share)) + least)
            outlier.update(part, share, usual, k + field.beyond)
    return [
        Finding(
            reason=reason,
            value=outlier.share,
            limit=outlier.limit,
            text=f"a cross-section {_SECTIONS[reason][0]}, {outlier.share:.0%} of its area",
            remedy=_SECTIONS[reason][1],
            points=field.grid.to_ras(outlier.nodes),
        )
        for reason, outlier in zip(_SECTIONS, (notch, bump, intrusion), strict=True)
    ]


class _Outlier:
    """The cross-section that departs most from its neighbors."""

    share = 0.0
    """Share of its area that departs."""
    limit = 1.0
    """Limit of that share."""
    nodes: Float = np.zeros((0, 3))
    """Grid nodes (N, 3) that depart."""

    def update(self, part: Bool, share: Float, limit: float, first: int) -> None:
        """Take over the cross-section that departs most, if more than before."""
        at = int(share.argmax())
        if share[at] / limit > self.share / self.limit:
            self.share, self.limit = float(share[at]), limit
            nodes = digital.positions(part[:, :, at]).astype(float)
            self.nodes = np.column_stack([nodes, np.full(len(nodes), at + first)])


def flag_margins(findings: Sequence[Finding]) -> dict[str, float]:
    """Largest value over limit by reason; above 1 is flagged."""
    margins: dict[str, float] = {}
    for finding in findings:
        margins[finding.reason] = max(finding.margin, margins.get(finding.reason, 0.0))
    return margins


def raise_flags(
    findings: Sequence[Finding], sheet: Sheet, position: Callable[[Float], str]
) -> list[Flag]:
    """Turn findings beyond their limits into flags, with place and consequence for the map.

    ``position`` writes the place of (N, 3) points, RAS mm.
    """
    flags = []
    for finding in findings:
        if finding.raised:
            consequence = add_consequence(finding, sheet)
            location = (
                f", near {position(finding.points)}"
                if len(finding.points) and not finding.placed
                else ""
            )
            flags.append(
                Flag(
                    reason=finding.reason,
                    message=f"{finding.text}{location}: {finding.remedy}",
                    value=float(finding.value),
                    limit=float(finding.limit),
                    points=finding.points,
                    share=consequence.share,
                    change=consequence.change,
                )
            )
    return flags


def add_consequence(finding: Finding, sheet: Sheet) -> Finding:
    """Add the share of the columns that the points of a finding concern, and its consequence.

    The mean thickness, weighted by area, is compared with a map in which the columns near these
    points have values of their neighbors. A share that is known already is left as it is.
    """
    if not len(finding.points) or not np.isnan(finding.share):
        return finding
    near = columns_near(sheet, finding.points, FLAG_REACH)
    return replace(finding, share=float(near.mean()), change=change_of_mean(sheet, near))


def change_of_mean(sheet: Sheet, concerned: Bool) -> float:
    """Compute how much larger the mean thickness is than with the neighbors of columns (Nx, Ny).

    In mm, weighted by area; NaN if all columns are concerned.
    """
    thickness, area = measure_thickness(sheet), column_area(sheet)
    valid = np.isfinite(thickness) & np.isfinite(area)
    if not (valid & ~concerned).any():
        return float("nan")
    step = np.where(concerned, thickness - spread_over(thickness, concerned | ~valid), 0.0)[valid]
    return float((step * area[valid]).sum() / area[valid].sum())


def columns_near(sheet: Sheet, points: Float, reach: float) -> Bool:
    """Columns (Nx, Ny) of which any point lies within ``reach`` mm of points (N, 3)."""
    valid = np.isfinite(sheet.points).all(axis=-1)
    near = np.zeros(valid.shape, dtype=bool)
    gap = cKDTree(points).query(sheet.points[valid], distance_upper_bound=reach)[0]
    near[valid] = np.isfinite(gap)
    return np.asarray(near.any(axis=2))


def spread_over(values: Float, mask: Bool) -> Float:
    """Replace values (Nx, Ny) by the smoothest continuation of the others, a harmonic function."""
    inner, outer = np.flatnonzero(mask), np.flatnonzero(~mask)
    result = values.ravel().copy()
    if len(inner) and len(outer):
        rows = _grid_laplace(values.shape)[inner]
        result[inner] = spsolve(rows[:, inner].tocsc(), -rows[:, outer] @ result[outer])
    return np.asarray(result.reshape(values.shape))


@lru_cache(maxsize=1)
def _grid_laplace(shape: tuple[int, int]) -> sparse.csr_array:
    """Laplace operator of the graph of columns."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
    second = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    edges = sparse.coo_array((np.ones(first.size), (first, second)), shape=(number.size,) * 2)
    weights = (edges + edges.T).tocsr()
    return sparse.csr_array(sparse.diags_array(weights.sum(axis=1)) - weights)
