"""Synthetic cohorts: groups with a planted effect, covariates and known truth."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import UsageError, did_you_mean
from hipsta_bids.io import files
from hipsta_bids.phantom import dataset
from hipsta_bids.phantom.head import HeadPhantom, HeadSpec
from hipsta_bids.phantom.labels import SUBFIELD_STARTS
from hipsta_bids.phantom.phantom import Phantom
from hipsta_bids.phantom.shape import KINDS, PhantomSpec, Thinning
from hipsta_bids.types import Float

Range = tuple[float, float]


def _regions() -> Mapping[str, tuple[Range, Range]]:
    borders = [start for _, start in SUBFIELD_STARTS] + [1.0]
    spans = {
        tissue.name: (borders[i], borders[i + 1]) for i, (tissue, _) in enumerate(SUBFIELD_STARTS)
    }
    spans["CA2-3"] = (spans.pop("CA2")[0], spans.pop("CA3")[1])
    spans["all"] = (0.0, 1.0)
    ends = {"": (0.0, 1.0), "-posterior": (0.0, 0.5), "-anterior": (0.5, 1.0)}
    return MappingProxyType(
        {
            f"{name if name.startswith('CA') else name.lower()}{end}": (u, v)
            for name, u in spans.items()
            for end, v in ends.items()
        }
    )


#: Regions of the sheet in which an effect can be planted: ranges of u and v.
REGIONS = _regions()

#: Years, mL; sex and the means of intracranial volume of women and men.
_AGES, _MEAN_AGE = (50.0, 80.0), 65.0
_ICV, _ICV_SD, _ICV_MEAN = MappingProxyType({"F": 1400.0, "M": 1560.0}), 110.0, 1480.0
_TURN, _SHIFT = 6.0, 3.0  # degrees and mm, SD of a head's position

#: True maps of each hemisphere, and where the effect was planted; below the dataset.
MAPS_FOLDER = "phantom_maps"
EFFECT_TABLE = "phantom_effect.tsv"

#: Nodes of the true maps along x and y: as many as the default sheet has.
NODES = (41, 21)

#: Of a phantom with a head: digitations at most, and mm of a mean subject: radius of the spiral,
#: tail, body, and what lies between the body and the hook next to the digitations.
_MOST_DIGITATIONS, _RADIUS, _TAIL, _BODY, _BEFORE_HOOK = 4, 5.0, 8.0, 15.0, 10.0
_MOST_SUBJECTS = 10_000

_ROUNDING = 1e-9  # nodes on the border of a region belong to it


@dataclass(frozen=True, kw_only=True)
class CohortPlan:
    """What a cohort looks like.

    The thickness of a wall is ``thickness + age_slope * (age - 65) + site + subject + hemisphere``
    with normal deviates for the last two; the planted thinning is added in every group but the
    first. Width and length grow with the cube root of intracranial volume.
    """

    n_subjects: int = 20
    """In all groups together; as equal as possible."""
    groups: tuple[str, ...] = ("control", "patient")
    """The first one has no effect; the others have it once, twice, and so on."""
    thinning: float = 0.3
    """mm, off the wall inside the region."""
    region: str = "CA1-anterior"
    """One of ``REGIONS``, or ``head`` of a phantom with a head."""
    shift: float = 0.0
    """mm, by which the pattern of the wall and the subfields' borders lie more lateral in the
    other groups; a method has to distinguish this from thinning."""
    seed: int = 0
    kind: str = "spiral"
    """Shape of the cross-section."""
    thickness: float = 1.8
    """mm, mean of the cohort at the age of 65."""
    variation: float = 0.12
    """Thickness varies along x by plus and minus this fraction."""
    subject_sd: float = 0.08
    """mm"""
    hemisphere_sd: float = 0.03
    """mm"""
    offset_sd: float = 0.3
    """mm, of each subject's shift along x."""
    age_slope: float = -0.004
    """mm per year."""
    sites: tuple[float, ...] = (0.0, 0.03)
    """mm that each site adds to thickness."""
    site: str = ""
    """Name of the one site of all, which labels begin with; the thickness is that of its mean."""
    cortex: float = 0.0
    """mm of neighboring cortex, by which the mid-curve extends beyond the subiculum."""
    head: int | None = None
    """Number of digitations of a head, up to 4; without it there are bodies alone."""
    probabilities: bool = False
    """Write the share of each voxel that a tissue fills, too."""

    def __post_init__(self) -> None:
        regions = REGIONS if self.head is None else ("head",)
        for name, value, choices in (("region", self.region, regions), ("kind", self.kind, KINDS)):
            if value not in choices:
                raise UsageError(
                    f"phantom: {name} {value!r} is unknown; choose from {', '.join(choices)}"
                    f"{did_you_mean([value], choices)}"
                )
        if problem := self._problem():
            raise UsageError(f"phantom: {problem}")

    def _problem(self) -> str:
        """Return what cannot be made, or nothing."""
        problem = ""
        if self.cortex and KINDS[self.kind].power != 1:
            problem = f"the shape {self.kind} cannot extend into cortex; choose another kind"
        if self.head is not None:
            if self.shift or self.cortex or self.probabilities or self.kind != CohortPlan.kind:
                problem = "a head has a shape of its own; remove shift, cortex, kind, probabilities"
            if not 0 <= self.head <= _MOST_DIGITATIONS:
                problem = f"a head has 0 to {_MOST_DIGITATIONS} digitations, not {self.head}"
        if not (1 <= self.n_subjects <= _MOST_SUBJECTS and self.seed >= 0):
            problem = f"{self.n_subjects} subjects; give 1 to {_MOST_SUBJECTS:,}"
            problem += f", and a seed of 0 or more, not {self.seed}"
        if not self.groups or len(set(self.groups)) < len(self.groups):
            problem = "give at least one group, and groups with different names"
        if not re.fullmatch("[A-Za-z0-9]*", self.site):
            problem = f"site {self.site!r}: labels have letters and digits only"
        return problem


