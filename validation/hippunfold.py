"""Thickness of HippUnfold's labels beside HippUnfold's own, and beside walls that it drew."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.errors import InputError
from hipsta_bids.extensions.regions.unfolded import Correspondence
from hipsta_bids.extensions.regions.whole import MAX_VOXEL
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.geometry.wall import vertex_normals
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput, InputRequest, find_hemispheres
from hipsta_bids.io.gifti import read_mesh
from hipsta_bids.io.hippunfold import unfolded_shares
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import translate
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, HemisphereMaps, LabelVolume
from validation import cases
from validation.cases import Refusal
from validation.report import Cell, Cells, Content, suite, table

VOXEL = 0.4
"""mm, of labels that are drawn from surfaces: fine enough for walls of 1.5 mm."""
LAST = 4
"""HippUnfold's code of CA3, the last subfield of the sheet; what lies in it has higher ones."""
MAX_SD, LEAST_CORRELATION = 0.09, 0.93
"""mm; of a person's two maps of thickness."""
MAX_BIAS = 0.03
"""mm, against known walls."""
_ROUNDING = 1e-6
"""Of barycentric coordinates: what lies on the face of two tetrahedra belongs to one at least."""
_INNER = (slice(4, -4), slice(2, -2))
"""Nodes away from the edges, 65 % of all."""

_UPRIGHT = 0.9
"""Cosine of the angle between a line across the sheet and its normal, at least."""
_BODY_ROWS = (10, 30)
"""First and last row of the body on the whole sheet."""
_SAME_PLACE = 0.95
"""Least correlation of the coordinates of the two unfolded sheets."""
_WHOLE_BIAS, _WHOLE_SD = 0.02, {"all": 0.1, "head": 0.1, "body": 0.06, "tail": 0.1}
"""mm; against known walls, from head to tail."""
_WHOLE_R, _PERSON_R = 0.94, 0.9
"""Correlation of all nodes with known walls, and with a person's thickness by HippUnfold."""
_BESIDE = 1.0
"""Nodes farther from HippUnfold's sheet than this have no counterpart there, mm."""

Parts = dict[str, tuple[Float, Float]]


Codes = NDArray[np.intp]
_UNFOLDED = "*space-unfold*den-0p5mm*label-hipp*midthickness.surf.gii"


Source = HemisphereInput | tuple[Path, str]
"""A person's labels, or a template's folder and side."""


Pair = tuple[HemisphereMaps, Float]
"""Our maps, and HippUnfold's thickness (Nx, Ny) where our mid-surface is, mm."""


@suite("hippunfold")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure HippUnfold's labels, and labels that are drawn between its surfaces."""
    folders = cases.hippunfold_beside(labels) if labels else []
    persons: list[HemisphereInput] = []
    templates: list[tuple[Path, str]] = []
    for folder in folders:
        found = find_hemispheres(InputRequest(bids_dir=folder))
        persons += [item for item in found if item.problem is None]
        templates += [(path, h) for path in sorted(folder.glob("templates/tpl-*")) for h in "LR"]
    persons, templates = (persons, templates) if full else (persons[:1], [])
    if not persons:
        yield _LEFT_OUT
        return
    yield _thickness_table(persons, templates)
    sources: list[Source] = [*templates, *persons]
    if templates and labels:
        yield _alone_table([*sources, *cases.fine_segmentations(labels, MAX_VOXEL)])
    if templates:
        yield _whole_table(sources)
    flat = [path for folder in folders for path in sorted(folder.rglob(_UNFOLDED))][:1]
    if flat and templates:
        yield _places_table(sources, flat[0])


@table("hippunfold.thickness")
def _thickness_table(
    persons: Sequence[HemisphereInput], templates: Sequence[tuple[Path, str]]
) -> Iterator[Cells]:
    known = cases.run_cases(measure_template, templates, timeout=120.0)
    own = cases.run_cases(measure_person, persons)
    for person, result in zip(persons, own, strict=True):
        yield _row(_name(person), OWN, result)
    for template, result in zip(templates, known, strict=True):
        yield _row(_name(template), DRAWN, result)


