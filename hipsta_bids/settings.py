"""Every number that changes a result: default, range, unit, meaning.

One table per stage; a stage receives its own table only and has no defaults of its own.
What does not change a result (jobs, verbosity, folders) is in
:class:`hipsta_bids.participant.run.RunOptions`.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from hipsta_bids.protocols.toml import (
    Fraction,
    Numbers,
    Odd,
    OpenFraction,
    OpenFractions,
    PositiveFraction,
    SettingsTable,
    read_settings,
)


class BodySettings(SettingsTable):
    """From labels to the body's mask and end planes."""

    region: Literal["body", "extended", "entorhinal", "headbody", "whole"] = "body"
    """What is measured: ``body`` (the subfields between the end planes), ``extended`` (with the
    neighboring cortex), ``entorhinal`` (that cortex alone), and, experimental, ``headbody`` and
    ``whole`` (with the tail)."""
    min_cortex_reach: PositiveFraction = 0.9
    """Refuse cortex with labels along less than this share of the body."""
    layer_rule: Literal["nearest-sheet", "nearest-label"] = "nearest-sheet"
    """Who gets the molecular layer: ``nearest-sheet`` (the nearest sheet subfield; Diers et al.
    2023) or ``nearest-label`` (the nearest label; voxels nearest to DG or CA4 are left out)."""
    join_every_layer: bool = False
    """Join the molecular layer to the sheet also where the protocol leaves it out (HippUnfold)."""
    min_length: NonNegativeFloat = 5.0
    """Shortest body that is measured, mm."""
    min_end_voxels: NonNegativeInt = 50
    """Fewer head or tail voxels than this count as no label."""
    plane_reach: PositiveFloat = 3.0
    """End planes are fitted to labels within this distance of the interface, mm; head and tail
    labels that lie up to it on the wrong side get the subfield of a neighbor."""
    plane_ratio: NonNegativeFloat = 1.8
    """Where slices are thicker than this many pixels, they have a say in the tilt of the planes."""
    plane_slices: PositiveFloat = 1.5
    """There planes are fitted to labels within this many slices of the interface."""
    plane_width: PositiveFloat = 0.05
    """Width of the logistic function, slices."""
    plane_tilt: Annotated[float, Field(gt=0, lt=90)] = 10.0
    """Tilts against the slices are expected to be of this size, degrees (standard deviation)."""
    plane_prior: NonNegativeFloat = 0.05
    """Weight of that expectation; all labels together weigh 1."""
    end_margin: NonNegativeFloat = 0.0
    """Taken off either end where head or tail labels are missing, mm."""
    end_smoothing: PositiveFloat = 1.0
    """Without end labels: standard deviation by which profiles along the axis are smoothed, mm."""
    end_usual: OpenFraction = 0.3
    """What is usual in the body: this quantile over cross-sections with CA1 and CA2 or CA3."""
    end_weight: PositiveFloat = 3.0
    """How much a millimeter of certain evidence multiplies odds, natural logarithm (times 0.5)."""
    lost_share: PositiveFraction = 0.5
    """Even odds of an end: the sheet, CA1, or CA2 and CA3 have this share of their usual area."""
    core_share: PositiveFraction = 0.5
    """The same of dentate gyrus and CA4, since the sheet closes over them in the tail."""
    lost_width: PositiveFloat = 0.5
    """The evidence rises from none to certain over this range of such shares."""
    uncus_spread: Annotated[float, Field(gt=1)] = 2.5
    """Even odds: CA2 and CA3 spread this many times as far as usual, since the uncus has some."""
    core_growth: Annotated[float, Field(gt=1)] = 1.6
    """The same of dentate gyrus and CA4; and even odds at this multiple of their usual area."""
    head_growth: Annotated[float, Field(gt=1)] = 1.5
    """Even odds: the sheet has this multiple of its usual area."""
    gap_directions: NonNegativeInt = 3
    """A voxel without a label lies in a thin gap if it has the sheet on both sides in this
    many of 13 directions; where an edge of the voxels is longer than ``slit_voxel``, in the same
    share of those across that edge."""
    slit_area: NonNegativeFloat = 2.5
    """Gaps larger than this are filled if they go through the sheet, mm2."""
    slit_openings: Fraction = 0.2
    """A gap goes through the sheet if what is beside it falls into two parts, each of at least this
    share (in six real bodies: none, and gaps with one opening are up to 4.0 mm2)."""
    slit_voxel: NonNegativeFloat = 0.8
    """Gaps are filled if no voxel edge is longer, mm: folds between thick slices look alike."""
    pit_reach: PositiveFloat = 0.9
    """A voxel without a label lies in a pit if the sheet is this near, mm, ..."""
    pit_sides: Annotated[int, Field(ge=4, le=6)] = 5
    """... on so many of its six sides (5 is open on one side)."""
    pit_size: Numbers = (0.2, 1.8)
    """Pits of this volume are filled, mm3, where gaps are (there are two in six real bodies)."""
    uncus_size: NonNegativeFloat = 1.0
    """Smaller pieces of CA2 or CA3 are no uncus, mm3."""
    uncus_offset: PositiveFloat = 5.0
    """CA2 or CA3 at the anterior plane is the uncus if it lies farther than this medially of the
    body's own, mm (10 to 12 in three real brains)."""
    cavity_openness: Fraction = 0.25
    """What is enclosed in a slice is filled if at most this share of what surrounds it is open to
    the next slices; between thick slices, whatever lies there."""
    cavity_radius: NonNegativeFloat = 0.9
    """A cavity with room for a ball of this radius is too wide to be the molecular layer, mm."""
    end_fullness: OpenFraction = 0.9
    """Cross-sections where labels end obliquely go below this share of those behind them."""
    end_reach: NonNegativeFloat = 3.0
    """Length behind an end that is compared, and of which all may be left out, mm."""
    max_mask_ratio: PositiveFloat = 1.5
    """Flag an edited mask whose voxels are more than this many times those of the labels."""
    max_mask_change: NonNegativeFloat = 0.5
    """Flag an edited mask that adds and removes more than this share of the body."""