@dataclass(frozen=True, kw_only=True)
class Subject:
    """One row of ``participants.tsv`` and the shapes behind it."""

    label: str
    group: str
    age: float
    """Years."""
    sex: str
    icv: float
    """mL."""
    site: str
    hemispheres: tuple[dataset.Hemisphere, ...]


def make_cohort(plan: CohortPlan) -> list[Subject]:
    """Draw subjects, each with its random generator: more subjects do not change the first."""
    return [_make_subject(plan, number) for number in range(plan.n_subjects)]


def typical_shape(plan: CohortPlan, dose: int) -> PhantomSpec:
    """Shape of a mean subject's body, with ``dose`` times the planted effect."""
    return _spec(plan, thickness=plan.thickness, scale=1.0, offset=plan.shift * dose, dose=dose)


def region_limits(plan: CohortPlan) -> tuple[Range, Range]:
    """Ranges of u and v of the plan's region, on a sheet that begins with the cortex."""
    (low, high), v = REGIONS[plan.region]
    share = plan.cortex / (PhantomSpec.width + plan.cortex)
    return (share + (1.0 - share) * low, share + (1.0 - share) * high), v


def _make_subject(plan: CohortPlan, number: int) -> Subject:
    random = np.random.default_rng((plan.seed, number))
    dose = number % len(plan.groups)
    age = round(float(random.uniform(*_AGES)), 1)
    sex = "FM"[int(random.integers(2))]
    icv = round(float(random.normal(_ICV[sex], _ICV_SD)), 1)
    site = int(random.integers(len(plan.sites)))
    wall = plan.thickness + plan.age_slope * (age - _MEAN_AGE)
    wall += 0.0 if plan.site else plan.sites[site]
    wall += plan.subject_sd * float(random.standard_normal())
    scale = float(np.cbrt(icv / _ICV_MEAN))
    offset = plan.shift * dose + plan.offset_sd * float(random.standard_normal())
    pose = dataset.rigid_motion(_three(random, _TURN), _three(random, _SHIFT))
    label = f"{plan.site}{number + 1:0{max(2, len(str(plan.n_subjects)))}d}"
    hemispheres = []
    for hemi in "LR":
        thickness = wall + plan.hemisphere_sd * float(random.standard_normal())
        spec: PhantomSpec | HeadSpec
        if plan.head is None:
            spec = _spec(plan, thickness=thickness, scale=scale, offset=offset, dose=dose)
        else:
            spec = _head(plan, thickness=thickness, scale=scale, dose=dose)
        hemispheres.append(dataset.Hemisphere(subject=label, hemi=hemi, spec=spec, pose=pose))
    return Subject(
        label=label,
        group=plan.groups[dose],
        age=age,
        sex=sex,
        icv=icv,
        site=plan.site or f"site{site + 1}",
        hemispheres=tuple(hemispheres),
    )


