"""Every number that changes a result: default, unit, meaning.

One frozen dataclass per stage; a stage receives its own part only and has no defaults of its own.
What does not change a result (jobs, verbosity, folders) is in
:class:`hipsta_bids.runner.RunOptions`.
"""

import ast
import dataclasses
import difflib
import hashlib
import inspect
import json
import textwrap
import tomllib
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hipsta_bids.errors import SettingsError


def _require(condition: bool, message: str) -> None:
    """Refuse values that no stage could work with."""
    if not condition:
        raise SettingsError(f"settings: {message}", reason="setting-out-of-range")


@dataclass(frozen=True, kw_only=True)
class BodySettings:
    """From labels to the body's mask and end planes."""

    region: str = "body"
    """What is measured between the end planes: ``body`` (the hippocampal subfields), ``extended``
    (with the neighboring cortex) or ``entorhinal`` (that cortex alone); the command line's
    ``--region`` goes first."""
    min_cortex_reach: float = 0.9
    """Refuse regions with cortex if its labels fill less than this share of the distance between
    the end planes: the sheet would not go from end to end."""
    layer_rule: str = "nearest-sheet"
    """Who gets the molecular layer: ``nearest-sheet`` (the nearest sheet subfield; Diers et al.
    2023) or ``nearest-label`` (the nearest label; voxels nearest to DG or CA4 are left out)."""
    min_length: float = 5.0
    """Shortest body that is measured, mm."""
    min_end_voxels: int = 50
    """Fewer head or tail voxels than this count as no label."""
    plane_reach: float = 3.0
    """End planes are fitted to labels within this distance of the interface, mm."""
    end_margin: float = 0.0
    """Taken off either end where head or tail labels are missing, mm."""
    head_piece: float = 1.5
    """Without end labels: the body ends where a slice shows two pieces above this area, mm2."""
    head_growth: float = 1.35
    """Without end labels: ... or twice running an area above this multiple of the median."""
    gap_directions: int = 3
    """A voxel without a label lies in a thin gap if it has the sheet on both sides in so many of
    13 directions."""
    slit_area: float = 2.5
    """Gaps larger than this are filled if they go through the sheet, mm2 ..."""
    slit_openings: float = 0.2
    """... so that what is beside them falls into two parts, each of at least this share (in
    six real bodies: none, and gaps with one opening are up to 4.0 mm2) ..."""
    slit_voxel: float = 0.8
    """... and no edge of a voxel is longer than this, mm: between thick slices folds look alike."""
    end_fullness: float = 0.9
    """Without end labels: cross-sections at an end are left out if they have less than this share
    of the area ..."""
    end_reach: float = 3.0
    """... of those within this distance behind them, mm; at most so much is left out."""
    max_mask_ratio: float = 1.5
    """Flag an edited mask whose voxels are more than this many times those of the labels ..."""
    max_mask_change: float = 0.5
    """... or that adds and removes more than this share of the body."""

    def __post_init__(self) -> None:
        rules = ("nearest-sheet", "nearest-label")
        regions = ("body", "extended", "entorhinal")
        _require(self.region in regions, f"body.region must be one of {', '.join(regions)}")
        _require(0 < self.min_cortex_reach <= 1, "body.min_cortex_reach must lie in (0, 1]")
        _require(self.layer_rule in rules, f"body.layer_rule must be {' or '.join(rules)}")


@dataclass(frozen=True, kw_only=True)
class GridSettings:
    """The working grid on which the surface is made."""

    spacing: float = 0.35
    """Distance of grid nodes and so the edge length of the meshes, mm."""
    smoothing: float = 0.9
    """Standard deviation of the Gaussian, in in-plane voxels of the segmentation."""
    min_smoothing: float = 0.36
    """... but at least this, mm, so that finer voxels do not leave other maps: what smoothing
    takes from thin rims and narrow bends changes the mean thickness."""
    margin: float = 1.5
    """Free space around the body, mm."""

    def __post_init__(self) -> None:
        _require(0.1 <= self.spacing <= 1, "grid.spacing must lie between 0.1 and 1 mm")  # noqa: PLR2004 -- said there
        _require(0 <= self.smoothing <= 3, "grid.smoothing must lie between 0 and 3 voxels")  # noqa: PLR2004 -- said there
        _require(self.margin > 0, "grid.margin must be positive")


