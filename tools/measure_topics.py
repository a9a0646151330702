"""What the page of measures says: figures, the measures that each explains, and texts."""

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
        text="Gray lines are columns of the sheet: they follow z from the interior to the exterior"
        " wall. Two of them are drawn in color with the lengths of their points' steps. Means count"
        " every square millimeter of the mid-surface the same, but for `thickness_nodes`: there"
        " every node counts the same, as in Diers et al. (2023).",
        measures={
            "sheet": ("thickness",),
            "sections": ("thickness",),
            "summary": ("thickness_mean", "thickness_nodes", "extent_z"),
        },
    ),
    Topic(
        figure="extents",
        title="Extents",
        text="The mid-surface with one line along each of its axes. The long axis of this phantom"
        " is bent, so lines along y differ in length.",
        measures={
            "sheet": ("extent_x", "extent_y"),
            "summary": ("extent_x", "extent_y"),
        },
    ),
    Topic(
        figure="sections",
        title="Cross-sections",
        text="The middle cross-section with its walls and its area in gray, and the same measures"
        " in all sections. Next to the rims, the walls are continued along the mid-surface.",
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
        text="At a column, the circles that touch the three surfaces across the axis, with the"
        " radii that were measured. Single points have the roughness of the voxels, on the"
        " interior most; means are taken away from rims and ends.",
        measures={
            "sheet": _three("curvature"),
            "summary": tuple(f"{name}_mean" for name in _three("curvature")),
        },
    ),
    Topic(
        figure="gaussian",
        title="Gaussian curvature",
        text="The product of both curvatures: zero where a surface could be laid flat. Here the"
        " axis bends too, so the lateral part is a dome. White: next to rims and ends, where it is"
        " not summed up.",
        measures={
            "sheet": _three("gaussian_curvature"),
            "summary": tuple(f"{name}_mean" for name in _three("gaussian_curvature")),
        },
    ),
    Topic(
        figure="surfaces",
        title="Areas and volume",
        text="The three surfaces from rim to rim and from end to end; the body is 16 mm long. Rims"
        " and end planes do not count as surface.",
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
        text="The nodes of the sheet by subfield. Areas and volumes do not depend on the nodes:"
        " they go by the labels at some ten thousand places between them, and by the tetrahedra.",
        measures={"subfields": tuple(row.name for row in PER_SUBFIELD)},
    ),
    Topic(
        figure="profiles",
        title="Profiles",
        text="Every map is averaged over y and over x in `desc-profile_morph.tsv`, by area; here"
        " thickness.",
        measures={},
    ),
    Topic(
        figure="layers",
        title="Layers",
        text="Points of a column lie at equal distances, or so that the same volume lies between"
        " any two layers, which moves them outwards at a bend (setting `sheet.depths`). They say"
        " where `--map` samples; no measure depends on them.",
        measures={},
    ),
)

INTRODUCTION = """\
What every number of the participant level is, shown on a phantom: a spiral wall of 2 mm that
varies by 20 % along x, 16 mm long, with a bent axis, drawn as labels in voxels of 0.4 mm and
measured with default settings. *Measured* is what came out, *analytic* what a perfect method
would find; of maps and of cross-sections both are means, of subfields those of CA1. x runs from
medial to lateral, y from posterior to anterior, z from interior to exterior."""

ERRORS = """\
The same comparison on other phantoms, one drawing each (left, 0.4 mm). Errors of Gaussian
curvature, and of curvatures that are zero, are in their unit. Tests ask for 2 % of every measure
(5 % of curvature, 0.005 1/mm² of Gaussian curvature) on shapes like these but the last, on both
sides. Areas and volumes of subfields may also be off by a strip of 0.15 mm: labels end at voxels,
and smoothing rounds off the sharp rims of phantoms, by 0.13 mm² per section. Thickness of CA2 and
CA3 in the wall of 1.2 mm may be off by 0.03 mm: three voxels at the strongest bend. The tight
spiral has an interior radius of 0.6 mm at its lateral end, which voxels of 0.4 mm do not hold: its
interior wall comes out too long."""

SIZES_TEXT = """\
Ranges over {count} measurements of real bodies: both hemispheres of three brains, with manual
labels (Winterburn et al. 2013, NeuroImage 74:254-265) in FreeSurfer's codes at 0.3 mm and in
ASHS's at 0.4 x 0.4 x 1.5 mm. The ends of the body were set at fixed shares of the hippocampus's
length, so `extent_y`, areas and volumes depend on that choice."""

PUBLISHED = """\
For scale: whole hippocampi have 3208 (left) and 3324 mm³ (right) on average by manual
segmentation (Pruessner et al. 2000, Cereb Cortex 10:433-442), dentate gyrus, CA4, head and tail
included, none of which is part of the sheet."""
