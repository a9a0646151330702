"""Whether a small change of the labels makes a small change of the map."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.protocols.protocol import Part
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision, End, Float, GivenEnd, HemisphereMaps, LabelVolume
from validation import cases
from validation.damage import Site, make_defect
from validation.report import Cell, Cells, Content, suite, table

SEED = 20241
#: Columns beyond this distance from a change of the labels are far from it, mm.
FAR = 3.0
#: A column is off if its thickness differs by more, mm.
OFF = 0.3
#: Share of far columns that may be off in a map without a flag.
MAX_OFF = 0.05
#: RMS of an accepted map that no perturbation of up to .4 mm may exceed, mm.
MAX_ACCEPTED = 0.25
#: Correlation length of displacements, mm; and of the warps that make other bodies of a body.
SMOOTHNESS, WARP_SMOOTHNESS = 3.0, 8.0
#: Warped copies: standard deviation of the displacement along each axis, mm.
WARP = 1.0
#: Seeds of the warps of each hemisphere.
WARPS_QUICK, WARPS_FULL = 0, 2
#: Share of the voxels at the surface that are flipped.
FLIPPED = 1e-3
#: Of phantoms, mm.
VOXEL = 0.4

Perturb = Callable[[LabelVolume, HemisphereMaps, np.random.Generator], LabelVolume]


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Labels of a hemisphere, or a smoothly warped copy of them."""

    labels: HemisphereInput | PhantomSpec
    warp: int = 0
    """Seed of the warp; 0 for none."""

    @property
    def name(self) -> str:
        """Name in tables."""
        name = (
            self.labels.kind
            if isinstance(self.labels, PhantomSpec)
            else f"{self.labels.subject} {self.labels.hemi}"
        )
        return f"{name}, warp {self.warp}" if self.warp else name


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A perturbation of the labels of a hemisphere."""

    subject: Subject
    perturbation: str
    draw: int
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True, kw_only=True)
class Movement:
    """What a perturbation did to a map."""

    same_xy: float
    """RMS difference of thickness at the same (x, y), mm."""
    same_place: float
    """RMS difference of thickness at the nearest points of the mid-surfaces, mm."""
    correlation: float
    mean: float
    """Difference of the mean thickness, mm."""
    far_off: float
    """Share of the columns beyond ``FAR`` of the change that are off."""
    accepted: bool
    """Whether nobody need look at either map."""
    reasons: tuple[str, ...]
    """Flags of the perturbed map."""
    choices: tuple[str, ...]
    """Discrete choices that differ between the two maps."""

    @property
    def silent(self) -> bool:
        """Whether the perturbed map is wrong far from the change and has no flag."""
        return self.accepted and self.far_off > MAX_OFF


def near_affine(
    volume: LabelVolume, _maps: HemisphereMaps, random: np.random.Generator, *, size: float
) -> LabelVolume:
    """Move every point of the body by about ``size`` mm."""
    affine, extent = volume.affine.copy(), max(volume.tissue.shape)
    affine[:3, :3] += random.uniform(-size, size, (3, 3)) / extent
    affine[:3, 3] += random.uniform(-size, size, 3)
    return replace(volume, affine=affine)


def _displaced(
    volume: LabelVolume, _maps: HemisphereMaps, random: np.random.Generator, *, size: float
) -> LabelVolume:
    """Displace boundaries smoothly; ``size`` is the SD along each axis, mm."""
    return warped(volume, size, SMOOTHNESS, random)


def warped(
    volume: LabelVolume, size: float, smoothness: float, random: np.random.Generator
) -> LabelVolume:
    """Pull labels through a smooth random displacement, SD ``size`` mm along each axis."""
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    shape = volume.tissue.shape
    shift = np.stack([smooth_noise(shape, smoothness / edges, random) for _ in range(3)])
    inverse = np.linalg.inv(volume.affine[:3, :3])
    step: Float = inverse @ (shift.reshape(3, -1) * size)
    return _sampled(volume, step)


def shifted(volume: LabelVolume, share: float, random: np.random.Generator) -> LabelVolume:
    """Draw labels on a grid that lies ``share`` of a voxel away along each axis."""
    step = share * random.choice([-1.0, 1.0], 3)
    moved = _sampled(volume, np.repeat(step[:, None], volume.tissue.size, axis=1))
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ step
    return replace(moved, affine=affine)


def smooth_noise(shape: Sequence[int], length: Float, random: np.random.Generator) -> Float:
    """Gaussian noise (I, J, K) of SD 1, correlated over ``length`` (3,) voxels."""
    noise = random.standard_normal(shape)
    noise = ndimage.gaussian_filter(noise, length / 2, mode="wrap")
    return np.asarray(noise / noise.std())


def _sampled(volume: LabelVolume, step: Float) -> LabelVolume:
    """Labels with most weight, by linear interpolation, at voxels moved by a step (3, N)."""
    shape = volume.tissue.shape
    codes = volume.tissue.astype(np.int32) + 256 * volume.part.astype(np.int32)
    places = np.indices(shape).reshape(3, -1) + step
    kinds = np.unique(codes)
    best, weight = np.zeros(codes.size, dtype=np.intp), np.zeros(codes.size)
    for kind in kinds:
        share = ndimage.map_coordinates(
            (codes == kind).astype(np.float32), places, order=1, mode="nearest"
        )
        better = share > weight
        best[better], weight[better] = kind, share[better]
    part, tissue = np.divmod(best.reshape(shape), 256)
    return replace(volume, tissue=tissue.astype(np.uint8), part=part.astype(np.uint8))


def _moved_end(
    volume: LabelVolume,
    maps: HemisphereMaps,
    random: np.random.Generator,
    *,
    step: float | None = None,
) -> LabelVolume:
    """Move one end plane by a step, mm, or by a slice."""
    end: End = "posterior" if random.integers(2) else "anterior"
    plane = maps.qc[f"{end}_plane"]
    normal = np.array(plane["normal_ras"])
    if step is None:
        step = float(np.abs(normal @ volume.affine[:3, :3]).max())
    point = np.array(plane["point_ras_mm"]) + random.choice([-1.0, 1.0]) * step * normal
    given = GivenEnd(end=end, point=tuple(point.tolist()), normal=tuple(normal.tolist()))
    return replace(volume, given_ends=(given,))


def _salted(volume: LabelVolume, _maps: HemisphereMaps, random: np.random.Generator) -> LabelVolume:
    """Flip one in a thousand of the voxels on both sides of the ribbon's surface."""
    sheet = np.isin(volume.tissue, (*volume.protocol.sheet, *volume.protocol.layer))
    border = ndimage.binary_dilation(sheet) & ~ndimage.binary_erosion(sheet)
    flip = border & (random.random(sheet.shape) < FLIPPED)
    points = to_ras(np.argwhere(flip), volume.affine)
    inside = np.argwhere(sheet)
    nearest = inside[cKDTree(to_ras(inside, volume.affine)).query(points)[1]]
    tissue, part = volume.tissue.copy(), volume.part.copy()
    chosen = tuple(np.argwhere(flip).T)
    was = sheet[chosen]
    tissue[chosen] = np.where(was, 0, volume.tissue[tuple(nearest.T)])
    part[chosen] = np.where(was, np.uint8(Part.UNKNOWN), volume.part[tuple(nearest.T)])
    return replace(volume, tissue=tissue, part=part)