@dataclass(frozen=True, kw_only=True)
class SliceSettings:
    """Shapes between thick slices."""

    min_ratio: float = 1.8
    """Slices thicker than this many pixels are interpolated by shape."""
    upsampling: int = 2
    """Fine pixels per pixel."""
    smoothing: float = 0.7
    """Standard deviation of the Gaussian in a slice, pixels."""
    reach: float = 2.0
    """Distances from the outline are kept up to this, mm."""
    edge: float = 0.2
    """Half width of the ramp across the outline, mm."""
    max_fragments: int = 8
    """Most fragments that are joined in a slice."""
    max_rank_jump: int = 2
    """Fragments are joined preferably to subfields at most so many ranks away."""
    bridge: float = 0.45
    """Half width of a bridge between fragments, mm."""
    max_gap: float = 1.2
    """Fragments are joined across at most this distance, mm."""
    crumb_area: float = 1.5
    """Fragments farther away are dropped if they are smaller than this, mm2."""
    hole_area: float = 3.0
    """Smaller holes in a slice are filled, mm2."""
    flow_window: float = 1.0
    """Standard deviation of the window of the registration of slices, mm."""
    flow_ridge: float = 0.02
    """Added to the mean squared slope in a window, which is 1 where outlines fill it: keeps
    displacements small where the outlines do not tell them."""
    flow_smoothing: float = 0.5
    """Standard deviation of the Gaussian on displacements after each iteration, mm."""
    flow_iterations: int = 5
    """Iterations of the registration per level."""
    touch: float = 0.6
    """The subiculum and CA2 or CA3 are kept apart where both are nearer than this, mm ..."""
    slit: float = 0.3
    """... by a slit of this half width, mm."""
    hidden_depth: float = 0.1
    """What lies less deep than this inside an end plane is taken from inside, where the sheet's
    labels end at the plane, mm."""
    extrapolation: float = 0.5
    """There, and beyond the last slice, shapes go on changing at this fraction of their pace."""


@dataclass(frozen=True, kw_only=True)
class TopologySettings:
    """Repair of holes, bridges, islands and cavities."""

    levels: int = 6
    """Steps in which field values are ordered while growing and shrinking."""
    rounds: int = 12
    """Most rounds of repair."""
    depth_rank: float = 0.05
    """... and depth, in grid nodes, adds this much of the field to the order."""
    small_cost: float = 5.0
    """Membranes cheaper than this are applied together; dearer ones one a round."""
    plug_reach: int = 8
    """A filled hole becomes as thick as the wall within this distance of it, grid nodes ..."""
    plug_neighbors: int = 12
    """... at each place as thick as at so many nodes of the wall's middle closest to it."""
    oriented_nodes: int = 4
    """Membranes of fewer nodes have no direction."""
    cut_across: float = 0.3
    """A cut severs the ribbon rather than a bridge if this share of it lies across the axis
    (projected areas, squared) ..."""
    sever_reach: int = 2
    """... and the body goes on for so many grid nodes before and behind it ..."""
    sever_share: float = 0.4
    """... at more than this share of its nodes."""
    sever_factor: float = 1000.0
    """Such cuts cost this much more: where one is the only way, the hemisphere is flagged."""
    contact_reach: float = 1.2
    """... unless both the subiculum and CA2 or CA3 lie within this distance of its middle, mm."""
    fill_across: float = 0.5
    """A fill spans the inside of a bend rather than a hole if this share lies across the axis."""
    lid_nodes: float = 6.0
    """... unless it lies within this distance of an end plane, grid nodes."""
    across_factor: float = 40.0
    """Such fills cost this much more."""
    flag_cut_cost: float = 2.0
    """Flag a cut that overrules more evidence than this (sum of the field)."""
    flag_fill_cost: float = 8.0
    """Flag a filled hole whose membrane overrules more evidence than this (sum of the field; holes
    of 0.8 mm radius cost 2 to 6, of 1 mm 6 to 11)."""
    doubtful_fill_cost: float = 2.0
    """... and a fill across the axis that overrules more than this."""
    flag_part: float = 0.01
    """Flag the parting of turns that touch beyond this fraction of the body."""
    flag_fraction: float = 0.05
    """Flag a repair, or all together, beyond this fraction of the body."""


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """The closed surface of the body."""

    taubin_iterations: int = 16
    """Pairs of shrinking and inflating steps."""
    taubin_shrink: float = 0.5
    """Step towards the mean of the neighbors, fraction."""
    taubin_inflate: float = -0.53
    """Step back, fraction."""
    untangle_tries: int = 2
    """How often a surface that TetGen cannot fill is smoothed more."""


