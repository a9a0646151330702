"""What suites measure: phantoms in chosen poses beside their truth, and bodies, in workers."""

import contextlib
import tempfile
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from nibabel.affines import from_matvec
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import HipstaError
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput, InputRequest, find_hemispheres
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.participant.pool import WorkerLost, WorkerPlan, processors, run_jobs
from hipsta_bids.phantom import Phantom, PhantomSpec, PhantomTruth
from hipsta_bids.phantom.shape import PITCH
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import GridSettings, Settings
from hipsta_bids.types import Bool, Float, HemisphereMaps, LabelVolume

#: Maps of curvature that are compared with the truth, interior to exterior.
CURVATURES = ("curvature_interior", "curvature", "curvature_exterior")
GAUSSIAN_CURVATURES = tuple(f"gaussian_{name}" for name in CURVATURES)

#: Outer nodes on each side of the grid, beside its medial and lateral edge and the end planes.
EDGE = 2

#: What suites damage or reslice: a phantom, or a segmentation of a dataset.
ValidationBody = PhantomSpec | HemisphereInput

#: (4, 4) mirror image across the plane between left and right, RAS mm.
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])

Key = TypeVar("Key", bound=Hashable)


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
    """What was measured, and the truth at the same points; all arrays (Nx, Ny)."""

    thickness: Float
    """mm."""
    true_thickness: Float
    """mm, where the mid-surface of the sheet was found."""
    curvature: Mapping[str, Float]
    """By name in ``CURVATURES``, 1/mm, and in ``GAUSSIAN_CURVATURES``, 1/mm2."""
    true_curvature: Mapping[str, Float]
    summary: Mapping[str, float]
    true_summary: Mapping[str, float]
    decision: str
    flags: tuple[str, ...]

    @property
    def error(self) -> Float:
        """Error of thickness, mm; NaN beyond the medial and lateral edge of the phantom."""
        return self.thickness - self.true_thickness


def without_edges(values: Float) -> Float:
    """Crop the outer nodes of a map (Nx, Ny)."""
    return values[EDGE:-EDGE, EDGE:-EDGE]


def measure_case(case: Case) -> Measured:
    """Draw a phantom, measure it, and look up the truth."""
    phantom = Phantom(case.spec)
    volume = draw(phantom, case)
    settings = Settings()
    if case.spacing is not None:
        settings = Settings(grid=GridSettings(spacing=case.spacing))
    maps = measure_body(volume, "R" if case.mirrored else case.hemi, settings)
    return compare(phantom, case, maps)


def draw(phantom: Phantom, case: Case, *, supersample: int = 1) -> LabelVolume:
    """Draw a case in FreeSurfer's labels; several points per axis give shares of voxels, too."""
    volume = phantom.label_volume(
        load_protocol("freesurfer"),
        hemi=case.hemi,
        voxel_size=case.voxel_size,
        pose=case.pose,
        axes=case.axes,
        grid_rotation=case.grid_rotation,
        supersample=supersample,
    )
    return replace(volume, affine=MIRROR @ volume.affine) if case.mirrored else volume


def compare(phantom: Phantom, case: Case, maps: HemisphereMaps) -> Measured:
    """Set maps beside the truth at the points where the mid-surface was found."""
    points = maps.sheet.points[:, :, maps.sheet.middle]
    if case.mirrored:
        points = points * MIRROR.diagonal()[:3]
    truth, inside = truth_at(phantom, points, hemi=case.hemi, pose=case.pose)
    names = (*CURVATURES, *GAUSSIAN_CURVATURES)
    return Measured(
        thickness=maps.thickness,
        true_thickness=np.where(inside, truth.thickness, np.nan),
        curvature={name: maps.maps[name] for name in names},
        true_curvature={name: np.where(inside, getattr(truth, name), np.nan) for name in names},
        summary=dict(maps.summary),
        true_summary=dict(truth.summary),
        decision=str(maps.decision),
        flags=tuple(flag.reason for flag in maps.flags),
    )


def truth_at(
    phantom: Phantom, points: Float, *, hemi: str = "L", pose: Float | None = None
) -> tuple[PhantomTruth, Bool]:
    """Look up the truth beside points (..., 3), and whether they lie within the sheet's edges."""
    found = phantom.body.locate(points.reshape(-1, 3), hemi=hemi, pose=pose).reshape(points.shape)
    inside = np.isfinite(found[..., 0])
    u, v = (np.where(inside, found[..., axis], 0.5) for axis in (0, 1))
    return phantom.truth(u, v), inside


def any_pose(generator: np.random.Generator, *, degrees: float = 25.0) -> Float:
    """Rotate by up to ``degrees`` about each axis, shift by up to 2 mm along each: (4, 4)."""
    return np.asarray(from_matvec(turned(generator, degrees), generator.uniform(-2.0, 2.0, 3)))


def turned(generator: np.random.Generator, degrees: float) -> Float:
    """Choose a rotation (3, 3) by up to ``degrees`` about each axis."""
    angles = generator.uniform(-degrees, degrees, 3)
    return Rotation.from_euler("xyz", angles, degrees=True).as_matrix()


def along_slices(
    generator: np.random.Generator, *, tilt: float = 0.0, degrees: float = 25.0
) -> tuple[Float, Float]:
    """Choose a shift (4, 4) by up to 2 mm along each axis, and a rotation (3, 3) of the grid.

    The third axis of the voxels is the body's long axis, as in scans, but for the tilt.
    """
    to_body = Rotation.from_euler("x", -PITCH)  # anterior to the long axis, which points down
    within = Rotation.from_euler("y", generator.uniform(-degrees, degrees), degrees=True)
    about = generator.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(about), 0.0, np.sin(about)])
    lean = Rotation.from_rotvec(np.deg2rad(tilt) * axis)
    turn = (to_body * lean * within).as_matrix()
    return from_matvec(np.eye(3), generator.uniform(-2.0, 2.0, 3)), turn


