"""The typed values that pass between stages.

Points are rows in RAS millimeters (float64), indices are int32. Arrays are checked and made
read-only at construction, so that nothing downstream has to check again. Axes of the sheet:
x runs medial to lateral, y posterior to anterior, z interior to exterior, in both hemispheres.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from hipsta_bids.protocols.protocol import Protocol

_FLAT = 1e-3  # a surface is flat if it is thinner than this share of its length
_ROUNDING = 1e-6  # of the ends of the body

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Bool = NDArray[np.bool_]
#: Rows of tables, of which there may be many.
Int64 = NDArray[np.int64]

#: Columns that identify visits, with the prefixes of BIDS.
PARTICIPANT, SESSION = "participant_id", "session_id"
#: A missing value in BIDS tables.
MISSING = "n/a"

End = Literal["posterior", "anterior"]
"""An end of the body."""


def _set(
    obj: object, name: str, dtype: type[np.generic], shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """Store an attribute as a read-only array of a given type; ``None`` in shape is any length.

    All in one order, in which images are not always read: mixing two takes twice the time.
    """
    array = np.array(getattr(obj, name), dtype=dtype, order="C")
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{type(obj).__name__}.{name}: shape {array.shape}, expected {shape}")
    array.flags.writeable = False
    object.__setattr__(obj, name, array)
    return array


@dataclass(frozen=True, eq=False, kw_only=True)
class EditedMask:
    """The body as corrected by hand."""

    inside: Bool
    """(I, J, K) whether a voxel of the labels' grid belongs to the body."""
    voxel: float
    """Edge of a voxel in plane in the mask's file, mm."""

    def __post_init__(self) -> None:
        _set(self, "inside", np.bool_, (None, None, None))


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyMask:
    """The measured body: the part of the labels' file in which it lies."""

    inside: Bool
    """(I, J, K) whether a voxel of this part belongs to the body."""
    start: tuple[int, int, int]
    """Index, in the file, of the first voxel of this part."""
    shape: tuple[int, int, int]
    """Of the file."""
    affine: Float
    """(4, 4), voxel index in the file to RAS mm."""

    def __post_init__(self) -> None:
        _set(self, "inside", np.bool_, (None, None, None))
        _set(self, "affine", np.float64, (4, 4))


@dataclass(frozen=True, kw_only=True, slots=True)
class Visit:
    """A participant, in one session where the dataset has sessions."""

    subject: str
    """Label without ``sub-``."""
    session: str | None
    """Label without ``ses-``; ``None`` where the dataset has no sessions."""