@dataclass(frozen=True, kw_only=True)
class TetraSettings:
    """The tetrahedral mesh."""

    radius_edge_ratio: float = 2.0
    """Worst ratio of circumradius to shortest edge (TetGen's q)."""
    smoothing_steps: int = 0
    """Passes in which TetGen moves its own vertices to better places (its own default is 7). They
    cost time; on phantoms the errors were the same without."""
    timeout: float = 60.0
    """Give up after this time, s."""


@dataclass(frozen=True, kw_only=True)
class BoundarySettings:
    """Medial and lateral boundary strips, and which side is interior."""

    solver: Literal["two-level", "lapy"] = "two-level"
    """What solves Laplace's equation, for boundaries and coordinates; ``lapy`` is slower."""
    sharp_bend: float = 0.5
    """Convex bends with less curvature than this do not slow diffusion, 1/mm."""
    anisotropy: float = 8.0
    """Diffusion across sharper ones, of curvature k, is slowed by exp(-anisotropy (k -
    sharp_bend)), mm."""
    least_diffusion: float = 0.1
    """... but, where curves are moved to the middle of the rims, never below this."""
    curvature_smoothing: int = 2
    """Smoothing steps of the curvature tensor."""
    lapy_curvature: float = 0.3
    """LaPy's curvature over curvature x mean edge length (measured on cylinders)."""
    label_neighbors: int = 30
    """Voxels around a vertex whose labels tell how lateral it is."""
    label_stride: int = 2
    """Every so many-th vertex is asked."""
    lateral_share: float = 0.1
    """Share of the vertices that count as most lateral."""
    axial_stretch: float = 4.0
    """Steps along the axis count this much longer, so that distances run across it."""
    rim_floor: float = 0.05
    """Cost of a path per mm along a rim; depth below the rim adds its square, mm2."""
    rim_zone: float = 1.5
    """Depth of the rim zones, multiples of 2 volume / wall area."""
    rim_bands: tuple[float, ...] = (1.25, 1.0, 1.0)
    """Half widths of the bands in which curves are moved to the middle of the rims, same unit."""
    rim_reach: float = 0.75
    """The zones hold at least all within this distance of the rim path, in the same unit."""
    max_distance: float = 1.0
    """The two rules may differ by this much, mm; beyond it the rims are taken."""
    strip_facing: float = 0.62
    """The boundary strips face away from the sheet: least cosine of the angle between the wall's
    normal and the direction in which the sheet would go on."""
    first_strip: float = 0.55
    """At first they hold all within this distance of the curves, multiples of 2 volume / wall
    area."""
    least_strip: float = 0.25
    """They hold at least all within this distance of their middle lines, in the same unit."""
    strip_step: float = 0.5
    """The direction of the sheet is found after one, two and three steps of this length from the
    rim, in the same unit."""
    strip_neighbors: int = 160
    """... as the mean over so many tetrahedra,"""
    rim_neighbors: int = 15
    """... and then over so many points of the rim."""
    strip_reach: tuple[float, ...] = (0.9, 0.75)
    """They hold nothing farther than this from the curves, in the same unit; one value per round.
    Later rounds start from the middle lines of the strips of the round before."""
    probe_distances: tuple[float, ...] = (0.4, 0.8, 1.2)
    """Distances at which interior labels are looked for, mm outside the wall."""
    min_probe_share: float = 0.02
    """Fewer hits than this share count as no interior labels."""


