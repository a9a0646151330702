"""Repair of a field's topology: one solid ribbon without holes, bridges or cavities.

Also a field that marching cubes reads as digital topology does, and the columns of the sheet that
rest on repaired voxels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import digital, membranes
from hipsta_bids.geometry.grid import Field
from hipsta_bids.settings import TopologySettings
from hipsta_bids.types import Bool, Float, Sheet, position_text

#: Most rounds of repair.
ROUNDS = 12
#: A column is marked as repaired this near to a grid node that a repair changed, mm.
REPAIR_REACH = 0.35
#: A column is marked as repaired up to this much farther from a cut than what is nearest to the
#: cut, mm.
STUMP_REACH = 0.7

Locate = Callable[[Float], str]
"""Function that names the subfields at (N, 3) points, RAS mm."""
Contact = Callable[[Float], bool]
"""Function that says whether, by the labels, two turns touch at (N, 3) points, RAS mm."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Repair:
    """One change of the body's shape."""

    kind: membranes.Kind
    """``part`` turns that touch, fill a ``slit`` of the labels, ``cut`` a bridge, ``fill`` a hole,
    remove an ``island``, fill a ``cavity``, leave out the ``uncus``."""
    voxels: int
    """Changed nodes of the working grid."""
    cost: float
    """How much evidence was overruled: sum of the field's distance from its level. For a filled
    hole, of the membrane alone, before it was made as thick as the wall."""
    position: tuple[float, float, float]
    """Center, RAS mm."""
    subfield: str = ""
    """Subfields at the center, if known."""
    excess: float
    """How many times the limits of :class:`TopologySettings` it is: beyond 1, a person should look
    at it; infinite if it contradicts the run of the ribbon."""
    points: Float
    """(N, 3) changed nodes, RAS mm."""

    @property
    def large(self) -> bool:
        """Whether it is beyond the limits."""
        return self.excess > 1

    def __str__(self) -> str:
        size = f"of {self.voxels} grid node{'s' if self.voxels > 1 else ''}"
        text = {
            "part": f"two touching turns were parted by a slit {size}",
            "slit": f"a slit or pit {size} was filled",
            "cut": f"a bridge {size} was cut",
            "fill": f"a hole {size} was filled",
            "island": f"a separate piece {size} was removed",
            "cavity": f"a gap {size} was filled",
            "uncus": f"a piece of the uncus, {size[3:]}, was excluded",
        }[self.kind]
        return f"{text} at {position_text(self.position, self.subfield)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class SolidField:
    """A field whose positive part is a ball together with plates on both ends."""

    field: Field
    """Field after all repairs."""
    before: Field
    """Field before all repairs."""
    repairs: tuple[Repair, ...]
    """Changes that were made, in their order."""
    touched: Bool
    """(A, B, W) nodes whose side was changed."""
    euler_before: int
    """Euler number of the body's voxels before the repairs; 1 is right."""
    euler_after: int
    """Euler number after the repairs; 1."""
    changed_fraction: float
    """Changed nodes over the nodes of the body."""
    rival: Field | None = None
    """Field before all repairs, with the second choices made that are as likely, if any."""


