"""The typed values that pass between stages.

Points are rows in RAS millimeters (float64), indices are int32. Every array is checked and made
read-only at construction, so that nothing downstream has to check again. Axes of the sheet:
x runs medial to lateral, y posterior to anterior, z interior to exterior, in both hemispheres.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.protocols.protocol import Protocol

Float = NDArray[np.float64]
Int = NDArray[np.int32]
Bool = NDArray[np.bool_]


def _set(
    obj: object, name: str, dtype: type[np.generic], shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """Store an attribute as a read-only array of a given type; ``None`` in shape is any length."""
    array = np.array(getattr(obj, name), dtype=dtype)
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{type(obj).__name__}.{name}: shape {array.shape}, expected {shape}")
    array.flags.writeable = False
    object.__setattr__(obj, name, array)
    return array


@dataclass(frozen=True, eq=False, kw_only=True)
class EditedMask:
    """The body as a person corrected it."""

    inside: Bool
    """(I, J, K) on the grid of the labels."""
    voxel: float
    """Edge of a voxel in plane in the mask's own file, mm."""

    def __post_init__(self) -> None:
        _set(self, "inside", np.bool_, (None, None, None))


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyMask:
    """The measured body, on the whole grid of the file with its labels."""

    inside: Bool
    """(I, J, K)"""
    affine: Float
    """(4, 4), voxel index to RAS mm."""

    def __post_init__(self) -> None:
        _set(self, "inside", np.bool_, (None, None, None))
        _set(self, "affine", np.float64, (4, 4))


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelVolume:
    """A segmentation in the package's own vocabulary."""

    tissue: NDArray[np.uint8]
    """(I, J, K), values of :class:`~hipsta_bids.protocols.Tissue`."""
    part: NDArray[np.uint8]
    """(I, J, K), values of :class:`~hipsta_bids.protocols.Part`."""
    affine: Float
    """(4, 4), voxel index to RAS mm."""
    protocol: Protocol
    edited_mask: EditedMask | None = None
    """What takes the place of the labels between the end planes, if anything."""
    start: tuple[int, int, int] = (0, 0, 0)
    """Index of the first voxel in the file, from which this was cropped."""
    file_shape: tuple[int, int, int] | None = None
    """Shape of the file; None where there is none or nothing was cropped."""

    def __post_init__(self) -> None:
        shape = np.shape(self.tissue)
        if self.edited_mask is not None and self.edited_mask.inside.shape != shape:
            raise ValueError(f"LabelVolume.edited_mask: shape differs from that of tissue, {shape}")
        _set(self, "tissue", np.uint8, (None, None, None))
        _set(self, "part", np.uint8, shape)
        affine = _set(self, "affine", np.float64, (4, 4))
        if not np.isfinite(affine).all() or not np.linalg.det(affine[:3, :3]):
            raise ValueError("LabelVolume.affine is singular or not finite")

    def in_file(self, inside: Bool) -> BodyMask:
        """Put a mask (I, J, K) back into the whole grid of the file."""
        whole = np.zeros(self.file_shape or inside.shape, dtype=np.bool_)
        whole[tuple(slice(a, a + n) for a, n in zip(self.start, inside.shape, strict=True))] = (
            inside
        )
        affine = self.affine.copy()
        affine[:3, 3] -= affine[:3, :3] @ np.array(self.start)
        return BodyMask(inside=whole, affine=affine)


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """A closed triangle mesh, outward oriented, with two planar caps."""

    vertices: Float
    """(V, 3) RAS mm."""
    triangles: Int
    """(F, 3)."""
    posterior_cap: Bool
    """(V,) vertices in the posterior end plane."""
    anterior_cap: Bool
    """(V,) vertices in the anterior end plane."""

    def __post_init__(self) -> None:
        vertices = _set(self, "vertices", np.float64, (None, 3))
        _set(self, "triangles", np.int32, (None, 3))
        _set(self, "posterior_cap", np.bool_, (len(vertices),))
        _set(self, "anterior_cap", np.bool_, (len(vertices),))