class GridSettings(SettingsTable):
    """The working grid on which the surface is made."""

    spacing: Annotated[float, Field(ge=0.1, le=1)] = 0.35
    """Distance of grid nodes and so the edge length of the meshes, mm."""
    smoothing: Annotated[float, Field(ge=0, le=3)] = 0.9
    """Standard deviation of the Gaussian, in in-plane voxels of the segmentation."""
    min_smoothing: NonNegativeFloat = 0.36
    """Least standard deviation of that Gaussian, mm, so that finer voxels do not change maps:
    what smoothing takes from thin edges and narrow bends changes the mean thickness."""
    margin: PositiveFloat = 1.5
    """Free space around the body, mm."""
    beyond: NonNegativeFloat = 1.75
    """The body goes on for this much beyond each end plane, mm, as it is there: columns would be
    oblique, and too long, next to a plane that cuts the sheet obliquely."""


class SliceSettings(SettingsTable):
    """Shapes between thick slices."""

    min_ratio: NonNegativeFloat = 1.8
    """Slices thicker than this many pixels are interpolated by shape."""
    upsampling: PositiveInt = 2
    """Fine pixels per pixel."""
    smoothing: NonNegativeFloat = 0.7
    """Standard deviation of the Gaussian in a slice, pixels."""
    reach: PositiveFloat = 2.0
    """Distances from the outline are kept up to this, mm."""
    edge: PositiveFloat = 0.2
    """Half width of the ramp across the outline, mm."""
    max_fragments: PositiveInt = 8
    """Most fragments that are joined in a slice."""
    max_rank_jump: NonNegativeInt = 2
    """Fragments are joined preferably to subfields at most this many ranks away."""
    bridge: NonNegativeFloat = 0.45
    """Half width of a bridge between fragments, mm."""
    max_gap: NonNegativeFloat = 1.2
    """Fragments are joined across at most this distance, mm."""
    max_break: NonNegativeFloat = 3.0
    """The same where a slice beside shows the ribbon, for pieces with a subfield of their own."""
    crumb_area: NonNegativeFloat = 1.5
    """Fragments farther away are dropped if they are smaller than this, mm2."""
    hole_area: NonNegativeFloat = 3.0
    """Smaller holes in a slice are filled, mm2."""
    ring_length: NonNegativeFloat = 0.02
    """Rings are cut along the cheapest path: cost of its length, to which depth in the ribbon (mm)
    is added."""
    ring_beside: NonNegativeFloat = 2.0
    """What lies in the ribbon of the slices beside costs their depth times this as well."""
    turn_length: PositiveFloat = 3.0
    """Turns are parts of the ribbon farther apart along it than this, mm."""
    ribbon_nodes: Annotated[int, Field(ge=3)] = 81
    """Nodes along the ribbon of a slice."""
    rim_half: PositiveFloat = 0.5
    """Half length of the edges of the ribbon along its outline, multiples of 2 area / length."""
    least_half: NonNegativeFloat = 0.3
    """Half the least thickness of the ribbon in a slice, mm: the working grid's smoothing leaves
    three fourths of the height of a strip of 0.6 mm, but only half of one of 0.4 mm."""
    match_stretch: NonNegativeFloat = 0.5
    """Mid-lines of slices are matched by squared distance, mm2, and this times squared stretch."""
    path_smoothing: Fraction = 1.0
    """Paths of the ribbon's nodes through the slices: from 0 (through their places in the slices)
    to 1 (cubic B-splines with these as control points: half the variance of noise is left)."""
    flow_window: PositiveFloat = 1.0
    """Standard deviation of the window of the registration of slices, mm."""
    flow_ridge: NonNegativeFloat = 0.02
    """Added to the mean squared slope in a window, which is 1 where outlines fill it: keeps
    displacements small where the outlines do not tell them."""
    flow_smoothing: NonNegativeFloat = 0.5
    """Standard deviation of the Gaussian on displacements after each iteration, mm."""
    flow_iterations: NonNegativeInt = 5
    """Iterations of the registration per level."""
    touch: NonNegativeFloat = 0.6
    """The subiculum and CA2 or CA3 are kept apart where both are nearer than this, mm."""
    slit: NonNegativeFloat = 0.3
    """Half width of the slit that keeps them apart, mm."""
    hidden_depth: NonNegativeFloat = 0.1
    """What lies less deep than this inside an end plane is taken from inside, where the sheet's
    labels end at the plane, mm."""
    extrapolation: NonNegativeFloat = 0.5
    """There, and beyond the last slice, shapes go on changing at this fraction of their pace."""