@table("hippunfold.alone")
def _alone_table(sources: Sequence[Source]) -> Iterator[Cells]:
    results = cases.run_cases(measure_alone, sources, timeout=120.0)
    yield from (_alone_row(_name(c), r) for c, r in zip(sources, results, strict=True))


@table("hippunfold.whole")
def _whole_table(sources: Sequence[Source]) -> Iterator[Cells]:
    results = cases.run_cases(measure_whole_sheet, sources, timeout=120.0)
    for case, result in zip(sources, results, strict=True):
        for row in _whole_rows(result, known=isinstance(case, tuple)):
            yield {"hemisphere": _name(case), **row}


@table("hippunfold.places")
def _places_table(sources: Sequence[Source], flat: Path) -> Iterator[Cells]:
    results = cases.run_cases(measure_places, [(case, flat) for case in sources], timeout=120.0)
    for case, row in zip(sources, results, strict=True):
        refused: Cells = {"target": str(row), "met": False}
        yield {"hemisphere": _name(case), **(refused if isinstance(row, Refusal) else row)}


def measure_person(item: HemisphereInput) -> Pair:
    """Measure a person's labels; HippUnfold's own thickness is in ``surf`` beside their folder."""
    name = _surfaces(item)
    subfield = _values(f"{name}*subfields.label.gii")
    points = _values(f"{name}midthickness.surf.gii", "pointset")[subfield <= LAST]
    thickness = _values(f"{name}thickness.shape.gii")[subfield <= LAST]
    return _pair(cases.measure_body(read_label_volume(item), item.hemi), points, thickness)


def measure_template(case: tuple[Path, str]) -> Pair:
    """Measure labels that are drawn between a template's walls."""
    volume, points, thickness = draw_template(*case)
    return _pair(cases.measure_body(volume, case[1]), points, thickness)


def measure_whole_sheet(case: Source) -> Parts:
    """Measure from head to tail: by part, our thickness and that of HippUnfold's walls, (N,) mm.

    Corresponding vertices of a template's two walls may lie obliquely to each other, next to edges;
    where they do by more than 26 degrees, their distance is not the thickness.
    """
    volume, hemi = _volume(case)
    maps = cases.measure_body(volume, hemi, Settings().changed(body={"region": "whole"}))
    name = _surfaces(case)
    points = _values(f"{name}midthickness.surf.gii", "pointset")
    if isinstance(case, tuple):
        inner, outer = (_values(f"{name}{w}.surf.gii", "pointset") for w in ("inner", "outer"))
        theirs = np.linalg.norm(outer - inner, axis=1)
        triangles = _values(f"{name}midthickness.surf.gii", "triangle").astype(np.int32)
        facing = np.abs((vertex_normals(points, triangles) * (outer - inner)).sum(axis=1))
        upright = facing > _UPRIGHT * theirs
    else:
        theirs = _values(f"{name}thickness.shape.gii")
        upright = np.ones(len(points), dtype=bool)
    valid = maps.sheet.valid
    away, nearest = cKDTree(points).query(maps.sheet.points[:, :, maps.sheet.middle][valid])
    nearest = np.asarray(nearest, dtype=np.intp)
    row, ours = np.nonzero(valid)[1], maps.thickness[valid]
    (tail, head), good = _BODY_ROWS, upright[nearest] & (away < _BESIDE)
    parts = {
        "all": good,
        "head": good & (row > head),
        "body": good & (row >= tail) & (row <= head),
        "tail": good & (row < tail),
    }
    return {part: (ours[rows], theirs[nearest[rows]]) for part, rows in parts.items()}


