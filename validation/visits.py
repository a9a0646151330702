"""Visits of one person on a common sheet: noise within the person against separate sheets."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from nibabel.affines import apply_affine, from_matvec
from numpy.typing import NDArray
from scipy import ndimage, stats
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from hipsta_bids.extensions.trials.sizes import participants_needed
from hipsta_bids.extensions.visits.common import Frame, make_frame, measure_placed, place_visit
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.columns import SMOOTHING
from hipsta_bids.geometry.digital import box_around, low_corner, positions
from hipsta_bids.geometry.ends import long_axis
from hipsta_bids.geometry.measures import column_area
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.participant.job import peak_memory, reset_peak_memory
from hipsta_bids.phantom import PhantomSpec, Thinning
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import Bool, Float, HemisphereMaps, LabelVolume, Sheet
from validation import cases
from validation.hippunfold import draw_template
from validation.labelings import revisions
from validation.report import Cell, Cells, Content, suite, table
from validation.thick_slices import sample_labels, slice_frame, steps_in_voxel

SEED = 20261
FINE, THICK = (0.4, 0.4, 0.4), (0.4, 0.4, 2.0)
"""Voxels, mm."""
YEARS = np.array([0.0, 1.0, 2.0])
NOISE, STRONG = 0.2, 0.3
"""mm, SD along each axis of displacements of the labels, correlated over ``CORRELATION`` mm."""
CORRELATION = 1.0
LAYER = 0.1
"""mm, lost from all sides of the sheet's labels at a second visit."""
OUTLINE, FINEST = 0.3, 0.15
"""mm, SD of the smoothing of the outline before, and voxels of these labels."""
SLOPE, LOCAL = -0.1, -0.15
"""mm per year, planted everywhere, and in CA1 only: so large that noise of voxels hides no bias."""
LOSS = 0.02
"""mm per year, lost without treatment in a trial, ..."""
TRUE_SD = 0.01
"""mm per year, SD of that loss between participants."""
SLOWED = 0.25
"""Share of the loss that treatment stops."""
DRAWS = 2
"""Times that the visits in thick slices are drawn: their mean thickness varies much."""
SHARES, POINTS = "real, 0.4 mm, shares", (3, 3, 3)
"""Visits whose voxels have shares of the tissues, from these points along their axes."""
UNCHANGED = 40
"""People without change, for false positives."""
MAX_BIAS, MAX_LEAKAGE = 0.05, 0.002
MAX_POSE, MAX_EQUAL = 0.02, 1e-6
MAX_COST, MAX_MEMORY = 1.6, 400.0
MAX_SHARES = 0.55
"""Noise on the common sheet with shares over that on separate sheets of labels alone."""
FALSE_POSITIVES = (0.04, 0.06)
MEGABYTE = 1e6


Voxel = tuple[float, float, float]
Source = HemisphereInput | PhantomSpec | tuple[Path, str]
"""A segmentation, a phantom, or a template's folder and side."""


