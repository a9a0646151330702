"""Membranes that cut or fill the tunnels of a voxel body.

Arrays here are padded: along the axis by a layer for a plate and one of free space, across it by
one of free space.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry.digital import euler_number, grow, shrink
from hipsta_bids.settings import TopologySettings
from hipsta_bids.types import Bool

Kind = Literal["part", "slit", "cut", "fill", "island", "cavity"]
Contact = Callable[[NDArray[np.intp]], bool]
FACES = ndimage.generate_binary_structure(3, 1)
ALL = np.ones((3, 3, 3), dtype=bool)
PAD = ((1, 1), (1, 1), (2, 2))  # along the axis: a plate, then free space
INNER = (slice(1, -1), slice(1, -1), slice(2, -2))
CORNER = np.array([1, 1, 2])
_LEVELS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
_SLOPE = 0.4  # of a smoothed step per node, at the body's surface


class Edit(NamedTuple):
    """One change of a padded body."""

    kind: Kind
    where: NDArray[np.intp]
    """(N, 3) nodes."""
    cost: float = 0.0
    """Evidence overruled by a membrane, before it was thickened: sum of the field."""
    doubtful: bool = False
    """It contradicts the run of the ribbon along the axis."""


def with_plates(state: NDArray[Any], value: float) -> NDArray[Any]:
    """Return a copy with solid plates beyond both ends."""
    solid = state.copy()
    solid[1:-1, 1:-1, 1] = value
    solid[1:-1, 1:-1, -2] = value
    return solid


def euler(state: Bool, *, plates: bool = False) -> int:
    """Find the Euler number of a padded body, with or without plates on both ends."""
    return euler_number(with_plates(state, True) if plates else state)


def apply_membranes(
    state: Bool,
    values: NDArray[np.float32],
    lifted: NDArray[np.float32],
    settings: TopologySettings,
    *,
    plates: bool,
    contact: Contact,
) -> list[Edit]:
    """Apply the cheapest membranes (in place): all small ones, or one large one.

    Without plates, tunnels of the body itself are found; with plates, pieces of an end's
    cross-section that hang together only further inside. ``lifted`` gets the values of filled
    holes. ``contact`` tells of nodes (N, 3) whether two turns of the sheet touch there.
    """
    ranked = _ranked(values, settings)
    solid = with_plates(state, True) if plates else state
    if plates:
        ranked = with_plates(ranked, float(ranked.max()) + 1.0)
    grown = grow(_inner_ball(solid, ranked), solid, ranked, settings.levels)
    shrunk = shrink(_outer_ball(solid, ranked), solid, ranked, settings.levels)
    both: tuple[tuple[Kind, Bool], ...] = (("cut", solid & ~grown), ("fill", shrunk & ~solid))
    found = [
        Edit(kind, where)
        for kind, membrane in both
        for where in _pieces(membrane)
        if not (plates and _in_plates(where, solid))
    ]
    candidates = _priced(found, solid, values, settings, contact)
    edits: list[Edit] = []
    for cost, edit in candidates:
        kind, where = edit.kind, edit.where
        if edits and cost > settings.small_cost:
            break
        if edits and _gain(solid, where, kind) <= 0:
            continue  # another membrane already dealt with this tunnel
        solid[tuple(where.T)] = kind == "fill"
        state[tuple(where.T)] = kind == "fill"
        if kind == "fill":
            where = _thicken(state, lifted, where, settings)
        edits.append(edit._replace(where=where))
        if cost > settings.small_cost:
            break
    return edits


def _pieces(membrane: Bool) -> list[NDArray[np.intp]]:
    """Nodes (N, 3) of each connected piece."""
    pieces, _ = ndimage.label(membrane, structure=ALL)
    return [
        np.argwhere(pieces[around] == number) + [s.start for s in around]
        for number, around in enumerate(ndimage.find_objects(pieces), start=1)
    ]


def _priced(
    found: list[Edit],
    solid: Bool,
    values: NDArray[np.float32],
    settings: TopologySettings,
    contact: Contact,
) -> list[tuple[float, Edit]]:
    """Price per tunnel of the membranes that deal with one.

    A cut from a hole to an end plane deals with none once the ends are closed; one through a
    strand along that plane does not either, but closing the ends opens its tunnel. So of such
    cuts as many are taken at their price as there are tunnels more without closed ends.
    """
    closed = with_plates(solid, True)
    open_tunnels = euler_number(closed) - euler_number(solid)
    any_hole = euler_number(closed) != 1
    candidates = []
    for kind, where, *_ in found:
        gain = _gain(solid, where, kind)
        if gain <= 0:
            continue
        cost = float(np.abs(values[tuple(where.T)]).sum())
        factor = _implausibility(kind, where, solid, settings)
        if kind == "cut" and factor > 1 and contact(where):
            factor = 1.0
        at_end = kind == "cut" and any_hole and _gain(closed, where, kind) <= 0
        doubtful = factor > 1 and (kind == "cut" or cost > settings.doubtful_fill_cost)
        candidates.append((factor * cost / gain, Edit(kind, where, cost, doubtful), at_end))
    candidates.sort(key=lambda c: c[0])
    priced = []
    for price, edit, at_end in candidates:
        wrong = at_end and open_tunnels <= 0
        open_tunnels -= at_end
        priced.append(
            (price * settings.across_factor, edit._replace(doubtful=True))
            if wrong
            else (price, edit)
        )
    return sorted(priced, key=lambda c: c[0])


def _ranked(values: NDArray[np.float32], settings: TopologySettings) -> NDArray[np.float32]:
    """Order in which nodes are added or removed: by value, and by depth where values saturate.

    So membranes come to lie midway across a wide hole, where the field is flat.
    """
    inside = values > 0
    depth = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
    return np.asarray(values + settings.depth_rank * depth, dtype=np.float32)


def _in_plates(where: NDArray[np.intp], solid: Bool) -> bool:
    """Whether a membrane lies in one of the plates, where nothing can be changed."""
    return bool(((where[:, 2] == 1) | (where[:, 2] == solid.shape[2] - 2)).any())


def _inner_ball(solid: Bool, values: NDArray[np.float32]) -> Bool:
    """Find a ball to grow from: the largest level set that is one, or a single voxel."""
    for level in _LEVELS:
        pieces, count = ndimage.label(solid & (values > level), structure=FACES)
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
        pieces, _ = ndimage.label(part, structure=FACES)
        part = pieces == pieces[tuple(np.argwhere(solid)[0])]
        if _is_ball(part):
            return np.asarray(part)
    return box


def _is_ball(mask: Bool) -> bool:
    """Whether one 6-connected piece has neither tunnels nor cavities."""
    return euler_number(mask) == 1 and ndimage.label(~mask, structure=ALL)[1] == 1


def _gain(state: Bool, where: NDArray[np.intp], kind: Kind) -> int:
    """Change of the Euler number if these voxels change sides."""
    low, high = where.min(axis=0) - 1, where.max(axis=0) + 2
    around = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    block = state[around].copy()
    before = euler_number(block)
    block[tuple((where - low).T)] = kind == "fill"
    return euler_number(block) - before


def _implausibility(
    kind: Kind, where: NDArray[np.intp], solid: Bool, settings: TopologySettings
) -> float:
    """Factor for membranes that lie across the long axis.

    The ribbon runs along the axis, so what fills a hole in it lies along the axis too, and so does
    what cuts a bridge between two of its turns. A cut across the axis, with ribbon before and
    behind it, severs a strip of the ribbon beside a hole; a fill across the axis spans the inside
    of a bend, unless it is the lid of a tunnel that opens at an end plane.
    """
    if len(where) < settings.oriented_nodes:
        return 1.0
    areas = np.array(
        [len(np.unique(np.delete(where, axis, axis=1), axis=0)) for axis in range(3)],
        dtype=float,
    )
    across = areas[2] ** 2 / float(areas @ areas)
    if kind == "cut":
        severs = across > settings.cut_across and _goes_on(where, solid, settings)
        return settings.sever_factor if severs else 1.0
    level = float(where[:, 2].mean()) - CORNER[2]
    last = solid.shape[2] - 2 * CORNER[2] - 1
    lid = min(level, last - level) < settings.lid_nodes
    return settings.across_factor if across > settings.fill_across and not lid else 1.0


def _goes_on(where: NDArray[np.intp], solid: Bool, settings: TopologySettings) -> bool:
    """Whether the body goes on along the axis on both sides of most of a membrane's nodes.

    It may step aside by a node; beyond an end plane it counts as going on.
    """
    wide = ndimage.maximum_filter(solid, size=(3, 3, 1))
    both = np.ones(len(where), dtype=bool)
    a, b, w = where.T
    for step in range(1, settings.sever_reach + 1):
        for level in (w - step, w + step):
            beyond = (level < CORNER[2]) | (level >= solid.shape[2] - CORNER[2])
            both &= beyond | wide[a, b, np.clip(level, 0, solid.shape[2] - 1)]
    return bool(both.mean() > settings.sever_share)


def _thicken(
    state: Bool,
    lifted: NDArray[np.float32],
    where: NDArray[np.intp],
    settings: TopologySettings,
) -> NDArray[np.intp]:
    """Make a filled membrane as thick as the wall around it (in place), if the topology allows.

    Half the wall's thickness at a node of the membrane is the mean depth of the nearest nodes along
    the wall's middle, which are sought within ``plug_reach`` nodes.
    """
    reach = settings.plug_reach
    low = np.maximum(where.min(axis=0) - reach, CORNER)
    high = np.minimum(where.max(axis=0) + reach + 1, np.array(state.shape) - CORNER)
    around = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    block = state[around]
    membrane = np.zeros_like(block)
    membrane[tuple((where - low).T)] = True
    off, nearest = ndimage.distance_transform_edt(~membrane, return_indices=True)
    at = _half_thickness(block & ~membrane, where - low, settings)
    thickness = np.zeros(block.shape)
    thickness[tuple((where - low).T)] = at
    half = thickness[tuple(nearest)]
    plug = np.clip(_SLOPE * (half - off), -0.5, 0.5).astype(np.float32)
    added = (plug > 0) & ~block
    trial = state.copy()
    trial[around] |= added
    if euler_number(trial) != euler_number(state):
        return where
    state[around] |= added
    lifted[around] = np.maximum(lifted[around], np.where(off < half + 1, plug, -1))
    return np.vstack([where, np.argwhere(added) + low])


def _half_thickness(
    wall: Bool, places: NDArray[np.intp], settings: TopologySettings
) -> NDArray[np.float64]:
    """Half the thickness of a wall, in nodes, (N,): the depth of its middle near (N, 3) nodes."""
    padded = np.pad(wall, 1, mode="edge")  # what goes on beyond the block has no surface there
    depth = ndimage.distance_transform_edt(padded)[1:-1, 1:-1, 1:-1]
    ridge = wall & (depth >= ndimage.maximum_filter(depth, 3))
    middle = np.argwhere(ridge)
    if not len(middle):
        return np.ones(len(places))
    count = min(settings.plug_neighbors, len(middle))
    _, nearest = cKDTree(middle).query(places, k=count)
    # A node's depth is the distance from the next node outside, half a step beyond the surface.
    found = depth[tuple(middle.T)][nearest.reshape(len(places), count)]
    return np.asarray(found.mean(axis=1) - 0.5)