@dataclass(frozen=True, eq=False, kw_only=True)
class TetMesh:
    """A tetrahedral mesh whose first vertices are those of the surface, in the same order."""

    vertices: Float
    """(V, 3) RAS mm."""
    tetrahedra: Int
    """(T, 4), positive volume."""

    def __post_init__(self) -> None:
        _set(self, "vertices", np.float64, (None, 3))
        _set(self, "tetrahedra", np.int32, (None, 4))


@dataclass(frozen=True, eq=False, kw_only=True)
class Coordinates:
    """Three harmonic functions on a tetrahedral mesh."""

    values: Float
    """(V, 3) in [-1, 1]: medial-lateral, posterior-anterior, interior-exterior."""

    def __post_init__(self) -> None:
        _set(self, "values", np.float64, (None, 3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Sheet:
    """The hippocampal body on a regular grid of its own coordinates."""

    points: Float
    """(Nx, Ny, Nz, 3) RAS mm, NaN where undefined; the middle z level is the mid-surface."""
    valid: Bool
    """(Nx, Ny) columns measured directly, not filled from neighbors."""

    def __post_init__(self) -> None:
        points = _set(self, "points", np.float64, (None, None, None, 3))
        _set(self, "valid", np.bool_, points.shape[:2])

    @property
    def middle(self) -> int:
        """Number of the z level of the mid-surface."""
        return int(self.points.shape[2] // 2)


class Status(StrEnum):
    """How a hemisphere ended."""

    OK = "ok"
    REPAIRED = "repaired"
    FLAGGED = "flagged"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Flag:
    """Something a person should look at before trusting a map."""

    reason: str
    """Machine-readable slug in kebab case."""
    message: str
    """One line for people: what, where, what to try."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HemisphereMaps:
    """All that the participant level measures in one hemisphere."""

    sheet: Sheet
    layers: Sheet
    """The columns of the sheet cut into layers; the same points unless depths are by volume."""
    maps: Mapping[str, Float]
    """(Nx, Ny) each, by name in the catalog of measures; NaN where undefined."""
    profiles: Mapping[str, Mapping[str, Float]]
    """The maps averaged: ``x`` over y, (Nx,) each, and ``y`` over x, (Ny,) each."""
    sections: Mapping[str, Float]
    """(Ny,) each, by name: one number per cross-section."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""
    repaired: Bool
    """(Nx, Ny) columns that a repair of the topology touched."""
    body_mask: BodyMask
    """What was measured, on the grid of the labels' file."""
    summary: Mapping[str, float]
    """One number per summary column (see the output table for units)."""
    qc: Mapping[str, Any]
    """JSON-serialisable numbers and words that say whether to trust the map."""
    repairs: tuple[str, ...] = ()
    """What was changed, one line each; empty if nothing was."""
    flags: tuple[Flag, ...] = ()
    mesh: TetMesh
    coordinates: Coordinates

    def __post_init__(self) -> None:
        shape = self.sheet.points.shape[:2]
        wrong = [name for name, values in self.maps.items() if values.shape != shape]
        if wrong:
            raise ValueError(f"HemisphereMaps.maps: {wrong[0]} has not the sheet's shape {shape}")
        _set(self, "subfield", np.uint8, shape)
        _set(self, "repaired", np.bool_, shape)

    @property
    def thickness(self) -> Float:
        """(Nx, Ny) mm, wall to wall."""
        return self.maps["thickness"]

    @property
    def curvature(self) -> Float:
        """(Nx, Ny) mean curvature of the mid-surface, 1/mm; positive round the interior."""
        return self.maps["curvature"]

    @property
    def curvature_interior(self) -> Float:
        """(Nx, Ny) the same of the interior surface."""
        return self.maps["curvature_interior"]

    @property
    def curvature_exterior(self) -> Float:
        """(Nx, Ny) the same of the exterior surface."""
        return self.maps["curvature_exterior"]

    @property
    def status(self) -> Status:
        """``flagged`` outranks ``repaired``; ``failed`` hemispheres have no maps."""
        if self.flags:
            return Status.FLAGGED
        return Status.REPAIRED if self.repairs else Status.OK


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """Surface whose vertices are the points of maps, where these lie on no regular grid."""

    points: Float
    """(points, 3)"""
    triangles: NDArray[np.int64]
    """(triangles, 3)"""
