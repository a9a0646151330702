"""The whole hippocampus, or head and body, on one sheet (experimental): labels to maps.

Head and tail bend and fold, so the solid has no ends to close and is not made a ball. It has two
faces and a rim; edges and ends are found afterwards, on the boundary of the mid-surface. In the
body, the grid is that of the sheet of the body: the body is measured first.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids import types
from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.regions.disk import (
    Disk,
    Edges,
    Lines,
    at_nodes,
    find_edges,
    flipped_area,
    level_surface,
    locate_nodes,
    make_disk,
    map_to_rectangle,
    proximodistal,
)
from hipsta_bids.extensions.regions.faces import (
    Faces,
    find_faces,
    find_ridges,
    find_touching_banks,
    whole_surface,
    whole_tissue,
)
from hipsta_bids.geometry import catalog
from hipsta_bids.geometry.body import Body, check_side
from hipsta_bids.geometry.checks import columns_near, flag_margins, name_place, raise_flags
from hipsta_bids.geometry.digital import voxel_points
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.geometry.fem import volume_laplace
from hipsta_bids.geometry.measures import column_area, labels_at, measure_thickness
from hipsta_bids.geometry.mesh import fill_surface, tetra_quality, triangle_areas, unique_edges
from hipsta_bids.geometry.sheet import coordinates_at, fill_points, label_sheet, sheet_levels
from hipsta_bids.participant.measure import find_in_body, flags_of, unfold
from hipsta_bids.protocols.protocol import CORE, LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import Bool, Finding, Float, Int, Sheet

Clock = Callable[[str], AbstractContextManager[None]]

MAX_VOXEL = 0.5
"""Refuse longer voxel edges, mm."""
MARGIN = 1.0
"""No value nearer than this to an edge, an end or a filled hole, thicknesses of at least 1 mm: so
far lines bend round the rim."""
MAX_PIECE = 0.02
"""Refuse a piece beside the mid-surface with a larger share of its area."""
MIN_EDGE = 30.0
"""Refuse a shorter medial or lateral edge, mm."""
FLAG_HOLE, FLAG_END = 10.0, 12.0
"""Flag holes of a longer perimeter, and longer ends, mm."""
FLAG_FOLDED, FLAG_MASKED = 0.01, 0.25
"""Flag larger shares of the area that are turned over, and that have no values."""
FLAG_TOUCHING = 2.0
"""Flag places where two banks of a fold touch over more than this, mm2 of one bank."""
FLAG_RIDGE = 5.0
"""Flag larger ridges of the head, which low folds are whose banks touch, mm2."""
THICK_NEAR, THICK = 4.0, 1.5
"""Beside such a place, up to this far, mm, columns thicker than this multiple of the median are
part of it."""
LATERAL_REACH = 1.6
"""The lateral edge lies this near to dentate gyrus or CA4, mm."""
HATA_REACH = 1.0
"""What is this near to the hippocampal-amygdaloid transition area, mm, is the anterior end."""
CUT_REACH = 1.0
"""Without a tail the sheet ends at the posterior plane: what is this near to it is no edge, mm."""
MAX_LENGTH = 8.0
"""Lines from the mid-surface to a wall that are longer than this are lost, mm."""
_FAR = 500.0
"""End planes moved by this far have all of the hippocampus between them, mm."""
_TOLERANCE = 0.005
"""mm; voxel edges that differ by less are the same."""
_RIM = 0.9999
"""Beside the edges themselves, where rounding does not choose the triangle."""


class BodySheet(NamedTuple):
    """The sheet of the body, and the labels of the body."""

    body: Body
    mesh: types.TetMesh
    coordinates: types.Coordinates
    flags: tuple[types.Flag, ...]


class Layout(NamedTuple):
    """The sheet of head and body flattened, and the evidence of the stages before it."""

    body: Body
    """All of the hippocampus, between end planes that are far away."""
    side: float
    """How far the medial subfields lie medially of CA1, mm."""
    surface: types.Surface
    mesh: types.TetMesh
    smoothed: int
    """How often the surface was smoothed more because TetGen could not fill it."""
    u: Float
    """(N,) coordinate from the interior to the exterior wall."""
    disk: Disk
    edges: Edges
    plane: Float
    """(V, 2) place of each vertex of the disk in the rectangle."""
    axes: tuple[Float, Float, Float]
    sheet: Sheet
    whole: Sheet
    """The same from edge to edge, without margins."""
    subfield: NDArray[np.uint8]
    folds: list[Finding]


def measure_region(
    volume: types.LabelVolume, hemi: str, settings: Settings, clock: Clock
) -> types.HemisphereMaps:
    """Measure head, body and, unless the region is ``headbody``, tail on one sheet.

    Arguments, result and errors are as in `measure_hemisphere`. The body is measured alone first.
    """
    check_fine(volume)
    body = unfold(volume, hemi, settings.changed(body={"region": "body"}), clock)
    flags = flags_of(body, find_in_body(volume, hemi, body))
    body_alone = BodySheet(body.body, body.mesh, body.coordinates, flags)
    layout = lay_out(volume, hemi, settings, clock, body_alone)
    with clock("measures"):
        return _measure(volume, settings, body_alone, layout)


def lay_out(
    volume: types.LabelVolume, hemi: str, settings: Settings, clock: Clock, body_alone: BodySheet
) -> Layout:
    """Lay out the sheet of a region around ``body_alone``, the body measured alone."""
    region = settings.body.region
    with clock("body"):
        side = check_side(body_alone.body, hemi)
        tissue = whole_tissue(volume, body_alone.body.tissue)
        ends = body_alone.body.ends
        far = ends.beyond(_FAR)
        body = replace(body_alone.body, tissue=tissue, inside=tissue > 0, region=region, ends=far)
    with clock("surface"):
        solid = partial(whole_surface, tissue > 0, volume.affine, settings.grid.spacing)
        surface, field, grid = solid(settings.surface)
    with clock("tetrahedra"):
        surface, mesh, smoothed = fill_surface(
            surface, lambda smoother: solid(smoother)[0], settings.surface, settings.tetra
        )
    with clock("boundaries"):
        faces = find_faces(surface, volume, field, grid)
    with clock("coordinates"):
        laplace = volume_laplace(mesh, settings.boundaries.solver)
        u = laplace.between(faces.interior, faces.exterior)
        disk = make_disk(*level_surface(mesh, u, 0.0))
        _check_pieces(disk)
        edges = _edges(disk, body, volume, ends.height, region)
        axes = sheet_levels(settings.sheet, region)
        limits = float(axes[1][0]), float(axes[1][-1])
        within = _in_body(disk, body_alone)
        plane = map_to_rectangle(disk, edges, within, settings.sheet.y_extent, limits)
    with clock("sheet"):
        lines_of = Lines(mesh, laplace.gradient(u))
        sheet = _sample(disk, plane, lines_of, axes, MARGIN)
        sheet, folds = _lost_clefts(surface, faces, sheet, axes[1] > 1)
        edge_to_edge = (np.linspace(-_RIM, _RIM, len(axes[0])), axes[1], axes[2][::2])
        whole = _sample(disk, plane, lines_of, edge_to_edge, 0.0)
        subfield = label_sheet(sheet, body)
    return Layout(
        body=body,
        side=side,
        surface=surface,
        mesh=mesh,
        smoothed=smoothed,
        u=u,
        disk=disk,
        edges=edges,
        plane=plane,
        axes=axes,
        sheet=sheet,
        whole=whole,
        subfield=subfield,
        folds=folds,
    )


def _measure(
    volume: types.LabelVolume, settings: Settings, body_alone: BodySheet, layout: Layout
) -> types.HemisphereMaps:
    """Measure the maps of a sheet that is flattened, and check them."""
    body, sheet = layout.body, layout.sheet
    measured = catalog.Measured(
        body=body,
        mesh=layout.mesh,
        sheet=sheet,
        subfield=layout.subfield,
        whole=layout.whole,
        settings=settings,
    )
    all_maps = catalog.measure_maps(measured)
    maps = {k: np.where(sheet.valid, v, np.nan) for k, v in all_maps.items()}
    maps["distortion"] = _distortion(sheet)
    medial_to_lateral = proximodistal(layout.disk, layout.edges)
    maps["proximodistal"] = at_nodes(layout.disk, layout.plane, medial_to_lateral, *layout.axes[:2])
    folded, masked = flipped_area(layout.disk, layout.plane), _masked(layout)
    findings = [*_findings(layout.disk, layout.edges, folded, masked, body.region), *layout.folds]
    return types.HemisphereMaps(
        sheet=sheet,
        layers=sheet,
        maps=maps,
        profiles=catalog.average_profiles(all_maps, sheet),
        sections=catalog.measure_sections(measured),
        subfield=layout.subfield,
        repaired=np.zeros(layout.subfield.shape, dtype=bool),
        doubtful=np.zeros(layout.subfield.shape, dtype=bool),
        body_mask=volume.in_file(body.inside),
        summary=catalog.summarize(measured, volume.protocol.sheet),
        qc={
            **_metrics(layout),
            "folded_fraction": folded,
            "masked_fraction": masked,
            **_metrics_of_ends(layout, body_alone.body.ends),
            "flag_margins": flag_margins(findings),
        },
        flags=(
            *raise_flags(findings, sheet, lambda at: name_place(at, body)),
            *(replace(f, message=f"the body alone: {f.message}") for f in body_alone.flags),
        ),
        mesh=layout.mesh,
        coordinates=types.Coordinates(
            values=np.column_stack([np.full((len(layout.u), 2), np.nan), layout.u])
        ),
    )


def _masked(layout: Layout) -> float:
    """Compute the share of the sheet's area that has no values."""
    measured_area = float(column_area(layout.sheet)[layout.sheet.valid].sum())
    area = float(triangle_areas(layout.disk.vertices, layout.disk.triangles).sum())
    return max(0.0, 1 - measured_area / area)