VisitKey = tuple[str, str | None]
"""Labels of subject and session, as a key of tables and sets."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Hemisphere(Visit):
    """One side of a visit."""

    hemi: str
    """``L`` or ``R``."""


@dataclass(frozen=True, kw_only=True)
class GivenEnd:
    """An end of the body placed by hand."""

    end: End
    point: tuple[float, float, float]
    """A point of the plane, scanner RAS, mm."""
    normal: tuple[float, float, float] | None = None
    """Its normal, RAS, of any length and sign; None for the estimated direction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelVolume:
    """A segmentation in the package's vocabulary."""

    tissue: NDArray[np.uint8]
    """(I, J, K), values of :class:`~hipsta_bids.protocols.Tissue`."""
    part: NDArray[np.uint8]
    """(I, J, K), values of :class:`~hipsta_bids.protocols.Part`."""
    affine: Float
    """(4, 4), voxel index to RAS mm."""
    protocol: "Protocol"
    edited_mask: EditedMask | None = None
    """Body that replaces that of the labels between the end planes, if a person corrected it."""
    given_ends: tuple[GivenEnd, ...] = ()
    """Ends that a person has placed; they go before labels and the automatic rule."""
    start: tuple[int, int, int] = (0, 0, 0)
    """Index, in the file, of the first voxel of this part of it."""
    file_shape: tuple[int, int, int] | None = None
    """Shape of the file; None without a file or if nothing was cropped."""
    shares: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    """(I, J, K) by tissue: which share of each voxel it fills, 0 to 1; empty if unknown."""
    notes: tuple[str, ...] = ()
    """What a reader should know about the files."""

    def __post_init__(self) -> None:
        shape = np.shape(self.tissue)
        if wrong := [kind for kind, share in self.shares.items() if share.shape != shape]:
            raise ValueError(f"LabelVolume.shares: shape of tissue {wrong[0]} differs from {shape}")
        if self.edited_mask is not None and self.edited_mask.inside.shape != shape:
            raise ValueError(
                f"LabelVolume.edited_mask: shape differs from the shape of tissue, {shape}"
            )
        _set(self, "tissue", np.uint8, (None, None, None))
        _set(self, "part", np.uint8, shape)
        affine = _set(self, "affine", np.float64, (4, 4))
        if not np.isfinite(affine).all() or not np.linalg.det(affine[:3, :3]):
            raise ValueError("LabelVolume.affine is singular or not finite")

    def in_file(self, inside: Bool) -> BodyMask:
        """Return the place in the file of a mask (I, J, K) of this part."""
        first, second, third = inside.shape
        affine = self.affine.copy()
        affine[:3, 3] -= affine[:3, :3] @ np.array(self.start)
        return BodyMask(
            inside=inside,
            start=self.start,
            shape=self.file_shape or (first, second, third),
            affine=affine,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """A closed triangle mesh, outward oriented, with two planar caps."""

    vertices: Float
    """(V, 3) RAS mm."""
    triangles: Int
    """(F, 3) vertex indices."""
    posterior_cap: Bool
    """(V,) whether a vertex lies in the posterior end plane."""
    anterior_cap: Bool
    """(V,) whether a vertex lies in the anterior end plane."""

    def __post_init__(self) -> None:
        vertices = _set(self, "vertices", np.float64, (None, 3))
        _set(self, "triangles", np.int32, (None, 3))
        _set(self, "posterior_cap", np.bool_, (len(vertices),))
        _set(self, "anterior_cap", np.bool_, (len(vertices),))


@dataclass(frozen=True, eq=False, kw_only=True)
class TetMesh:
    """A tetrahedral mesh whose first vertices are the surface's, in the same order."""

    vertices: Float
    """(V, 3) RAS mm."""
    tetrahedra: Int
    """(T, 4) vertex indices; volumes are positive."""

    def __post_init__(self) -> None:
        _set(self, "vertices", np.float64, (None, 3))
        _set(self, "tetrahedra", np.int32, (None, 4))


@dataclass(frozen=True, eq=False, kw_only=True)
class Coordinates:
    """Three harmonic functions on a tetrahedral mesh."""

    values: Float
    """(V, 3) in [-1, 1]: x medial to lateral, y posterior to anterior, z interior to exterior."""

    def __post_init__(self) -> None:
        _set(self, "values", np.float64, (None, 3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """The hippocampal body on a regular grid in coordinates of the body."""

    points: Float
    """(Nx, Ny, Nz, 3) RAS mm, NaN where undefined; the middle z level is the mid-surface."""
    valid: Bool
    """(Nx, Ny) whether a column was measured directly, not filled from its neighbors."""

    def __post_init__(self) -> None:
        points = _set(self, "points", np.float64, (None, None, None, 3))
        _set(self, "valid", np.bool_, points.shape[:2])

    @property
    def middle(self) -> int:
        """Index of the z level of the mid-surface."""
        return int(self.points.shape[2] // 2)


#: What the maps of a family of tests have in common, by the setting ``multiplicity.scope``.
FAMILY = {
    "map": ("measure", "contrast", "hemi"),
    "hemispheres": ("measure", "contrast"),
    "all": ("contrast",),
}
#: Names of the sides in tables of maps; in those of summary measures LR may be a mean.
SIDES = {"L": "left", "R": "right", "LR": "left minus right", "both": "both sides"}
DIFFERENCE, BOTH_SIDES = "LR", "both"
#: Name of the map that tests several measures together, among those of measures.
JOINT = "joint"
#: Between a map and a region in names of means over regions, which are summary measures.
REGION = "_region_"
#: SD of a normal distribution over its median absolute deviation; scipy.stats takes .6 s to import.
MAD_TO_SD = 1.4826
#: Columns at a repair are hatched if thickness is farther off its neighbors, mm.
HATCHED_FROM = 0.05
#: How a person rates a hemisphere, in the order of the keys 1, 2, 3; the last leaves it out.
RATINGS = ("use", "unsure", "exclude")


class Decision(StrEnum):
    """Decision on a hemisphere, from its flags."""

    USE = "use"
    LOOK = "look"
    FAILED = "failed"


def _nowhere() -> Float:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Finding:
    """What a check measured, whether or not that is beyond its limit."""

    reason: str
    """Name of the reason in kebab case."""
    value: float
    """Statistic of the check."""
    limit: float
    """A larger value is flagged."""
    text: str
    """The finding, for people."""
    remedy: str
    """What to try, for people."""
    points: Float = field(default_factory=_nowhere)
    """(N, 3) where it is, RAS mm; none if it concerns the sheet as a whole."""
    placed: bool = False
    """Whether :attr:`text` says where."""
    share: float = float("nan")
    """Share of the columns that are concerned, where the points do not show."""
    change: float = float("nan")
    """What the mean thickness may be off by, mm, where the points do not show."""

    @property
    def margin(self) -> float:
        """Value over limit; infinite where none is allowed."""
        if self.limit > 0:
            return self.value / self.limit
        return float("inf") if self.value > self.limit else 0.0

    @property
    def raised(self) -> bool:
        """Whether a rater should look at it."""
        return self.value > self.limit


@dataclass(frozen=True, eq=False, kw_only=True)
class Flag:
    """Something a rater should look at before a map is used."""

    reason: str
    """Name of the reason in kebab case, for programs."""
    message: str
    """One line for people: what, where, what to try, and what it means for the map."""
    value: float = float("nan")
    """Statistic of the check; NaN where nothing was measured."""
    limit: float = float("nan")
    """Its limit."""
    points: Float = field(default_factory=_nowhere)
    """(N, 3) where it is, RAS mm."""
    share: float = float("nan")
    """Share of the columns that are concerned."""
    change: float = float("nan")
    """By how much the mean thickness is larger than if these were as those around them, mm."""

    @property
    def consequence(self) -> tuple[float, float]:
        """Size of the change, mm, and share of the columns, as flags are ordered; 0 if unknown."""
        return abs(float(np.nan_to_num(self.change))), float(np.nan_to_num(self.share))


def position_text(point: Float | tuple[float, float, float], subfields: str = "") -> str:
    """Write a point (3,), RAS mm, and perhaps the subfields there, as messages do."""
    text = f"RAS {' '.join(f'{value:.1f}' for value in point)} mm"
    return f"{text} ({subfields})" if subfields else text


def p_text(p: float) -> str:
    """Write a p-value."""
    if not np.isfinite(p):
        return MISSING
    return "< 0.001" if p < 0.001 else f"{p:.3f}"  # noqa: PLR2004  (as papers have it)


def parts_of(y: Float) -> NDArray[np.str_] | None:
    """Name the part of rows at ``y``, whose body lies from -1 to 1; ``None`` if all are body."""
    part = (y > -1 - _ROUNDING).astype(np.intp) + (y > 1 + _ROUNDING)
    return np.array(("tail", "body", "head"))[part] if (part != 1).any() else None


@dataclass(frozen=True, eq=False, kw_only=True)
class HemisphereMaps:
    """All that the participant level measures in one hemisphere."""

    sheet: Sheet
    """Grid on which all maps are defined."""
    layers: Sheet
    """Columns of the sheet cut into layers; the same points unless depths are by volume."""
    maps: Mapping[str, Float]
    """Maps (Nx, Ny) by name in the catalog of measures; NaN where undefined."""
    profiles: Mapping[str, Mapping[str, Float]]
    """Maps averaged over the other axis, by axis and name: ``x`` (Nx,) and ``y`` (Ny,)."""
    sections: Mapping[str, Float]
    """Measures of cross-sections, (Ny,), by name in the catalog of measures."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""
    repaired: Bool
    """(Nx, Ny) columns that a repair of the topology touched."""
    doubtful: Bool
    """(Nx, Ny) columns near a flag, or of odd thickness at a repair that is no filled gap."""
    body_mask: BodyMask
    """Measured body, on the grid of the labels' file."""
    summary: Mapping[str, float]
    """One number per summary column (see the output table for units)."""
    qc: Mapping[str, Any]
    """Numbers and words, ready for JSON, that show whether to trust the maps."""
    repairs: tuple[str, ...] = ()
    """Changes of the body's topology, one line each."""
    flags: tuple[Flag, ...] = ()
    """Reasons to look at the maps before trusting them, that with the largest consequence first."""
    mesh: TetMesh
    """Tetrahedra of the body."""
    coordinates: Coordinates
    """Harmonic coordinates at the vertices of the mesh."""

    def __post_init__(self) -> None:
        shape = self.sheet.points.shape[:2]
        wrong = [name for name, values in self.maps.items() if values.shape != shape]
        if wrong:
            raise ValueError(
                f"HemisphereMaps.maps: the shape of {wrong[0]} differs from the sheet's, {shape}"
            )
        _set(self, "subfield", np.uint8, shape)
        _set(self, "repaired", np.bool_, shape)
        _set(self, "doubtful", np.bool_, shape)
        ordered = sorted(self.flags, key=lambda flag: flag.consequence, reverse=True)
        object.__setattr__(self, "flags", tuple(ordered))

    @property
    def thickness(self) -> Float:
        """(Nx, Ny) mm, wall to wall."""
        return self.maps["thickness"]

    @property
    def decision(self) -> Decision:
        """Whether a rater should look before use; ``failed`` hemispheres have no maps."""
        return Decision.LOOK if self.flags else Decision.USE


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """Surface whose vertices are the points of maps that lie on no regular grid."""

    points: Float
    """(V, 3) RAS mm."""
    triangles: NDArray[np.int64]
    """(F, 3) vertex indices."""

    @property
    def flat(self) -> bool:
        """Whether it lies in the plane of the first two axes, as unfolded surfaces do."""
        reach = np.ptp(self.points, axis=0)
        return bool(reach[2] <= _FLAT * reach.max())


@dataclass(frozen=True, eq=False, kw_only=True)
class ScalarVolume:
    """One or more numbers per voxel, cropped to the part needed."""

    values: Float
    """(I, J, K, T); not finite where missing."""
    affine: Float
    """(4, 4), index into ``values`` to RAS mm."""
    start: tuple[int, int, int]
    """Index of the first voxel in the whole image."""
    shape: tuple[int, int, int]
    """Shape of the whole image."""