def repair_topology(
    field: Field, settings: TopologySettings, locate: Locate, contact: Contact
) -> SolidField:
    """Make the positive part of a field one solid piece without tunnels.

    Solid plates beyond both ends make an ordinary tunnel of several cap pieces. Growing from inside
    by simple points stops at the membranes that cut every tunnel; shrinking from outside stops at
    membranes that fill it. The cheaper membrane of each tunnel is applied. (The two-sided use of
    homotopic growing follows Kriegeskorte & Goebel 2001, NeuroImage 14:329-346.)
    """
    values = field.values
    before = values > 0
    if not before.any():
        raise GeometryError(
            "nothing is left of the body after smoothing: the sheet is too thin for its voxels; "
            "use a finer segmentation",
            reason="sheet-too-thin",
        )
    state = np.pad(before, membranes.PAD)
    euler_before = membranes.euler(state)
    padded = np.pad(values, membranes.PAD, constant_values=-1.0)
    lifted = padded.copy()
    _refuse_strips(state, field, settings, locate)

    def touching(nodes: digital.Index) -> bool:
        return contact(field.grid.to_ras((nodes - membranes.FIRST).astype(float)))

    edits = _before_smoothing(field)
    edits += _remove_islands(state, field, locate) + _fill_cavities(state)
    ranked = None
    for _ in range(ROUNDS):
        wrong = [plates for plates in (False, True) if membranes.euler(state, plates=plates) != 1]
        if not wrong:
            break
        ranked = membranes.rank(padded) if ranked is None else ranked
        # Pits only once the body itself is sound: the inside of a closed tube is none.
        pits = _fill_cavities(state, plates=True) if wrong[0] else []
        proposals = pits or membranes.apply_membranes(
            state, padded, ranked, lifted, settings, plates=wrong[0], contact=touching
        )
        edits += proposals
        if not proposals or _has_strips(state, settings):
            raise _unrepaired(edits, state, field, locate)
        edits += _remove_islands(state, field, locate) + _fill_cavities(state)
    else:
        raise _unrepaired(edits, state, field, locate)
    after = state[membranes.INNER]
    size = int(np.count_nonzero(before))
    changed, touched = _changes(field, after, edits)
    consistent = _consistent_values(lifted[membranes.INNER], after)
    repairs = tuple(
        _describe(edit, field, size, settings, locate)
        for edit in edits
        if _between_planes(edit, field).mean() > 0.5  # noqa: PLR2004 -- most of it
    )
    return SolidField(
        field=replace(field, values=consistent, separated=None, slits=None),
        before=field,
        repairs=repairs,
        touched=touched,
        euler_before=euler_before,
        euler_after=membranes.euler(state),
        changed_fraction=float(np.count_nonzero(changed) / size),
        rival=_second_choices(field, edits),
    )


def _second_choices(field: Field, edits: Sequence[membranes.Edit]) -> Field | None:
    """Cut where holes were filled, and fill where bridges were cut, if that was as likely."""
    values = field.values.copy()
    for edit in edits:
        if edit.alternative is not None:
            nodes = edit.alternative - membranes.FIRST
            nodes = nodes[((nodes >= 0) & (nodes < values.shape)).all(axis=1)]
            values[tuple(nodes.T)] = -0.1 if edit.kind == "fill" else 0.1
    return None if np.array_equal(values, field.values) else replace(field, values=values)


def _between_planes(edit: membranes.Edit, field: Field) -> Bool:
    """Which nodes (N,) of a change lie between the end planes."""
    level = (edit.nodes - membranes.FIRST)[:, 2]
    return np.asarray((level >= field.beyond) & (level < field.grid.shape[2] - field.beyond))


def _changes(field: Field, after: Bool, edits: Sequence[membranes.Edit]) -> tuple[Bool, Bool]:
    """Nodes that repairs of the sheet changed, and all for which columns of the map are marked."""
    changed = after != (field.values > 0)
    for edit in edits:
        if edit.kind == "uncus":  # no part of the sheet
            changed[tuple((edit.nodes - membranes.FIRST).T)] = False
    if field.slits is not None:
        changed |= field.slits
    touched = changed.copy()
    for nodes in (field.separated, field.cavities):
        if nodes is not None:
            touched |= nodes
    return changed, touched


def _before_smoothing(field: Field) -> list[membranes.Edit]:
    """List what was removed between turns that touch, and what was filled, before smoothing."""
    edits = []
    if field.separated is not None and field.separated.any():
        edits.append(membranes.Edit("part", digital.positions(field.separated) + membranes.FIRST))
    kinds: tuple[tuple[membranes.Kind, Bool | None], ...] = (
        ("slit", field.slits),
        ("cavity", field.cavities),
    )
    for kind, nodes in kinds:
        if nodes is not None:
            pieces, count = ndimage.label(nodes, structure=digital.CUBE)
            edits += [
                membranes.Edit(kind, digital.positions(pieces == n + 1) + membranes.FIRST)
                for n in range(count)
            ]
    return edits


def _through_pieces(state: Bool) -> tuple[NDArray[Any], int, NDArray[Any]]:
    """Pieces of the body, their number, and those from plate to plate, the largest first.

    The plates are left out, or a fragment that touches one of them would count as connected.
    """
    pieces, count = ndimage.label(state[membranes.INNER], structure=digital.FACES)
    through = np.intersect1d(pieces[:, :, 0], pieces[:, :, -1])
    through = through[through > 0]
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[through]
    return pieces, count, through[np.argsort(-sizes)]