def _metrics(layout: Layout) -> dict[str, Any]:
    """Return numbers about the solid and its sheet."""
    body = layout.body
    return {
        "region": body.region,
        "experimental": True,
        "voxel_size_mm": np.linalg.norm(body.affine[:3, :3], axis=0).round(4).tolist(),
        "body_voxels": int(np.count_nonzero(body.inside)),
        "surface_vertices": len(layout.surface.vertices),
        "extra_smoothing": layout.smoothed,
        "tetrahedra": len(layout.mesh.tetrahedra),
        "tetra_quality_median": float(np.median(tetra_quality(layout.mesh))),
        "holes_mm": [round(hole, 2) for hole in layout.disk.holes],
        "edge_lengths_mm": _lengths(layout.disk, layout.edges),
    }


def _metrics_of_ends(layout: Layout, ends: EndPlanes) -> dict[str, Any]:
    """Return the side, and the end planes of the body."""
    inside = layout.body.inside_points()[1]
    return {
        "medial_offset_mm": layout.side,
        "posterior_end_rule": ends.posterior.rule,
        "anterior_end_rule": ends.anterior.rule,
        "posterior_plane": ends.posterior.entry(inside),
        "anterior_plane": ends.anterior.entry(inside),
    }


def check_fine(volume: types.LabelVolume) -> None:
    """Refuse voxels in which head and tail cannot be measured."""
    longest = float(np.linalg.norm(volume.affine[:3, :3], axis=0).max())
    if longest > MAX_VOXEL + _TOLERANCE:
        raise GeometryError(
            f"voxels of {longest:.2f} mm: head and tail need {MAX_VOXEL:g} mm or less; "
            "measure the body, or use finer labels",
            reason="whole-voxels",
        )


