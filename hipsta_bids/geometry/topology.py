"""Repair of a field's topology: one solid ribbon without holes, bridges or cavities."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.simple_points import euler_number, grow, shrink
from hipsta_bids.settings import TopologySettings

_FACES = ndimage.generate_binary_structure(3, 1)
_ALL = np.ones((3, 3, 3), dtype=bool)
_PAD = ((1, 1), (1, 1), (2, 2))  # along the axis: a plate, then free space
_INNER = (slice(1, -1), slice(1, -1), slice(2, -2))
_LEVELS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
_CORNER = np.array([1, 1, 2])
_SLOPE = 0.4  # of a smoothed step per node, at the body's surface

Kind = Literal["cut", "fill", "island", "cavity"]
Locate = Callable[[Float], str]
"""Names the subfields at (N, 3) points, RAS mm."""


@dataclass(frozen=True, kw_only=True)
class Repair:
    """One change of the body's shape."""

    kind: Kind
    """``cut`` a bridge, ``fill`` a hole, remove an ``island``, fill a ``cavity``."""
    voxels: int
    """Changed nodes of the working grid."""
    cost: float
    """How much evidence was overruled: sum of the field's distance from its level."""
    position: tuple[float, float, float]
    """Center, RAS mm."""
    subfield: str = ""
    """Subfield there, if known."""
    large: bool
    """Worth a look: beyond the limits of :class:`TopologySettings`."""

    def __str__(self) -> str:
        what = {
            "cut": "cut a bridge",
            "fill": "filled a hole",
            "island": "removed a separate piece",
            "cavity": "filled a cavity",
        }[self.kind]
        return f"{what} of {self.voxels} grid nodes at {_place(self.position, self.subfield)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class SolidField:
    """A field whose positive part is a ball together with plates on both ends."""

    field: Field
    repairs: tuple[Repair, ...]
    touched: Bool
    """(A, B, W) nodes whose side was changed."""
    euler_before: int
    """Euler number of the body's voxels; 1 is right."""
    euler_after: int
    changed_fraction: float
    """Changed nodes over the nodes of the body."""


def repair_topology(
    field: Field, settings: TopologySettings, locate: Locate | None = None
) -> SolidField:
    """Make the positive part of a field one solid piece without tunnels.

    Solid plates beyond both ends turn several cap pieces into an ordinary tunnel. Growing from
    inside by simple points stops at the membranes that cut every tunnel; shrinking from outside
    stops at those that fill it. The cheaper membrane of each tunnel is applied. (The two-sided
    use of homotopic growing follows Kriegeskorte & Goebel 2001, NeuroImage 14:329-346.)

    Parameters
    ----------
    field : Field
    settings : TopologySettings
    locate : callable, optional
        Names the subfields at points, for messages.

    Returns
    -------
    SolidField

    Raises
    ------
    GeometryError
        ``sheet-too-thin``, ``body-interrupted``, ``body-split``, or ``topology`` where no repair
        is found.
    """
    values = field.values
    before = values > 0
    if not before.any():
        raise GeometryError(
            "nothing is left of the body after smoothing: the sheet is too thin for its voxels",
            reason="sheet-too-thin",
        )
    state = np.pad(before, _PAD)
    euler_before = _euler(state)
    padded = np.pad(values, _PAD, constant_values=-1.0)
    lifted = padded.copy()
    _refuse_strips(state, field, settings, locate)
    edits = _remove_islands(state) + _fill_cavities(state)
    for _ in range(settings.rounds):
        wrong = [plates for plates in (False, True) if _euler(state, plates=plates) != 1]
        if not wrong:
            break
        # Only once the body itself is sound: the inside of a closed tube is no pit.
        pits = _fill_cavities(state, plates=True) if wrong[0] else []
        found = pits or _one_round(state, padded, lifted, settings, plates=wrong[0])
        edits += found
        if not found or _has_strips(state, settings):
            raise _unrepaired(edits, state, field, locate)
        edits += _remove_islands(state) + _fill_cavities(state)
    else:
        raise _unrepaired(edits, state, field, locate)
    after = state[_INNER]
    size = int(np.count_nonzero(before))
    repairs = tuple(_describe(edit, field, size, settings, locate) for edit in edits)
    return SolidField(
        field=Field(grid=field.grid, values=_consistent_values(lifted[_INNER], after)),
        repairs=repairs,
        touched=after != before,
        euler_before=euler_before,
        euler_after=_euler(state),
        changed_fraction=float(np.count_nonzero(after != before) / size),
    )


Edit = tuple[Kind, NDArray[np.intp]]


def _with_plates(state: NDArray[Any], value: float) -> NDArray[Any]:
    """Return a copy with solid plates beyond both ends."""
    solid = state.copy()
    solid[1:-1, 1:-1, 1] = value
    solid[1:-1, 1:-1, -2] = value
    return solid


