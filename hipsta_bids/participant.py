"""The participant level: one hemisphere from labels to maps.

Reads like the methods section of Diers et al. 2023 (NeuroImage 276:120182): labels, surface,
tetrahedra, boundaries, coordinates, sheet, measures.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np

from hipsta_bids.artifacts import (
    Coordinates,
    Flag,
    Float,
    HemisphereMaps,
    LabelVolume,
    Sheet,
    Surface,
    TetMesh,
)
from hipsta_bids.geometry.body import Body, check_side, extract_body
from hipsta_bids.geometry.boundaries import Boundaries, find_boundaries
from hipsta_bids.geometry.checks import check_label_order, check_thickness, check_voxels_across
from hipsta_bids.geometry.coordinates import solve_coordinates
from hipsta_bids.geometry.grid import in_plane_voxel, resample_body
from hipsta_bids.geometry.measures import (
    bending_angle,
    mean_curvature,
    measure_thickness,
    summarize,
)
from hipsta_bids.geometry.sheet import folded_fraction, label_sheet, sample_sheet
from hipsta_bids.geometry.surface import extract_surface, mean_wall_thickness, signed_volume
from hipsta_bids.geometry.tetra import count_intersections, tetra_quality, tetrahedralize
from hipsta_bids.geometry.topology import SolidField, repair_topology
from hipsta_bids.settings import Settings

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
        solid = repair_topology(resample_body(body, settings.grid), settings.topology)
        surface = extract_surface(solid.field, settings.surface)
        wall = mean_wall_thickness(surface)
        across = check_voxels_across(wall, in_plane_voxel(body.affine), settings.checks)
    with clock("tetrahedra"):
        surface, crossings = _untangled(solid, surface, settings)
        mesh = tetrahedralize(surface, settings.tetra)
    with clock("boundaries"):
        boundaries = find_boundaries(surface, mesh, body, settings.boundaries)
    with clock("coordinates"):
        coordinates = solve_coordinates(mesh, boundaries)
        order = check_label_order(mesh, coordinates, body, settings.checks)
    with clock("sheet"):
        sheet = sample_sheet(mesh, coordinates, settings.sheet)
        bending = bending_angle(sheet, settings.measures)
        if boundaries.side_rule == "bending" and bending < 0:
            sheet, coordinates, boundaries = _turned(sheet, coordinates, boundaries)
            bending = -bending
        subfield = label_sheet(sheet, body)
    with clock("measures"):
        thickness = measure_thickness(sheet)
        layers = {
            name: mean_curvature(
                sheet.points[:, :, level], sheet.points[:, :, -1] - sheet.points[:, :, 0],
                settings.measures,
            )
            for name, level in (
                ("curvature_interior", 0),
                ("curvature", sheet.points.shape[2] // 2),
                ("curvature_exterior", -1),
            )
        }
        expected = boundaries.sheet_thickness
        flags = [
            *check_thickness(thickness, expected, settings.checks),
            *_flags(solid, boundaries, sheet, bending, folded_fraction(mesh, coordinates), settings),
        ]
        summary = summarize(
            sheet, thickness, subfield, volume.scheme.sheet,
            signed_volume(surface.vertices, surface.triangles),
        )
    return HemisphereMaps(
        sheet=sheet,
        thickness=thickness,
        subfield=subfield,
        summary=summary,
        qc=_qc(body, solid, surface, mesh, coordinates, boundaries, sheet)
        | {
            "medial_offset_mm": side,
            "voxels_across": across,
            "intersecting_triangles": crossings,
            "label_order": order,
            "bending_rad": bending,
            "thickness_mean_mm": summary["thickness_mean"],
            "thickness_expected_mm": expected,
        },
        repairs=tuple(map(str, solid.repairs)),
        flags=tuple(flags),
        mesh=mesh,
        coordinates=coordinates,
        **layers,
    )


def _untangled(solid: SolidField, surface: Surface, settings: Settings) -> tuple[Surface, int]:
    """Smooth more where the surface intersects itself; whatever is left, TetGen decides."""
    crossings = count_intersections(surface, settings.tetra)
    for extra in range(1, settings.surface.untangle_tries + 1):
        if crossings <= 0:
            break
        steps = settings.surface.taubin_iterations * (1 + extra)
        surface = extract_surface(
            solid.field, replace(settings.surface, taubin_iterations=steps)
        )
        crossings = count_intersections(surface, settings.tetra)
    return surface, crossings


def _turned(
    sheet: Sheet, coordinates: Coordinates, boundaries: Boundaries
) -> tuple[Sheet, Coordinates, Boundaries]:
    """Exchange interior and exterior."""
    return (
        Sheet(points=sheet.points[:, :, ::-1], valid=sheet.valid),
        Coordinates(values=coordinates.values * [1, 1, -1]),
        replace(boundaries, interior=boundaries.exterior, exterior=boundaries.interior),
    )


def _flags(
    solid: SolidField,
    boundaries: Boundaries,
    sheet: Sheet,
    bending: float,
    folded: float,
    settings: Settings,
) -> list[Flag]:
    checks = settings.checks
    filled = 1 - float(sheet.valid.mean())
    rows = [
        *(
            (repair.large, "large-repair", f"{repair}: a large repair, look at the labels there")
            for repair in solid.repairs
        ),
        (
            solid.changed_fraction > settings.topology.flag_fraction,
            "much-repaired",
            f"{solid.changed_fraction:.1%} of the body was changed by repairs: look at the labels",
        ),
        (
            boundaries.rim_distance > checks.flag_rim_distance,
            "boundary-doubtful",
            f"the medial or lateral boundary is uncertain by {boundaries.rim_distance:.1f} mm: "
            "look at the ends of the ribbon in each slice",
        ),
        (
            boundaries.side_rule == "labels" and bending < -checks.flag_bending,
            "side-doubtful",
            f"interior labels lie on the outer side of the bend ({bending:.1f} rad): "
            "check the dentate gyrus labels",
        ),
        (
            folded > checks.flag_folded,
            "folded",
            f"the coordinates fold in {folded:.1%} of the volume: look at the map",
        ),
        (
            filled > checks.flag_filled,
            "columns-filled",
            f"{filled:.1%} of the columns were filled from their neighbors: look at the map",
        ),
    ]
    return [Flag(reason=reason, message=message) for wrong, reason, message in rows if wrong]


def _qc(
    body: Body,
    solid: SolidField,
    surface: Surface,
    mesh: TetMesh,
    coordinates: Coordinates,
    boundaries: Boundaries,
    sheet: Sheet,
) -> dict[str, Any]:
    """Numbers and words that say whether to trust the map."""
    ends = body.ends
    return {
        "voxel_size_mm": np.linalg.norm(body.affine[:3, :3], axis=0).round(4).tolist(),
        "body_voxels": int(np.count_nonzero(body.inside)),
        "layer_voxels": body.layer_voxels,
        "body_length_mm": ends.length(body.inside_points()[1]),
        "posterior_end_rule": ends.posterior_rule,
        "anterior_end_rule": ends.anterior_rule,
        "posterior_plane": _plane(ends.posterior_point, ends.posterior_normal),
        "anterior_plane": _plane(ends.anterior_point, ends.anterior_normal),
        "euler_before": solid.euler_before,
        "euler_after": 1,
        "changed_fraction": solid.changed_fraction,
        "surface_vertices": len(surface.vertices),
        "surface_euler": 2,
        "posterior_cap_vertices": int(surface.posterior_cap.sum()),
        "anterior_cap_vertices": int(surface.anterior_cap.sum()),
        "tetrahedra": len(mesh.tetrahedra),
        "tetra_quality_median": float(np.median(tetra_quality(mesh))),
        "tetra_quality_p01": float(np.quantile(tetra_quality(mesh), 0.01)),
        "boundary_rule": boundaries.rule,
        "boundary_distance_mm": boundaries.distance,
        "boundary_rim_distance_mm": boundaries.rim_distance,
        "boundary_strip_mm": boundaries.strip_width,
        "side_rule": boundaries.side_rule,
        "side_margin": boundaries.side_margin,
        "folded_fraction": folded_fraction(mesh, coordinates),
        "filled_columns": int(np.count_nonzero(~sheet.valid)),
        "filled_fraction": float(1 - sheet.valid.mean()),
        "regions_outside": "head and tail (as in Diers et al. 2023)",
    }


def _plane(point: Float, normal: Float) -> dict[str, list[float]]:
    return {"point_ras_mm": point.round(3).tolist(), "normal_ras": normal.round(4).tolist()}