def measure_places(case: tuple[Source, Path]) -> Cells:
    """Compare x and y of the whole sheet with HippUnfold's coordinates, by its unfolded surface.

    At each node with a value: coordinates of HippUnfold's nearest vertex, and how far off the place
    lies at which `resample` takes HippUnfold's map.
    """
    source, flat = case
    settings = Settings().changed(body={"region": "whole"})
    maps = cases.measure_body(*_volume(source), settings)
    sheet = maps.sheet
    vertices = _values(f"{_surfaces(source)}midthickness.surf.gii", "pointset")
    unfolded = unfolded_shares(read_mesh(flat))
    if unfolded is None:
        raise InputError(f"{flat}: is no unfolded surface of HippUnfold")
    between = Correspondence(unfolded[1], settings.sheet, maps.maps["proximodistal"])
    points = sheet.points[:, :, sheet.middle]
    off = np.linalg.norm(between.to_nodes(vertices) - points, axis=-1)[sheet.valid]
    nearest = np.asarray(cKDTree(vertices).query(points[sheet.valid])[1], dtype=np.intp)
    cells: dict[str, Cell] = {}
    met = True
    for name, number in (("AP", 1), ("PD", 0)):
        ours, theirs = between.nodes[sheet.valid][:, number], between.places[nearest, number]
        extent = np.ptp(between.places[:, number])
        same = _two(ours, theirs)[1]
        away = float(np.abs(ours - theirs).mean() / extent)
        cells |= {f"{name}, r": same, f"{name}, mean difference": f"{away:.1%}"}
        met = met and same >= _SAME_PLACE
    middle, high = np.nanpercentile(off, [50, 90])
    cells |= {"nodes": len(nearest), "median, mm": float(middle), "90 %, mm": float(high)}
    return {**cells, "target": f"r ≥ {_SAME_PLACE:g}", "met": met}


def _whole_rows(result: Parts | Refusal, *, known: bool) -> list[Cells]:
    """Compare the whole sheet's thickness with that of known walls, or a person's, part by part."""
    if isinstance(result, Refusal):
        return [{"part": "all", "target": str(result), "met": False}]
    rows: list[Cells] = []
    for part, (ours, true) in result.items():
        bias, (spread, same) = float((ours - true).mean()), _two(ours, true)
        limit = _WHOLE_SD[part]
        met = abs(bias) <= _WHOLE_BIAS and spread <= limit
        target = f"bias within {_WHOLE_BIAS:g}, SD ≤ {limit:g}"
        if not known:
            target, met = f"r ≥ {_PERSON_R:g}", same >= _PERSON_R
        elif part == "all":
            target, met = f"{target}, r ≥ {_WHOLE_R:g}", met and same >= _WHOLE_R
        cells: Cells = {"part": part, "bias": f"{bias:+.3f}", "SD": spread, "r": same}
        rows.append({**cells, "nodes": len(ours), "target": target, "met": met})
    return rows


def measure_alone(case: Source) -> tuple[Float, Float, Float]:
    """Measure the body on the sheet with the head, and alone, both without the molecular layer.

    Returns the two thicknesses of the nodes that have both, and their distances, (N,) mm.
    """
    volume, hemi = _volume(case)
    volume = replace(volume, protocol=volume.protocol.model_copy(update={"layer": ()}))
    with_tail = volume.protocol.name == "hippunfold"
    maps, alone = (
        cases.measure_body(volume, hemi, Settings().changed(body={"region": region}))
        for region in ("whole" if with_tail else "headbody", "body")
    )
    first = _BODY_ROWS[0] if with_tail else 0
    rows = slice(first, first + alone.thickness.shape[1])
    middle, own = (s.points[:, :, s.middle] for s in (maps.sheet, alone.sheet))
    apart = np.linalg.norm(middle[:, rows] - own, axis=2)
    told = maps.sheet.valid[:, rows]
    return maps.thickness[:, rows][told], alone.thickness[told], apart[told]


def _volume(case: Source) -> tuple[LabelVolume, str]:
    if isinstance(case, tuple):
        return draw_template(*case)[0], case[1]
    return read_label_volume(case), case.hemi