def _euler(state: Bool, *, plates: bool = False) -> int:
    return euler_number(_with_plates(state, True) if plates else state)


def _through_pieces(state: Bool) -> tuple[NDArray[Any], int, NDArray[Any]]:
    """Pieces of the body, their number, and which of them reach from plate to plate.

    The largest comes first. The plates are left out of the count, or a crumb that touches one of
    them would count as connected.
    """
    pieces, count = ndimage.label(state[_INNER], structure=_FACES)
    through = np.intersect1d(pieces[:, :, 0], pieces[:, :, -1])
    through = through[through > 0]
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[through]
    return pieces, count, through[np.argsort(-sizes)]


def _has_strips(state: Bool, settings: TopologySettings) -> bool:
    """Whether two pieces of a fair size reach from plate to plate."""
    pieces, _, through = _through_pieces(state)
    sizes = [np.count_nonzero(pieces == n) for n in through[:2]]
    return len(sizes) > 1 and bool(sizes[1] > settings.flag_fraction * sizes[0])


def _refuse_strips(
    state: Bool, field: Field, settings: TopologySettings, locate: Locate | None
) -> None:
    """Refuse a ribbon that a gap parts from end to end, and say where."""
    if not _has_strips(state, settings):
        return
    pieces, _, through = _through_pieces(state)
    gap, nearest = ndimage.distance_transform_edt(pieces != through[0], return_indices=True)
    facing = np.argwhere((pieces == through[1]) & (gap <= gap[pieces == through[1]].min() + 1))
    other = nearest[:, *facing.T].T
    center = 0.5 * (facing.mean(axis=0) + other.mean(axis=0))
    names = locate(field.grid.to_ras(np.vstack([facing, other]).astype(float))) if locate else ""
    place = _place(field.grid.to_ras(center[None])[0], names)
    raise GeometryError(
        f"a gap parts the sheet into {len(through)} strips from end to end, at {place}: "
        "fill it in the labels",
        reason="body-split",
    )


def _unrepaired(
    edits: list[Edit], state: Bool, field: Field, locate: Locate | None
) -> GeometryError:
    """Say where the largest of the repairs was tried that did not lead to one solid piece."""
    _, where = max(edits, key=lambda edit: len(edit[1]), default=("cut", np.argwhere(state)))
    point = field.grid.to_ras((where - _CORNER).mean(axis=0, keepdims=True))
    place = _place(point[0], locate(point) if locate else "")
    return GeometryError(
        f"the labels have holes or bridges that could not be repaired (Euler number "
        f"{_euler(state)}, with closed ends {_euler(state, plates=True)}, instead of 1), the "
        f"largest near {place}: correct the labels there by hand",
        reason="topology",
    )


def _place(point: Float | tuple[float, float, float], subfield: str) -> str:
    """Spell a place for people."""
    words = " ".join(f"{value:.1f}" for value in point)
    return f"RAS {words} mm ({subfield})" if subfield else f"RAS {words} mm"


def _remove_islands(state: Bool) -> list[Edit]:
    """Remove all but the largest piece that reaches from plate to plate (in place)."""
    pieces, count, through = _through_pieces(state)
    if not len(through):
        raise GeometryError(
            "the body is interrupted: no connected path of its labels leads from the "
            "posterior to the anterior end plane; check the labels for missing slices and for a "
            "sheet too thin for its voxels",
            reason="body-interrupted",
        )
    if count == 1:
        return []
    state[_INNER] &= pieces == through[0]
    return [
        ("island", np.argwhere(pieces == n) + _CORNER)
        for n in range(1, count + 1)
        if n != through[0]
    ]


def _fill_cavities(state: Bool, *, plates: bool = False) -> list[Edit]:
    """Fill background that does not reach the border (in place).

    With plates, pits that open at an end plane only are cavities too.
    """
    solid = _with_plates(state, True) if plates else state
    pieces, count = ndimage.label(~solid, structure=_ALL)
    if count == 1:
        return []
    outside = int(pieces[0, 0, 0])
    state |= (pieces > 0) & (pieces != outside)
    return [("cavity", np.argwhere(pieces == n)) for n in range(1, count + 1) if n != outside]