def _damaged(
    volume: LabelVolume, maps: HemisphereMaps, random: np.random.Generator, kind: str, size: float
) -> LabelVolume:
    """Damage an edge of the sheet, medial or lateral, somewhere along the body."""
    position = float(random.choice([0.05, 0.95])), float(random.uniform(0.3, 0.7))
    return make_defect(Site(volume, maps.sheet), kind, size, position).volume


#: Perturbations by name.
PERTURBATIONS: Mapping[str, Perturb] = MappingProxyType(
    {
        "affine, 1e-6 mm": partial(near_affine, size=1e-6),
        "affine, 1e-5 mm": partial(near_affine, size=1e-5),
        "grid shifted by 0.1 voxel": lambda volume, _, random: shifted(volume, 0.1, random),
        "end plane moved by 0.4 mm": partial(_moved_end, step=0.4),
        "end plane moved by a slice": _moved_end,
        "labels displaced by 0.1 mm": partial(_displaced, size=0.1),
        "labels displaced by 0.3 mm": partial(_displaced, size=0.3),
        "1 of 1000 surface voxels flipped": _salted,
        "edge notch of 1 mm": partial(_damaged, kind="rim-notch", size=1.0),
        "edge notch of 1.4 mm": partial(_damaged, kind="rim-notch", size=1.4),
        "edge relabeled over 1.4 mm": partial(_damaged, kind="relabeled-tip", size=1.4),
    }
)
#: Damage of an edge.
EDGES = tuple(name for name in PERTURBATIONS if name.startswith("edge"))
#: Largest median and maximum of the RMS, mm.
TARGETS = {
    "affine, 1e-5 mm": (0.018, 0.03),
    "end plane moved by 0.4 mm": (0.10, 0.15),
    "labels displaced by 0.1 mm": (0.11, 0.14),
}