@dataclass(frozen=True, kw_only=True)
class Person:
    """Visits to be drawn: a segmentation scanned anew, two segmentations, or phantoms."""

    name: str
    sources: tuple[Source, ...]
    """Of each visit."""
    voxels: tuple[Voxel, ...] = (FINE,) * 3
    """Of each visit, mm; without any, segmentations are taken as they are and share a space."""
    noise: float = 0.0
    """mm."""
    seed: int = 0
    separate: bool = True
    """Whether the visits are also measured on sheets of their own."""
    coarse: bool = False
    """Whether the working grid is coarse, which saves time."""
    true: bool = False
    """Whether the visits are also measured on the sheet of the labels before the scans."""
    layers: tuple[float, ...] = ()
    """mm, lost at each visit from all sides of the sheet's labels."""
    shares_of: tuple[int, int, int] = (1, 1, 1)
    """Along the axes of each voxel; several give shares, of which separate sheets know nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """Maps of thickness (visits, Nx, Ny), mm."""

    frame: Float
    """On the common sheet."""
    smooth: Float | None
    """On separate sheets, smoothed as the walls of the common sheet are; None if not measured."""
    separate: Float | None
    """On separate sheets."""
    true: Float | None
    """On the sheet of the labels before the scans, by the true motions; None if not measured."""
    smoother: tuple[Float, Float] | None
    """Maps of separate sheets and of the common one, all smoothed in the same way."""
    volume: Float
    """(visits,) of the sheet on the common sheet, mm3."""
    separate_volume: Float | None
    """(visits,) of the sheet on separate sheets, mm3."""
    labels_volume: Float
    """(visits,) of the labels between the ends of the common sheet, mm3."""
    ca1: Bool
    """(Nx, Ny) columns in CA1."""
    filled: float
    """Largest share of columns without a wall."""
    overlap: float
    """Least overlap of a visit with the mean."""
    distance: float
    """Largest distance of the walls of a visit, mm."""
    flagged: int
    """Visits that are flagged as different."""
    cost: float
    """Processor time on the common sheet over separate sheets."""
    memory: float
    """Peak on the common sheet, MB."""


def scan(
    volume: LabelVolume,
    voxel: tuple[float, float, float],
    noise: float,
    random: np.random.Generator,
    shares_of: tuple[int, int, int] = (1, 1, 1),
) -> tuple[LabelVolume, Float]:
    """Take the labels in new voxels: position and direction of the grid, pose, errors of labels.

    Several points along the axes of a voxel, ``shares_of``, give the shares of tissues in it. Also
    returns the pose (4, 4), RAS mm.
    """
    hippocampal = (volume.tissue > 0) & (volume.tissue <= Tissue.HIPPOCAMPUS)
    points = apply_affine(volume.affine, np.argwhere(hippocampal))
    axis = long_axis(points, volume.part[hippocampal])
    degrees = 6.0 if max(voxel) > 2 * min(voxel) else 25.0
    turn = cases.turned(random, degrees) @ slice_frame(axis)
    matrix = turn * np.array(voxel)
    index = np.linalg.solve(matrix, points.T).T
    low = np.floor(index.min(axis=0)) - 2 + random.uniform(0, 1, 3)
    shape = tuple((np.ceil(index.max(axis=0) - low) + 3).astype(int).tolist())
    affine = from_matvec(matrix, matrix @ low)
    places = apply_affine(affine, np.indices(shape).reshape(3, -1).T)
    if noise:
        for side in range(3):
            errors = random.standard_normal(shape)
            errors = ndimage.gaussian_filter(errors, CORRELATION / np.array(voxel) / 2, mode="wrap")
            places[:, side] += noise / errors.std() * errors.ravel()
    to_volume = np.linalg.inv(volume.affine)
    sampled = (
        apply_affine(to_volume, places + matrix @ step).T for step in steps_in_voxel(shares_of)
    )
    pose = from_matvec(cases.turned(random, 6.0), random.uniform(-4, 4, 3))
    return sample_labels(volume, sampled, shape, pose @ affine), pose


def lose_layer(volume: LabelVolume, layer: float) -> LabelVolume:
    """Take a layer, mm, from all sides of the sheet's labels, whose outline is smoothed before.

    Steps of voxels have a larger surface than the outline, and would lose more. What is lost gets
    the label beside it: a gap between labels would be mended.
    """
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    # Head and tail lose a layer, too, but not where they meet the sheet.
    sheet = (extract_body(volume, BodySettings()).tissue > 0) | (
        volume.tissue == Tissue.HIPPOCAMPUS
    )
    around = box_around(positions(volume.tissue > 0))
    smooth = ndimage.gaussian_filter(sheet[around].astype(np.float32), OUTLINE / edges)
    sizes = tuple(int(n) for n in np.ceil((np.array(smooth.shape) - 1) * edges / FINEST))
    scale = FINEST / edges
    fine = ndimage.affine_transform(smooth, scale, output_shape=sizes, order=3)
    vertices, _, normals, _ = marching_cubes(  # type: ignore[no-untyped-call]  # no types
        fine, 0.5, spacing=(FINEST,) * 3
    )
    inside = positions(fine > 0.5)  # noqa: PLR2004 -- the outline
    nearest = KDTree(vertices).query(inside * FINEST)[1]
    depth = ((inside * FINEST - vertices[nearest]) * normals[nearest]).sum(axis=1)
    left = inside[np.abs(depth) >= layer]
    voxel = tuple(np.rint(left * scale).astype(int).T)
    tissue, part = (np.zeros(sizes, dtype=np.uint8) for _ in range(2))
    for new, labels in ((tissue, volume.tissue), (part, volume.part)):
        beside = labels[around][_nearest(~sheet[around], edges)]  # takes the place of what is lost
        ndimage.affine_transform(beside, scale, output=new, order=0)
        new[tuple(left.T)] = labels[around][_nearest(sheet[around], edges)][voxel]
    part[tissue == Tissue.BACKGROUND] = Part.UNKNOWN
    moved = volume.affine @ from_matvec(np.diag(scale), low_corner(around))
    return replace(volume, tissue=tissue, part=part, affine=moved)


def _nearest(mask: Bool, edges: Float) -> tuple[NDArray[np.int32], ...]:
    """Find the nearest voxel of a mask for each voxel; edges are in mm."""
    return tuple(
        ndimage.distance_transform_edt(
            ~mask, sampling=edges, return_distances=False, return_indices=True
        )
    )


def load(source: Source) -> tuple[LabelVolume, str]:
    """Load the labels of a source; return the hemisphere, too."""
    if isinstance(source, tuple):
        return draw_template(*source)[0], source[1]
    return cases.load_body(source, 0.3)


def draw(person: Person) -> tuple[list[LabelVolume], str]:
    """Draw the visits of a person; return the hemisphere, too."""
    volumes, _, hemi = draw_posed(person)
    return volumes, hemi


def draw_posed(person: Person) -> tuple[list[LabelVolume], list[Float], str]:
    """Draw the visits of a person; return their poses (4, 4), RAS mm, and the hemisphere, too."""
    random = np.random.default_rng((SEED, person.seed))
    bodies = {source: load(source) for source in dict.fromkeys(person.sources)}
    loaded = [bodies[source] for source in person.sources]
    volumes = [volume for volume, _ in loaded]
    if person.layers:
        volumes = [lose_layer(v, layer) for v, layer in zip(volumes, person.layers, strict=True)]
    poses: list[Float] = []
    if person.voxels:
        scans = [
            scan(volume, voxel, person.noise, random, person.shares_of)
            for volume, voxel in zip(volumes, person.voxels, strict=True)
        ]
        volumes, poses = [volume for volume, _ in scans], [pose for _, pose in scans]
    return volumes, poses, loaded[0][1]


def measure_frame(
    volumes: Sequence[LabelVolume], hemi: str, settings: Settings, *, shared: bool = False
) -> list[HemisphereMaps]:
    """Measure visits on a common sheet."""
    frame = make_frame(volumes, hemi, settings, untimed, shared=shared)
    return measure_on(frame, volumes, hemi)


def measure_on(frame: Frame, volumes: Sequence[LabelVolume], hemi: str) -> list[HemisphereMaps]:
    """Measure visits on a sheet."""
    return [
        measure_placed(
            frame, motion, volume, place_visit(frame, number, volume, hemi, untimed), untimed
        )
        for number, (motion, volume) in enumerate(zip(frame.motions, volumes, strict=True))
    ]


def untimed(_stage: str) -> AbstractContextManager[None]:
    """Time no stage."""
    return nullcontext()


def measure_person(person: Person) -> Result:
    """Measure the visits of a person on a common sheet, and perhaps on further ones."""
    volumes, poses, hemi = draw_posed(person)
    settings = Settings().changed(grid={"spacing": 0.5}) if person.coarse else Settings()
    separate: list[HemisphereMaps] = []
    start = time.process_time()
    if person.separate:
        separate = [cases.measure_body(replace(v, shares={}), hemi, settings) for v in volumes]
    middle = time.process_time()
    reset_peak_memory()
    frame = make_frame(volumes, hemi, settings, untimed, shared=not person.voxels)
    maps = measure_on(frame, volumes, hemi)
    end, memory = time.process_time(), peak_memory()
    true = None
    if person.true:
        drawn = make_frame([load(person.sources[0])[0]], hemi, settings, untimed, shared=True)
        posed = replace(drawn, motions=tuple(pose @ drawn.motions[0] for pose in poses))
        true = _stacked(measure_on(posed, volumes, hemi))
    smoothed = _smoothed(separate) if separate else None
    return Result(
        frame=_stacked(maps),
        separate=_stacked(separate) if separate else None,
        smooth=smoothed,
        true=true,
        smoother=None if smoothed is None else (smoothed, _smoothed(maps)),
        volume=np.array([m.summary["volume"] for m in maps]),
        separate_volume=np.array([m.summary["volume"] for m in separate]) if separate else None,
        labels_volume=np.array(
            [
                np.count_nonzero(m.body_mask.inside)
                * abs(np.linalg.det(m.body_mask.affine[:3, :3]))
                for m in maps
            ]
        ),
        ca1=maps[0].subfield == Tissue.CA1,
        filled=max(m.qc["filled_fraction"] for m in maps),
        overlap=min(m.qc["frame_overlap"] for m in maps),
        distance=max(m.qc["frame_distance_mm"] for m in maps),
        flagged=sum("visits-differ" in {f.reason for f in m.flags} for m in maps),
        cost=(end - middle) / (middle - start) if separate else np.nan,
        memory=memory / MEGABYTE,
    )


def _stacked(maps: Sequence[HemisphereMaps]) -> Float:
    """Stack maps of thickness (visits, Nx, Ny), mm."""
    return np.stack([m.thickness for m in maps])


def _smoothed(maps: Sequence[HemisphereMaps]) -> Float:
    """Stack smoothed maps of thickness (visits, Nx, Ny), mm."""
    return np.stack([smooth(m.sheet, m.thickness) for m in maps])


def smooth(sheet: Sheet, values: Float) -> Float:
    """Smooth a map (Nx, Ny) on its sheet as the walls of a common sheet are."""
    middle = sheet.points[:, :, sheet.middle].reshape(-1, 3)
    squared = ((middle[:, None] - middle[None]) ** 2).sum(axis=-1)
    kernel = np.exp(-squared / (2 * (SMOOTHING / np.sqrt(8 * np.log(2))) ** 2))
    kernel = kernel * column_area(sheet).ravel()
    return np.asarray(kernel @ values.ravel() / kernel.sum(axis=1)).reshape(values.shape)


def noise_of(maps: Float, *, mean: bool = False) -> float:
    """SD within a person, mm: RMS over the map, or of the mean over the map."""
    values = maps.mean(axis=(1, 2)) if mean else maps
    return float(np.sqrt(values.var(axis=0, ddof=1).mean()))


def slopes(maps: Float) -> Float:
    """Slope (Nx, Ny) over the visits, mm per year."""
    years = YEARS[: len(maps)] - YEARS[: len(maps)].mean()
    return np.asarray(np.tensordot(years, maps, axes=1) / (years**2).sum())


def per_arm(noise: float) -> float:
    """Participants per arm of a trial of the mean thickness, for noise of a visit, mm."""
    spread = ((YEARS - YEARS.mean()) ** 2).sum()
    sd = np.sqrt(TRUE_SD**2 + noise**2 / spread)
    effect = np.array([SLOWED * LOSS / sd])
    return float(participants_needed(effect, 0.05, 0.8, 100_000)[0])


def ragged(seed: int) -> PhantomSpec:
    """Make a phantom with thin tips and notches along its edges."""
    random = np.random.default_rng((SEED, seed, 7))
    tips = [
        Thinning(depth=0.45, u=(-1.0, 0.08), v=(-1.0, 2.0), edge=0.6),
        Thinning(depth=0.45, u=(0.93, 2.0), v=(-1.0, 2.0), edge=0.6),
    ]
    for edge in (0.05, 0.95):
        start = float(random.uniform(0.15, 0.7))
        notch = (edge - 0.08, edge + 0.08)
        tips.append(Thinning(depth=0.35, u=notch, v=(start, start + 0.15), edge=0.5))
    return PhantomSpec(
        kind="spiral", variation=0.1, bend=0.02, length=14.0, thickness=2.0, thinnings=tuple(tips)
    )


def plain(seed: int, change: float = 0.0, local: float = 0.0) -> PhantomSpec:
    """Make a smooth phantom, changed everywhere or in CA1, mm."""
    kind = ("spiral", "arc")[seed % 2]
    thinning = Thinning(depth=-local, u=(0.35, 0.75), v=(-1.0, 2.0), edge=0.2)
    return PhantomSpec(
        kind=kind,
        thickness=2.0 + change,
        variation=0.1,
        bend=0.02,
        length=14.0,
        thinnings=(thinning,) if local else (),
    )


def people(full: bool, labels: Path | None) -> dict[str, list[Person]]:
    """List the people of each set."""
    items = cases.fine_segmentations(labels, 0.6) if labels else []
    beside = [
        item
        for folder in (cases.hippunfold_beside(labels) if labels else [])
        for item in cases.fine_segmentations(folder, 0.6)
    ]
    few = slice(None) if full else slice(1)

    def real(group: Sequence[HemisphereInput], **options: object) -> list[Person]:
        return [
            Person(name=f"{item.subject} {item.hemi}", sources=(item,) * 3, seed=n, **options)  # type: ignore[arg-type]  # fields of Person
            for n, item in enumerate(group)
        ]

    pairs = revisions(labels, Settings())
    return {
        "real, 0.4 mm": real([*items, *beside][few], true=True),
        **({SHARES: real([*items, *beside], shares_of=POINTS)} if full else {}),
        "real, 2 mm slices": (
            [
                replace(person, seed=person.seed + 1000 * draw)
                for draw in range(DRAWS)
                for person in real(items, voxels=(THICK,) * 3, true=True)
            ]
            if full
            else []
        ),
        "real, third visit in 2 mm slices": (
            real(items[:3], voxels=(FINE, FINE, THICK)) if full else []
        ),
        "real, label errors": real(items[few], noise=STRONG) if full else [],
        "two labelings": [
            Person(name=pair.name, sources=(pair.first, pair.second), voxels=())
            for pair in (pairs if full else [])
        ],
        "ragged phantoms": [
            Person(name=f"{n}", sources=(ragged(n),) * 3, noise=NOISE, seed=n)
            for n in range(4 if full else 1)
        ],
        "smooth phantoms": [
            Person(name=f"{n}", sources=(plain(n),) * 3, seed=n) for n in range(4 if full else 0)
        ],
    }


def loss_people(full: bool, labels: Path | None) -> dict[str, list[Person]]:
    """List people of real shapes who lose a layer between two visits."""
    items = cases.fine_segmentations(labels, 0.6) if labels else []
    folders = cases.hippunfold_beside(labels) if labels else []
    others: list[Source] = [i for f in folders for i in cases.fine_segmentations(f, 0.6)]
    others += [
        (path, hemi) for f in folders for path in sorted(f.glob("templates/tpl-*")) for hemi in "LR"
    ]

    def drawn(sources: Sequence[Source]) -> list[Person]:
        return [
            Person(
                name=str(n),
                sources=(source,) * 2,
                voxels=(FINE,) * 2,
                layers=(0.0, LAYER),
                seed=300 + n,
            )
            for n, source in enumerate(sources)
        ]

    if not full:
        return {"three brains": drawn(items[:1])}
    return {
        "three brains": drawn(items),
        "other brains": drawn(others),
    }


@suite("visits")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure people on common and separate sheets, planted change, and invariances."""
    sets = people(full, labels)
    results = cases.run_groups(measure_person, sets, timeout=300.0)
    yield noise_table({name: group for name, group in results.items() if group}, sets)
    losses = cases.run_groups(measure_person, loss_people(full, labels), timeout=300.0)
    yield _losses(losses, [r for r in results["real, 0.4 mm"] if isinstance(r, Result)])
    count = 8 if full else 2
    planted = {
        name: [
            Person(
                name=name,
                sources=tuple(plain(n, *(float(y) * c for c in change)) for y in YEARS),
                seed=100 + n,
                separate=False,
            )
            for n in range(count)
        ]
        for name, change in (("everywhere", (SLOPE, 0.0)), ("CA1", (0.0, LOCAL)))
    }
    planted["none"] = [
        Person(
            name="none",
            sources=(replace(plain(n), length=10.0),) * 3,
            voxels=((0.5, 0.5, 0.5),) * 3,
            noise=NOISE,
            seed=200 + n,
            separate=False,
            coarse=True,
        )
        for n in range(UNCHANGED if full else 4)
    ]
    yield _slopes(cases.run_groups(measure_person, planted, timeout=300.0))
    yield _invariance(cases.attempt(invariance, Person(name="", sources=(plain(0),) * 2)))
    yield cases.left_out(labels)