def _one_round(
    state: Bool,
    values: NDArray[np.float32],
    lifted: NDArray[np.float32],
    settings: TopologySettings,
    *,
    plates: bool,
) -> list[Edit]:
    """Apply the cheapest membranes (in place): all small ones, or one large one.

    Without plates, tunnels of the body itself are found; with plates, pieces of an end's
    cross-section that hang together only further inside. ``lifted`` gets the values of filled
    holes.
    """
    weight = np.abs(values)
    if plates:
        solid, ranked = _with_plates(state, True), _with_plates(values, 1.0)
    else:
        solid, ranked = state, values
    grown = grow(_inner_ball(solid, ranked), solid, ranked, settings.levels)
    shrunk = shrink(_outer_ball(solid, ranked), solid, ranked, settings.levels)
    candidates: list[tuple[float, Kind, NDArray[np.intp]]] = []
    membranes: tuple[tuple[Kind, Bool], ...] = (("cut", solid & ~grown), ("fill", shrunk & ~solid))
    for kind, membrane in membranes:
        pieces, _ = ndimage.label(membrane, structure=_ALL)
        for number, around in enumerate(ndimage.find_objects(pieces), start=1):
            where = np.argwhere(pieces[around] == number) + [s.start for s in around]
            cost = float(weight[tuple(where.T)].sum())
            gain = _gain(solid, where, kind)
            if gain > 0:
                cost *= _implausibility(kind, where, state.shape[2], settings)
                candidates.append((cost / gain, kind, where))
    candidates.sort(key=lambda c: c[0])
    edits: list[Edit] = []
    for cost, kind, where in candidates:
        if edits and cost > settings.small_cost:
            break
        if edits and _gain(solid, where, kind) <= 0:
            continue  # another membrane already dealt with this tunnel
        solid[tuple(where.T)] = kind == "fill"
        state[tuple(where.T)] = kind == "fill"
        edits.append((kind, _thicken(state, lifted, where, settings) if kind == "fill" else where))
        if cost > settings.small_cost:
            break
    return edits


def _inner_ball(solid: Bool, values: NDArray[np.float32]) -> Bool:
    """Find a ball to grow from: the largest level set that is one, or a single voxel."""
    for level in _LEVELS:
        pieces, count = ndimage.label(solid & (values > level), structure=_FACES)
        if not count:
            break
        part = pieces == np.argmax(np.bincount(pieces[pieces > 0]))
        if _is_ball(part):
            return np.asarray(part)
    seed = np.zeros_like(solid)
    seed[np.unravel_index(np.argmax(np.where(solid, values, -np.inf)), solid.shape)] = True
    return seed


def _outer_ball(solid: Bool, values: NDArray[np.float32]) -> Bool:
    """Find a ball to shrink from: the smallest level set that is one, or the full box."""
    box = np.zeros_like(solid)
    box[1:-1, 1:-1, 1:-1] = True
    for level in _LEVELS:
        part = (solid | (values > -level)) & box
        pieces, _ = ndimage.label(part, structure=_FACES)
        part = pieces == pieces[tuple(np.argwhere(solid)[0])]
        if _is_ball(part):
            return np.asarray(part)
    return box


def _is_ball(mask: Bool) -> bool:
    """Whether one 6-connected piece has neither tunnels nor cavities."""
    return euler_number(mask) == 1 and ndimage.label(~mask, structure=_ALL)[1] == 1


def _gain(state: Bool, where: NDArray[np.intp], kind: Kind) -> int:
    """Change of the Euler number if these voxels change sides."""
    low, high = where.min(axis=0) - 1, where.max(axis=0) + 2
    around = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    block = state[around].copy()
    before = euler_number(block)
    block[tuple((where - low).T)] = kind == "fill"
    return euler_number(block) - before


def _implausibility(
    kind: Kind, where: NDArray[np.intp], depth: int, settings: TopologySettings
) -> float:
    """Factor for membranes that lie across the long axis.

    The ribbon runs along the axis, so what fills a hole in it lies along the axis too, and so does
    what cuts a bridge between two of its turns. A cut across the axis severs a strip of the
    ribbon beside a hole; a fill across it spans the inside of a bend, unless it is the lid of a
    tunnel that opens at an end plane.
    """
    level = float(where[:, 2].mean()) - _CORNER[2]
    lid = kind == "fill" and min(level, depth - 2 * _CORNER[2] - 1 - level) < settings.lid_nodes
    if len(where) < settings.oriented_nodes or lid:
        return 1.0
    areas = np.array(
        [len(np.unique(np.delete(where, axis, axis=1), axis=0)) for axis in range(3)], dtype=float
    )
    across = areas[2] ** 2 / float(areas @ areas)
    limit = settings.cut_across if kind == "cut" else settings.fill_across
    return settings.across_factor if across > limit else 1.0


