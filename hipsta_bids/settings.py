"""Every number that changes a result: default, range, unit, meaning.

One table per stage; a stage receives its own table only and has no defaults of its own.
What does not change a result (jobs, verbosity, folders) is in
:class:`hipsta_bids.participant.run.RunOptions`.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic.types import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from hipsta_bids.joints import find_settings
from hipsta_bids.protocols import EXPERIMENTAL, toml
from hipsta_bids.types import tables

if TYPE_CHECKING:  # type checkers know no extensions
    _Region = str
else:
    _Region = Literal["body", "extended", "entorhinal", *EXPERIMENTAL]


class BodySettings(tables.SettingsTable):
    """From labels to the body's mask and end planes."""

    region: _Region = "body"
    """Region: ``body`` (subfields between the end planes), ``extended`` (with neighboring
    cortex), ``entorhinal`` (that cortex alone). Experimental ones: see ``--region``."""
    min_cortex_reach: tables.PositiveFraction = 0.9
    """Refuse cortex with labels along less than this share of the body."""
    layer_rule: Literal["nearest-sheet", "nearest-label"] = "nearest-sheet"
    """The molecular layer belongs to the nearest subfield of the sheet (``nearest-sheet``; Diers et
    al. 2023), or to the ``nearest-label``. Voxels nearest to DG or CA4 are then excluded."""
    join_every_layer: bool = False
    """Join the molecular layer to the sheet also where the protocol excludes it (HippUnfold)."""
    min_length: NonNegativeFloat = 5.0
    """Shortest body that is measured, mm."""
    min_end_voxels: NonNegativeInt = 50
    """Fewer head or tail voxels than this count as no label."""
    plane_reach: PositiveFloat = 3.0
    """End planes are fitted to labels within this distance of the interface, mm. Head and tail
    labels beyond the plane, up to this distance, get the subfield of a neighbor."""
    end_rule: Literal["graded", "last-slice"] = "graded"
    """Ends without labels of head or tail: ``graded``, a mean over several cues. ``last-slice``:
    the last slice with CA1 and CA2 or CA3 posteriorly, with CA2 or CA3 anteriorly (Diers et al.
    2023)."""
    mending: Literal["gaps", "closing"] = "gaps"
    """Before the surface: ``gaps`` fills slits, pits and cavities that match no fold. ``closing``
    dilates and erodes the mask by a voxel (Diers et al. 2023)."""
    end_margin: NonNegativeFloat = 0.0
    """Taken off either end where head or tail labels are missing, mm."""
    slit_area: NonNegativeFloat = 2.5
    """Gaps through the sheet are filled if they are larger than this, mm2."""
    slit_voxel: NonNegativeFloat = 0.8
    """Gaps are filled if no voxel edge is longer, mm: folds between thick slices look alike."""
    end_fullness: tables.OpenFraction = 0.9
    """Cross-sections in oblique ends of labels are smaller than this share of the cross-sections
    behind them."""
    end_reach: NonNegativeFloat = 3.0
    """Length behind an end that is compared, mm; all of it may be excluded."""
    max_mask_ratio: PositiveFloat = 1.5
    """Flag an edited mask with more than this many times the voxels of the labels."""
    max_mask_change: NonNegativeFloat = 0.5
    """Flag an edited mask that adds and removes more than this share of the body."""


class GridSettings(tables.SettingsTable):
    """The working grid on which the surface is made."""

    spacing: Annotated[float, Field(ge=0.1, le=1)] = 0.35
    """Distance of grid nodes and so the edge length of the meshes, mm."""
    smoothing: Annotated[float, Field(ge=0, le=3)] = 0.9
    """Standard deviation of the Gaussian, in in-plane voxels of the segmentation."""
    min_smoothing: NonNegativeFloat = 0.36
    """Least standard deviation of that Gaussian, mm. It keeps finer voxels from changing maps:
    smoothing of thin edges and narrow bends changes the mean thickness."""
    beyond: NonNegativeFloat = 1.75
    """The body is continued by this much beyond each end plane, mm. Columns next to a plane that
    cuts the sheet obliquely would be oblique, and too long."""


class SliceSettings(tables.SettingsTable):
    """Shapes between thick slices."""

    min_ratio: NonNegativeFloat = 1.8
    """Slices thicker than this many pixels are interpolated by shape."""
    upsampling: PositiveInt = 2
    """Fine pixels per pixel."""
    max_gap: NonNegativeFloat = 1.2
    """Fragments are joined across at most this distance, mm."""
    hole_area: NonNegativeFloat = 3.0
    """Smaller holes in a slice are filled, mm2."""