def _surfaces(case: Source) -> str:
    """Pattern of the names of HippUnfold's surfaces, up to what they are."""
    folder, hemi = (
        case if isinstance(case, tuple) else (case.files[0].parent.parent / "surf", case.hemi)
    )
    return str(folder / f"*_hemi-{hemi}_*_label-hipp_")


def _name(case: Source) -> str:
    if isinstance(case, tuple):
        return f"{case[0].name.removeprefix('tpl-')} {case[1]}"
    return f"{case.subject} {case.hemi}"


def _alone_row(name: str, result: tuple[Float, Float, Float] | Refusal) -> Cells:
    """Compare the body on the whole sheet with the body alone, node by node."""
    cells: dict[str, Cell] = {"hemisphere": name}
    met = False
    if isinstance(result, Refusal):
        return {**cells, "target": str(result), "met": met}
    ours, alone, apart = result
    bias, (spread, same) = float((ours - alone).mean()), _two(ours, alone)
    cells |= {"distance, median": float(np.median(apart)), "95 %": float(np.quantile(apart, 0.95))}
    cells |= {"bias": f"{bias:+.3f}", "SD": spread, "r": same, "nodes": len(ours)}
    cells["target"] = f"bias within {MAX_BIAS:g}, r ≥ {LEAST_CORRELATION:g}"
    return {**cells, "met": abs(bias) <= MAX_BIAS and same >= LEAST_CORRELATION}


def _values(pattern: str, kind: str | None = None) -> Float:
    """Read the data of the one GIFTI file that a pattern fits, of one intent or of all."""
    (path,) = Path("/").glob(pattern.removeprefix("/"))
    return np.asarray(nib.GiftiImage.from_filename(path).agg_data(kind), dtype=np.float64)


def _pair(maps: HemisphereMaps, points: Float, thickness: Float) -> Pair:
    """Take thickness at the one of (N, 3) vertices that is nearest to each mid-surface node."""
    middle = maps.sheet.points[:, :, maps.sheet.middle]
    nearest = cKDTree(points).query(middle.reshape(-1, 3))[1]
    return maps, thickness[nearest].reshape(maps.thickness.shape)


def draw_template(folder: Path, hemi: str) -> tuple[LabelVolume, Float, Float]:
    """Draw labels between a template's walls.

    Also the vertices (N, 3) of its sheet, RAS mm, and their thickness (N,), mm: the distance of
    corresponding vertices. What lies within the sheet keeps the template's own labels.
    """
    name = _surfaces((folder, hemi))
    inner, outer, middle = (
        _values(f"{name}{wall}.surf.gii", "pointset") for wall in ("inner", "outer", "midthickness")
    )
    triangles = _values(f"{name}midthickness.surf.gii", "triangle").astype(np.intp)
    subfield = _values(str(folder.parent / f"hemi-{hemi}_*subfields.label.gii")).astype(np.intp)
    low = np.floor(np.minimum(inner, outer).min(axis=0) / VOXEL) * VOXEL - 4.0
    room = (np.maximum(inner, outer).max(axis=0) + 4.0 - low) / VOXEL
    shape = tuple(int(n) for n in np.ceil(room))
    affine = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
    affine[:3, 3] = low
    codes = _codes_within(next(folder.glob(f"*_hemi-{hemi}_*_dseg.nii.gz")), shape, affine)
    # A prism between two corresponding triangles is three tetrahedra.
    a, b, c = triangles.T
    for corners in (
        (inner[a], inner[b], inner[c], outer[c]),
        (inner[a], inner[b], outer[c], outer[b]),
        (inner[a], outer[b], outer[c], outer[a]),
    ):
        _fill(codes, (np.stack(corners, axis=1) - low) / VOXEL, subfield[triangles[:, 0]])
    protocol = load_protocol("hippunfold")
    tissue, part = translate(codes, protocol)
    volume = LabelVolume(tissue=tissue, part=part, affine=affine, protocol=protocol)
    sheet = subfield <= LAST
    return volume, middle[sheet], np.linalg.norm(outer - inner, axis=1)[sheet]