def _has_strips(state: Bool, settings: TopologySettings) -> bool:
    """Whether two pieces of a fair size reach from plate to plate."""
    pieces, _, through = _through_pieces(state)
    sizes = [np.count_nonzero(pieces == n) for n in through[:2]]
    return len(sizes) > 1 and bool(sizes[1] > settings.flag_fraction * sizes[0])


def _refuse_strips(state: Bool, field: Field, settings: TopologySettings, locate: Locate) -> None:
    """Refuse a ribbon that a gap divides from end to end, and say where."""
    if not _has_strips(state, settings):
        return
    pieces, _, through = _through_pieces(state)
    gap, nearest = ndimage.distance_transform_edt(pieces != through[0], return_indices=True)
    facing = digital.positions(
        (pieces == through[1]) & (gap <= gap[pieces == through[1]].min() + 1)
    )
    opposite = nearest[:, *facing.T].T
    center = 0.5 * (facing.mean(axis=0) + opposite.mean(axis=0))
    names = locate(field.grid.to_ras(np.vstack([facing, opposite]).astype(float)))
    at = position_text(field.grid.to_ras(center[None])[0], names)
    raise GeometryError(
        f"a gap divides the sheet into {len(through)} strips, at {at}; fill it in the "
        "labels, or check the protocol",
        reason="body-split",
    )


def _unrepaired(
    edits: list[membranes.Edit], state: Bool, field: Field, locate: Locate
) -> GeometryError:
    """Report the largest of the repairs that did not lead to one solid piece."""
    fallback = membranes.Edit("cut", digital.positions(state))
    nodes = max(edits, key=lambda edit: len(edit.nodes), default=fallback).nodes
    point = field.grid.to_ras((nodes - membranes.FIRST).mean(axis=0, keepdims=True))
    at = position_text(point[0], locate(point))
    return GeometryError(
        "holes or bridges of the labels cannot be repaired (Euler number "
        f"{membranes.euler(state)}, closed {membranes.euler(state, plates=True)}), near "
        f"{at}; correct the labels there",
        reason="topology",
    )


def _interrupted(pieces: digital.Index, field: Field, locate: Locate) -> GeometryError:
    """Report where the body ends that begins at the posterior plane."""
    first = int(np.flatnonzero((pieces > 0).any(axis=(0, 1)))[0])
    nodes = digital.positions(np.isin(pieces, np.unique(pieces[:, :, first])) & (pieces > 0))
    level = nodes[:, 2].max() if first == 0 else first
    point = field.grid.to_ras(nodes[nodes[:, 2] == level].astype(float))
    at = position_text(point.mean(axis=0), locate(point))
    return GeometryError(
        f"the body is interrupted at {at}; fill in missing slices, correct head and tail "
        "labels, or use finer labels",
        reason="body-interrupted",
    )


def _remove_islands(state: Bool, field: Field, locate: Locate) -> list[membranes.Edit]:
    """Remove (in place) all but the largest piece that reaches from plate to plate."""
    pieces, count, through = _through_pieces(state)
    if not len(through):
        raise _interrupted(pieces, field, locate)
    if count == 1:
        return []
    main = pieces == through[0]
    state[membranes.INNER] &= main
    return [
        membranes.Edit(
            "uncus" if _is_uncus(piece, main) else "island",
            digital.positions(piece) + membranes.FIRST,
        )
        for piece in (pieces == n for n in range(1, count + 1) if n != through[0])
    ]


def _is_uncus(piece: Bool, main: Bool) -> bool:
    """Whether a separate piece reaches the anterior end, and lies medially of the sheet there."""
    levels = np.flatnonzero(piece.any(axis=(0, 1)))
    if levels[-1] < piece.shape[2] - 1:
        return False
    # The first direction across the axis points laterally.
    medial = digital.positions(piece)[:, 0].mean()
    return bool(medial < digital.positions(main[:, :, levels[0] :])[:, 0].mean())


