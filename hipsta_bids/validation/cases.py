"""One phantom, drawn, measured and set beside its truth; and the poses in which to draw it."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hipsta_bids.artifacts import Float, HemisphereMaps, LabelVolume
from hipsta_bids.participant import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.phantom.body import PITCH
from hipsta_bids.schemes import load_scheme
from hipsta_bids.settings import GridSettings, Settings

#: Maps of curvature that are compared with the truth, interior to exterior.
CURVATURES = ("curvature_interior", "curvature", "curvature_exterior")
GAUSSIAN_CURVATURES = tuple(f"gaussian_{name}" for name in CURVATURES)

#: Nodes at each border of the grid that are its edge: rims and end planes.
EDGE = 2

_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A phantom and how it is drawn: voxels are labeled by their centers."""

    spec: PhantomSpec
    voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4)
    """mm along the three voxel axes."""
    pose: Float | None = None
    """(4, 4) rigid motion of the phantom, RAS mm."""
    grid_rotation: Float | None = None
    """(3, 3) rotation of the voxel grid."""
    axes: str = "LIA"
    hemi: str = "L"
    mirrored: bool = False
    """Mirror the labels after they were drawn."""
    spacing: float | None = None
    """mm, of the working grid, if not the default."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """What was measured, and the truth at the same places; all arrays (Nx, Ny)."""

    thickness: Float
    """mm."""
    true_thickness: Float
    """mm, where the mid-surface of the sheet was found."""
    curvature: Mapping[str, Float]
    """By name in ``CURVATURES``, 1/mm, and in ``GAUSSIAN_CURVATURES``, 1/mm2."""
    true_curvature: Mapping[str, Float]
    summary: Mapping[str, float]
    true_summary: Mapping[str, float]
    status: str
    flags: tuple[str, ...]

    @property
    def error(self) -> Float:
        """Error of thickness, mm; NaN where the sheet has left the phantom's rims."""
        return self.thickness - self.true_thickness


def without_edges(values: Float) -> Float:
    """Take the edges off a map (Nx, Ny)."""
    return values[EDGE:-EDGE, EDGE:-EDGE]


def measure_case(case: Case) -> Measured:
    """Draw a phantom, measure it with default settings, and look up the truth.

    Raises
    ------
    GeometryError
        If the package refuses the hemisphere.
    SettingsError
        If the phantom is impossible.
    """
    phantom = Phantom(case.spec)
    volume = draw(phantom, case)
    hemi = "R" if case.mirrored else case.hemi
    settings = Settings()
    if case.spacing is not None:
        settings = replace(settings, grid=GridSettings(spacing=case.spacing))
    maps = measure_hemisphere(volume, hemi, settings, lambda _: nullcontext())
    return compare(phantom, case, maps)


def draw(phantom: Phantom, case: Case) -> LabelVolume:
    """Draw a case in FreeSurfer's labels."""
    volume = phantom.label_volume(
        load_scheme("freesurfer"),
        hemi=case.hemi,
        voxel_size=case.voxel_size,
        pose=case.pose,
        axes=case.axes,
        grid_rotation=case.grid_rotation,
    )
    return replace(volume, affine=_MIRROR @ volume.affine) if case.mirrored else volume


def compare(phantom: Phantom, case: Case, maps: HemisphereMaps) -> Measured:
    """Set maps beside the truth at the places where the mid-surface was found."""
    points = maps.sheet.points[:, :, maps.sheet.middle]
    if case.mirrored:
        points = points * _MIRROR.diagonal()[:3]
    found = phantom.body.locate(points.reshape(-1, 3), hemi=case.hemi, pose=case.pose)
    u, v, _ = np.moveaxis(found.reshape(points.shape), -1, 0)
    inside = np.isfinite(u)
    truth = phantom.truth(np.where(inside, u, 0.5), np.where(inside, v, 0.5))
    return Measured(
        thickness=maps.thickness,
        true_thickness=np.where(inside, truth.thickness, np.nan),
        curvature={name: maps.maps[name] for name in (*CURVATURES, *GAUSSIAN_CURVATURES)},
        true_curvature={
            name: np.where(inside, getattr(truth, name), np.nan)
            for name in (*CURVATURES, *GAUSSIAN_CURVATURES)
        },
        summary=dict(maps.summary),
        true_summary=dict(truth.summary),
        status=str(maps.status),
        flags=tuple(flag.reason for flag in maps.flags),
    )


def any_pose(generator: np.random.Generator, *, degrees: float = 25.0) -> Float:
    """Turn by up to so many degrees about each axis, shift by up to 2 mm along each: (4, 4)."""
    turn = Rotation.from_euler("xyz", generator.uniform(-degrees, degrees, 3), degrees=True)
    return _motion(turn.as_matrix(), generator.uniform(-2.0, 2.0, 3))


def along_slices(
    generator: np.random.Generator, *, tilt: float = 0.0, degrees: float = 25.0
) -> tuple[Float, Float]:
    """Choose a pose, and a voxel grid whose third axis is the body's long axis, as scans have.

    Parameters
    ----------
    generator : numpy.random.Generator
    tilt : float
        Degrees by which slices miss the perpendicular, about a random axis within them.
    degrees : float
        The grid is turned within the slices by up to so much.

    Returns
    -------
    pose : (4, 4) array
        Shift by up to 2 mm along each axis, no turn.
    grid_rotation : (3, 3) array
        For voxel axes of which the third points to anterior.
    """
    to_body = Rotation.from_euler("x", -PITCH)  # anterior to the long axis, which points down
    within = Rotation.from_euler("y", generator.uniform(-degrees, degrees), degrees=True)
    about = generator.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(about), 0.0, np.sin(about)])
    lean = Rotation.from_rotvec(np.deg2rad(tilt) * axis)
    turn = (to_body * lean * within).as_matrix()
    return _motion(np.eye(3), generator.uniform(-2.0, 2.0, 3)), turn


def random_motion(generator: np.random.Generator) -> Float:
    """Turn by any rotation (uniform over all of them), shift by up to 20 mm along each axis."""
    turn = Rotation.from_quat(generator.normal(size=4))  # normalized: uniform
    return _motion(turn.as_matrix(), generator.uniform(-20.0, 20.0, 3))


def _motion(turn: Float, shift: Float) -> Float:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    return motion