class TopologySettings(SettingsTable):
    """Repair of holes, bridges, islands and cavities."""

    levels: PositiveInt = 6
    """Steps in which field values are ordered while growing and shrinking."""
    rounds: NonNegativeInt = 12
    """Most rounds of repair."""
    depth_rank: NonNegativeFloat = 0.05
    """Share of the field that each grid node of depth adds to the order of that."""
    small_cost: NonNegativeFloat = 5.0
    """Membranes cheaper than this are applied together; costlier ones one per round."""
    plug_reach: NonNegativeInt = 8
    """A filled hole becomes as thick as the wall within this distance of it, grid nodes."""
    plug_neighbors: PositiveInt = 12
    """Number of nearest nodes of the wall's middle that a filled hole takes its thickness from."""
    oriented_nodes: NonNegativeInt = 4
    """Membranes of fewer nodes have no direction."""
    cut_across: NonNegativeFloat = 0.3
    """A cut severs the ribbon, no bridge, if this share lies across the axis (squared areas)."""
    sever_reach: NonNegativeInt = 2
    """A cut severs the ribbon if the body goes on this many grid nodes before and behind it."""
    sever_share: NonNegativeFloat = 0.1
    """Share of the cut's nodes at which the body has to go on."""
    sever_along: NonNegativeFloat = 0.5
    """A cut severs in any case if the line between its stumps is more along the axis than this,"""
    bridge_along: NonNegativeFloat = 0.25
    """and in no case if it is less than this (squared cosines with the axis)."""
    sever_factor: NonNegativeFloat = 1000.0
    """Such cuts cost this much more: where one is the only way, the hemisphere is flagged."""
    contact_reach: NonNegativeFloat = 1.2
    """A cut this near, mm, to both the subiculum and CA2 or CA3 severs but turns that touch."""
    fill_across: NonNegativeFloat = 0.5
    """A fill spans the inside of a bend rather than a hole if this share lies across the axis."""
    lid_nodes: NonNegativeFloat = 6.0
    """A fill within this distance of an end plane closes an end and no bend, grid nodes."""
    across_factor: NonNegativeFloat = 40.0
    """Such fills cost this much more."""
    flag_cut_cost: NonNegativeFloat = 2.0
    """Flag a cut that overrules more evidence than this (sum of the field)."""
    flag_fill_cost: NonNegativeFloat = 8.0
    """Flag a filled hole whose membrane overrules more evidence (holes of .8 mm radius: 2 to 6)."""
    doubtful_fill_cost: NonNegativeFloat = 2.0
    """Flag a fill across the axis that overrules more than this (sum of the field)."""
    flag_part: NonNegativeFloat = 0.01
    """Flag the separation of turns that touch beyond this fraction of the body."""
    flag_fraction: NonNegativeFloat = 0.05
    """Flag a repair, or all together, beyond this fraction of the body."""