def _codes_within(path: Path, shape: tuple[int, ...], affine: Float) -> Codes:
    """Codes of what lies within the sheet, from a label file, on another grid; 0 elsewhere."""
    image = nib.Nifti1Image.from_filename(path)
    place = np.moveaxis(np.indices(shape), 0, -1)
    voxel = np.rint(to_ras(place, np.linalg.inv(image.affine) @ affine)).astype(int)
    held = ((voxel >= 0) & (voxel < image.shape)).all(axis=-1)
    codes = np.zeros(shape, dtype=np.intp)
    codes[held] = np.asarray(image.dataobj)[tuple(voxel[held].T)]
    return np.where(codes > LAST, codes, 0)


def _fill(codes: Codes, tetra: Float, values: Codes) -> None:
    """Write values (N,) into the voxels whose centers lie in tetrahedra (N, 4, 3), in voxels."""
    first = np.ceil(tetra.min(axis=1)).astype(int)
    count = np.floor(tetra.max(axis=1)).astype(int) - first + 1
    edges = np.swapaxes(tetra[:, 1:] - tetra[:, :1], 1, 2)
    inverse = np.linalg.inv(edges + 1e-9 * np.eye(3))  # some are flat
    for step in np.ndindex(*count.max(axis=0)):
        near = np.flatnonzero((np.array(step) < count).all(axis=1))
        at = first[near] + step
        weight = np.einsum("nij,nj->ni", inverse[near], at - tetra[near, 0])
        inside = (weight >= -_ROUNDING).all(axis=1) & (weight.sum(axis=1) <= 1 + _ROUNDING)
        codes[tuple(at[inside].T)] = values[near[inside]]


def _row(name: str, walls: str, result: Pair | Refusal) -> Cells:
    """Compare two maps; of a person by SD and correlation, of a template by the mean."""
    cells: dict[str, Cell] = {"hemisphere": name, "labels": walls}
    met = False
    if not isinstance(result, Refusal):
        maps, theirs = result
        ours = maps.thickness
        both = [_two(ours[part], theirs[part]) for part in ((slice(None),) * 2, _INNER)]
        bias = float((ours - theirs).mean())
        of_rows = (ours - theirs).mean(axis=0)
        met = (
            abs(bias) <= MAX_BIAS
            if walls == DRAWN
            else both[0][0] <= MAX_SD and both[0][1] >= LEAST_CORRELATION
        )
        outer = (ours - theirs - bias) ** 2
        cells |= {
            "bias": f"{bias:+.3f}",
            "SD": both[0][0],
            "r": both[0][1],
            "SD, inner nodes": both[1][0],
            "r, inner nodes": both[1][1],
            "variance in outer nodes": f"{1 - outer[_INNER].sum() / outer.sum():.0%}",
            "posterior row": f"{of_rows[0]:+.2f}",
        }
    cells["target"] = _TARGETS[walls]
    return {**cells, "met": met}


def _two(ours: Float, theirs: Float) -> tuple[float, float]:
    """SD of the difference, mm, and correlation."""
    return float((ours - theirs).std()), float(np.corrcoef(ours.ravel(), theirs.ravel())[0, 1])


OWN, DRAWN = "HippUnfold's", "between its walls"
_TARGETS = {
    OWN: f"SD ≤ {MAX_SD:g}, r ≥ {LEAST_CORRELATION:g}",
    DRAWN: f"bias within {MAX_BIAS:g}",
}

_LEFT_OUT = """\
Left out: it needs `--labels DIR` and, beside DIR, a folder `hippunfold` with outputs of that
program (its labels, and its surfaces in `surf`). Coordinates are compared if an unfolded surface
(`space-unfold`, 0.5 mm) is there.
"""