@lru_cache(maxsize=4)
def load(subject: Subject) -> tuple[LabelVolume, str]:
    """Read labels of a subject, cropped to what is labeled, and its hemisphere."""
    volume, hemi = cases.load_body(subject.labels, VOXEL)
    if subject.warp:
        random = np.random.default_rng((SEED, subject.warp))
        volume = warped(volume, WARP, WARP_SMOOTHNESS, random)
    return volume, hemi


@lru_cache(maxsize=4)
def reference(subject: Subject, settings: Settings) -> HemisphereMaps:
    """Measure a subject's labels as they are."""
    return cases.measure_body(*load(subject), settings)


def move(trial: Trial) -> Movement:
    """Perturb labels, measure them, and compare the maps."""
    volume, hemi = load(trial.subject)
    maps = reference(trial.subject, trial.settings)
    number = list(PERTURBATIONS).index(trial.perturbation)
    random = np.random.default_rng((SEED, number, trial.draw))
    perturbed = PERTURBATIONS[trial.perturbation](volume, maps, random)
    moved = cases.measure_body(perturbed, hemi, trial.settings)
    return compare(maps, moved, changed_points(volume, perturbed))


def changed_points(volume: LabelVolume, perturbed: LabelVolume) -> Float:
    """Centers (N, 3) of the voxels whose label differs, RAS mm; none if the grids differ."""
    if volume.tissue.shape != perturbed.tissue.shape:
        return np.zeros((0, 3))
    changed = (volume.tissue != perturbed.tissue) | (volume.part != perturbed.part)
    return to_ras(np.argwhere(changed), volume.affine)


def compare(maps: HemisphereMaps, perturbed: HemisphereMaps, changed: Float) -> Movement:
    """Compare a map with that of perturbed labels; ``changed`` (N, 3) are voxels, RAS mm."""
    difference = perturbed.thickness - maps.thickness
    middle, moved = (sheet.points[:, :, sheet.middle] for sheet in (maps.sheet, perturbed.sheet))
    there = _at(moved, perturbed.thickness, middle)
    far = np.ones(difference.shape, dtype=bool)
    if len(changed):
        distance = np.asarray(cKDTree(changed).query(maps.sheet.points.reshape(-1, 3))[0])
        far = distance.reshape(maps.sheet.points.shape[:3]).min(axis=2) > FAR
    off = ~(np.abs(difference) <= OFF)
    known = np.isfinite(difference)
    pair = maps.thickness[known], perturbed.thickness[known]
    return Movement(
        same_xy=cases.rms(difference),
        same_place=cases.rms(there - maps.thickness),
        correlation=float(np.corrcoef(*pair)[0, 1]),
        mean=float(np.nanmean(difference)),
        far_off=float(off[far].mean()) if far.any() else 0.0,
        accepted=all(m.decision is Decision.USE for m in (maps, perturbed)),
        reasons=tuple(dict.fromkeys(flag.reason for flag in perturbed.flags)),
        choices=_choices(maps, perturbed),
    )