def _thicken(
    state: Bool,
    lifted: NDArray[np.float32],
    where: NDArray[np.intp],
    settings: TopologySettings,
) -> NDArray[np.intp]:
    """Make a filled membrane as thick as the wall around it (in place), if the topology allows.

    Half the wall's thickness is the median of the distance from its surface along its middle,
    within ``plug_reach`` nodes of the membrane.
    """
    reach = settings.plug_reach
    low = np.maximum(where.min(axis=0) - reach, _CORNER)
    high = np.minimum(where.max(axis=0) + reach + 1, np.array(state.shape) - _CORNER)
    around = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    block = state[around]
    membrane = np.zeros_like(block)
    membrane[tuple((where - low).T)] = True
    off = ndimage.distance_transform_edt(~membrane)
    half = _half_thickness(block & (off > 0), off <= reach)
    plug = np.clip(_SLOPE * (half - off), -0.5, 0.5).astype(np.float32)
    added = (plug > 0) & ~block
    trial = state.copy()
    trial[around] |= added
    if euler_number(trial) != euler_number(state):
        return where
    state[around] |= added
    lifted[around] = np.maximum(lifted[around], np.where(off < half + 1, plug, -1))
    return np.vstack([where, np.argwhere(added) + low])


def _half_thickness(wall: Bool, near: Bool) -> float:
    """Half the thickness of a wall, in nodes: the median depth of its middle."""
    padded = np.pad(wall, 1, mode="edge")  # what goes on beyond the block has no surface there
    depth = ndimage.distance_transform_edt(padded)[1:-1, 1:-1, 1:-1]
    ridge = wall & near & (depth >= ndimage.maximum_filter(depth, 3)) & (depth > 1)
    # A node's depth is the distance from the next node outside, half a step beyond the surface.
    return float(np.median(depth[ridge])) - 0.5 if ridge.any() else 1.0


def _consistent_values(values: NDArray[np.float32], after: Bool) -> NDArray[np.float32]:
    """Make the field's sign that of the repaired body, and marching cubes agree with it.

    Where the sign is ambiguous on a face or inside a cube, marching cubes decides by the values;
    small positive and larger negative ones keep foreground corners apart, as 6-connectivity does.
    """
    result = np.where(after, np.maximum(values, 0.01), np.minimum(values, -0.01))
    edited = after != (values > 0)
    result = np.where(edited, np.where(after, 0.1, -0.1), result)
    corners = np.zeros(after.shape, dtype=bool)
    for axis in range(3):
        a = np.moveaxis(after, axis, 0)
        faces = (a[:, 1:, 1:] == a[:, :-1, :-1]) & (a[:, 1:, :-1] == a[:, :-1, 1:])
        faces &= a[:, 1:, 1:] != a[:, 1:, :-1]
        _mark(np.moveaxis(corners, axis, 0), faces, cube=False)
    opposite = np.zeros(tuple(n - 1 for n in after.shape), dtype=bool)
    total = after.astype(np.int8)
    for axis in range(3):
        total = np.take(total, range(1, total.shape[axis]), axis) + np.take(
            total, range(total.shape[axis] - 1), axis
        )
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        first = after[dx : dx - 1 or None, dy : dy - 1 or None, :-1]
        last = after[1 - dx : -dx or None, 1 - dy : -dy or None, 1:]
        opposite |= first & last & (total == 2)  # noqa: PLR2004 -- two opposite corners only
        opposite |= ~first & ~last & (total == 6)  # noqa: PLR2004 -- the reverse
    _mark(corners, opposite, cube=True)
    positive = np.minimum(result, 0.03)
    negative = np.minimum(result, -0.08)
    return np.where(corners, np.where(after, positive, negative), result).astype(np.float32)


def _mark(corners: Bool, cells: Bool, *, cube: bool) -> None:
    """Mark the corners of flagged faces (first axis runs over nodes) or cubes, in place."""
    for dx in (0, 1) if cube else (None,):
        for dy in (0, 1):
            for dz in (0, 1):
                first = slice(None) if dx is None else slice(dx, dx - 1 or None)
                corners[first, dy : dy - 1 or None, dz : dz - 1 or None] |= cells


def _describe(
    edit: Edit, field: Field, size: int, settings: TopologySettings, locate: Locate | None
) -> Repair:
    kind, where = edit
    nodes: Float = where - _CORNER
    centre = field.grid.to_ras(nodes.mean(axis=0, keepdims=True))[0]
    inside = np.clip(where - _CORNER, 0, np.array(field.grid.shape) - 1)
    cost = float(np.abs(field.values[tuple(inside.T)]).sum())
    limit = {
        "cut": settings.flag_cut_cost,
        "fill": settings.flag_fill_cost,
    }.get(kind, np.inf)
    return Repair(
        kind=kind,
        voxels=len(where),
        cost=cost,
        position=(float(centre[0]), float(centre[1]), float(centre[2])),
        subfield=locate(centre[None]) if locate else "",
        large=bool(cost > limit or len(where) > settings.flag_fraction * size),
    )
