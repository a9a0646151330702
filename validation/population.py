"""A population of undamaged and damaged hippocampi, and what flags do on it.

Segmentations are warped smoothly at random, turned, mirrored and drawn in the voxels of usual
protocols. The limit of each flag is compared with quantiles of its statistic, and judged on brains
that did not set it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from nibabel.affines import from_matvec
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import SettingsError
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.digital import to_ras, voxel_points
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, LabelVolume
from validation import cases, defects
from validation.cases import MIRROR, Refusal, ValidationBody
from validation.damage import Injury, Site, make_defect
from validation.defects import PLAN, Damage
from validation.report import Cell, Cells, Content, Suite, suite, table
from validation.thick_slices import FULL_VOXEL, PHANTOMS, slice_frame

SEED = 3
#: Voxels that usual protocols give: FreeSurfer; HSF and others on isotropic scans; ASHS at 7 T and
#: at 3 T, across the long axis. Labels with thick slices keep their own.
SIZES: tuple[tuple[float, float, float], ...] = (
    (1 / 3, 1 / 3, 1 / 3),
    (0.5, 0.5, 0.5),
    (0.4, 0.4, 1.0),
    (0.4, 0.4, 2.0),
)
WARP_SD = (0.5, 1.5)
"""mm, SD of the displacement along each axis, from the narrowest to the widest warp."""
WARP_SCALE = (8.0, 20.0)
"""mm, full width at half maximum of the Gaussian that makes it smooth: strains are 10 to 12 %."""
TURN = 15.0
"""Degrees, about each axis, by which isotropic grids are turned at most."""
TILT = 8.0
"""Degrees, standard deviation of the tilt of slices against the long axis."""
CRISP = 0.6
"""Voxels, SD of the Gaussian on the labels before they are drawn anew."""
FINE = 0.6
"""mm; voxels without a longer edge are fine."""
WARPS_QUICK, WARPS_FULL = 1, 3

MULTIPLES = (0.7, 0.85, 1.0, 1.2, 1.5)
"""Of the present limits, at which flags are counted."""
QUANTILE = 0.98
"""Of the undamaged population."""
ROOM = 1.1
"""Times the quantile: brains differ by more than warps of one do."""
MAX_FALSE = {"fine": 0.05, "thick": 0.10}
"""Largest share of undamaged hemispheres with any flag."""
MAX_FAR = 0.05
"""A map is wrong if more than this share of the columns away from the damage is off."""
MAX_MEAN = 0.1
"""mm; thick slices change the mean by less."""
MAX_SILENT = 0.03
"""Largest share of wrong maps among the damaged that are accepted."""
TIMEOUT = 120.0
"""s per specimen."""

#: Settings of the flags whose statistic varies among sound hemispheres, and the least that the
#: first limit may be: less does not matter to a map. Limits of other flags follow what they do to
#: the map, or what the header says; they are counted only.
CALIBRATED: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "section-notch": ("notch_share", 0.12),
        "section-bump": ("bump_contrast", 3.5),
        "section-intrusion": ("intrusion_contrast", 3.5),
        "extent-jump": ("flag_row_jump", 0.15),
        "extent-dip": ("flag_row_dip", 0.15),
        "edge-notch": ("flag_edge", 1.0),
        "subfield-gap": ("flag_subfield_gap", 1.5),
        "edge-lost": ("flag_lost_edge", 0.05),
        "wall-bump": ("flag_bump", 5.0),
        "wall-dent": ("flag_dent", 5.0),
        "end-swollen": ("flag_swollen_end", 1.5),
        "thin-gap": ("flag_gap", 60),
    }
)


@dataclass(frozen=True, kw_only=True)
class Specimen:
    """One hemisphere of the population."""

    body: ValidationBody
    number: int
    """Seeds the warp and the pose; 0 leaves the labels as they are."""
    voxel: tuple[float, float, float] | None
    """mm; None keeps the grid of the labels."""
    injuries: tuple[Injury, ...] = ()

    @property
    def brain(self) -> str:
        """Name of the brain, both sides and all namings of labels together."""
        body = self.body
        return f"phantom {body.kind}" if isinstance(body, PhantomSpec) else body.subject

    @property
    def origin(self) -> str:
        """Name of labels and warp, whatever the voxels."""
        body = self.body
        if isinstance(body, PhantomSpec):
            return f"{body.kind} {self.number}"
        return f"{body.subject} {body.hemi} {body.source} {self.number}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Member:
    """What one specimen gave, undamaged and damaged."""

    brain: str
    origin: str
    """Names the labels and the warp, whatever the voxels."""
    mean: float
    """Thickness, mm."""
    spacing: float
    """Longest edge of the voxels, mm."""
    margins: Mapping[str, float]
    """Statistic over limit by reason of the undamaged one."""
    damages: tuple[Damage, ...]

    @property
    def kind(self) -> str:
        """Key of ``MAX_FALSE``."""
        return "fine" if self.spacing <= FINE else "thick"


def run(full: bool, labels: Path | None = None) -> Suite:
    """Measure the population and count flags."""
    specimens = plan(find_bodies(labels), full)
    return describe(specimens, cases.run_cases(measure_specimen, specimens, timeout=TIMEOUT))


def find_bodies(labels: Path | None) -> Sequence[ValidationBody]:
    """Find segmentations of a dataset, and of ``hippunfold`` beside it; phantoms without one."""
    return cases.segmentations(labels, *cases.hippunfold_beside(labels)) if labels else PHANTOMS


def plan(bodies: Sequence[ValidationBody], full: bool) -> list[Specimen]:
    """List specimens: bodies as they are, and warped, with the damages in turn."""
    warps = WARPS_FULL if full else WARPS_QUICK
    order = np.random.default_rng(SEED).permutation(len(PLAN))
    specimens: list[Specimen] = []
    for body in bodies:
        sizes = SIZES if is_fine(cases.load_body(body, FULL_VOXEL)[0]) else (None,)
        ways = [(None, 0), *((size, 1 + n) for n in range(warps) for size in sizes)]
        for size, number in ways:
            injury = PLAN[order[len(specimens) % len(PLAN)]]
            specimens.append(Specimen(body=body, number=number, voxel=size, injuries=(injury,)))
    return specimens


def is_fine(volume: LabelVolume) -> bool:
    """Whether labels can be drawn anew in other voxels."""
    return cases.longest_edge(volume) <= FINE


def measure_specimen(specimen: Specimen) -> Member:
    """Measure one specimen as it is, and with each of its damages."""
    volume, hemi = make_labels(specimen)
    maps = cases.measure_body(volume, hemi)
    site = Site(volume, maps.sheet)
    damages = []
    for injury in specimen.injuries:
        try:
            defect = make_defect(site, *injury)
        except SettingsError:  # too small for these voxels, or nothing there to damage
            continue
        found = cases.attempt(lambda labels: cases.measure_body(labels, hemi), defect.volume)
        damages.append(
            defects.refused(found)
            if isinstance(found, Refusal)
            else defects.compare(found, maps, defect.changed)
        )
    return Member(
        brain=specimen.brain,
        origin=specimen.origin,
        mean=float(np.nanmean(maps.thickness)),
        spacing=cases.longest_edge(volume),
        margins=maps.qc["flag_margins"],
        damages=tuple(damages),
    )


def make_labels(specimen: Specimen) -> tuple[LabelVolume, str]:
    """Draw the labels of a specimen; its hemisphere."""
    volume, hemi = cases.load_body(specimen.body, FULL_VOXEL)
    if specimen.number == 0:
        return volume, hemi
    seed = (SEED, specimen.number, *map(ord, specimen.brain))
    generator, pose = np.random.default_rng(seed), np.random.default_rng((*seed, 1))
    mirrored = pose.random() < 0.5  # noqa: PLR2004 -- half of them
    share = generator.random()
    sd, scale = (a + share * (b - a) for a, b in (WARP_SD, WARP_SCALE))
    if specimen.voxel is None:  # within slices only, or labels would mix between them
        shape, affine = volume.tissue.shape, volume.affine
    else:
        shape, affine = _grid(volume, specimen.voxel, pose)
    points = to_ras(np.moveaxis(np.indices(shape), 0, -1), affine)
    warp = smooth_warp(voxel_points(volume.tissue > 0, volume.affine), sd, scale, generator)
    index = to_ras(points + warp(points), np.linalg.inv(volume.affine))
    if specimen.voxel is None:
        across = int(np.linalg.norm(volume.affine[:3, :3], axis=0).argmax())
        index[..., across] = np.indices(shape)[across]
    drawn = redraw(volume, index, affine)
    if mirrored:
        return replace(drawn, affine=MIRROR @ drawn.affine), "LR"[hemi == "L"]
    return drawn, hemi


def smooth_warp(
    labeled: Float, sd: float, scale: float, generator: np.random.Generator
) -> Callable[[Float], NDArray[np.float64]]:
    """Draw a smooth random displacement round points (N, 3), mm, of standard deviation ``sd``.

    White noise on a grid of 2 mm, smoothed by a Gaussian of ``scale`` mm full width. The function
    that is returned gives it at points (..., 3), so that several grids share it.
    """
    step = 2.0
    low = labeled.min(axis=0) - scale
    count = np.ceil((labeled.max(axis=0) + scale - low) / step).astype(int) + 1
    sigma = scale / np.sqrt(8 * np.log(2)) / step
    size = sd * np.sqrt((2 * np.sqrt(np.pi) * sigma) ** 3)  # 1 / SD of smoothed white noise
    noise = [
        size * ndimage.gaussian_filter(generator.standard_normal(count), sigma, mode="wrap")
        for _ in range(3)
    ]

    def warp(points: Float) -> NDArray[np.float64]:
        where = np.moveaxis((points - low) / step, -1, 0)
        moves = [ndimage.map_coordinates(part, where, order=1, mode="nearest") for part in noise]
        return np.stack(moves, axis=-1)

    return warp


def _grid(
    volume: LabelVolume, voxel: tuple[float, float, float], generator: np.random.Generator
) -> tuple[tuple[int, ...], Float]:
    """Shape and affine of a turned grid round all labels; slices lie across the long axis."""
    if max(voxel) <= FINE:
        frame = cases.turned(generator, TURN)
    else:
        about = generator.uniform(0, np.pi)
        lean = np.deg2rad(TILT) * generator.standard_normal()
        tilt = Rotation.from_rotvec(lean * np.array([np.cos(about), np.sin(about), 0.0]))
        frame = slice_frame(extract_body(volume, Settings().body).ends.axis) @ tilt.as_matrix()
    matrix = frame * np.array(voxel)
    inside = voxel_points(volume.tissue > 0, volume.affine) @ np.linalg.inv(matrix).T
    room = 4.0 / np.array(voxel)
    low = np.floor(inside.min(axis=0) - room) + generator.random(3)
    shape = np.ceil(inside.max(axis=0) + room - low).astype(int)
    return tuple(int(n) for n in shape), from_matvec(matrix, matrix @ low)


def redraw(volume: LabelVolume, index: Float, affine: Float) -> LabelVolume:
    """Take the most probable label at indices (I, J, K, 3) of a volume, without stairs.

    The mask of each label is smoothed and interpolated; the largest wins.
    """
    codes = volume.part.astype(np.intp) * 256 + volume.tissue
    kinds, number = np.unique(codes, return_inverse=True)
    number = np.pad(number.reshape(codes.shape), 1, mode="edge")
    at = np.clip(np.moveaxis(index, -1, 0) + 1, 0, np.array(number.shape)[:, None, None, None] - 1)
    nearest = np.rint(at).astype(np.intp)
    found = number[tuple(nearest)]
    mixed = ndimage.maximum_filter(number, 3) > ndimage.minimum_filter(number, 3)
    here = mixed[tuple(nearest)]
    if here.any():
        where = at[:, here]
        best = np.full(where.shape[1], -1.0)
        label = np.zeros(where.shape[1], dtype=np.intp)
        sharp = np.where(np.linalg.norm(volume.affine[:3, :3], axis=0) > FINE, 0.0, CRISP)
        for kind in range(len(kinds)):
            soft = ndimage.gaussian_filter((number == kind).astype(np.float32), sharp)
            value = ndimage.map_coordinates(soft, where, order=1)
            label, best = np.where(value > best, kind, label), np.maximum(value, best)
        found[here] = label
    drawn = kinds[found]
    return LabelVolume(
        tissue=(drawn % 256).astype(np.uint8),
        part=(drawn // 256).astype(np.uint8),
        affine=affine,
        protocol=volume.protocol,
    )


@suite("population")
def describe(
    specimens: Sequence[Specimen], results: Sequence[Member | Refusal]
) -> Iterator[Content]:
    """Make the tables of a population that was measured."""
    members = [result for result in results if isinstance(result, Member)]
    names = {
        f"{s.brain}, {'own voxels' if s.voxel is None else 'x'.join(f'{v:.2g}' for v in s.voxel)}"
        f", warp {s.number}": [result]
        for s, result in zip(specimens, results, strict=True)
        if isinstance(result, Refusal)
    }
    yield _counts(members)
    yield _curves(members)
    yield _quantiles(members)
    yield _left_out(members, cases.refusal_notes(names))


def set_limits(members: Sequence[Member]) -> dict[str, float]:
    """Find the limits that a population asks for, multiples of the present ones by reason."""
    checks, limits = Settings().checks, dict[str, float]()
    for reason, (name, least) in CALIBRATED.items():
        present = np.ravel(getattr(checks, name))[0]
        values = [member.margins.get(reason, 0.0) for member in members]
        wanted = ROOM * float(np.quantile(values, QUANTILE, method="higher"))
        limits[reason] = max(wanted, least / float(present))
    return limits


def is_flagged(margins: Mapping[str, float], limits: Mapping[str, float]) -> bool:
    """Whether any statistic is beyond its limit, a multiple of the present one (1 if not given)."""
    return any(value > limits.get(reason, 1.0) for reason, value in margins.items())


def is_silent(damage: Damage, limits: Mapping[str, float]) -> bool | None:
    """Whether an accepted map is wrong far from the damage; None if it is not accepted."""
    if not damage.margins or is_flagged(damage.margins, limits):
        return None
    return damage.far_wrong > MAX_FAR * damage.far


def _share(hits: Sequence[object]) -> float:
    return float(np.mean([bool(hit) for hit in hits])) if len(hits) else float("nan")


def _percent(hits: Sequence[object]) -> str | None:
    return f"{_share(hits):.1%} of {len(hits)}" if len(hits) else None


@table("population.present")
def _counts(members: Sequence[Member]) -> Iterator[Cells]:
    """At the present limits, by size of voxels."""
    finest = {m.origin: m.mean for m in sorted(members, key=lambda m: -m.spacing)}
    for spacing in sorted({round(m.spacing, 2) for m in members}):
        group = [m for m in members if round(m.spacing, 2) == spacing]
        flagged = [is_flagged(m.margins, {}) for m in group]
        off = [abs(m.mean - finest[m.origin]) > MAX_MEAN for m in group]
        damages = [d for m in group for d in m.damages]
        silent = [s for d in damages if (s := is_silent(d, {})) is not None]
        yield {
            "longest edge, mm": f"{spacing:g}",
            "undamaged, flagged": _percent(flagged),
            "of these, off by > 0.1 mm": int(np.sum(np.array(off) & flagged)),
            "accepted, off by > 0.1 mm": int(np.sum(np.array(off) > flagged)),
            "damaged, refused": _percent([d.outcome == "refused" for d in damages]),
            "damaged, flagged": _percent([d.outcome == "flagged" for d in damages]),
            "accepted, wrong far away": _percent(silent),
        }


@table("population.curves")
def _curves(members: Sequence[Member]) -> Iterator[Cells | str]:
    """By flag: how often it is raised at multiples of its limit, undamaged and damaged."""
    reasons = sorted({r for m in members for r, v in m.margins.items()})
    for kind in MAX_FALSE:
        group = [m for m in members if m.kind == kind]
        damages = [d for m in group for d in m.damages if d.margins]
        for reason in reasons:
            whole, hurt = (
                [unit.margins.get(reason, 0.0) for unit in units] for units in (group, damages)
            )
            shares = [
                (_share([v > k for v in whole]), _share([v > k for v in hurt])) for k in MULTIPLES
            ]
            if shares[0][0] > 0 or shares[0][1] > 0:
                cells: dict[str, Cell] = {"voxels": kind, "flag": reason}
                for k, (false, found) in zip(MULTIPLES, shares, strict=True):
                    cells[f"x {k:g}"] = f"{false:.1%} / {found:.0%}"
                yield cells
    yield (
        f"Undamaged: {len(members)}. Damaged ones that were measured count; a flag is not "
        "expected for each damage. Flags that are missing were never raised."
    )


@table("population.quantiles")
def _quantiles(members: Sequence[Member]) -> Iterator[Cells]:
    checks, limits = Settings().checks, set_limits(members)
    for reason in sorted({reason for m in members for reason in m.margins}):
        cells: dict[str, Cell] = {"flag": reason}
        for kind in MAX_FALSE:
            values = [m.margins.get(reason, 0.0) for m in members if m.kind == kind] or [np.nan]
            for q in (0.5, 0.95, QUANTILE):
                cells[f"{kind}, {q:g}"] = float(np.quantile(values, q, method="higher"))
        if reason in CALIBRATED:
            name = CALIBRATED[reason][0]
            present = np.ravel(getattr(checks, name))
            asked = ", ".join(f"{limits[reason] * value:.3g}" for value in present)
            cells |= {
                "setting": name,
                "present": ", ".join(f"{value:g}" for value in present),
                "asked for": asked,
            }
        yield cells


@table("population.left_out")
def _left_out(members: Sequence[Member], refused: str) -> Iterator[Cells | str]:
    """Judge limits on brains that did not set them."""
    for kind, most in MAX_FALSE.items():
        every: dict[str, tuple[list[bool], list[bool]]] = {
            name: ([], []) for name in ("present", "quantile")
        }
        for brain in dict.fromkeys(m.brain for m in members):
            others = [m for m in members if m.brain != brain]
            group = [m for m in members if m.brain == brain and m.kind == kind]
            asked = set_limits(others) if others else {}
            judged = {"present": _judge(group, {}), "quantile": _judge(group, asked)}
            for name, (false, silent) in judged.items():
                every[name] = every[name][0] + false, every[name][1] + silent
            yield {"brain": brain, "voxels": kind, **_judged(judged)}
        met = {
            f"{name} met": _share(false) <= most and not _share(silent) > MAX_SILENT
            for name, (false, silent) in every.items()
        }
        targets = f"≤ {most:.0%}, ≤ {MAX_SILENT:.0%}"
        yield {"brain": "all", "voxels": kind, **_judged(every), "targets": targets, **met}
    yield refused


def _judge(group: Sequence[Member], limits: Mapping[str, float]) -> tuple[list[bool], list[bool]]:
    """Who of the undamaged is flagged, and which of the damaged that are accepted is wrong."""
    silent = [is_silent(damage, limits) for member in group for damage in member.damages]
    flags = [is_flagged(member.margins, limits) for member in group]
    return flags, [wrong for wrong in silent if wrong is not None]


def _judged(found: Mapping[str, tuple[list[bool], list[bool]]]) -> dict[str, Cell]:
    cells: dict[str, Cell] = {}
    for name, title in (("present", "present limits"), ("quantile", "quantile")):
        false, silent = found[name]
        cells[f"{title}: false flags"] = _percent(false)
        cells[f"{title}: accepted and wrong"] = _percent(silent)
    return cells