class SurfaceSettings(SettingsTable):
    """The closed surface of the body."""

    taubin_iterations: NonNegativeInt = 16
    """Pairs of shrinking and inflating steps."""
    taubin_shrink: Fraction = 0.5
    """Step towards the mean of the neighbors, fraction."""
    taubin_inflate: Annotated[float, Field(ge=-1, le=0)] = -0.53
    """Step back, fraction."""
    untangle_tries: NonNegativeInt = 2
    """How often a surface that TetGen cannot fill is smoothed more."""


class TetraSettings(SettingsTable):
    """The tetrahedral mesh."""

    radius_edge_ratio: Annotated[float, Field(ge=1)] = 2.0
    """Worst ratio of circumradius to shortest edge (TetGen's q)."""
    smoothing_steps: NonNegativeInt = 0
    """Passes in which TetGen moves its own vertices to better places (its own default is 7). They
    cost time; on phantoms the errors were the same without."""
    timeout: PositiveFloat = 60.0
    """Give up after this time, s."""


class BoundarySettings(SettingsTable):
    """Medial and lateral boundary strips, and which side is interior."""

    solver: Literal["two-level", "lapy"] = "two-level"
    """What solves Laplace's equation, for boundaries and coordinates; ``lapy`` is slower."""
    sharp_bend: NonNegativeFloat = 0.5
    """Convex bends with less curvature than this do not slow diffusion, 1/mm."""
    anisotropy: NonNegativeFloat = 8.0
    """Diffusion across sharper ones, of curvature k, is slowed by exp(-anisotropy (k -
    sharp_bend)), mm."""
    least_diffusion: PositiveFraction = 0.1
    """Least diffusion where curves are moved to the middle of the edges of the sheet."""
    curvature_smoothing: NonNegativeInt = 2
    """Smoothing steps of the curvature tensor."""
    lapy_curvature: PositiveFloat = 0.3
    """LaPy's curvature over curvature x mean edge length (measured on cylinders)."""
    label_neighbors: PositiveInt = 30
    """Voxels around a vertex whose labels tell how lateral it is."""
    label_stride: PositiveInt = 4
    """One vertex in this many is asked."""
    lateral_share: PositiveFraction = 0.1
    """Share of the vertices that count as most lateral."""
    axial_stretch: PositiveFloat = 4.0
    """Steps along the axis count this much longer, so that distances run across it."""
    rim_floor: PositiveFloat = 0.05
    """Cost of a path per mm along a rim; depth below the rim adds its square, mm2."""
    rim_zone: PositiveFloat = 1.5
    """Depth of the rim zones, multiples of 2 volume / wall area."""
    rim_bands: Numbers = (1.25, 1.0, 1.0)
    """Half widths of the bands in which curves are moved to the middle of the rims, same unit."""
    rim_reach: NonNegativeFloat = 0.75
    """The zones hold at least all within this distance of the rim path, in the same unit."""
    max_distance: NonNegativeFloat = 1.0
    """The two rules may differ by this much, mm; beyond it the rims are taken."""
    strip_facing: Annotated[float, Field(ge=-1, le=1)] = 0.62
    """The boundary strips face away from the sheet: least cosine of the angle between the wall's
    normal and the direction in which the sheet would go on."""
    first_strip: NonNegativeFloat = 0.55
    """At first they hold all within this distance of the curves, multiples of 2 volume / wall
    area."""
    least_strip: NonNegativeFloat = 0.25
    """They hold at least all within this distance of their middle lines, in the same unit."""
    strip_step: PositiveFloat = 0.5
    """The direction of the sheet is found after one, two and three steps of this length from the
    rim, in the same unit."""
    strip_neighbors: PositiveInt = 40
    """Number of tetrahedra over which that direction is averaged."""
    strip_stride: PositiveInt = 4
    """One tetrahedron in this many is asked."""
    rim_neighbors: PositiveInt = 15
    """Number of points of the edge over which it is averaged then."""
    strip_reach: Numbers = (0.9, 0.75)
    """They hold nothing farther than this from the curves, in the same unit; one value per round.
    Later rounds start from the middle lines of the strips of the round before."""
    probe_distances: Numbers = (0.4, 0.8, 1.2)
    """Distances at which interior labels are looked for, mm outside the wall."""
    min_probe_share: Fraction = 0.02
    """Fewer hits than this share count as no interior labels."""