@dataclass(frozen=True, kw_only=True)
class SheetSettings:
    """The grid of the sheet, in coordinates from -1 to 1 along each axis.

    The grid of Hipsta (Diers et al. 2023) is x_extent 0.9, y_extent 0.975, z_extent 0.9.
    """

    x_nodes: int = 41
    """Nodes from medial to lateral."""
    y_nodes: int = 21
    """Nodes from posterior to anterior."""
    z_nodes: int = 9
    """Nodes from interior to exterior, odd so that the middle one is the mid-surface."""
    x_extent: float = 0.9
    """The grid spans plus and minus this along x."""
    y_extent: float = 1.0
    """The grid spans plus and minus this along y."""
    z_extent: float = 1.0
    """The grid spans plus and minus this along z; 1 is the whole wall."""
    max_filled: float = 0.2
    """Refuse a sheet with a larger fraction of columns that could not be measured."""
    depths: str = "distance"
    """How layers are spaced along each column: ``distance`` (evenly) or ``volume`` (the same volume
    between any two; Bok 1929, Leprince et al. 2015). The measures do not depend on it."""

    def __post_init__(self) -> None:
        least = 3  # two walls and a middle
        for axis in "xyz":
            extent = getattr(self, f"{axis}_extent")
            _require(0 < extent <= 1, f"sheet.{axis}_extent must lie above 0 and not above 1")
            _require(
                getattr(self, f"{axis}_nodes") >= least, f"sheet.{axis}_nodes must be at least 3"
            )
        _require(self.z_nodes % 2 == 1, "sheet.z_nodes must be odd")
        _require(self.depths in ("distance", "volume"), "sheet.depths must be distance or volume")


@dataclass(frozen=True, kw_only=True)
class MeasureSettings:
    """Measures on the sheet."""

    curvature_window: int = 9
    """Grid nodes over which a local polynomial is fitted, odd."""
    curvature_order: int = 3
    """Order of the local polynomials."""
    gaussian_window: int = 21
    """Grid nodes along y over which they are fitted for the Gaussian curvature, odd: it multiplies
    noise along the axis with the curvature across it."""
    max_curvature: float = 2.5
    """Principal curvatures are bounded by this, 1/mm: the working grid holds no sharper bend."""
    rim_start: float = 0.8
    """Beyond this x, and its negative, the lengths and areas of both walls follow those of the
    mid-surface: where a rounded rim ends a wall is arbitrary."""
    rim_window: float = 0.2
    """... at the ratio of the two over this much of x before."""
    repair_reach: float = 0.35
    """A column is marked as repaired this near to a grid node that a repair changed, mm."""
    stump_reach: float = 0.7
    """... and up to this much farther from a cut than what is nearest to it, mm."""

    def __post_init__(self) -> None:
        _require(self.repair_reach > 0, "measures.repair_reach must be positive")
        for name in ("curvature_window", "gaussian_window"):
            window = getattr(self, name)
            _require(window % 2 == 1, f"measures.{name} must be odd")
            _require(
                1 < self.curvature_order < window,
                f"measures.curvature_order must be at least 2 and below {name}",
            )
        _require(self.max_curvature > 0, "measures.max_curvature must be positive")
        _require(0 < self.rim_start <= 1, "measures.rim_start must lie above 0 and not above 1")
        _require(self.rim_window > 0, "measures.rim_window must be positive")