def _check_pieces(disk: Disk) -> None:
    if disk.beside > MAX_PIECE:
        raise GeometryError(
            f"the sheet's two faces meet ({disk.beside:.0%} of the mid-surface is separate); "
            "check for missing dentate gyrus or molecular layer",
            reason="whole-topology",
        )


def _edges(
    disk: Disk,
    body: Body,
    volume: types.LabelVolume,
    height: Callable[[Float, types.End], Float],
    region: str,
) -> Edges:
    """Find edges and ends of the sheet on the boundary, by the labels beside it."""
    points = disk.vertices[disk.loop]
    tissue = labels_at(points, body)
    core = cKDTree(voxel_points(np.isin(volume.tissue, CORE), volume.affine))
    near = core.query(points, distance_upper_bound=LATERAL_REACH)[0] < LATERAL_REACH
    medial = np.where(np.isin(tissue, MEDIAL_END), 1.0, -1.0)
    ca1 = np.where(tissue == Tissue.CA1, 0.0, -1.0)  # it goes all round in the tail
    lateral = np.where(near, np.where(np.isin(tissue, LATERAL_END), 1.0, ca1), -1.0)
    above = height(points, "posterior")
    if region == "headbody":
        medial[above < CUT_REACH] = lateral[above < CUT_REACH] = -1.0
    hata = voxel_points(volume.tissue == Tissue.HATA, volume.affine)
    if len(hata):
        at_end = cKDTree(hata).query(points)[0] < HATA_REACH
        medial[at_end] = lateral[at_end] = -len(points)  # no edge passes it
    edges = find_edges(disk, medial, lateral, above)
    for name in ("medial", "lateral"):
        length = _length(disk, getattr(edges, name))
        if length < MIN_EDGE:
            raise GeometryError(
                f"the {name} edge of the sheet has {length:.0f} mm, below {MIN_EDGE:g}; "
                "check the labels of the subiculum, CA2 and CA3",
                reason="whole-topology",
            )
    return edges


