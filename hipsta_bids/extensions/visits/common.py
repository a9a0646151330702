"""All visits of one side of a participant on one sheet: the sheet of their mean labels.

The labels of the visits are aligned and averaged, and the mean is unfolded once. So its end planes,
boundaries and coordinates hold for all visits. Each visit has its own walls, which are found along
the columns of the common sheet.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from nibabel.affines import apply_affine

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.visits import carry
from hipsta_bids.extensions.visits.align import align
from hipsta_bids.extensions.visits.average import average_labels
from hipsta_bids.geometry import catalog, checks, columns, repairs
from hipsta_bids.geometry.body import Body, check_side, extract_body, relabel_by_mask
from hipsta_bids.geometry.digital import voxel_points
from hipsta_bids.geometry.ends import EndPlanes, hippocampal_voxels
from hipsta_bids.geometry.grid import Field, resample_body
from hipsta_bids.geometry.label_checks import check_label_image
from hipsta_bids.geometry.measures import bending_angle, subfield_volumes
from hipsta_bids.geometry.topology import SolidField, repaired_columns
from hipsta_bids.participant import measure
from hipsta_bids.participant.evidence import Evidence, describe_repair, find_all
from hipsta_bids.participant.measure import Clock
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import (
    Bool,
    Coordinates,
    End,
    Finding,
    Float,
    GivenEnd,
    HemisphereMaps,
    LabelVolume,
    Sheet,
)

#: A visit whose walls lie farther from the mean's is flagged: RMS over both walls, mm. Walls that
#: are not found count as the largest distance.
FLAG_DISTANCE = 0.35
#: A visit whose body overlaps less with the mean's is flagged (Dice's coefficient).
FLAG_OVERLAP = 0.8
#: Walls at least this far from the mean's are the place of a visit that does not fit, mm.
FAR = 0.5

_PAIR = 2  # visits of which none can be told to be the wrong one
_ENDS: tuple[End, ...] = ("posterior", "anterior")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Visit(catalog.Measured):
    """The common sheet at the walls of a visit."""

    coordinates: Coordinates
    """Of the vertices of the mesh."""
    factors: dict[Tissue, float]
    """Volume of each subfield of the mean over the volume of its cells, which lack the rounded
    edges."""

    @cached_property
    def volumes(self) -> dict[Tissue, float]:
        """Volume of each subfield, mm3: the mean's volume, changed as the cells are."""
        cells = subfield_volumes(self.mesh, self.body)
        return {tissue: v * self.factors.get(tissue, 1.0) for tissue, v in cells.items()}


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """The sheet of the mean labels of all visits, and the way from there to each visit."""

    evidence: Evidence
    """The mean, unfolded."""
    volume: LabelVolume
    """The mean labels."""
    motions: tuple[Float, ...]
    """(4, 4) from the mean to each visit, RAS mm."""

    @cached_property
    def factors(self) -> dict[Tissue, float]:
        """Volume of each subfield over the volume of its cells."""
        mesh, _ = carry.grid_mesh(self.evidence.whole)
        cells = subfield_volumes(mesh, self.evidence.body)
        return {t: v / cells[t] for t, v in self.evidence.volumes.items() if cells.get(t)}

    @cached_property
    def edges(self) -> Float:
        """(Ny, 2) where rows leave the body of the mean, mm from the edges of its sheet."""
        return carry.find_edges(self.evidence.whole, np.eye(4), self.evidence.solid.field)

    def ends(self, motion: Float) -> tuple[GivenEnd, ...]:
        """Return the end planes in a visit."""
        body = self.evidence.body
        points = body.inside_points()[1]
        return tuple(_moved_end(body.ends[end].moved(end, 0.0, points), motion) for end in _ENDS)

    def body(self, motion: Float) -> Body:
        """Return the body of the mean in a visit: what names the subfields along the sheet."""
        body = self.evidence.body
        planes = {
            end: body.ends[end]._replace(
                point=apply_affine(motion, body.ends[end].point),
                normal=motion[:3, :3] @ body.ends[end].normal,
            )
            for end in _ENDS
        }
        ends = EndPlanes(
            **planes, axis=motion[:3, :3] @ body.ends.axis, half_slice=body.ends.half_slice
        )
        return replace(body, affine=motion @ body.affine, ends=ends)


