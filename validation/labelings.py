"""Two sets of labels of the same brains by the same laboratory: how far a map moves."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import BodyMask, Bool, Decision, Float, HemisphereMaps
from validation import cases
from validation.cases import Refusal
from validation.report import Cell, Cells, Content, suite, table

MAX_DIFFERENCE = 0.02
"""mm, of the mean thickness of a hemisphere."""
MIN_R = 0.98
"""Of the maps of a hemisphere."""
OFF = 0.3
"""mm; columns that differ by more are off."""
FINE = 0.6
"""mm, longest edge of voxels that are measured here."""
NEAR = 0.6
"""mm, two voxels: columns farther from each voxel that only one body has are elsewhere."""
MEAN = "mean of absolute values"
_LATTICE = 0.05
"""mm; centers of voxels that are nearer to each other are those of the same voxel."""


@dataclass(frozen=True, kw_only=True)
class Revision:
    """Two sets of labels of one hemisphere."""

    first: HemisphereInput
    second: HemisphereInput
    settings: Settings

    @property
    def name(self) -> str:
        """Name in tables: the brain and the hemisphere."""
        return f"{self.first.subject[:-1]} {self.first.hemi}"


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Two maps of one part of a hemisphere, second minus first."""

    difference: float
    """mm, of the mean over the mid-surface; in a subfield, of each map's own labels."""
    same_columns: float
    """mm, mean difference of the same columns (x, y); in a subfield, of the first map's labels."""
    r: float
    """Pearson's, over the same columns."""
    off: float
    """Share of these columns that differ by more than ``OFF``."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How the two labelings of a hemisphere ended, and how their maps differ."""

    decisions: tuple[Decision, Decision]
    parts: Mapping[Tissue | None, Agreement]
    """By subfield; None is the whole body. Empty if a labeling has no map."""
    elsewhere: Agreement | None = None
    """Of the columns that are far from each change of the body."""
    volume: float = float("nan")
    """Relative change of the labeled body's volume."""

    @property
    def flipped(self) -> bool:
        """Whether the decisions differ."""
        return self.decisions[0] is not self.decisions[1]


def revisions(labels: Path | None, settings: Settings) -> list[Revision]:
    """Pair the sets A and B of each brain in the revised dataset beside ``labels``."""
    if labels is None:
        return []
    folder = labels.absolute().parent / f"{labels.absolute().name}-revised"
    items = cases.fine_segmentations(folder, FINE) if folder.is_dir() else []
    sets = {(item.subject, item.hemi): item for item in items}
    return [
        Revision(first=item, second=sets[subject[:-1] + "B", hemi], settings=settings)
        for (subject, hemi), item in sets.items()
        if subject.endswith("A") and (subject[:-1] + "B", hemi) in sets
    ]


def compare_revision(revision: Revision) -> Comparison:
    """Measure both labelings of a hemisphere, and compare their maps."""
    pair = [
        cases.attempt(lambda item: measure(item, revision.settings), item)
        for item in (revision.first, revision.second)
    ]
    decisions = [Decision.FAILED if isinstance(m, Refusal) else m.decision for m in pair]
    ends = decisions[0], decisions[1]
    if Decision.FAILED in ends:
        return Comparison(decisions=ends, parts={})
    first, second = pair
    changed = changed_points(first.body_mask, second.body_mask)
    far = distances(first, changed) > NEAR
    means = [float(np.nanmean(maps.thickness[far])) for maps in pair]
    voxels = [np.count_nonzero(maps.body_mask.inside) for maps in pair]
    tissues = for_region(read_label_volume(revision.first).protocol, "body").sheet
    return Comparison(
        decisions=ends,
        parts=compare_maps(first, second, tissues),
        elsewhere=compare_columns(first.thickness, second.thickness, far, means[1] - means[0]),
        volume=voxels[1] / voxels[0] - 1,
    )


def measure(item: HemisphereInput, settings: Settings) -> HemisphereMaps:
    """Measure the labels of a file."""
    return cases.measure_body(read_label_volume(item), item.hemi, settings)


def compare_maps(
    first: HemisphereMaps, second: HemisphereMaps, tissues: Sequence[Tissue]
) -> dict[Tissue | None, Agreement]:
    """Compare two maps as a whole and in the subfields that the first one has."""
    parts: dict[Tissue | None, Agreement] = {}
    for tissue in (None, *tissues):
        columns = np.ones_like(first.repaired) if tissue is None else first.subfield == tissue
        if columns.any():
            name = "thickness_mean" + (f"_{tissue.name}" if tissue else "")
            parts[tissue] = compare_columns(
                first.thickness,
                second.thickness,
                columns,
                second.summary[name] - first.summary[name],
            )
    return parts