def _in_body(disk: Disk, body_alone: BodySheet) -> Float:
    """Coordinates (V, 2), x and y, of a disk's vertices in the sheet of the body; NaN outside.

    The body goes on beyond its end planes. One vertex there belongs to it, so that the rows at the
    planes lie between known values.
    """
    coordinates = coordinates_at(body_alone.mesh, body_alone.coordinates, disk.vertices)[:, :2]
    inside = np.asarray((np.abs(coordinates) <= 1).all(axis=1))
    edges = unique_edges(disk.triangles)
    inside[edges[inside[edges].any(axis=1)]] = True
    return np.where(inside[:, None] & (np.abs(coordinates[:, :1]) <= 1), coordinates, np.nan)


def _length(disk: Disk, arc: Int) -> float:
    return float(np.linalg.norm(np.diff(disk.vertices[arc], axis=0), axis=1).sum())


def _lengths(disk: Disk, edges: Edges) -> dict[str, float]:
    return {name: round(_length(disk, getattr(edges, name)), 2) for name in Edges.__annotations__}


def _sample(
    disk: Disk, plane: Float, lines: Lines, axes: tuple[Float, Float, Float], margin: float
) -> Sheet:
    """Follow the lines through the nodes of a grid; without values near rims, and where lost."""
    x, y, z = axes
    triangle, weights = locate_nodes(disk, plane, x, y)
    corner = disk.triangles[triangle]
    middle = np.einsum("xyk,xykd->xyd", weights, disk.vertices[corner])
    on_sheet = (triangle >= 0) & (disk.cell[triangle] >= 0)
    cells = disk.cell[triangle[on_sheet]]
    columns, arrived = lines.columns(cells, middle[on_sheet], len(z), MAX_LENGTH)
    columns[~arrived] = np.nan
    points = np.full((len(x), len(y), len(z), 3), np.nan)
    points[on_sheet] = columns
    thickness = np.linalg.norm(np.diff(points, axis=2), axis=3).sum(axis=2)
    far = np.einsum("xyk,xyk->xy", weights, disk.from_edges[corner]) > margin * np.fmax(
        thickness, 1.0
    )
    valid = np.isfinite(points).all(axis=(2, 3)) & far
    if not valid.any():
        raise GeometryError(
            "no node of the sheet is measured: check the labels", reason="sheet-incomplete"
        )
    return Sheet(points=fill_points(points), valid=valid)