def make_frame(
    volumes: Sequence[LabelVolume], hemi: str, settings: Settings, clock: Clock, *, shared: bool
) -> Frame:
    """Align and average the labels of all visits, and lay out the mean.

    The order of the visits does not matter. With ``shared``, they share a space.
    """
    order = sorted(range(len(volumes)), key=lambda n: _digest(volumes[n]))
    ordered = [volumes[n] for n in order]
    with clock("alignment"):
        aligned = align(ordered, hemi, shared=shared)
    with clock("template"):
        mean = average_labels(ordered, aligned, settings.slices)
        mean = replace(mean, given_ends=_mean_ends(ordered, aligned))
    motions = [aligned[order.index(n)] for n in range(len(volumes))]
    evidence = measure.unfold(mean, hemi, settings, clock, rivals=False)
    return Frame(evidence=evidence, volume=mean, motions=tuple(motions))


def _digest(volume: LabelVolume) -> bytes:
    content = (volume.tissue, volume.part, volume.affine)
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in content)).digest()


def _moved_end(end: GivenEnd, motion: Float) -> GivenEnd:
    point = apply_affine(motion, np.array(end.point)).tolist()
    normal = None if end.normal is None else (motion[:3, :3] @ np.array(end.normal)).tolist()
    return GivenEnd(
        end=end.end, point=tuple(point), normal=None if normal is None else tuple(normal)
    )