def _spec(
    plan: CohortPlan, *, thickness: float, scale: float, offset: float, dose: int
) -> PhantomSpec:
    """Shape of one hemisphere; a larger one has the same bends, only wider.

    Curvature changes in the cortex as it does along the hippocampus, whose shape stays.
    """
    plain = PhantomSpec(kind=plan.kind)
    bend = KINDS[plan.kind]
    width = plain.width + plan.cortex
    medial = bend.medial - (bend.lateral - bend.medial) * plan.cortex / plain.width
    thinnings: tuple[Thinning, ...] = ()
    if dose and plan.thinning:
        u, v = region_limits(plan)
        thinnings = (Thinning(depth=plan.thinning * dose, u=u, v=v),)
    return replace(
        plain,
        curvature=(medial / scale, bend.lateral / scale),
        thickness=thickness,
        variation=plan.variation,
        variation_axis="x",
        width=width * scale,
        cortex=plan.cortex * scale,
        length=plain.length * scale,
        thinnings=thinnings,
        offset=offset / (width * scale),
    )


def _head(plan: CohortPlan, *, thickness: float, scale: float, dose: int) -> HeadSpec:
    """Shape of one hemisphere with a head; a larger one is longer."""
    count = plan.head or 0
    plain = HeadSpec(
        thickness=thickness,
        thinning=plan.thinning * dose,
        digitations=count,
        radius=scale * _RADIUS,
        ends=(scale * _TAIL, scale * (_TAIL + _BODY)),
        taper=scale * _TAIL,
    )
    folds = count * (2 * thickness + plain.interior + plain.exterior)
    return replace(plain, straight=plain.ends[1] + scale * _BEFORE_HOOK + folds)


def _three(random: np.random.Generator, sd: float) -> tuple[float, float, float]:
    x, y, z = random.normal(0.0, sd, 3)
    return float(x), float(y), float(z)


def write_cohort(
    out: Path,
    plan: CohortPlan,
    *,
    layout: str = "freesurfer",
    voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
) -> None:
    """Write a cohort as a BIDS dataset with segmentations, participants and all truth.

    ``voxel_size`` is in mm along left, inferior and anterior, the axes of the images.
    """
    dataset.refuse_taken(out)
    subjects = make_cohort(plan)
    hemispheres = [item for subject in subjects for item in subject.hemispheres]
    dataset.write_dataset(
        out,
        hemispheres,
        layouts=(layout,),
        voxel_size=voxel_size,
        probabilities=plan.probabilities,
        columns=_columns(plan),
        rows={s.label: (s.group, f"{s.age:.1f}", s.sex, f"{s.icv:.1f}", s.site) for s in subjects},
    )
    for item in hemispheres:
        if isinstance(item.spec, PhantomSpec):
            _write_maps(out, item, Phantom(item.spec))
    (_write_effect if plan.head is None else _write_head_effect)(out, plan)


def _columns(plan: CohortPlan) -> Mapping[str, Mapping[str, Any]]:
    """Describe the columns of ``participants.tsv``."""
    groups = {
        name: "no effect" if not dose else f"effect planted {dose} time(s)"
        for dose, name in enumerate(plan.groups)
    }
    sites = {f"site{i}": f"{add:+g} mm of thickness" for i, add in enumerate(plan.sites, 1)}
    if plan.site:
        sites = {plan.site: f"{plan.thickness:g} mm of thickness at 65 years"}
    return {
        "group": {"Description": "group of the cohort", "Levels": groups},
        "age": {"Description": "age", "Units": "year"},
        "sex": {"Description": "sex", "Levels": {"F": "female", "M": "male"}},
        "icv": {"Description": "intracranial volume", "Units": "mL"},
        "site": {"Description": "place of the scan", "Levels": sites},
    }