class SheetSettings(SettingsTable):
    """The grid of the sheet, in coordinates from -1 to 1 along each axis.

    The grid of Hipsta (Diers et al. 2023) is x_extent 0.9, y_extent 0.975, z_extent 0.9.
    """

    x_nodes: Annotated[int, Field(ge=3, le=1000)] = 41
    """Nodes from medial to lateral."""
    y_nodes: Annotated[int, Field(ge=3, le=1000)] = 21
    """Nodes from posterior to anterior."""
    z_nodes: Odd = 9
    """Nodes from interior to exterior, odd so that the middle one is the mid-surface."""
    x_extent: PositiveFraction = 0.9
    """The grid spans plus and minus this along x."""
    y_extent: PositiveFraction = 1.0
    """The grid spans plus and minus this along y."""
    z_extent: PositiveFraction = 1.0
    """The grid spans plus and minus this along z; 1 is the whole wall."""
    max_filled: Fraction = 0.2
    """Refuse a sheet with a larger fraction of columns that could not be measured."""
    depths: Literal["distance", "volume"] = "distance"
    """How layers are spaced along each column: ``distance`` (evenly) or ``volume`` (the same volume
    between any two; Bok 1929, Leprince et al. 2015). The measures do not depend on it."""


class MeasureSettings(SettingsTable):
    """Measures on the sheet."""

    curvature_window: Odd = 9
    """Grid nodes over which a local polynomial is fitted, odd."""
    curvature_order: Annotated[int, Field(ge=2)] = 3
    """Order of the local polynomials."""
    gaussian_window: Odd = 21
    """Grid nodes along y over which they are fitted for the Gaussian curvature, odd: it multiplies
    noise along the axis with the curvature across it."""
    max_curvature: PositiveFloat = 2.5
    """Principal curvatures are bounded by this, 1/mm: the working grid holds no sharper bend."""
    rim_start: PositiveFraction = 0.8
    """Beyond this x, and its negative, the lengths and areas of both walls follow those of the
    mid-surface: where a rounded rim ends a wall is arbitrary."""
    rim_window: PositiveFloat = 0.2
    """Extent in x, before that, over which the ratio of wall and mid-surface is taken."""
    repair_reach: PositiveFloat = 0.35
    """A column is marked as repaired this near to a grid node that a repair changed, mm."""
    stump_reach: NonNegativeFloat = 0.7
    """A column is marked as repaired up to this much farther from a cut than what is nearest to the
    cut, mm."""

    @model_validator(mode="after")
    def _windows_hold_the_order(self) -> Self:
        if self.curvature_order >= min(self.curvature_window, self.gaussian_window):
            raise ValueError("curvature_order has to be below curvature_window and gaussian_window")
        return self