def _mean_ends(volumes: Sequence[LabelVolume], motions: Sequence[Float]) -> tuple[GivenEnd, ...]:
    """Average the planes that a person placed in some visits, in the space of the mean."""
    means = []
    for end in _ENDS:
        planes = [
            _moved_end(given, np.asarray(np.linalg.inv(motion), dtype=np.float64))
            for volume, motion in zip(volumes, motions, strict=True)
            for given in volume.given_ends
            if given.end == end
        ]
        if planes:
            point = np.mean([plane.point for plane in planes], axis=0).tolist()
            normals = np.array([plane.normal for plane in planes if plane.normal])
            normals *= np.sign(normals @ normals[:1].T) if len(normals) else 1.0
            normal = tuple(normals.mean(axis=0).tolist()) if len(normals) == len(planes) else None
            means.append(GivenEnd(end=end, point=tuple(point), normal=normal))
    return tuple(means)


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A visit on the common sheet, before it is measured."""

    image: list[Finding]
    """What the checks of the label image found."""
    body: Body
    side: float
    """How far the medial subfields lie medially of CA1, mm."""
    solid: SolidField
    visit: _Visit
    walls: columns.Walls


def check_alone(volume: LabelVolume, hemi: str, settings: Settings) -> None:
    """Check labels that are to enter a mean.

    GeometryError if these labels cannot be measured, whatever the further visits are like.
    """
    check_label_image(volume, hemi, settings.checks)
    check_side(extract_body(volume, settings.body), hemi)


def find_common(
    volumes: Sequence[LabelVolume], hemi: str, settings: Settings, clock: Clock, *, shared: bool
) -> tuple[Frame, dict[int, Placed | GeometryError]]:
    """Make the common sheet of the visits that resemble each other, and lay them on it.

    Of three visits or more, a refused visit is omitted, of several the one that resembles the
    rest least, until none is refused. Returns the result of each visit on the sheet, by its number.
    """
    numbers = list(range(len(volumes)))
    relabeled = [relabel_by_mask(volume, settings.body) for volume in volumes]
    while True:
        part = [relabeled[n] for n in numbers]
        placed: dict[int, Placed | GeometryError] = {}
        try:
            frame = make_frame(part, hemi, settings, clock, shared=shared)
        except GeometryError:
            if len(numbers) <= _PAIR:
                raise
            with clock("alignment"):
                motions = align(part, hemi, shared=shared)
        else:
            motions = list(frame.motions)
            for place, n in enumerate(numbers):
                try:
                    placed[n] = place_visit(frame, place, volumes[n], hemi, clock)
                except GeometryError as error:
                    placed[n] = error
            fit = not any(isinstance(result, GeometryError) for result in placed.values())
            if fit or len(numbers) <= _PAIR:
                return frame, placed
        refused = [n for n in numbers if not isinstance(placed.get(n), Placed)]
        overlap = _resemblance(part, motions)
        numbers.remove(min(refused, key=lambda n: overlap[numbers.index(n)]))


def _resemblance(volumes: Sequence[LabelVolume], motions: Sequence[Float]) -> list[float]:
    """Compute the mean overlap of the labels of each visit with the labels of all visits."""
    masks = [hippocampal_voxels(volume) for volume in volumes]
    places = [
        apply_affine(np.linalg.inv(motion), voxel_points(mask, volume.affine))
        for mask, volume, motion in zip(masks, volumes, motions, strict=True)
    ]
    shares = np.array(
        [
            [
                _count_in(mask, volume.affine, apply_affine(m, points)) / len(points)
                for points in places
            ]
            for mask, volume, m in zip(masks, volumes, motions, strict=True)
        ]
    )
    return [float(share) for share in np.minimum(shares, shares.T).mean(axis=1)]


def _count_in(mask: Bool, affine: Float, points: Float) -> int:
    """Count the points (N, 3), RAS mm, whose nearest voxel is in a mask."""
    voxel = np.rint(apply_affine(np.linalg.inv(affine), points)).astype(np.intp)
    within = ((voxel >= 0) & (voxel < mask.shape)).all(axis=1)
    return int(np.count_nonzero(mask[tuple(voxel[within].T)]))


def place_visit(frame: Frame, number: int, volume: LabelVolume, hemi: str, clock: Clock) -> Placed:
    """Lay the common sheet on a visit; ``number`` is its place in the frame.

    GeometryError if its labels cannot be measured, or do not resemble the mean at all.
    """
    motion, settings = frame.motions[number], frame.evidence.settings
    with clock("body"):
        image = check_label_image(volume, hemi, settings.checks)
        body = extract_body(replace(volume, given_ends=frame.ends(motion)), settings.body)
        side = check_side(body, hemi)
    with clock("surface"):
        field = resample_body(body, hemi, settings.grid, settings.slices)
        solid = measure.make_solid(field, body, settings)
    with clock("sheet"):
        visit, walls = _carry(frame, motion, solid.field)
    return Placed(image=image, body=body, side=side, solid=solid, visit=visit, walls=walls)


def measure_placed(
    frame: Frame, motion: Float, volume: LabelVolume, placed: Placed, clock: Clock
) -> HemisphereMaps:
    """Measure a visit on the common sheet."""
    common, settings = frame.evidence, frame.evidence.settings
    body, solid, measured, walls = placed.body, placed.solid, placed.visit, placed.walls
    sheet = measured.sheet
    with clock("measures"):
        maps = catalog.measure_maps(measured)
        repaired = repaired_columns(sheet, solid)
        layers, folded_layers = measure.space_layers(sheet, settings)
        overlap = _overlap(body, frame, motion)
        findings = [
            *placed.image,
            *checks.check_image(body),
            *checks.check_end_labels(volume, body, settings.checks),
            *measure.check_edits(volume, body, settings),
            *_of_visit(body, solid, settings),
            *_fits(walls, sheet, overlap, settings),
            *folded_layers,
            *(_of_frame(finding, motion) for finding in find_all(common)),
        ]
        doubtful = repairs.doubtful_columns(sheet, solid, findings)
        return HemisphereMaps(
            sheet=sheet,
            layers=layers,
            maps=maps,
            profiles=catalog.average_profiles(maps, sheet),
            sections=catalog.measure_sections(measured),
            subfield=measured.subfield,
            repaired=repaired,
            doubtful=doubtful,
            body_mask=volume.in_file(body.inside),
            summary=catalog.summarize(measured, for_region(volume.protocol, body.region).sheet),
            qc={
                **measure.body_metrics(body, placed.side, settings),
                **{f"{end}_end_rule": common.body.ends[end].rule for end in _ENDS},
                "euler_before": solid.euler_before,
                "euler_after": solid.euler_after,
                "changed_fraction": solid.changed_fraction,
                "bending_rad": bending_angle(sheet, settings.measures),
                "filled_columns": int(np.count_nonzero(~sheet.valid)),
                "filled_fraction": 1 - float(sheet.valid.mean()),
                "regions_outside": "head and tail (as in Diers et al. 2023)",
                **repairs.repair_metrics(sheet, solid, repaired, body),
                "doubtful_fraction": float(doubtful.mean()),
                "frame": "person",
                "frame_visits": len(frame.motions),
                "frame_to_visit": motion.round(6).tolist(),
                "frame_distance_mm": walls.distance,
                "frame_overlap": overlap,
                "flag_margins": checks.flag_margins(findings),
            },
            repairs=(*map(str, solid.repairs), *checks.describe_uncus(body, settings.checks)),
            flags=tuple(checks.raise_flags(findings, sheet, partial(checks.name_place, body=body))),
            mesh=measured.mesh,
            coordinates=measured.coordinates,
        )


def _carry(frame: Frame, motion: Float, field: Field) -> tuple[_Visit, columns.Walls]:
    """Carry the common sheet to a visit, to its edges and walls.

    GeometryError if too many columns meet no wall.
    """
    common, settings = frame.evidence, frame.evidence.settings
    extents = settings.sheet.x_extent, settings.sheet.y_extent
    edges = carry.find_edges(common.whole, motion, field) - frame.edges
    edges = carry.smooth_edges(edges, common.whole)
    inner = carry.move_edges(common.sheet, edges, *extents)
    whole = carry.move_edges(common.whole, edges, 1.0, 1.0)
    walls = columns.find_walls(inner, motion, field)
    valid = common.sheet.valid & walls.known
    if 1 - valid.mean() > settings.sheet.max_filled:
        raise GeometryError(
            f"{1 - valid.mean():.0%} of the columns meet no wall near the wall of the mean visit: "
            "compare the labels of the visits",
            reason="visit-unlike",
        )
    moves = carry.moves_at(walls.moves, inner, whole, *extents)
    whole = carry.move_walls(whole, moves, motion)
    mesh, coordinates = carry.grid_mesh(whole)
    visit = _Visit(
        factors=frame.factors,
        body=frame.body(motion),
        mesh=mesh,
        coordinates=coordinates,
        sheet=Sheet(points=carry.move_walls(inner, walls.moves, motion).points, valid=valid),
        subfield=common.subfield,
        whole=whole,
        settings=settings,
    )
    return visit, walls


def _of_visit(body: Body, solid: SolidField, settings: Settings) -> list[Finding]:
    """List what the checks of the labels of a visit found."""
    cuts = solid.touched & (solid.field.values < 0)
    step = 2 * body.ends.half_slice
    return [
        *map(describe_repair, solid.repairs),
        *checks.check_cavities(body, settings.checks),
        *checks.check_labels(body, settings.checks),
        *checks.check_cross_sections(solid.field, step, settings.checks, cuts),
    ]


def _of_frame(finding: Finding, motion: Float) -> Finding:
    """Carry what was found in the mean labels to a visit."""
    text = "a repair" if finding.reason == "large-repair" else finding.text
    return replace(
        finding,
        text=f"in the mean of the visits, {text}",
        points=apply_affine(motion, finding.points) if len(finding.points) else finding.points,
        placed=finding.placed and finding.reason != "large-repair",
    )


def _overlap(body: Body, frame: Frame, motion: Float) -> float:
    """Compute Dice's coefficient of the bodies of a visit and of the mean."""
    mean = frame.evidence.body
    points = apply_affine(np.linalg.inv(motion), body.inside_points()[1])
    shared = _count_in(mean.inside, mean.affine, points) * body.voxel_volume
    total = len(points) * body.voxel_volume + np.count_nonzero(mean.inside) * mean.voxel_volume
    return float(2 * shared / total)


def _fits(walls: columns.Walls, sheet: Sheet, overlap: float, settings: Settings) -> list[Finding]:
    """Check whether a visit resembles the mean of all visits."""
    far = sheet.points[:, :, sheet.middle][(walls.distances > FAR).any(axis=-1)]
    remedy = "compare the labels of the visits there"
    return [
        Finding(
            reason="visits-differ",
            value=max(walls.distance / FLAG_DISTANCE, (1 - overlap) / (1 - FLAG_OVERLAP)),
            limit=1.0,
            text=f"the walls lie {walls.distance:.2f} mm from the walls of the mean visit, and "
            f"{overlap:.0%} of the bodies overlap",
            remedy=remedy,
            points=far,
        ),
        Finding(
            reason="columns-filled",
            value=1 - float(sheet.valid.mean()),
            limit=settings.checks.flag_filled,
            text=f"{1 - sheet.valid.mean():.1%} of the columns meet no wall near the wall of the "
            "mean visit",
            remedy=remedy,
            points=sheet.points[:, :, sheet.middle][~sheet.valid],
        ),
    ]