def _grid() -> tuple[Float, Float]:
    """Sheet coordinates u and v of the nodes of the true maps."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, nodes) for nodes in NODES), indexing="ij")
    return u, v


def _write_maps(out: Path, item: dataset.Hemisphere, phantom: Phantom) -> None:
    """Write the true map of one hemisphere."""
    u, v = _grid()
    truth = phantom.truth(u, v, hemi=item.hemi, pose=item.pose)
    names = ("thickness", "curvature", "curvature_interior", "curvature_exterior")
    path = out / MAPS_FOLDER / f"sub-{item.subject}_hemi-{item.hemi}_truth.tsv"
    points = {name: truth.points[..., axis] for axis, name in enumerate("ras")}
    _write_nodes(path, points | {name: getattr(truth, name) for name in names})


def _write_effect(out: Path, plan: CohortPlan) -> None:
    """Write the plan, and by how much a group's wall differs at each point of the sheet."""
    u, v = _grid()
    doses = (0, min(1, len(plan.groups) - 1))
    without, with_effect = (Phantom(typical_shape(plan, dose)) for dose in doses)
    planted = replace(with_effect.spec, offset=0.0)
    thinning = Phantom(planted).body.thickness(u, v) - without.body.thickness(u, v)
    observed = with_effect.body.thickness(u, v) - without.body.thickness(u, v)
    limits = region_limits(plan)
    inside = np.logical_and.reduce(
        [
            (low - _ROUNDING <= at) & (at <= high + _ROUNDING)
            for at, (low, high) in zip((u, v), limits, strict=True)
        ]
    )
    differences = {"difference": thinning, "difference_unregistered": observed}
    _write_nodes(out / EFFECT_TABLE, {"in_region": inside.astype(int), **differences})
    difference = "thickness of the second group minus the first group's, at the same"
    columns = {
        "in_region": ("1 within the limits of the region; at them, half of the effect", None),
        "difference": (f"{difference} anatomical place", "mm"),
        "difference_unregistered": (
            "the same at equal u, where the planted shift counts too",
            "mm",
        ),
    }
    dataset.write_sidecar(out / EFFECT_TABLE, columns, Plan=asdict(plan))


def _write_head_effect(out: Path, plan: CohortPlan) -> None:
    """Write the plan, and by how much a group's wall differs in each part."""
    without, planted = (
        HeadPhantom(_head(plan, thickness=plan.thickness, scale=1.0, dose=dose))
        for dose in (0, min(1, len(plan.groups) - 1))
    )
    rows = []
    for part in ("tail", "body", "head"):
        a, b = (phantom.region_summary(part)["thickness_mean"] for phantom in (without, planted))
        rows.append([part, str(int(part == "head")), f"{b - a:.5f}"])
    files.write_tsv(out / EFFECT_TABLE, ["part", "in_region", "difference"], rows)
    columns = {
        "in_region": ("1 where the effect was planted", None),
        "difference": ("mean thickness of the second group minus the first group's", "mm"),
    }
    dataset.write_sidecar(out / EFFECT_TABLE, columns, Plan=asdict(plan))


def _write_nodes(path: Path, columns: Mapping[str, NDArray[np.generic]]) -> None:
    """Write one row per node, x slowest: its numbers along x and y, u and v, and other columns."""
    x, y = np.indices(NODES) + 1
    all_columns = {"x": x, "y": y, **dict(zip("uv", _grid(), strict=True)), **columns}
    text = [
        [str(cell) if values.dtype.kind in "iu" else f"{cell:.5f}" for cell in values.ravel()]
        for values in all_columns.values()
    ]
    files.write_tsv(path, list(all_columns), zip(*text, strict=True))
