"""The participant level: one hemisphere from labels to maps.

Reads like the methods section of Diers et al. 2023 (NeuroImage 276:120182): labels, surface,
tetrahedra, boundaries, coordinates, sheet, measures.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import repairs, sheet_checks
from hipsta_bids.geometry.body import Body, check_mask, check_side, extract_body
from hipsta_bids.geometry.boundaries import Boundaries, find_boundaries
from hipsta_bids.geometry.catalog import average_profiles, measure_maps, measure_sections, summarize
from hipsta_bids.geometry.checks import (
    check_end_labels,
    check_label_order,
    check_thickness,
    check_voxels_across,
    describe_uncus,
    find_contacts,
    flag_margins,
    name_place,
    name_subfields,
    raise_flags,
)
from hipsta_bids.geometry.completion import DOUBTFUL_CAVITY
from hipsta_bids.geometry.fem import Laplace, volume_laplace
from hipsta_bids.geometry.grid import Field, in_plane_voxel, resample_body
from hipsta_bids.geometry.label_checks import check_label_image
from hipsta_bids.geometry.measures import bending_angle, measure_thickness
from hipsta_bids.geometry.mesh import extract_surface, fill_surface, tetra_quality
from hipsta_bids.geometry.sheet import (
    between_planes,
    check_flipped,
    check_layers,
    equal_volume_layers,
    folded_fraction,
    is_flipped,
    label_sheet,
    sample_sheet,
    solve_coordinates,
    straighten_rows,
    whole_body,
)
from hipsta_bids.geometry.topology import SolidField, repair_topology
from hipsta_bids.joints import find_regions, load
from hipsta_bids.participant.evidence import Evidence, find_all
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.load import for_region
from hipsta_bids.settings import Settings
from hipsta_bids.types import (
    BodyMask,
    Coordinates,
    Finding,
    Flag,
    Float,
    HemisphereMaps,
    LabelVolume,
    Sheet,
    Surface,
    TetMesh,
)


def quality_metrics(evidence: Evidence) -> dict[str, Any]:
    """Numbers and words by which to judge the map, JSON-serializable."""
    solid, boundaries, surface = evidence.solid, evidence.boundaries, evidence.surface
    body, valid = evidence.body, evidence.sheet.valid
    quality = tetra_quality(evidence.mesh)
    return {
        **body_metrics(body, evidence.side, evidence.settings),
        "voxels_across": evidence.voxels_across,
        "euler_before": solid.euler_before,
        "euler_after": solid.euler_after,
        "changed_fraction": solid.changed_fraction,
        "surface_vertices": len(surface.vertices),
        "posterior_cap_vertices": int(surface.posterior_cap.sum()),
        "anterior_cap_vertices": int(surface.anterior_cap.sum()),
        "extra_smoothing": evidence.smoothed,
        "tetrahedra": len(evidence.mesh.tetrahedra),
        "tetra_quality_median": float(np.median(quality)),
        "tetra_quality_p01": float(np.quantile(quality, 0.01)),
        "boundary_doubt_mm": boundaries.doubt,
        "second_choice_mm": max(
            (
                sheet_checks.rms_difference(rival, evidence.thickness)
                for rival in evidence.rivals.values()
            ),
            default=0.0,
        ),
        "boundary_strip_mm": boundaries.strip_width,
        "side_rule": boundaries.side_rule,
        "side_margin": boundaries.side_margin,
        "label_order": evidence.label_order,
        "bending_rad": evidence.bending,
        "folded_fraction": evidence.folded,
        "filled_columns": int(np.count_nonzero(~valid)),
        "filled_fraction": float(1 - valid.mean()),
        "thickness_expected_mm": boundaries.sheet_thickness,
        "regions_outside": "head and tail (as in Diers et al. 2023)",
        **repairs.repair_metrics(evidence.sheet, solid, evidence.repaired, body),
        **({"mask_change": asdict(body.mask_change)} if body.mask_change else {}),
    }


def body_metrics(body: Body, side: float, settings: Settings) -> dict[str, Any]:
    """Return numbers and words about a body, ``side`` mm medial, and its end planes."""
    ends, inside = body.ends, body.inside_points()[1]
    return {
        "region": body.region,
        "x_coordinate": settings.sheet.x_coordinate,
        "voxel_size_mm": np.linalg.norm(body.affine[:3, :3], axis=0).round(4).tolist(),
        "body_voxels": int(np.count_nonzero(body.inside)),
        "layer_voxels": body.layer_voxels,
        "cavities_mm3": len(body.cavities.all) * body.voxel_volume,
        "uncus_mm3": len(body.uncus) * body.voxel_volume,
        "end_voxels_inside": body.handed_over,
        "body_length_mm": ends.length(inside),
        "medial_offset_mm": side,
        "posterior_end_rule": ends.posterior.rule,
        "anterior_end_rule": ends.anterior.rule,
        "posterior_end_uncertainty_mm": ends.posterior.uncertainty,
        "anterior_end_uncertainty_mm": ends.anterior.uncertainty,
        "posterior_plane": ends.posterior.entry(inside),
        "anterior_plane": ends.anterior.entry(inside),
    }


Clock = Callable[[str], AbstractContextManager[None]]


def unfold(
    volume: LabelVolume, hemi: str, settings: Settings, clock: Clock, *, rivals: bool = True
) -> Evidence:
    """Lay out the sheet of one body, with second choices or not; cf. `measure_hemisphere`."""
    with clock("body"):
        findings = check_label_image(volume, hemi, settings.checks)
        body = extract_body(volume, settings.body)
        side = check_side(body, hemi)
    with clock("surface"):
        field = resample_body(body, hemi, settings.grid, settings.slices)
        solid = make_solid(field, body, settings)
        surface = extract_surface(solid.field, settings.surface)
        across = check_voxels_across(surface, body, settings.checks)
    with clock("tetrahedra"):
        surface, mesh, smoothed = _fill(surface, solid, settings)
    with clock("boundaries"):
        laplace = volume_laplace(mesh, settings.boundaries.solver)
        boundaries = _boundaries(surface, laplace, body, settings)
    with clock("coordinates"):
        lay_out = partial(_lay_out, laplace, mesh, body, settings)
        coordinates = lay_out(boundaries)
        order = check_label_order(mesh, coordinates, body, settings.checks)
    with clock("sheet"):
        sheet = sample_sheet(mesh, coordinates, settings.sheet)
        bending = bending_angle(sheet, settings.measures)
        if body.region != "body" and boundaries.side_rule == "bending":
            boundaries = replace(boundaries, side_rule="continuity")
        if _has_other_side(sheet, hemi, boundaries, bending):
            sheet, coordinates, boundaries = _flipped(sheet, coordinates, boundaries)
            bending = -bending
        whole = sample_sheet(mesh, coordinates, whole_body(settings.sheet))
        subfield = label_sheet(sheet, body)
        folded = folded_fraction(mesh, coordinates)
    with clock("alternatives"):
        rival_maps = {}
        if rivals and boundaries.rival is not None:
            rival = sample_sheet(mesh, lay_out(boundaries.rival), settings.sheet)
            rival_maps["medial or lateral boundary"] = measure_thickness(rival)
        if rivals:
            rival_maps |= _rivals_of_labels(volume, hemi, settings, body, solid)
    return Evidence(
        body=body,
        surface=surface,
        mesh=mesh,
        coordinates=coordinates,
        sheet=sheet,
        subfield=subfield,
        whole=whole,
        settings=settings,
        image=tuple(findings),
        side=side,
        solid=solid,
        voxels_across=across,
        smoothed=smoothed,
        boundaries=boundaries,
        label_order=order,
        bending=bending,
        folded=folded,
        rivals=rival_maps,
    )


def _rivals_of_labels(
    volume: LabelVolume, hemi: str, settings: Settings, body: Body, solid: SolidField
) -> dict[str, Float]:
    """Measure thickness after another repair, and another reading of a cavity, where as likely."""
    maps = {}
    with suppress(GeometryError):
        if solid.rival is not None:
            maps["repair"] = _thickness(solid.rival, body, settings)
    with suppress(GeometryError):
        if body.cavities.doubtful:
            second = extract_body(volume, settings.body, second=True)
            changed = np.count_nonzero(second.inside != body.inside) * body.voxel_volume
            if changed > DOUBTFUL_CAVITY:
                field = resample_body(second, hemi, settings.grid, settings.slices)
                maps["reading of a cavity"] = _thickness(field, second, settings)
    return maps


def _has_other_side(sheet: Sheet, hemi: str, boundaries: Boundaries, bending: float) -> bool:
    """Check whether interior and exterior are exchanged, unless labels have decided already."""
    if boundaries.side_rule == "continuity":
        return is_flipped(sheet, hemi)
    return boundaries.side_rule == "bending" and bending < 0


def make_solid(field: Field, body: Body, settings: Settings) -> SolidField:
    """Repair the topology of the field of a body."""
    return repair_topology(field, settings.topology, name_subfields(body), find_contacts(body))


def _fill(surface: Surface, solid: SolidField, settings: Settings) -> tuple[Surface, TetMesh, int]:
    return fill_surface(
        surface,
        partial(extract_surface, solid.field),
        settings.surface,
        settings.tetra,
        solid.field.grid.frame,
    )


def _boundaries(surface: Surface, laplace: Laplace, body: Body, settings: Settings) -> Boundaries:
    longer = replace(body, ends=body.ends.beyond(settings.grid.beyond))
    return find_boundaries(surface, laplace, longer, settings.boundaries)


def _thickness(field: Field, body: Body, settings: Settings) -> Float:
    """Measure the thickness (Nx, Ny), mm, of another field of the same body."""
    solid = make_solid(field, body, settings)
    surface, mesh, _ = _fill(extract_surface(solid.field, settings.surface), solid, settings)
    laplace = volume_laplace(mesh, settings.boundaries.solver)
    boundaries = _boundaries(surface, laplace, body, settings)
    coordinates = _lay_out(laplace, mesh, body, settings, boundaries)
    return measure_thickness(sample_sheet(mesh, coordinates, settings.sheet))


def _lay_out(
    laplace: Laplace, mesh: TetMesh, body: Body, settings: Settings, boundaries: Boundaries
) -> Coordinates:
    """Solve for the three coordinates between boundaries."""
    coordinates = solve_coordinates(laplace, boundaries)
    if settings.grid.beyond:
        coordinates = between_planes(mesh, coordinates, body.ends)
    if settings.sheet.x_coordinate == "midsurface":
        coordinates = straighten_rows(mesh, coordinates, settings.boundaries.solver)
    return coordinates


def measure_hemisphere(
    volume: LabelVolume, hemi: str, settings: Settings, clock: Clock
) -> HemisphereMaps:
    """Measure thickness, curvature and shape of one hippocampal body.

    Parameters
    ----------
    volume : LabelVolume
    hemi : {"L", "R"}
    settings : Settings
    clock : callable
        ``clock(stage)`` is a context manager that times a stage.

    Returns
    -------
    HemisphereMaps

    Raises
    ------
    GeometryError
        With the reason why this hemisphere cannot be measured.
    """
    region = settings.body.region
    if volume.edited_mask is not None and region != "body":
        raise GeometryError(
            f"region {region}: an edited mask is about the body alone; edit the labels instead "
            "(desc-edited_dseg)",
            reason="edited-mask-region",
        )
    if region in EXPERIMENTAL:
        measured: HemisphereMaps = load(find_regions()[region].measure)(
            volume, hemi, settings, clock
        )
        return measured
    evidence = unfold(volume, hemi, settings, clock)
    with clock("measures"):
        return _measure(volume, hemi, evidence)


def _measure(volume: LabelVolume, hemi: str, evidence: Evidence) -> HemisphereMaps:
    """Measure the maps of a sheet that is laid out, and check them."""
    sheet = evidence.sheet
    tissues = for_region(volume.protocol, evidence.settings.body.region).sheet
    layers, folded_layers = space_layers(sheet, evidence.settings)
    findings = [*find_in_body(volume, hemi, evidence), *folded_layers]
    maps = measure_maps(evidence)
    doubtful = repairs.doubtful_columns(sheet, evidence.solid, findings)
    return HemisphereMaps(
        sheet=sheet,
        layers=layers,
        maps=maps,
        profiles=average_profiles(maps, sheet),
        sections=measure_sections(evidence),
        subfield=evidence.subfield,
        repaired=evidence.repaired,
        doubtful=doubtful,
        body_mask=volume.in_file(evidence.body.inside),
        summary=summarize(evidence, tissues),
        qc={
            **quality_metrics(evidence),
            "doubtful_fraction": float(doubtful.mean()),
            "flag_margins": flag_margins(findings),
        },
        repairs=(
            *map(str, evidence.solid.repairs),
            *describe_uncus(evidence.body, evidence.settings.checks),
        ),
        flags=flags_of(evidence, findings),
        mesh=evidence.mesh,
        coordinates=evidence.coordinates,
    )


def find_in_body(volume: LabelVolume, hemi: str, evidence: Evidence) -> list[Finding]:
    """List what the checks of a body found, within its limit or not."""
    body, settings, checks = evidence.body, evidence.settings, evidence.settings.checks
    return [
        *evidence.image,
        *check_end_labels(volume, body, checks),
        *check_thickness(evidence.thickness, evidence.boundaries.sheet_thickness, checks),
        *([check_flipped(evidence.sheet, hemi)] if body.region == "extended" else []),
        *check_edits(volume, body, settings),
        *find_all(evidence),
    ]


def check_edits(volume: LabelVolume, body: Body, settings: Settings) -> list[Finding]:
    """Check what an edited mask changed of a body, if there is one."""
    mask, change = volume.edited_mask, body.mask_change
    if mask is None or change is None:
        return []
    return check_mask(mask, change, in_plane_voxel(body.affine), settings.body)


def flags_of(evidence: Evidence, findings: list[Finding]) -> tuple[Flag, ...]:
    """Return the findings beyond their limits as flags, with their places."""
    place = partial(name_place, body=evidence.body)
    return tuple(raise_flags(findings, evidence.sheet, place))


def find_body(volume: LabelVolume, settings: Settings) -> BodyMask | None:
    """Find the body of a hemisphere that cannot be measured, for a correction by hand."""
    try:
        body = extract_body(volume, settings.body)
    except GeometryError:
        return None
    return volume.in_file(body.inside)


def space_layers(sheet: Sheet, settings: Settings) -> tuple[Sheet, list[Finding]]:
    """Space layers by the settings, and list places where this is impossible."""
    if settings.sheet.depths == "distance":
        return sheet, []
    layers, folded = equal_volume_layers(sheet)
    return layers, [check_layers(folded, sheet)]


def _flipped(
    sheet: Sheet, coordinates: Coordinates, boundaries: Boundaries
) -> tuple[Sheet, Coordinates, Boundaries]:
    """Exchange interior and exterior."""
    return (
        Sheet(points=sheet.points[:, :, ::-1], valid=sheet.valid),
        Coordinates(values=coordinates.values * [1, 1, -1]),
        replace(boundaries, interior=boundaries.exterior, exterior=boundaries.interior),
    )