@table("visits.noise")
def noise_table(
    results: Mapping[str, Sequence[Result | cases.Refusal]], sets: Mapping[str, Sequence[Person]]
) -> Iterator[Cells | str]:
    """Compare the noise of common and separate sheets by set."""
    for name, group in results.items():
        measured = [result for result in group if isinstance(result, Result)]
        keys = ("separate", "smooth", "frame", *(("true",) if measured[0].true is not None else ()))
        sums = {key: _pooled(measured, key) for key in keys}
        means = {key: _pooled(measured, key, mean=True) for key in ("separate", "frame")}
        arms = {key: per_arm(value) for key, value in means.items()}
        cells: dict[str, Cell] = {"set": name, "hemispheres": f"{len(measured)} of {len(group)}"}
        cells |= {
            "separate, mm": sums["separate"],
            "separate, smoothed, mm": sums["smooth"],
            "common, mm": sums["frame"],
            "ratio": sums["frame"] / sums["separate"],
            "ratio, equal smoothing": sums["frame"] / sums["smooth"],
            "ratio, true sheet": sums["true"] / sums["smooth"] if "true" in sums else None,
            "ratio, all smoothed": _smoother(measured),
            "lower in": f"{sum(_lower(result) for result in measured)} of {len(measured)}",
            "mean, separate, mm": means["separate"],
            "mean, common, mm": means["frame"],
            "ratio of means": means["frame"] / means["separate"],
            "level, mm": float(np.mean([_level(result) for result in measured])),
            "per arm, separate": f"{arms['separate']:.0f}",
            "per arm, common": f"{arms['frame']:.0f}",
            "without wall, at most": f"{max(result.filled for result in measured):.1%}",
            "overlap, at least": min(result.overlap for result in measured),
            "flagged": str(sum(result.flagged for result in measured)),
            "cost": float(np.median([result.cost for result in measured])),
            "memory, MB": f"{max(result.memory for result in measured):.0f}",
        }
        yield cells | {
            "ratio met": float(cells["ratio"]) <= MAX_SHARES if name == SHARES else None,  # type: ignore[arg-type]  # of this kind
            "cost met": float(cells["cost"]) <= MAX_COST,  # type: ignore[arg-type]  # as above
            "memory met": max(result.memory for result in measured) <= MAX_MEMORY,
        }
    names = {f"{key}, {p.name}": [r] for key in results for p, r in zip(sets[key], results[key])}  # noqa: B905
    yield cases.refusal_notes(names)