def _fill_cavities(state: Bool, *, plates: bool = False) -> list[membranes.Edit]:
    """Fill (in place) background that does not reach the border, or with plates that cannot."""
    solid = membranes.with_plates(state, True) if plates else state
    pieces, count = ndimage.label(~solid, structure=digital.CUBE)
    if count == 1:
        return []
    outside = int(pieces[0, 0, 0])
    state |= (pieces > 0) & (pieces != outside)
    return [
        membranes.Edit("cavity", digital.positions(pieces == n))
        for n in range(1, count + 1)
        if n != outside
    ]


def _describe(
    edit: membranes.Edit, field: Field, size: int, settings: TopologySettings, locate: Locate
) -> Repair:
    """Locate one change, and find out whether it is large."""
    kind, nodes = edit.kind, edit.nodes
    points = field.grid.to_ras((nodes - membranes.FIRST).astype(np.float64))
    center = points.mean(axis=0)
    inside = np.clip(nodes - membranes.FIRST, 0, np.array(field.grid.shape) - 1)
    cost = edit.cost or float(np.abs(field.values[tuple(inside.T)]).sum())
    share = settings.flag_part if kind == "part" else settings.flag_fraction
    limit = {"cut": settings.flag_cut_cost, "fill": settings.flag_fill_cost}.get(kind, np.inf)
    return Repair(
        kind=kind,
        voxels=len(nodes),
        cost=cost,
        position=(float(center[0]), float(center[1]), float(center[2])),
        subfield=locate(center[None]),
        excess=float("inf")
        if edit.doubtful or (kind == "fill" and _touches_slit(inside, field))
        else max(cost / max(limit, 1e-9), 0.0 if kind == "uncus" else len(nodes) / (share * size)),
        points=points,
    )


def _touches_slit(nodes: digital.Index, field: Field) -> bool:
    """Whether a hole lies next to a slit between turns, which then went through a wall."""
    if field.separated is None:
        return False
    near = digital.widened(digital.widened(field.separated))
    return bool(near[tuple(nodes.T)].any())


def _consistent_values(values: NDArray[np.float32], after: Bool) -> NDArray[np.float32]:
    """Give the field the sign of the repaired body, and marching cubes the same topology.

    Where the sign is ambiguous on a face or inside a cube, marching cubes decides by the values;
    small positive and larger negative ones keep foreground corners apart, as 6-connectivity does.
    """
    result = np.where(after, np.maximum(values, 0.01), np.minimum(values, -0.01))
    edited = after != (values > 0)
    result = np.where(edited, np.where(after, 0.1, -0.1), result)
    corners = np.zeros(after.shape, dtype=bool)
    for axis in range(3):
        nodes = np.moveaxis(after, axis, 0)
        square = sliding_window_view(nodes, (2, 2), axis=(1, 2))
        a, b, c, d = (square[..., k, m] for k in (0, 1) for m in (0, 1))
        marked = np.moveaxis(corners, axis, 0)
        squares = sliding_window_view(marked, (2, 2), axis=(1, 2), writeable=True)
        squares[(a == d) & (b == c) & (a != b)] = True
    cube = sliding_window_view(after, (2, 2, 2))
    total = np.zeros(cube.shape[:3], dtype=np.int8)
    for corner in np.ndindex(2, 2, 2):
        total += cube[(..., *corner)]
    opposite = np.zeros(total.shape, dtype=bool)
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        first, last = cube[..., dx, dy, 0], cube[..., 1 - dx, 1 - dy, 1]
        opposite |= first & last & (total == 2)  # noqa: PLR2004 -- two opposite corners only
        opposite |= ~first & ~last & (total == 6)  # noqa: PLR2004 -- the reverse
    sliding_window_view(corners, (2, 2, 2), writeable=True)[opposite] = True
    ambiguous = np.where(after, np.minimum(result, 0.03), np.minimum(result, -0.08))
    return np.where(corners, ambiguous, result).astype(np.float32)