def _lost_clefts(
    surface: types.Surface, faces: Faces, sheet: Sheet, head: Bool
) -> tuple[Sheet, list[Finding]]:
    """Find clefts that the labels do not have, and take the values there from the sheet.

    ``head`` (Ny,) tells its rows.
    """
    thickness, findings = measure_thickness(sheet), []
    thick = thickness > THICK * np.median(thickness[sheet.valid])
    without = ~sheet.valid
    for banks in find_touching_banks(surface, faces):
        if banks.area > FLAG_TOUCHING:
            beside = thick & columns_near(sheet, banks.points, THICK_NEAR)
            columns = sheet.valid & (beside | columns_near(sheet, banks.points, MARGIN))
            text = f"two banks of a fold touch over {banks.area:.0f} mm2: the cleft between them"
            text += f" on the {banks.side} side is not in the labels"
            findings.append(_cleft_finding(text, banks.area, FLAG_TOUCHING, banks.points, columns))
            without |= columns
    sheet = replace(sheet, valid=~without)
    for columns, area in find_ridges(sheet, np.broadcast_to(head, without.shape)):
        if area > FLAG_RIDGE:
            text = f"a ridge of {area:.0f} mm2 in the head is thicker than what lies round it: the"
            text += " cleft of a low fold may not be in the labels"
            middle = sheet.points[columns, sheet.middle]
            findings.append(_cleft_finding(text, area, FLAG_RIDGE, middle, columns))
            without |= columns
    return replace(sheet, valid=~without), findings


def _cleft_finding(text: str, area: float, limit: float, points: Float, columns: Bool) -> Finding:
    return Finding(
        reason="fused-digitation",
        value=area if columns.any() else 0.0,
        limit=limit,
        text=text,
        remedy="correct the labels there; the sheet has no values there",
        points=points,
        share=float(columns.mean()),
    )


def _distortion(sheet: Sheet) -> Float:
    """Area round each node over the mean, (Nx, Ny), binary logarithm: 1 is twice as large."""
    area = np.where(sheet.valid, column_area(sheet), np.nan)
    return np.asarray(np.log2(area / np.nanmean(area)))


def _findings(disk: Disk, edges: Edges, folded: float, masked: float, region: str) -> list[Finding]:
    """List what was found on the whole sheet, within its limit or not."""
    findings = [
        Finding(
            reason="whole-hole",
            value=length,
            limit=FLAG_HOLE,
            text=f"the sheet has a hole with a perimeter of {length:.0f} mm",
            remedy="check the labels there; the hole has no values",
            points=center[None],
        )
        for length, center in zip(disk.holes, disk.centers, strict=True)
    ]
    ends = ("anterior",) if region == "headbody" else ("posterior", "anterior")
    for end in ends:
        arc = getattr(edges, end)
        length = _length(disk, arc)
        findings.append(
            Finding(
                reason="whole-end",
                value=length,
                limit=FLAG_END,
                text=f"the {end} end of the sheet is {length:.0f} mm long",
                remedy="look where the subiculum, and CA2 or CA3, end there",
                points=disk.vertices[arc],
            )
        )
    return [
        *findings,
        Finding(
            reason="folded",
            value=folded,
            limit=FLAG_FOLDED,
            text=f"the map folds in {folded:.1%} of the area",
            remedy="look at the map",
            share=folded,
        ),
        Finding(
            reason="whole-masked",
            value=masked,
            limit=FLAG_MASKED,
            text=f"{masked:.0%} of the area, beside edges, ends and holes, has no values",
            remedy="look at the map",
            share=masked,
        ),
    ]
