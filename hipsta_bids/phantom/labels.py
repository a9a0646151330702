"""A phantom drawn on a voxel grid, in the labels of any protocol."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np
from nibabel.affines import from_matvec
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from hipsta_bids.errors import ProtocolError
from hipsta_bids.phantom.shape import Body, PhantomSpec, bad, check_rotation
from hipsta_bids.protocols.protocol import CORE, LATERAL_END, Label, Part, Protocol, Tissue
from hipsta_bids.types import Float, LabelVolume


def make_grid(
    points: Float,
    *,
    voxel_size: tuple[float, float, float],
    axes: str,
    rotation: Float | None,
    border: float,
) -> tuple[tuple[int, int, int], Float]:
    """Lay a grid round points (N, 3), RAS mm, with a border of background, mm.

    Returns the number of voxels, and the affine from index to RAS mm.

    The lattice is fixed in space (a voxel center lies at the origin of RAS), so that moving the
    phantom by part of a voxel changes its voxels.
    """
    if not all(size > 0.0 for size in voxel_size):
        raise bad(f"voxel size {voxel_size} must be positive")
    directions = _axis_directions(axes)
    if rotation is not None:
        rotation = np.asarray(rotation, dtype=np.float64)
        check_rotation(rotation)
        directions = rotation @ directions
    matrix = directions * np.asarray(voxel_size)
    index = points @ np.linalg.inv(matrix).T
    pad = border / np.asarray(voxel_size)
    low = np.floor(index.min(axis=0) - pad)
    count = (np.ceil(index.max(axis=0) + pad) - low).astype(int) + 1
    shape = (int(count[0]), int(count[1]), int(count[2]))
    return shape, from_matvec(matrix, matrix @ low)


def _axis_directions(axes: str) -> Float:
    """Matrix (3, 3) whose columns are the unit directions of the voxel axes in RAS."""
    names = {"R": 0, "L": 0, "A": 1, "P": 1, "S": 2, "I": 2}
    if sorted(names.get(letter, -1) for letter in axes) != [0, 1, 2]:
        raise bad(f"axes {axes!r} must name each direction once, such as RAS or LIA")
    directions = np.zeros((3, 3))
    for column, letter in enumerate(axes):
        directions[names[letter], column] = 1.0 if letter in "RAS" else -1.0
    return directions


#: Subfields of the sheet and the u at which each begins. The share of CA2 is small, as in life.
SUBFIELD_STARTS: tuple[tuple[Tissue, float], ...] = (
    (Tissue.PRESUBICULUM, 0.0),
    (Tissue.SUBICULUM, 0.15),
    (Tissue.CA1, 0.35),
    (Tissue.CA2, 0.75),
    (Tissue.CA3, 0.82),
)

#: Neighboring cortex. BA35 takes the far part of it; nearer to the subiculum lies entorhinal cortex
#: in the anterior half and parahippocampal cortex in the posterior one.
CORTEX: tuple[Tissue, ...] = (Tissue.ENTORHINAL, Tissue.BA35, Tissue.PARAHIPPOCAMPAL)
_BA35_SHARE = 0.4

#: What to draw where a protocol lacks a tissue, first choice first.
_STAND_INS: Mapping[Tissue, tuple[Tissue, ...]] = MappingProxyType(
    {
        Tissue.PRESUBICULUM: (Tissue.SUBICULUM,),
        Tissue.CA2: (Tissue.CA2_3, Tissue.CA3),
        Tissue.CA3: (Tissue.CA2_3,),
        Tissue.CA4: (Tissue.DENTATE_GYRUS,),
        Tissue.DENTATE_GYRUS: (Tissue.CA4,),
        Tissue.BA35: (Tissue.ENTORHINAL, Tissue.PARAHIPPOCAMPAL),
        Tissue.PARAHIPPOCAMPAL: (Tissue.ENTORHINAL,),
        Tissue.ENTORHINAL: (Tissue.PARAHIPPOCAMPAL,),
    }
)

#: mm of dentate gyrus before CA4 begins, going inwards.
_GYRUS_DEPTH = 0.8

_CHUNK = 400_000  # points located at once: about 200 MB of temporary arrays


def draw(
    body: Body,
    shape: tuple[int, int, int],
    affine: Float,
    protocol: Protocol,
    *,
    hemi: str,
    pose: Float | None,
    supersample: int | tuple[int, int, int],
) -> tuple[NDArray[np.intp], dict[int, NDArray[np.float32]]]:
    """Label every voxel of a grid; the affine maps index to RAS mm.

    Returns also the share of each voxel that each code fills, with one point per voxel none.
    """
    counts = np.broadcast_to(np.asarray(supersample, dtype=int), 3)
    if (counts < 1).any():
        raise bad(f"supersample must be 1 or more, not {supersample}")
    table = _label_table(protocol)
    index = np.indices(shape).reshape(3, -1).T.astype(np.float64)
    codes = np.concatenate(
        [table[_regions(body, part, affine, hemi, pose)] for part in _chunks(index, 1)]
    ).reshape(shape)
    shares: dict[int, NDArray[np.float32]] = {}
    if (counts > 1).any():
        # In voxels, the points (M, 3) that vote for the label of one that touches another label.
        steps = [(np.arange(count) + 0.5) / count - 0.5 for count in counts]
        offsets = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        low, high = (f(codes, 3, mode="nearest") for f in (minimum_filter, maximum_filter))
        mixed = np.argwhere(low != high).astype(np.float64)
        votes = [
            _votes(
                table[_regions(body, (part[:, None] + offsets).reshape(-1, 3), affine, hemi, pose)],
                per_voxel=len(offsets),
                kinds=len(protocol.labels) + 1,
            )
            for part in _chunks(mixed, len(offsets))
        ]
        by_code, at = np.concatenate(votes), tuple(mixed.astype(int).T)
        for code in np.flatnonzero(np.bincount(codes.ravel())):
            shares[int(code)] = (codes == code).astype(np.float32)
            shares[int(code)][at] = by_code[:, code] / len(offsets)
        codes[at] = by_code.argmax(axis=1)  # ties take the lowest
    return codes, shares


def subfield_at(u: Float) -> NDArray[np.uint8]:
    """Tissue of the sheet at positions ``u``, in the finest division."""
    starts = np.array([start for _, start in SUBFIELD_STARTS])
    tissues = np.array([tissue for tissue, _ in SUBFIELD_STARTS], dtype=np.uint8)
    return np.asarray(tissues[np.searchsorted(starts[1:], u, side="right")])


def subfield_spans(protocol: Protocol) -> dict[Tissue, tuple[float, float]]:
    """Range of the hippocampal part of the sheet that each subfield of a protocol has."""
    ends = [start for _, start in SUBFIELD_STARTS[1:]] + [1.0]
    spans: dict[Tissue, tuple[float, float]] = {}
    for (tissue, start), end in zip(SUBFIELD_STARTS, ends, strict=True):
        label = label_for(protocol, tissue, Part.BODY)
        if label is not None:
            spans[label.tissue] = (spans.get(label.tissue, (start,))[0], end)
    return spans


def tissue_at(spec: PhantomSpec, u: Float, v: Float) -> NDArray[np.uint8]:
    """Tissue of the whole wall, cortex included, at positions ``u`` and ``v``."""
    share, cortex = _along(spec, u - spec.offset)
    return np.asarray(np.where(share < 0.0, _cortex_at(cortex, v), subfield_at(share)))


def _cortex_at(share: Float, v: Float) -> NDArray[np.uint8]:
    """Kind of cortex at a share of its extent, from far to near, and at ``v``."""
    near = np.where(v < 0.5, Tissue.PARAHIPPOCAMPAL, Tissue.ENTORHINAL)  # noqa: PLR2004 -- half
    return np.where(share < _BA35_SHARE, Tissue.BA35, near).astype(np.uint8)


def _along(spec: PhantomSpec, u: Float) -> tuple[Float, Float]:
    """Share of the hippocampal subfields' extent, below 0 in cortex; and of the cortex's."""
    share = spec.cortex_share
    if share == 0.0:
        return np.maximum(u, 0.0), np.full(np.shape(u), np.inf)
    return (u - share) / (1.0 - share), u / share


def label_for(protocol: Protocol, tissue: Tissue, part: Part) -> Label | None:
    """Label of a tissue of a part in a protocol; None if it has none.

    First the tissue (or its stand-in) in this part, then a label for the whole part, then the
    tissue wherever it is. Without head and tail labels the body is known by CA2 and CA3, so these
    must not extend beyond it (Diers et al. 2023, section 2.1: NeuroImage 276:120182).
    """
    by_meaning = {(label.tissue, label.part): label for label in reversed(protocol.labels)}
    tissues = (tissue, *_STAND_INS.get(tissue, ()))
    meanings = [(choice, part) for choice in tissues]
    if tissue not in CORTEX:
        meanings += [(Tissue.HIPPOCAMPUS, part)]
    if part is Part.BODY or tissue not in LATERAL_END:
        meanings += [(choice, Part.UNKNOWN) for choice in tissues]
    return next((by_meaning[key] for key in meanings if key in by_meaning), None)


def encode(volume: LabelVolume) -> NDArray[np.int32]:
    """Codes (I, J, K) of a label volume in its protocol, to write it as that tool would.

    Where several labels mean the same tissue of the same part, the first one is written.
    """
    table = np.zeros((max(Tissue) + 1, max(Part) + 1), dtype=np.int32)
    for label in reversed(volume.protocol.labels):
        table[label.tissue, label.part] = label.code
    codes = table[volume.tissue, volume.part]
    if np.any((codes == 0) & (volume.tissue != Tissue.BACKGROUND)):
        raise ProtocolError(
            f"protocol {volume.protocol.name} has no code for some tissues of this volume; "
            "write it in the protocol it was made with"
        )
    return codes


# Regions are numbered part by part: for each part, the sheet's subfields, the same again for the
# molecular layer beneath each, then dentate gyrus and CA4, then cortex. Region 0 is outside.
_PARTS = (Part.TAIL, Part.BODY, Part.HEAD)
_SHEET = len(SUBFIELD_STARTS)
_PER_PART = 2 * _SHEET + 2 + len(CORTEX)


def _label_table(protocol: Protocol) -> NDArray[np.intp]:
    """Position in ``protocol.labels`` plus 1 for each region number."""
    table = [0]
    position = {id(label): i + 1 for i, label in enumerate(protocol.labels)}
    for part in _PARTS:
        sheet = [label_for(protocol, tissue, part) for tissue, _ in SUBFIELD_STARTS]
        # A phantom's layer is part of its wall, as it is of the sheet in these protocols only.
        layered = Tissue.MOLECULAR_LAYER in protocol.layer
        layer = label_for(protocol, Tissue.MOLECULAR_LAYER, part) if layered else None
        inner = [label_for(protocol, tissue, part) for tissue in CORE]
        if part is Part.BODY and None in sheet:
            raise ProtocolError(
                f"phantom: protocol {protocol.name} has no label for some subfield of the sheet; "
                "choose another protocol"
            )
        cortex = [label_for(protocol, tissue, part) for tissue in CORTEX]
        layers = [None if tissue is None else layer or tissue for tissue in sheet]
        table += [
            position[id(x)] if x is not None else 0 for x in (*sheet, *layers, *inner, *cortex)
        ]
    return np.array(table, dtype=np.intp)


def _regions(
    body: Body, index: Float, affine: Float, hemi: str, pose: Float | None
) -> NDArray[np.intp]:
    """Region number (N,) at voxel coordinates (N, 3)."""
    spec = body.spec
    points = index @ affine[:3, :3].T + affine[:3, 3]
    reach = body.thickest / 2.0 + spec.interior_depth
    u, v, n = body.locate(points, hemi=hemi, pose=pose, reach=reach).T
    region = np.zeros(len(points), dtype=np.intp)
    beyond = spec.end_length / spec.length
    near = np.flatnonzero((v >= -beyond) & (v <= 1.0 + beyond))  # NaN compares false
    u, v, n = u[near], v[near], n[near]
    half = body.thickness(u, v) / 2.0
    starts = [start for _, start in SUBFIELD_STARTS[1:]]
    position, share = _along(spec, u - spec.offset)
    band = 1 + np.searchsorted(starts, position, side="right")
    layer = n < -half + spec.layer_thickness
    cortex = 2 * _SHEET + 3 + np.searchsorted(CORTEX, _cortex_at(share, v))
    wall = np.where(position < 0.0, cortex, band + _SHEET * layer)
    depth = -half - n
    lined = _along(spec, u)[0] >= spec.interior_start
    inner = (depth > 0.0) & (depth <= spec.interior_depth) & lined
    local = np.where(np.abs(n) <= half, wall, 0)
    local[inner] = np.where(depth[inner] <= _GYRUS_DEPTH, 2 * _SHEET + 1, 2 * _SHEET + 2)
    part = (v >= 0.0).astype(int) + (v > 1.0)
    region[near] = np.where(local > 0, part * _PER_PART + local, 0)
    return region


def _votes(labels: NDArray[np.intp], *, per_voxel: int, kinds: int) -> NDArray[np.intp]:
    """Count labels (N, kinds) in each run of ``per_voxel`` labels."""
    voxels = len(labels) // per_voxel
    keys = np.repeat(np.arange(voxels), per_voxel) * kinds + labels
    return np.bincount(keys, minlength=voxels * kinds).reshape(voxels, kinds)


def _chunks(rows: Float, points_each: int) -> Iterator[Float]:
    """Rows in runs that keep the number of points located at once below ``_CHUNK``."""
    step = max(1, _CHUNK // points_each)
    for start in range(0, len(rows), step):
        yield rows[start : start + step]