def random_motion(generator: np.random.Generator) -> Float:
    """Rotate by any angle (uniform over all rotations), shift by up to 20 mm along each axis."""
    turn = Rotation.from_quat(generator.normal(size=4))  # normalized: uniform
    return np.asarray(from_matvec(turn.as_matrix(), generator.uniform(-20.0, 20.0, 3)))


def rms(values: ArrayLike) -> float:
    """Root mean square of what is known."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def hippunfold_beside(labels: Path) -> list[Path]:
    """Look for a folder ``hippunfold`` with outputs of that program beside a dataset."""
    folder = labels.absolute().parent / "hippunfold"
    return [folder] if folder.is_dir() else []


def segmentations(*folders: Path) -> list[HemisphereInput]:
    """Find the usable segmentations of datasets."""
    found = [item for path in folders for item in find_hemispheres(InputRequest(bids_dir=path))]
    return [item for item in found if item.problem is None]


def longest_edge(volume: LabelVolume) -> float:
    """Longest edge of the voxels, mm."""
    return float(np.linalg.norm(volume.affine[:3, :3], axis=0).max())


def fine_segmentations(labels: Path | None, largest: float) -> list[HemisphereInput]:
    """Find the usable segmentations of a dataset with voxels of at most ``largest`` mm."""
    found = segmentations(labels) if labels else []
    return [item for item in found if longest_edge(read_label_volume(item)) <= largest]


def left_out(labels: Path | None) -> str:
    """Say below a suite's text that it has no real labels, if it was given none."""
    return "" if labels else " Real labels were left out: they need `--labels`."


def load_body(body: ValidationBody, voxel: float) -> tuple[LabelVolume, str]:
    """Labels of a body and its hemisphere; a phantom is drawn in voxels of ``voxel`` mm."""
    if isinstance(body, PhantomSpec):
        volume = Phantom(body).label_volume(load_protocol("freesurfer"), voxel_size=(voxel,) * 3)
        return volume, "L"
    return read_label_volume(body), body.hemi


@lru_cache(maxsize=2)
def measure_reference(
    body: ValidationBody, voxel: float
) -> tuple[LabelVolume, str, HemisphereMaps]:
    """Load and measure a body as it is; the cases of one body should follow each other."""
    volume, hemi = load_body(body, voxel)
    return volume, hemi, measure_body(volume, hemi)


def measure_body(
    volume: LabelVolume, hemi: str, settings: Settings | None = None
) -> HemisphereMaps:
    """Measure labels, with default settings if none are given."""
    return measure_hemisphere(volume, hemi, settings or Settings(), lambda _: nullcontext())


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """In place of a case's result: the package refused it, or its worker was lost."""

    reason: str
    """Of the error in kebab case; ``timeout``, ``worker-died`` or ``crash`` (a bug)."""
    message: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.message}"

    @property
    def is_bug(self) -> bool:
        """Whether this is anything but a foreseen error."""
        return self.reason in ("timeout", "worker-died", "crash")


def run_cases(
    work: Callable[[Any], Any], cases: Sequence[Any], *, timeout: float = 60.0
) -> list[Any]:
    """Run cases in parallel, one processor each, in workers that may die or hang without harm."""
    results: list[Any] = [None] * len(cases)
    with tempfile.TemporaryDirectory() as folder:
        plan = WorkerPlan(
            work=_work,
            n_workers=max(1, min(len(cases), processors())),
            timeout=timeout,
            log=Path(folder) / "workers.log",
        )
        jobs = [(number, work, case) for number, case in enumerate(cases)]
        # Closed at once: the workers end before their log is removed.
        with contextlib.closing(run_jobs(plan, jobs)) as done:
            for job, result in done:
                results[job[0]] = _lost(result) if isinstance(result, WorkerLost) else result
    return results


def run_groups(
    work: Callable[[Any], Any], groups: Mapping[Key, Sequence[Any]], *, timeout: float = 60.0
) -> dict[Key, list[Any]]:
    """Run the cases of all groups together, and return the results by group."""
    every = [case for cases in groups.values() for case in cases]
    results = iter(run_cases(work, every, timeout=timeout))
    return {key: [next(results) for _ in cases] for key, cases in groups.items()}


def refusal_notes(groups: Mapping[str, Sequence[Any]]) -> str:
    """List why maps are missing in Markdown, by name of the group; empty where none is."""
    counts = Counter(
        f"- {name}: {result}"
        for name, group in groups.items()
        for result in group
        if isinstance(result, Refusal)
    )
    lines = [line + (f" ({n} times)" if n > 1 else "") for line, n in counts.items()]
    return "\n".join(["\nRefused:\n", *lines]) if lines else ""


def _lost(lost: WorkerLost) -> Refusal:
    if lost.timed_out:
        return Refusal(reason="timeout", message=f"no result after {lost.seconds:.0f} s")
    return Refusal(reason="worker-died", message=f"the worker died ({lost.cause})")


def _work(job: tuple[int, Callable[[Any], Any], Any]) -> Any:  # noqa: ANN401  (any result)
    _, work, case = job
    return attempt(work, case)


def attempt(work: Callable[[Any], Any], case: Any) -> Any:  # noqa: ANN401  (any result)
    """Do the work of a case; an error becomes a refusal."""
    try:
        return work(case)
    except HipstaError as error:
        return Refusal(reason=error.reason, message=str(error))
    except Exception as error:  # noqa: BLE001  (a bug becomes a row of the report)
        return Refusal(reason="crash", message=f"{type(error).__name__}: {error}")