class CheckSettings(SettingsTable):
    """What makes a map doubtful (flag) or wrong (refusal)."""

    max_voxel: PositiveFloat = 0.9
    """Refuse larger voxels in plane, mm: no sheet is ``min_voxels_across`` of these thick."""
    min_voxels_across: NonNegativeFloat = 2.5
    """Refuse sheets thinner than this many in-plane voxels."""
    min_label_order: Annotated[float, Field(ge=-1, le=1)] = 0.45
    """Refuse if the rank correlation of x with the medial-to-lateral order of labels is lower."""
    flag_thickness_ratio: NonNegativeFloat = 0.15
    """Flag if the mean thickness departs from 2 volume / area by more than this fraction."""
    max_thickness_ratio: NonNegativeFloat = 0.35
    """Refuse beyond this fraction."""
    flag_folded: NonNegativeFloat = 0.05
    """Flag if a larger fraction of the volume has coordinates turned inside out."""
    flag_filled: NonNegativeFloat = 0.02
    """Flag if a larger fraction of the columns had to be filled from neighbors."""
    flag_bending: NonNegativeFloat = 0.5
    """Flag if the sheet turns round its exterior side by more than this, rad."""
    slice_ratio: NonNegativeFloat = 1.5
    """Voxels are long if their longest edge is more than this many times the shortest."""
    flag_end: NonNegativeFloat = 2.5
    """Flag an end without a label if its standard error is larger, mm (2.1 at most in 12 real)."""
    usual_length_difference: NonNegativeFloat = 4.0
    """The report marks sides whose lengths differ by more, mm (2.8 at most in real labels)."""
    end_label_depth: NonNegativeFloat = 2.0
    """Head or tail labels farther inside the body than this are out of place, mm."""
    end_label_share: NonNegativeFloat = 0.005
    """Flag them if they are more than this share of the body's voxels."""
    beyond_reach: PositiveFloat = 3.0
    """Labels are counted within this distance on both sides of an end plane, mm."""
    beyond_share: NonNegativeFloat = 0.7
    """Flag an end without a label if fewer lie beyond it than this share of those before it."""
    notch_reach: Numbers = (1.0, 2.0, 3.0)
    """A cross-section is compared with those at these distances on both sides, mm."""
    notch_share: Numbers = (0.12, 0.3, 0.35)
    """Flag if more than this share of what both sides have is missing, one per distance."""
    bump_contrast: NonNegativeFloat = 4.5
    """Flag a section with more of what others lack than so often the usual (suite population)."""
    intrusion_contrast: NonNegativeFloat = 3.7
    """The same for what both its neighbors label interior."""
    stub_nodes: NonNegativeFloat = 6.0
    """What lies this near to a bridge that was cut is left out of that comparison, grid nodes."""
    section_noise: NonNegativeFloat = 0.02
    """Share of the area added to the usual before, per mm of distance (interior: in all)."""
    flag_row_jump: NonNegativeFloat = 0.15
    """Flag if the width changes by more than this between rows, or by twice as much at an end."""
    flag_row_dip: NonNegativeFloat = 0.22
    """Flag rows narrower than the widest on both sides by more than this (from the population)."""
    row_dip_reach: NonNegativeFloat = 8.0
    """Distance along the axis within which rows are compared, mm."""
    flag_subfield_gap: NonNegativeFloat = 1.5
    """Flag rows without their edge's subfield over more than this, mm (1.2 at most in 128)."""
    edge_reach: Numbers = (2.5, 3.5, 5.0)
    """Edges are compared with themselves at these distances along the axis on both sides, mm."""
    flag_edge: Numbers = (1.8, 2.2, 2.7)
    """Flag an edge that recedes behind both by more than this, one per distance, mm."""
    ridge_reach: Numbers = (1.0, 2.0, 3.0)
    """Thickness is compared with that at these distances along the axis on both sides, mm."""
    ridge_columns: PositiveInt = 9
    """Number of neighboring columns of a row over which thickness is averaged for that."""
    flag_ridge: Numbers = (0.85, 1.4, 1.3)
    """Flag a band that is thicker than both by more than this, one per distance, mm."""
    flag_groove: Numbers = (0.55, 0.75, 0.75)
    """Flag a band that is thinner than both by more than this, one per distance, mm."""
    uncus_reach: NonNegativeFloat = 2.0
    """Warn of an uncus that begins farther than this behind the anterior plane, mm."""
    flag_cavity: NonNegativeFloat = 0.03
    """Flag a wide cavity beyond this share of the body: the mean may be off by half of it."""
    flag_reach: PositiveFloat = 1.0
    """A flag concerns the columns within this distance of what was found, mm."""
    flag_pinholes: NonNegativeFloat = 0.01
    """Flag labels with more single voxels without a label than this share of the sheet's."""
    flag_gap: NonNegativeInt = 70
    """Flag a gap of more voxels than this (from the population, coarse or fine)."""
    flag_loose_part: NonNegativeFloat = 0.15
    """Flag a second piece of voxels, connected by faces, above this share of the sheet."""
    flag_rim_distance: NonNegativeFloat = 1.25
    """Flag if rim paths and boundary curves differ by more than this, multiples of thickness."""