@dataclass(frozen=True, kw_only=True)
class CheckSettings:
    """What makes a map doubtful (flag) or wrong (refusal)."""

    min_voxels_across: float = 2.5
    """Refuse sheets thinner than this many in-plane voxels."""
    min_label_order: float = 0.45
    """Refuse if the rank correlation of x with the medial-to-lateral order of labels is lower."""
    flag_thickness_ratio: float = 0.15
    """Flag if the mean thickness departs from 2 volume / area by more than this fraction."""
    max_thickness_ratio: float = 0.35
    """Refuse beyond this fraction."""
    flag_folded: float = 0.05
    """Flag if a larger fraction of the volume has coordinates turned inside out."""
    flag_filled: float = 0.02
    """Flag if a larger fraction of the columns had to be filled from neighbors."""
    flag_bending: float = 0.5
    """Flag if the sheet turns round its exterior side by more than this, rad."""
    slice_ratio: float = 1.5
    """Voxels are long if their longest edge is more than this many times the shortest."""
    end_label_depth: float = 2.0
    """Head or tail labels farther inside the body than this are out of place, mm."""
    end_label_share: float = 0.005
    """Flag them if they are more than this share of the body's voxels."""
    beyond_reach: float = 3.0
    """Labels are counted within this distance on both sides of an end plane, mm."""
    beyond_share: float = 0.7
    """Flag an end without a label of its own if fewer lie beyond it than this share of those before
    it (0.92 at least in twelve real bodies)."""
    notch_reach: tuple[float, ...] = (1.0, 2.0, 3.0)
    """A cross-section is compared with those at these distances on both sides, mm."""
    notch_share: tuple[float, ...] = (0.12, 0.3, 0.35)
    """Flag if more than this share of what both sides have is missing, one per distance."""
    bump_contrast: float = 3.5
    """Flag a cross-section that has more than this many times of what its neighbors lack, or label
    interior, than the body's other cross-sections (2.7 at most in twelve real bodies)."""
    stub_nodes: float = 6.0
    """... but for what lies within this distance of a bridge that was cut, grid nodes."""
    section_noise: float = 0.02
    """Share of the area that is added to the usual before such comparisons, per mm of distance
    (interior: in all), since thickness may change along the body."""
    flag_row_jump: float = 0.15
    """Flag if the sheet's width changes by more than this from one row to the next."""
    flag_row_dip: float = 0.15
    """Flag rows narrower than the widest on both sides by more than this (0.13 at most in twelve
    real bodies)."""
    row_dip_reach: float = 8.0
    """... within this distance along the axis, mm."""
    ridge_reach: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Thickness is compared with that at these distances along the axis on both sides, mm ..."""
    ridge_columns: int = 9
    """... as the mean of so many neighboring columns of a row."""
    flag_ridge: tuple[float, ...] = (0.45, 0.75, 0.7)
    """Flag a band that is thicker than both by more than this, one per distance, mm (0.31, 0.56 and
    0.54 at most in twelve real bodies) ..."""
    flag_groove: tuple[float, ...] = (0.55, 0.75, 0.75)
    """... or thinner (0.38, 0.59 and 0.53)."""
    flag_pinholes: float = 0.01
    """Flag labels in which single voxels without a label are more than this share of the sheet's
    voxels (0.0015 at most in twelve real bodies)."""
    flag_gap: int = 60
    """Flag a gap of more voxels than this (44 at most in twelve real bodies, coarse or fine)."""
    flag_loose_part: float = 0.15
    """Flag a second piece of voxels, connected by faces, above this share of the sheet (0.04 at
    most in twelve real bodies)."""
    flag_rim_distance: float = 1.25
    """Flag if the rim paths and the boundary curves differ by more than this, multiples of the
    sheet's thickness (along a flat rim a path may follow either edge)."""


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """Other volumes on the sheet (``--map``)."""

    min_known: float = 0.5
    """A value is missing if less than this share of the voxels, or of the depth, that it is made
    of is known."""
    flag_outside: float = 0.05
    """Flag if a larger share of the points lies outside the volume's field of view."""

    def __post_init__(self) -> None:
        _require(0 <= self.min_known <= 1, "maps.min_known must lie between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class SurrogateSettings:
    """Thickness from the medial axis of single slices (``hipsta-bids surrogate``)."""

    positions: tuple[float, ...] = (0.5,)
    """Where the slices are, fractions of the body's length from its posterior end."""
    pixel: float = 0.1
    """Edge of the pixels on which the slices are drawn, mm."""
    smoothing: float = 0.4
    """Standard deviation of the Gaussian that rounds the voxels' corners, in-plane voxels."""
    step: float = 0.5
    """Distance of points in the equidistant sampling, mm."""
    axis_smoothing: float = 0.5
    """Standard deviation of the Gaussian that straightens the steps of the medial axis, mm."""
    hole_area: float = 3.0
    """Smaller holes in a slice are filled, mm2."""
    fork: float = 1.5
    """The medial axis forks towards the corners of the rims: so much of its ends is replaced by a
    straight line, multiples of half the thickness there."""
    reach: float = 1.0
    """Compared with points of the mid-surface that lie this near, mm."""

    def __post_init__(self) -> None:
        _require(
            bool(self.positions) and all(0 < p < 1 for p in self.positions),
            "surrogate.positions must lie between 0 and 1",
        )
        _require(0.02 <= self.pixel <= 1, "surrogate.pixel must lie between 0.02 and 1 mm")  # noqa: PLR2004 -- said there
        _require(self.step > 0, "surrogate.step must be positive")
        _require(self.smoothing >= 0, "surrogate.smoothing must not be negative")
        _require(self.axis_smoothing >= 0, "surrogate.axis_smoothing must not be negative")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of the participant level."""

    body: BodySettings = field(default_factory=BodySettings)
    grid: GridSettings = field(default_factory=GridSettings)
    slices: SliceSettings = field(default_factory=SliceSettings)
    topology: TopologySettings = field(default_factory=TopologySettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    tetra: TetraSettings = field(default_factory=TetraSettings)
    boundaries: BoundarySettings = field(default_factory=BoundarySettings)
    sheet: SheetSettings = field(default_factory=SheetSettings)
    measures: MeasureSettings = field(default_factory=MeasureSettings)
    checks: CheckSettings = field(default_factory=CheckSettings)
    maps: MapSettings = field(default_factory=MapSettings)
    surrogate: SurrogateSettings = field(default_factory=SurrogateSettings)


# Settings from and to TOML, their resolved form and its hash.


T = TypeVar("T")

_LINE = 96


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


def read_settings(path: Path | None, kind: type[T]) -> T:
    """Read a TOML file as settings of some kind; see :func:`load_settings`."""
    if path is None:
        return kind()
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
    except OSError as error:
        raise SettingsError(
            f"{path}: settings cannot be read ({error.strerror}); check the path",
            reason="settings-unreadable",
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(
            f"{path}: not a TOML file ({error}); start from `hipsta-bids settings`",
            reason="settings-not-toml",
        ) from error
    return settings_from(values, kind, where=str(path))


def settings_from(values: Mapping[str, Any], kind: type[T], *, where: str, prefix: str = "") -> T:
    """Build a settings dataclass from nested tables."""
    hints = get_type_hints(kind)
    names = [entry.name for entry in dataclasses.fields(kind)]  # type: ignore[arg-type]  # any dataclass
    chosen = {}
    for key, value in values.items():
        if key not in names:
            raise SettingsError(
                f"{where}: unknown setting {prefix}{key}; {_suggest(key, names)}",
                reason="unknown-setting",
            )
        hint = hints[key]
        if not (isinstance(hint, type) and dataclasses.is_dataclass(hint)):
            chosen[key] = _convert(value, hint, f"{where}: {prefix}{key}")
        elif isinstance(value, Mapping):
            chosen[key] = settings_from(value, hint, where=where, prefix=f"{prefix}{key}.")
        else:
            raise SettingsError(
                f"{where}: {prefix}{key} is a group of settings; write it as a table"
                f" [{prefix}{key}]",
                reason="bad-setting",
            )
    try:
        return kind(**chosen)
    except ValueError as error:  # the dataclass's own check of ranges
        raise SettingsError(
            f"{where}: {prefix.rstrip('.') or 'settings'}: {error}", reason="bad-setting"
        ) from error


def _suggest(key: str, names: list[str]) -> str:
    near = difflib.get_close_matches(key, names, n=1)
    if near:
        return f"did you mean {near[0]}?"
    return f"known here: {', '.join(names)}"


def _convert(value: object, hint: Any, where: str) -> object:  # noqa: ANN401  (a type hint)
    """Check one value against the type of its field; whole numbers may stand for floats."""
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    for choice in choices:
        fits, converted = _fit(value, choice)
        if fits:
            return converted
    raise SettingsError(
        f"{where} is {value!r}, but has to be {_describe(choices)}", reason="bad-setting"
    )


def _fit(value: object, hint: Any) -> tuple[bool, object]:  # noqa: ANN401  (a type hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments, value
    if origin is tuple:
        return _fit_tuple(value, arguments)
    # bool is an int to Python, but not to a person.
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return True, float(value)
    if hint is int and isinstance(value, bool):
        return False, None
    return isinstance(hint, type) and isinstance(value, hint), value


def _fit_tuple(value: object, arguments: tuple[Any, ...]) -> tuple[bool, object]:
    if not isinstance(value, (list, tuple)):
        return False, None
    any_length = len(arguments) == 2 and arguments[1] is Ellipsis  # noqa: PLR2004  (tuple[X, ...])
    kinds = [arguments[0]] * len(value) if any_length else list(arguments)
    if len(kinds) != len(value):
        return False, None
    fitted = [_fit(item, kind) for item, kind in zip(value, kinds, strict=True)]
    return all(fits for fits, _ in fitted), tuple(item for _, item in fitted)


def _describe(choices: tuple[Any, ...]) -> str:
    words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    described = []
    for choice in choices:
        if get_origin(choice) is Literal:
            described += [repr(option) for option in get_args(choice)]
        elif get_origin(choice) is tuple:
            described.append(f"a list like {choice}".replace("tuple", ""))
        elif choice is not types.NoneType:
            described.append(words.get(choice, str(choice)))
    return " or ".join(described)


def resolve(settings: Any) -> dict[str, Any]:  # noqa: ANN401  (any dataclass)
    """Turn settings into nested dictionaries of plain values, every default filled in."""
    resolved: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return resolved


def settings_hash(settings: Any) -> str:  # noqa: ANN401  (any dataclass)
    """Hash the resolved settings."""
    canonical = json.dumps(resolve(settings), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def flatten(resolved: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Name each leaf of resolved settings by its dotted path."""
    flat: dict[str, Any] = {}
    for key, value in resolved.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def settings_toml(settings: Any) -> str:  # noqa: ANN401  (any dataclass)
    """Write settings as TOML, each with its meaning as a comment."""
    return "\n".join(_toml_lines(settings, "")).strip() + "\n"


def _toml_lines(group: Any, prefix: str) -> Iterator[str]:  # noqa: ANN401  (any dataclass)
    """Write the leaves of one group first, then its tables, as TOML demands."""
    yield from _comment(inspect.getdoc(type(group)) or "")
    if prefix:
        yield f"[{prefix.rstrip('.')}]"
    meanings = field_meanings(type(group))
    nested = []
    for entry in dataclasses.fields(group):
        value = getattr(group, entry.name)
        if dataclasses.is_dataclass(value):
            nested.append((entry.name, value))
            continue
        yield from _comment(meanings.get(entry.name, ""))
        yield f"# {entry.name} is not set" if value is None else f"{entry.name} = {_toml(value)}"
    for name, value in nested:
        yield ""
        yield from _toml_lines(value, f"{prefix}{name}.")


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return json.dumps(value)  # TOML writes numbers, booleans and basic strings as JSON does


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(" ".join(text.split()), _LINE)]


def field_meanings(kind: type) -> dict[str, str]:
    """Read the docstrings that follow the fields of a dataclass in its source."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    meanings: dict[str, str] = {}
    name = None
    for node in tree.body if isinstance(tree, ast.ClassDef) else []:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
        elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            meanings[name] = inspect.cleandoc(str(node.value.value))
            name = None
        else:
            name = None
    return meanings