def repaired_columns(sheet: Sheet, solid: SolidField) -> Bool:
    """Mark the columns (Nx, Ny) of the sheet that a repair of the topology touched.

    A column represents the sheet up to halfway to its neighbors, so that a repair between two
    columns is not lost. A cut bridge leaves two stumps: the columns nearest to either face of the
    cut are marked, too. Pieces that were removed leave no mark.
    """
    marked = np.zeros(sheet.valid.shape, dtype=bool)
    if not solid.touched.any():
        return marked
    valid = np.asarray(np.isfinite(sheet.points).all(axis=(2, 3)))
    if not valid.any():
        return marked
    nodes, radii = _changed_nodes(solid, sheet.points[valid].reshape(-1, 3))
    gaps = np.stack([_gaps(sheet.points, axis) for axis in (0, 1)], axis=-1)
    # Most columns are far from all repairs: only the others are interpolated.
    reach = float(radii.max() + gaps[valid].max())
    tree = cKDTree(nodes)
    near = np.asarray(tree.query(sheet.points[valid], distance_upper_bound=reach)[0])
    candidates = digital.positions(valid)[
        near.min(axis=1) <= radii.max() + gaps[valid].mean(axis=-1)
    ]
    # Few of those reached need places between columns to show it.
    for is_dense in (False, True):
        candidates = candidates[~marked[tuple(candidates.T)]]
        if not len(candidates):
            break
        places = sheet.points[tuple(candidates.T)]
        if is_dense:
            widest = gaps[tuple(candidates.T)].max(axis=0)
            parts = np.maximum(np.ceil(widest / REPAIR_REACH), 1).astype(int)
            places = _cells(sheet.points, candidates, parts)
        defined = np.isfinite(places).all(axis=-1)
        # A balanced tree takes longer to make than it saves.
        tree = cKDTree(places[defined], balanced_tree=False, compact_nodes=False)
        hit = np.concatenate(tree.query_ball_point(nodes, radii)).astype(np.intp)
        marked[tuple(candidates[np.nonzero(defined)[0][hit]].T)] = True
    return marked


def _gaps(points: Float, axis: int) -> Float:
    """Distance (Nx, Ny) of each column to the farther of its neighbors along an axis, mm."""
    gap = np.nan_to_num(np.linalg.norm(np.diff(points, axis=axis), axis=-1)).max(axis=-1)
    ends = [(int(k == axis), int(k == axis)) for k in range(2)]
    padded = np.pad(gap, ends)
    count = points.shape[axis]
    before, after = (padded.take(range(k, count + k), axis=axis) for k in (0, 1))
    return np.asarray(np.maximum(before, after))


def _changed_nodes(solid: SolidField, points: Float) -> tuple[Float, Float]:
    """Points (N, 3), RAS mm, of changed nodes and faces of cuts, and the reach (N,) of each, mm."""
    box = digital.box_around(digital.positions(solid.touched))
    inside, touched = solid.field.values[box] > 0, solid.touched[box]
    faces = digital.widened(touched & ~inside) & inside
    cuts, _ = ndimage.label(faces & ~touched)
    low = digital.low_corner(box)
    changed = solid.field.grid.to_ras((digital.positions(touched) + low).astype(np.float64))
    radius = np.full(len(changed), REPAIR_REACH)
    nodes = digital.positions(cuts > 0)
    if not len(nodes):
        return changed, radius
    face = solid.field.grid.to_ras((nodes + low).astype(np.float64))
    number = cuts[tuple(nodes.T)]
    distance, _ = cKDTree(points).query(face)
    nearest = np.asarray(ndimage.minimum(distance, number, np.arange(number.max() + 1)))
    stumps = nearest[number] + STUMP_REACH
    return np.vstack([changed, face]), np.concatenate([radius, stumps])


def _cells(points: Float, columns: digital.Index, parts: digital.Index) -> Float:
    """Interpolate round columns, up to halfway to their neighbors; NaN next to undefined ones."""
    steps = [np.linspace(-0.5, 0.5, int(n) + 1) for n in parts]
    offsets = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    last = np.array(points.shape[:2]) - 1
    at = np.clip(columns[:, None] + offsets, 0, last)
    low, high = np.floor(at).astype(np.intp), np.ceil(at).astype(np.intp)
    share = (at - low)[..., None, None]
    x, y = share[:, :, 0], share[:, :, 1]
    (a, b), (c, d) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    before = (1 - y) * points[a, b] + y * points[a, d]
    after = (1 - y) * points[c, b] + y * points[c, d]
    return np.asarray((1 - x) * before + x * after)