class MapSettings(SettingsTable):
    """Other volumes on the sheet (``--map``)."""

    min_known: Fraction = 0.5
    """A value is missing if less than this share of its voxels, or of the depth, is known."""
    flag_outside: NonNegativeFloat = 0.05
    """Flag if a larger share of the points lies outside the volume's field of view."""


class UncertaintySettings(SettingsTable):
    """Perturbed copies of the labels; their spread says how certain a map is (`--uncertainty`)."""

    jitter: NonNegativeFloat = 0.5
    """Boundaries may be drawn this far away, voxels along each axis of the voxels, evenly
    distributed: SD is this over the root of 3. 0: perfect labels, but for their voxels."""
    correlation: PositiveFloat = 1.0
    """Points this far apart move alike with a correlation of 1/e, voxels: 1 if voxels are labeled
    one by one. Errors that reach farther make maps less certain."""
    rotation: Annotated[float, Field(ge=0, le=45)] = 5.0
    """Voxels are turned by up to this about each axis, degrees, and shifted by up to half of one:
    as if the body had lain elsewhere in the scanner."""
    spacing: Annotated[float, Field(ge=0.1, le=1)] = 0.46
    """Least ``grid.spacing`` of copies, mm: what all copies share cancels out, and time matters."""


class SurrogateSettings(SettingsTable):
    """Thickness from the medial axis of single slices (``hipsta-bids surrogate``)."""

    positions: OpenFractions = (0.5,)
    """Where the slices are, fractions of the body's length from its posterior end."""
    pixel: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    """Edge of the pixels on which the slices are drawn, mm."""
    smoothing: NonNegativeFloat = 0.4
    """Standard deviation of the Gaussian that rounds the voxels' corners, in-plane voxels."""
    step: PositiveFloat = 0.5
    """Distance of points in the equidistant sampling, mm."""
    axis_smoothing: NonNegativeFloat = 0.5
    """Standard deviation of the Gaussian that straightens the steps of the medial axis, mm."""
    hole_area: NonNegativeFloat = 3.0
    """Smaller holes in a slice are filled, mm2."""
    fork: NonNegativeFloat = 1.5
    """The medial axis forks towards the corners of the rims: so much of its ends is replaced by a
    straight line, multiples of half the thickness there."""
    reach: NonNegativeFloat = 1.0
    """Compared with points of the mid-surface that lie this near, mm."""


class Settings(SettingsTable):
    """All settings of the participant level."""

    body: BodySettings = Field(default_factory=BodySettings)
    grid: GridSettings = Field(default_factory=GridSettings)
    slices: SliceSettings = Field(default_factory=SliceSettings)
    topology: TopologySettings = Field(default_factory=TopologySettings)
    surface: SurfaceSettings = Field(default_factory=SurfaceSettings)
    tetra: TetraSettings = Field(default_factory=TetraSettings)
    boundaries: BoundarySettings = Field(default_factory=BoundarySettings)
    sheet: SheetSettings = Field(default_factory=SheetSettings)
    measures: MeasureSettings = Field(default_factory=MeasureSettings)
    checks: CheckSettings = Field(default_factory=CheckSettings)
    maps: MapSettings = Field(default_factory=MapSettings)
    uncertainty: UncertaintySettings = Field(default_factory=UncertaintySettings)
    surrogate: SurrogateSettings = Field(default_factory=SurrogateSettings)


def load_settings(path: Path | None) -> Settings:
    """Read a user's TOML file; what it leaves out keeps its default.

    Parameters
    ----------
    path : Path or None
        The file; ``None`` gives the defaults.

    Returns
    -------
    Settings
        All settings.

    Raises
    ------
    SettingsError
        If the file cannot be read, or a key or a value in it is wrong.
    """
    return read_settings(path, Settings)
