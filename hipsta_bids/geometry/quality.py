"""Numbers that say whether to trust a map, and flags."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.catalog import Measured
from hipsta_bids.geometry.checks import check_cross_sections, check_image, check_labels, check_rows
from hipsta_bids.geometry.mesh import tetra_quality
from hipsta_bids.geometry.topology import SolidField
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.types import Bool, Flag, Float

#: What every protocol labels along the sheet, from medial to lateral.
_PARTS = {
    "subiculum": (Tissue.PRESUBICULUM, Tissue.SUBICULUM),
    "CA1": (Tissue.CA1,),
    "CA2 or CA3": (Tissue.CA2, Tissue.CA2_3, Tissue.CA3),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """One hemisphere's sheet, and what the stages found out on their way to it."""

    measured: Measured
    side: float
    """How far the medial subfields lie medially of CA1, mm."""
    solid: SolidField
    voxels_across: float
    smoothed: int
    """How often the surface was smoothed more because TetGen could not fill it."""
    boundaries: Boundaries
    label_order: float
    """Rank correlation of x with the labels' order."""
    bending: float
    """Angle by which the sheet bends round its interior side, rad."""
    folded: float
    """Fraction of the volume in which the coordinates have the opposite orientation."""


def find_flags(evidence: Evidence) -> list[Flag]:
    """List what a person should look at before using the map."""
    measured, solid, boundaries = evidence.measured, evidence.solid, evidence.boundaries
    body, sheet, settings = measured.body, measured.sheet, measured.settings
    checks = settings.checks
    filled = 1 - float(sheet.valid.mean())
    present = set(np.unique(body.tissue[body.inside]).tolist())
    rows: list[tuple[bool, str, str]] = [
        (repair.large, "large-repair", f"{repair}: a large repair, look at the labels there")
        for repair in solid.repairs
    ]
    rows += [
        (
            not present & set(tissues),
            "subfield-missing",
            f"the body has no {name}: the sheet ends there; look at the labels",
        )
        for name, tissues in _PARTS.items()
        if body.region != "entorhinal"
    ]
    rows += [
        (
            solid.changed_fraction > settings.topology.flag_fraction,
            "much-repaired",
            f"{solid.changed_fraction:.1%} of the body was changed by repairs: look at the labels",
        ),
        (
            boundaries.rim_distance > checks.flag_rim_distance * boundaries.sheet_thickness,
            "boundary-doubtful",
            f"the medial or lateral boundary is uncertain by {boundaries.rim_distance:.1f} mm",
        ),
        (
            # The cortex beside the body bends the other way.
            body.region == "body"
            and boundaries.side_rule == "labels"
            and evidence.bending < -checks.flag_bending,
            "side-doubtful",
            f"dentate gyrus labels lie on the outer side of the bend ({evidence.bending:.1f} rad)",
        ),
        (
            evidence.folded > checks.flag_folded,
            "folded",
            f"the coordinates fold in {evidence.folded:.1%} of the volume: look at the map",
        ),
        (
            filled > checks.flag_filled,
            "columns-filled",
            f"{filled:.1%} of the columns were filled from their neighbors: look at the map",
        ),
    ]
    found = [Flag(reason=reason, message=message) for wrong, reason, message in rows if wrong]
    return [
        *found,
        *check_image(body, checks),
        *check_labels(body, checks),
        *check_cross_sections(solid.field, body, checks, solid.touched & (solid.field.values < 0)),
        *check_rows(sheet, checks),
    ]


def quality_metrics(evidence: Evidence, repaired: Bool) -> dict[str, Any]:
    """Numbers and words that say whether to trust the map, JSON-serializable.

    ``repaired`` marks the columns (Nx, Ny) that a repair touched.
    """
    measured, solid, boundaries = evidence.measured, evidence.solid, evidence.boundaries
    body, ends, surface = measured.body, measured.body.ends, measured.surface
    quality = tetra_quality(measured.mesh)
    valid = measured.sheet.valid
    return {
        "region": body.region,
        "voxel_size_mm": np.linalg.norm(body.affine[:3, :3], axis=0).round(4).tolist(),
        "body_voxels": int(np.count_nonzero(body.inside)),
        "layer_voxels": body.layer_voxels,
        "body_length_mm": ends.length(body.inside_points()[1]),
        "medial_offset_mm": evidence.side,
        "posterior_end_rule": ends.posterior_rule,
        "anterior_end_rule": ends.anterior_rule,
        "posterior_plane": _plane(ends.posterior_point, ends.posterior_normal),
        "anterior_plane": _plane(ends.anterior_point, ends.anterior_normal),
        "voxels_across": evidence.voxels_across,
        "euler_before": solid.euler_before,
        "euler_after": solid.euler_after,
        "changed_fraction": solid.changed_fraction,
        "surface_vertices": len(surface.vertices),
        "posterior_cap_vertices": int(surface.posterior_cap.sum()),
        "anterior_cap_vertices": int(surface.anterior_cap.sum()),
        "extra_smoothing": evidence.smoothed,
        "tetrahedra": len(measured.mesh.tetrahedra),
        "tetra_quality_median": float(np.median(quality)),
        "tetra_quality_p01": float(np.quantile(quality, 0.01)),
        "boundary_rule": boundaries.rule,
        "boundary_distance_mm": boundaries.distance,
        "boundary_rim_distance_mm": boundaries.rim_distance,
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
        "repaired_fraction": float(repaired.mean()),
        **({"mask_change": asdict(body.mask_change)} if body.mask_change else {}),
    }


def _plane(point: Float, normal: Float) -> dict[str, list[float]]:
    return {"point_ras_mm": point.round(3).tolist(), "normal_ras": normal.round(4).tolist()}