def _at(middle: Float, thickness: Float, points: Float) -> Float:
    """Thickness (Nx, Ny) of a map where other points (Nx, Ny, 3) lie: inverse distances of 4."""
    known = np.isfinite(thickness) & np.isfinite(middle).all(axis=-1)
    asked = np.isfinite(points).all(axis=-1)
    distance, nearest = cKDTree(middle[known]).query(points[asked], k=4)
    weight = 1 / np.maximum(distance, 1e-6) ** 2
    values = np.full(points.shape[:2], np.nan)
    values[asked] = (weight * thickness[known][nearest]).sum(axis=1) / weight.sum(axis=1)
    return values


def _choices(maps: HemisphereMaps, perturbed: HemisphereMaps) -> tuple[str, ...]:
    """Name discrete choices that differ."""
    keys = ("side_rule", "posterior_end_rule", "anterior_end_rule")
    # A plane that the perturbation gives is no choice.
    changed = [key for key in keys if perturbed.qc[key] not in (maps.qc[key], "user")]
    if len(maps.repairs) != len(perturbed.repairs):
        changed.append("repairs")
    return tuple(changed)


def subjects(labels: Path | None, full: bool) -> list[Subject]:
    """List the hemispheres of a dataset, of the revised one beside it, and warped copies."""
    found: list[Subject] = []
    if labels is None:
        return [Subject(labels=PhantomSpec(kind="spiral", thickness=2.0, variation=0.15))]
    revised = labels.absolute().parent / f"{labels.absolute().name}-revised"
    folders = [labels, *([revised] if full and revised.is_dir() else [])]
    folders += cases.hippunfold_beside(labels) if full else []
    for folder in folders:
        items = cases.fine_segmentations(folder, 0.6)
        found += [Subject(labels=item) for item in (items if full else items[:2])]
        if folder == labels:
            warps = range(1, 1 + (WARPS_FULL if full else WARPS_QUICK))
            found += [Subject(labels=item, warp=n) for item in items for n in warps]
    return found


@suite("continuity")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Perturb labels a little, and see how far maps move."""
    names = list(PERTURBATIONS) if full else ["affine, 1e-5 mm", "labels displaced by 0.1 mm"]
    draws = 2 if full else 1
    groups = {
        name: [
            Trial(subject=subject, perturbation=name, draw=draw)
            for subject in subjects(labels, full)
            for draw in range(draws)
        ]
        for name in names
    }
    results = cases.run_groups(move, groups)
    yield _movements(results)
    yield cases.left_out(labels)


@table("continuity.movements")
def _movements(
    results: Mapping[str, Sequence[Movement | cases.Refusal]],
) -> Iterator[Cells | str]:
    for name, group in results.items():
        moved = [result for result in group if isinstance(result, Movement)]
        same = np.array([result.same_xy for result in moved] or [np.nan])
        wrong = sum(result.accepted and result.same_xy > MAX_ACCEPTED for result in moved)
        silent = sum(result.silent for result in moved)
        cells: dict[str, Cell] = {
            "perturbation": name,
            "maps": len(moved),
            "refused": len(group) - len(moved),
            "flagged": sum(not result.accepted for result in moved),
            "RMS, median": float(np.median(same)),
            "RMS, largest": float(same.max()),
            "same place, median": float(np.median([r.same_place for r in moved] or [np.nan])),
            "r, least": float(min((r.correlation for r in moved), default=np.nan)),
            "choices differ": sum(bool(result.choices) for result in moved),
            f"accepted, RMS > {MAX_ACCEPTED:g}": wrong,
            "silent far away": silent,
        }
        met: bool | None = None
        target: str | None = None
        if name in TARGETS:
            median, largest = TARGETS[name]
            target = f"median ≤ {median:g}, largest ≤ {largest:g}"
            met = bool(np.median(same) <= median and same.max() <= largest)
        elif name in EDGES:
            target, met = "no silent map", not silent
        yield {**cells, "target": target, "met": met}
    yield cases.refusal_notes(results)