def _pooled(results: Sequence[Result], key: str, *, mean: bool = False) -> float:
    """Pool the SD within people, as root mean square."""
    return cases.rms([noise_of(getattr(result, key), mean=mean) for result in results])


def _smoother(results: Sequence[Result]) -> float:
    """Compute the ratio of the SD within people where maps of both kinds are smoothed."""
    pairs = [result.smoother for result in results if result.smoother is not None]
    separate, common = (
        cases.rms([noise_of(maps) for maps in kind]) for kind in zip(*pairs, strict=True)
    )
    return common / separate


def _lower(result: Result) -> bool:
    """Whether a person has less noise on the common sheet, at equal smoothing."""
    return result.smooth is not None and noise_of(result.frame) < noise_of(result.smooth)


def _level(result: Result) -> float:
    """Mean thickness on the common sheet minus that on separate sheets, mm."""
    separate = result.frame if result.separate is None else result.separate
    return float(result.frame.mean() - separate.mean())


@table("visits.losses")
def _losses(
    results: Mapping[str, Sequence[Result | cases.Refusal]], unchanged: Sequence[Result]
) -> Iterator[Cells | str]:
    """Compare the change that is measured where all walls lose a layer."""
    kinds = ("separate", "frame") if unchanged else ()
    noise = {key: _pooled(unchanged, key, mean=True) for key in kinds}
    for name, group in results.items():
        measured = [result for result in group if isinstance(result, Result)]
        if not measured:
            continue
        change = {
            key: np.array([np.diff(getattr(r, key).mean(axis=(1, 2)))[0] for r in measured])
            for key in kinds
        }
        volume = {
            key: float(np.mean([getattr(r, key)[1] / getattr(r, key)[0] - 1 for r in measured]))
            for key in ("labels_volume", "separate_volume", "volume")
        }
        response = {key: float(values.mean() / (-2 * LAYER)) for key, values in change.items()}
        arms = {key: per_arm(noise[key] / response[key]) for key in noise}
        yield {
            "set": name,
            "hemispheres": f"{len(measured)} of {len(group)}",
            "planted, mm": -2 * LAYER,
            "separate, mm": float(change["separate"].mean()),
            "common, mm": float(change["frame"].mean()),
            "standard error": float(stats.sem(change["frame"])) if len(measured) > 1 else None,
            "bias": f"{response['frame'] - 1:+.1%}",
            "volume of labels": f"{volume['labels_volume']:+.1%}",
            "volume, separate": f"{volume['separate_volume']:+.1%}",
            "volume, common": f"{volume['volume']:+.1%}",
            "per arm, separate": f"{arms['separate']:.0f}",
            "per arm, common": f"{arms['frame']:.0f}",
            "bias met": abs(response["frame"] - 1) <= MAX_BIAS,
        }
    yield cases.refusal_notes(results)