def compare_columns(first: Float, second: Float, columns: Bool, difference: float) -> Agreement:
    """Compare two maps (Nx, Ny) over some columns, those that lack a value left aside."""
    known = columns & np.isfinite(first) & np.isfinite(second)
    change = second[known] - first[known]
    return Agreement(
        difference=float(difference),
        same_columns=float(change.mean()),
        r=float(np.corrcoef(first[known], second[known])[0, 1]),
        off=float((np.abs(change) > OFF).mean()),
    )


def changed_points(first: BodyMask, second: BodyMask) -> Float:
    """Find the voxels that one of two bodies on the same lattice has, (N, 3) RAS mm."""
    points = [to_ras(np.argwhere(m.inside) + m.start, m.affine) for m in (first, second)]
    keys = [set(map(tuple, np.rint(p / _LATTICE).astype(int).tolist())) for p in points]
    return np.array(sorted(keys[0] ^ keys[1]), dtype=np.float64).reshape(-1, 3) * _LATTICE


def distances(maps: HemisphereMaps, points: Float) -> Float:
    """Measure how far each column (Nx, Ny) is from the nearest of points (N, 3), mm."""
    if not len(points):
        return np.full(maps.thickness.shape, np.inf)
    distance = np.asarray(KDTree(points).query(maps.sheet.points.reshape(-1, 3))[0])
    return np.asarray(distance.reshape(maps.sheet.points.shape[:3]).min(axis=2))


@suite("labelings")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:  # noqa: ARG001  (all are few)
    """Measure every hemisphere that was labeled twice."""
    pairs = revisions(labels, Settings())
    results = dict(
        zip([pair.name for pair in pairs], cases.run_cases(compare_revision, pairs), strict=True)
    )
    if results:
        yield _hemispheres(results)
        yield _subfields(results)
    yield cases.left_out(labels)


@table("labelings.hemispheres")
def _hemispheres(results: Mapping[str, Comparison | Refusal]) -> Iterator[Cells | str]:
    compared = {name: c for name, c in results.items() if isinstance(c, Comparison)}
    for name, comparison in compared.items():
        whole, elsewhere = comparison.parts.get(None), comparison.elsewhere
        cells: dict[str, Cell] = {"hemisphere": name, "volume, %": 100 * comparison.volume}
        if whole and elsewhere:
            cells |= {**_cells(whole), "elsewhere, mm": elsewhere.same_columns}
            cells |= {"elsewhere, r": elsewhere.r}
        yield cells | {
            "difference met": whole is not None and abs(whole.difference) <= MAX_DIFFERENCE,
            "r met": whole is not None and whole.r >= MIN_R,
            "first set": str(comparison.decisions[0]),
            "second set": str(comparison.decisions[1]),
            "decision met": not comparison.flipped,
        }
    wholes = [c.parts[None] for c in compared.values() if c.parts]
    rest = [c.elsewhere for c in compared.values() if c.elsewhere]
    if wholes and rest:
        yield {
            "hemisphere": MEAN,
            "volume, %": float(np.mean([abs(100 * c.volume) for c in compared.values()])),
            **_cells(*wholes),
            "elsewhere, mm": float(np.mean([abs(part.same_columns) for part in rest])),
            "elsewhere, r": float(np.mean([part.r for part in rest])),
        }
    yield cases.refusal_notes({n: [r] for n, r in results.items() if isinstance(r, Refusal)})


@table("labelings.subfields")
def _subfields(results: Mapping[str, Comparison | Refusal]) -> Iterator[Cells]:
    compared = {name: c for name, c in results.items() if isinstance(c, Comparison)}
    tissues = dict.fromkeys(t for c in compared.values() for t in c.parts if t is not None)
    for tissue in tissues:
        parts = {name: c.parts[tissue] for name, c in compared.items() if tissue in c.parts}
        for name, part in parts.items():
            yield {"subfield": _name(tissue), "hemisphere": name, **_cells(part)}
        yield {
            "subfield": _name(tissue),
            "hemisphere": MEAN,
            **_cells(*parts.values()),
        }


def _cells(*parts: Agreement) -> dict[str, Cell]:
    """Return the cells of one comparison, or means of several, of absolute differences."""
    size = abs if len(parts) > 1 else float
    return {
        "difference of the mean, mm": float(np.mean([size(part.difference) for part in parts])),
        "same columns, mm": float(np.mean([size(part.same_columns) for part in parts])),
        "r": float(np.mean([part.r for part in parts])),
        f"off by > {OFF:g} mm": f"{np.mean([part.off for part in parts]):.1%}",
    }


def _name(tissue: Tissue) -> str:
    """Return the usual name of a subfield."""
    words = {"SUBICULUM": "subiculum", "PRESUBICULUM": "presubiculum", "CA2_3": "CA2/3"}
    return words.get(tissue.name, tissue.name)