class TopologySettings(tables.SettingsTable):
    """Repair of holes, bridges, islands and cavities."""

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


class SurfaceSettings(tables.SettingsTable):
    """The closed surface of the body."""

    taubin_iterations: NonNegativeInt = 16
    """Pairs of shrinking and inflating steps."""


class TetraSettings(tables.SettingsTable):
    """The tetrahedral mesh."""

    radius_edge_ratio: Annotated[float, Field(ge=1)] = 2.0
    """Worst ratio of circumradius to shortest edge (TetGen's q)."""
    timeout: PositiveFloat = 60.0
    """Give up after this time, s."""


class BoundarySettings(tables.SettingsTable):
    """Medial and lateral boundary strips, and which side is interior."""

    solver: Literal["two-level", "lapy"] = "two-level"
    """What solves Laplace's equation, for boundaries and coordinates; ``lapy`` is slower."""
    operator: Literal["sharp-bends", "published"] = "sharp-bends"
    """Diffusion on the wall is slowed by convex bends beyond ``sharp_bend``. ``published``: by both
    principal curvatures, without a threshold (Diers et al. 2023, appendix A)."""
    edges: Literal["faces", "zero-lines"] = "faces"
    """x is fixed on the end faces of the sheet (``faces``). ``zero-lines``: on the zero lines of
    the eigenfunction as they are (Diers et al. 2023)."""
    sharp_bend: NonNegativeFloat = 0.5
    """Convex bends with less curvature than this do not slow diffusion, 1/mm."""
    anisotropy: NonNegativeFloat = 8.0
    """Diffusion across bends of curvature k beyond ``sharp_bend`` is slowed by exp(-anisotropy (k -
    sharp_bend)), mm. ``published``: exp(-anisotropy |k|) in both directions, k in LaPy's units,
    which grow with the mesh's edges. Hipsta takes 40."""


class SheetSettings(tables.SettingsTable):
    """The grid of the sheet, in coordinates from -1 to 1 along each axis.

    The grid of Hipsta (Diers et al. 2023) is x_extent 0.9, y_extent 0.975, z_extent 0.9.
    """

    x_nodes: Annotated[int, Field(ge=3, le=1000)] = 41
    """Nodes from medial to lateral."""
    y_nodes: Annotated[int, Field(ge=3, le=1000)] = 21
    """Nodes from posterior to anterior."""
    z_nodes: tables.Odd = 9
    """Nodes from interior to exterior, odd so that the middle one is the mid-surface."""
    x_coordinate: Literal["midsurface", "volume"] = "midsurface"
    """What x is: harmonic on the mid-surface, or in the volume (Diers et al. 2023)."""
    x_extent: tables.PositiveFraction = 0.9
    """The grid spans plus and minus this along x."""
    y_extent: tables.PositiveFraction = 1.0
    """The grid spans plus and minus this along y."""
    z_extent: tables.PositiveFraction = 1.0
    """The grid spans plus and minus this along z; 1 is the whole wall."""
    max_filled: tables.Fraction = 0.2
    """Refuse a sheet with a larger fraction of columns that could not be measured."""
    depths: Literal["distance", "volume"] = "distance"
    """Spacing of layers along each column: ``distance`` (even), or ``volume`` (equal volumes; Bok
    1929, Leprince et al. 2015). The measures do not depend on it."""


class MeasureSettings(tables.SettingsTable):
    """Measures on the sheet."""

    curvature_window: tables.Odd = 9
    """Grid nodes over which a local polynomial is fitted, odd."""
    curvature_order: Annotated[int, Field(ge=2)] = 3
    """Order of the local polynomials."""
    gaussian_window: tables.Odd = 21
    """Grid nodes along y of the fit for the Gaussian curvature, odd. That curvature multiplies
    noise along the axis with the curvature across it."""
    max_curvature: PositiveFloat = 2.5
    """Principal curvatures are bounded by this, 1/mm: the working grid holds no sharper bend."""

    @model_validator(mode="after")
    def _windows_hold_the_order(self) -> Self:
        if self.curvature_order >= min(self.curvature_window, self.gaussian_window):
            raise ValueError("curvature_order has to be below curvature_window and gaussian_window")
        return self