@table("visits.slopes")
def _slopes(results: Mapping[str, Sequence[Result | cases.Refusal]]) -> Iterator[Cells | str]:
    for name, group in results.items():
        measured = [result for result in group if isinstance(result, Result)]
        maps = np.stack([slopes(result.frame) for result in measured])
        ca1 = np.stack([result.ca1 for result in measured])
        inner = np.stack([ndimage.binary_erosion(result.ca1, iterations=3) for result in measured])
        outer = np.stack(
            [~ndimage.binary_dilation(result.ca1, iterations=3) for result in measured]
        )
        part = inner if name == "CA1" else np.ones_like(ca1)
        true = {"everywhere": SLOPE, "CA1": LOCAL, "none": 0.0}[name]
        people_means = np.array([m[p].mean() for m, p in zip(maps, part, strict=True)])
        error = people_means.std(ddof=1) / np.sqrt(len(maps))
        p = stats.ttest_1samp(maps, 0.0, axis=0).pvalue
        positives = float(np.mean(p < 0.05))  # noqa: PLR2004 -- the level
        leakage = float(np.mean([m[o].mean() for m, o in zip(maps, outer, strict=True)]))
        cells: dict[str, Cell] = {
            "change": name,
            "people": str(len(maps)),
            "planted, mm per year": true,
            "measured, mm per year": float(people_means.mean()),
            "standard error": float(error),
            "bias": f"{people_means.mean() / true - 1:+.1%}" if true else None,
            "outside CA1": leakage if name == "CA1" else None,
            "false positives": f"{positives:.3f}" if not true else None,
        }
        bias = bool(abs(people_means.mean() / true - 1) <= MAX_BIAS) if true else None
        low, high = FALSE_POSITIVES
        yield cells | {
            "bias met": bias,
            "leakage met": abs(leakage) <= MAX_LEAKAGE if name == "CA1" else None,
            "false positives met": low <= positives <= high if not true else None,
        }
    yield cases.refusal_notes(results)


