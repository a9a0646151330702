"""The participant level: one hemisphere from labels to maps.

Reads like the methods section of Diers et al. 2023 (NeuroImage 276:120182): labels, surface,
tetrahedra, boundaries, coordinates, sheet, measures.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body, check_mask, check_side, extract_body
from hipsta_bids.geometry.boundaries import Boundaries, find_boundaries
from hipsta_bids.geometry.catalog import (
    Measured,
    average_profiles,
    measure_maps,
    measure_sections,
    summarize,
)
from hipsta_bids.geometry.checks import (
    check_end_labels,
    check_label_order,
    check_ridges,
    check_thickness,
    check_voxels_across,
    find_contacts,
    name_subfields,
)
from hipsta_bids.geometry.fem import volume_laplace
from hipsta_bids.geometry.grid import in_plane_voxel, resample_body
from hipsta_bids.geometry.measures import bending_angle
from hipsta_bids.geometry.mesh import extract_surface, tetrahedralize
from hipsta_bids.geometry.quality import Evidence, find_flags, quality_metrics
from hipsta_bids.geometry.sheet import (
    check_flipped,
    check_layers,
    equal_volume_layers,
    folded_fraction,
    is_flipped,
    label_sheet,
    sample_sheet,
    solve_coordinates,
    whole_body,
)
from hipsta_bids.geometry.topology import SolidField, repair_topology, repaired_columns
from hipsta_bids.protocols.load import for_region
from hipsta_bids.settings import Settings
from hipsta_bids.types import (
    BodyMask,
    Coordinates,
    Flag,
    HemisphereMaps,
    LabelVolume,
    Sheet,
    Surface,
    TetMesh,
)

Clock = Callable[[str], AbstractContextManager[None]]


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
    with clock("body"):
        body = extract_body(volume, settings.body)
        side = check_side(body, hemi)
    with clock("surface"):
        solid = repair_topology(
            resample_body(body, settings.grid, settings.slices),
            settings.topology,
            name_subfields(body),
            find_contacts(body, settings.topology),
        )
        surface = extract_surface(solid.field, settings.surface)
        across = check_voxels_across(surface, body, settings.checks)
    with clock("tetrahedra"):
        surface, mesh, smoothed = _filled(solid, surface, settings)
    with clock("boundaries"):
        laplace = volume_laplace(mesh, settings.boundaries.solver)
        boundaries = find_boundaries(surface, laplace, body, settings.boundaries)
    with clock("coordinates"):
        coordinates = solve_coordinates(laplace, boundaries)
        order = check_label_order(mesh, coordinates, body, settings.checks)
    with clock("sheet"):
        sheet = sample_sheet(mesh, coordinates, settings.sheet)
        bending = bending_angle(sheet, settings.measures)
        if body.region != "body" and boundaries.side_rule == "bending":
            boundaries = replace(boundaries, side_rule="continuity")
        if _sides_exchanged(sheet, boundaries.side_rule, bending, hemi):
            sheet, coordinates, boundaries = _flipped(sheet, coordinates, boundaries)
            bending = -bending
        whole = sample_sheet(mesh, coordinates, whole_body(settings.sheet))
        subfield = label_sheet(sheet, body)
        folded = folded_fraction(mesh, coordinates)
    with clock("measures"):
        measured = Measured(
            body=body,
            surface=surface,
            mesh=mesh,
            sheet=sheet,
            subfield=subfield,
            whole=whole,
            settings=settings,
        )
        evidence = Evidence(
            measured=measured,
            side=side,
            solid=solid,
            voxels_across=across,
            smoothed=smoothed,
            boundaries=boundaries,
            label_order=order,
            bending=bending,
            folded=folded,
        )
        flags = check_end_labels(volume, body, settings.checks)
        flags += check_thickness(measured.thickness, boundaries.sheet_thickness, settings.checks)
        flags += check_ridges(sheet, measured.thickness, settings.checks)
        flags += check_flipped(sheet, hemi) if body.region == "extended" else []
        flags += _check_edited_mask(volume, body, settings)
        flags += find_flags(evidence)
        layers, folds = _layers(sheet, settings)
        repaired = repaired_columns(sheet, solid, settings.measures)
        maps = measure_maps(measured)
        return HemisphereMaps(
            sheet=sheet,
            layers=layers,
            maps=maps,
            profiles=average_profiles(maps, sheet),
            sections=measure_sections(measured),
            subfield=subfield,
            repaired=repaired,
            body_mask=volume.in_file(body.inside),
            summary=summarize(measured, for_region(volume.protocol, body.region).sheet),
            qc=quality_metrics(evidence, repaired),
            repairs=tuple(map(str, solid.repairs)),
            flags=(*flags, *folds),
            mesh=mesh,
            coordinates=coordinates,
        )


def find_body(volume: LabelVolume, settings: Settings) -> BodyMask | None:
    """Find the body of a hemisphere that cannot be measured, for a person to correct."""
    try:
        body = extract_body(volume, settings.body)
    except GeometryError:
        return None
    return volume.in_file(body.inside)


def _check_edited_mask(volume: LabelVolume, body: Body, settings: Settings) -> list[Flag]:
    if volume.edited_mask is None or body.mask_change is None:
        return []
    voxel = in_plane_voxel(body.affine)
    return check_mask(volume.edited_mask, body.mask_change, voxel, settings.body)


def _filled(
    solid: SolidField, surface: Surface, settings: Settings
) -> tuple[Surface, TetMesh, int]:
    """Fill the surface; smooth it more while TetGen cannot, and count how often."""
    for extra in range(settings.surface.untangle_tries):
        try:
            return surface, tetrahedralize(surface, settings.tetra), extra
        except GeometryError:
            steps = settings.surface.taubin_iterations * (2 + extra)
            surface = extract_surface(
                solid.field, settings.surface.changed(taubin_iterations=steps)
            )
    return surface, tetrahedralize(surface, settings.tetra), settings.surface.untangle_tries


def _layers(sheet: Sheet, settings: Settings) -> tuple[Sheet, list[Flag]]:
    """Space layers as the settings say, and flag where that is not possible."""
    if settings.sheet.depths == "distance":
        return sheet, []
    layers, folded = equal_volume_layers(sheet)
    return layers, check_layers(folded)


def _sides_exchanged(sheet: Sheet, rule: str, bending: float, hemi: str) -> bool:
    """Decide whether interior and exterior have to be exchanged; labels have decided already."""
    if rule == "continuity":
        return is_flipped(sheet, hemi)
    return rule == "bending" and bending < 0


def _flipped(
    sheet: Sheet, coordinates: Coordinates, boundaries: Boundaries
) -> tuple[Sheet, Coordinates, Boundaries]:
    """Exchange interior and exterior."""
    return (
        Sheet(points=sheet.points[:, :, ::-1], valid=sheet.valid),
        Coordinates(values=coordinates.values * [1, 1, -1]),
        replace(boundaries, interior=boundaries.exterior, exterior=boundaries.interior),
    )