class CheckSettings(tables.SettingsTable):
    """What makes a map doubtful (flag) or wrong (refusal)."""

    max_voxel: PositiveFloat = 0.9
    """Refuse larger voxels in plane, mm: no sheet is ``min_voxels_across`` of these thick."""
    min_voxels_across: NonNegativeFloat = 2.5
    """Refuse sheets of fewer in-plane voxels: above, 0.5% of nodes are off by 0.3 mm (phantoms)."""
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
    flag_end: NonNegativeFloat = 2.5
    """Flag an end without a label if its standard error is larger, mm (2.1 at most in 12 real)."""
    usual_length_difference: NonNegativeFloat = 4.0
    """The report marks sides whose lengths differ by more, mm (2.8 at most in real labels)."""
    end_label_share: NonNegativeFloat = 0.005
    """Flag them if they are more than this share of the body's voxels."""
    notch_share: tables.Numbers = (0.12, 0.3, 0.35)
    """Flag if more than this share of what both sides have is missing, one per distance."""
    bump_contrast: NonNegativeFloat = 5.6
    """Flag a section with more of what others lack than so often the usual (suite population)."""
    intrusion_contrast: NonNegativeFloat = 3.7
    """The same for what both its neighbors label interior."""
    flag_row_jump: NonNegativeFloat = 0.15
    """Flag if the width changes by more than this between rows, or by twice as much at an end."""
    flag_row_dip: NonNegativeFloat = 0.22
    """Flag rows narrower than the widest on both sides by more than this (from the population)."""
    flag_subfield_gap: NonNegativeFloat = 1.5
    """Flag rows without their edge's subfield over more than this, mm (1.2 at most in 128)."""
    flag_subfield_end: NonNegativeFloat = 3.0
    """The same for rows up to an end of the body, mm (2.8 at most in 128)."""
    flag_lost_edge: NonNegativeFloat = 0.06
    """Flag an edge beyond which more of extent_x is labeled, share (.058 at most in 128)."""
    min_edge_voxels: PositiveFloat = 1.5
    """Flag an edge of the sheet that is thinner, voxels: less is lost (1.7 at least in 128)."""
    flag_edge: tables.Numbers = (1.8, 2.2, 2.7)
    """Flag an edge that recedes behind both by more than this, one per distance, mm."""
    flag_bump: NonNegativeFloat = 5.8
    """Flag a patch thicker than round about by more roughnesses of the smoother wall (128 real
    hemispheres: 2 above it)."""
    flag_dent: NonNegativeFloat = 5.1
    """The same for a thinner patch (4.6 at most in them, 4.9 in 156 phantoms)."""
    flag_swollen_end: NonNegativeFloat = 1.9
    """Flag an end that is thicker than the sheet farther in by more, mm (1.7 at most in them)."""
    smooth_wall: PositiveFloat = 0.08
    """Least roughness of a wall, mm: phantoms, which are smooth, stay below 5 times it."""
    uncus_reach: NonNegativeFloat = 2.0
    """Warn of an uncus that begins farther than this behind the anterior plane, mm."""
    flag_cavity: NonNegativeFloat = 0.03
    """Flag a wide cavity beyond this share of the body: the mean may be off by half of it."""
    flag_pinholes: NonNegativeFloat = 0.01
    """Flag labels with more single voxels without a label than this share of the sheet's."""
    flag_gap: NonNegativeInt = 70
    """Flag a gap of more voxels than this (from the population, coarse or fine)."""
    flag_loose_part: NonNegativeFloat = 0.15
    """Flag a second piece of voxels, connected by faces, above this share of the sheet."""
    flag_rival: NonNegativeFloat = 0.12
    """Flag if an equally likely second choice, or a group of copies (`--uncertainty`), moves the
    map by more (RMS), mm."""


#: Settings of ``--method published``: what Diers et al. 2023 describe. Topology is repaired in any
#: case, where the original stops.
PUBLISHED: Mapping[str, Mapping[str, str | float]] = MappingProxyType(
    {
        "body": {"end_rule": "last-slice", "mending": "closing"},
        "boundaries": {"operator": "published", "anisotropy": 40.0, "edges": "zero-lines"},
        "sheet": {"x_coordinate": "volume"},
    }
)


class Settings(tables.ExtendedSettings):
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

    def as_published(self) -> list[str]:
        """List the settings of ``--method published`` that hold here, as ``group.name``."""
        return [
            f"{group}.{name}"
            for group, values in PUBLISHED.items()
            for name, value in values.items()
            if getattr(getattr(self, group), name) == value
        ]


if not TYPE_CHECKING:  # type checkers know the tables of the core
    Settings = Settings.extended(find_settings("participant"))
    SheetSettings = type(Settings().sheet)  # with settings of extensions


def load_settings(path: Path | None) -> Settings:
    """Read a user's TOML file; settings that it omits keep their defaults.

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
    return toml.read_settings(path, Settings)