def invariance(person: Person) -> dict[str, float]:
    """Measure the largest difference of maps that should be equal, mm, by name."""
    volumes, hemi = draw(replace(person, voxels=(FINE,) * 2))
    settings = Settings()
    maps = [m.thickness for m in measure_frame(volumes, hemi, settings)]
    backward = [m.thickness for m in measure_frame(volumes[::-1], hemi, settings)][::-1]
    twice = [m.thickness for m in measure_frame(volumes[:1] * 2, hemi, settings)]
    turn = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    moved = replace(volumes[0], affine=from_matvec(turn, [0, 20, 0]) @ volumes[0].affine)
    pair = [m.thickness for m in measure_frame([volumes[0], moved], hemi, settings)]
    return {
        "order of visits reversed, largest": float(np.abs(np.subtract(maps, backward)).max()),
        "one visit twice, largest": float(np.abs(twice[0] - twice[1]).max()),
        "a visit moved by 20 degrees and 20 mm, RMS": cases.rms(pair[0] - pair[1]),
    }


@table("visits.invariance")
def _invariance(result: Mapping[str, float] | cases.Refusal) -> Iterator[Cells | str]:
    if isinstance(result, cases.Refusal):
        yield cases.refusal_notes({"invariance": [result]})
        return
    for name, value in result.items():
        limit = MAX_POSE if "moved" in name else MAX_EQUAL
        yield {"maps of": name, "difference, mm": value, "limit, mm": limit, "met": value <= limit}
