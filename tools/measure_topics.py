"""Texts of the page of measures: figures, and the measures that each explains."""

from collections.abc import Mapping
from dataclasses import dataclass

from hipsta_bids.geometry.catalog import PER_SUBFIELD, SECTIONS


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A figure and the measures that it explains."""

    figure: str
    """As in ``DRAWINGS``."""
    title: str
    text: str
    measures: Mapping[str, tuple[str, ...]]
    """Names by table."""


def _three(name: str) -> tuple[str, ...]:
    """Name a measure of the three surfaces."""
    return (name, f"{name}_interior", f"{name}_exterior")


TOPICS = (
    Topic(
        figure="thickness",
        title="Thickness",
        text="Gray lines are columns of the sheet, which follow z from the interior to the exterior"
        " wall. Two columns are colored, with the lengths of their steps. Thickness is the"
        " length of a column. `thickness_mean` weights grid points by the area of the"
        " mid-surface and excludes points that were not measured directly. `thickness_nodes` is the"
        " unweighted mean over grid points, as in Diers et al. (2023). Grid points are not"
        " evenly spaced, therefore the two means differ. `extent_z` includes all points.",
        measures={
            "sheet": ("thickness",),
            "sections": ("thickness",),
            "summary": ("thickness_mean", "thickness_nodes", "extent_z"),
        },
    ),
    Topic(
        figure="extents",
        title="Extents",
        text="The mid-surface with one line along each axis. Lines reach from edge to edge and from"
        " end plane to end plane. The long axis of this phantom is bent, therefore lines along y"
        " differ in length.",
        measures={
            "sheet": ("extent_x", "extent_y"),
            "summary": ("extent_x", "extent_y"),
        },
    ),
    Topic(
        figure="sections",
        title="Cross-sections",
        text="The middle cross-section with its walls and its area (gray), and the measures of all"
        " cross-sections. Where a wall ends on a rounded edge is arbitrary. In the outer tenth"
        " at either edge, wall lengths therefore follow the mid-line, scaled by the ratio of"
        " wall and mid-line further inside. `shape_index` is circumference over area, not the"
        " shape index of Koenderink.",
        measures={
            "sections": tuple(row.name for row in SECTIONS if row.name != "thickness"),
            "summary": (
                "circumference_mean",
                "interior_exterior_ratio_mean",
                "section_area_mean",
                "shape_index_mean",
            ),
        },
    ),
    Topic(
        figure="curvature",
        title="Mean curvature",
        text="Circles that touch the three surfaces at one column, with the measured radii. Mean"
        " curvature is half the sum of the principal curvatures. They follow from the first and"
        " second fundamental form of cubic polynomials in windows of 9 x 9 grid points. Curvature"
        " is positive"
        " where the surface is concave towards the interior side; a cylinder of radius r has"
        " 1/(2r). Voxels roughen single points, most on the interior wall. Means exclude the"
        " four outermost rows and columns of grid points.",
        measures={
            "sheet": _three("curvature"),
            "summary": tuple(f"{name}_mean" for name in _three("curvature")),
        },
    ),
    Topic(
        figure="gaussian",
        title="Gaussian curvature",
        text="The product of the principal curvatures, in windows of 9 x 21 grid points. It is zero"
        " where a surface could be flattened without stretching. The axis of this phantom bends,"
        " therefore the lateral part is a dome. White grid points are excluded from means.",
        measures={
            "sheet": _three("gaussian_curvature"),
            "summary": tuple(f"{name}_mean" for name in _three("gaussian_curvature")),
        },
    ),
    Topic(
        figure="surfaces",
        title="Areas and volume",
        text="The three surfaces from edge to edge and from end plane to end plane, over 16 mm."
        " Edges and end planes are excluded from the areas.",
        measures={
            "summary": (
                *(f"area_{name}" for name in ("interior", "mid", "exterior")),
                "area_ratio",
                "volume",
                "surface_volume_ratio",
            )
        },
    ),
    Topic(
        figure="subfields",
        title="Subfields",
        text="Grid points by subfield: the most frequent label of the column. Areas use the labels"
        " at about ten thousand places between grid points, volumes the labels of tetrahedra.",
        measures={"subfields": tuple(row.name for row in PER_SUBFIELD)},
    ),
    Topic(
        figure="profiles",
        title="Profiles",
        text="`desc-profile_morph.tsv` has each map averaged over y, and over x, weighted by area;"
        " here thickness.",
        measures={},
    ),
    Topic(
        figure="layers",
        title="Layers",
        text="Points of a column have equal distances, or equal volumes between layers"
        " (`sheet.depths`). Equal volumes move points outwards at a bend. Layers decide where"
        " `--map` samples; no measure depends on them.",
        measures={},
    ),
)

INTRODUCTION = """\
This page defines the measures of the participant level. The example is a phantom: a spiral wall, 16
mm long, with a bent axis. Its thickness is 2 mm and varies by 20 % along x. It was drawn in voxels
of 0.4 mm and measured with default settings. *Measured* is the result, *analytic* the exact value;
both are means over maps and cross-sections, and values of CA1 for subfields. The tables are
`desc-sheet_morph.tsv` (also as GIFTI maps), `desc-sections_morph.tsv` and `desc-summary_morph.tsv`;
measures of subfields are in the latter, with the name of the subfield. [Method](method.md) defines
the coordinates x, y and z."""

ERRORS = """\
Smallest and largest error of the means over eight phantoms (left, 0.4 mm, one drawing each):
[all errors](measures-errors.tsv). Errors of Gaussian curvature are in 1/mm². Tests require 2 % for
all measures, 5 % for mean curvature and 0.005 1/mm² for Gaussian curvature, except on the tight
spiral. Its interior radius of 0.6 mm at the lateral end is too small for voxels of 0.4 mm, and the
interior wall is too long. Areas and volumes of subfields may differ by a strip of 0.15 mm, because
labels end at voxels and smoothing rounds edges. In the wall of 1.2 mm, thickness of CA2 and CA3 may
differ by 0.03 mm. [Validation](validation.md) has the errors over positions and voxel sizes."""

SIZES_TEXT = """\
Ranges over {count} measurements of real bodies: both hemispheres of three brains with manual labels
(Winterburn et al. 2013, NeuroImage 74:254-265). The labels are in FreeSurfer's codes at 0.3 mm, and
in ASHS's codes at 0.4 x 0.4 x 1.5 mm. End planes were placed at fixed fractions of the length of
the hippocampus; `extent_y`, areas and volumes depend on this choice."""

PUBLISHED = """\
For comparison, manual segmentations of the whole hippocampus have 3208 mm³ (left) and 3324 mm³
(right) on average (Pruessner et al. 2000, Cereb Cortex 10:433-442). They include head, tail,
dentate gyrus and CA4, which the sheet excludes."""
