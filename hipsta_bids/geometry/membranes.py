"""Membranes that cut or fill the tunnels of a body.

They are sought in padded arrays: along the axis by a layer for a plate and one of free space,
across it by one of free space.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry import digital
from hipsta_bids.geometry.digital import CUBE, FACES, Index
from hipsta_bids.settings import TopologySettings
from hipsta_bids.types import Bool, Float

#: Steps in which field values are ordered while growing and shrinking.
FIELD_LEVELS = 6
#: Share of the field that each grid node of depth adds to the order of growing and shrinking.
DEPTH_RANK = 0.05
#: Membranes cheaper than this are applied together; costlier ones one per round.
SMALL_COST = 5.0
#: A membrane of the other kind is as likely if its price is less than this many times as high.
ALTERNATIVE_PRICE = 2.0
#: Tunnels whose membranes overrule less evidence than this change no map, sum of the field.
ALTERNATIVE_COST = 1.0
#: Membranes this near to each other remove the same tunnel, grid nodes.
ALTERNATIVE_REACH = 2
#: A filled hole becomes as thick as the wall within this distance of it, grid nodes.
PLUG_REACH = 8
#: Number of nearest nodes of the wall's middle that a filled hole takes its thickness from.
PLUG_NEIGHBORS = 12
#: Membranes of fewer nodes have no direction.
ORIENTED_NODES = 4
#: A cut severs the ribbon, no bridge, if this share lies across the axis (squared areas).
CUT_ACROSS = 0.3
#: A cut severs the ribbon if the body goes on this many grid nodes before and behind it.
SEVER_REACH = 2
#: Share of the cut's nodes at which the body has to go on.
SEVER_SHARE = 0.1
#: A cut severs if the line between its stumps is more along the axis than this (squared cosine).
SEVER_ALONG = 0.5
#: A cut does not sever if that line is less along the axis than this (squared cosine).
BRIDGE_ALONG = 0.25
#: Cuts that sever cost this many times more: where one is the only way, the hemisphere is flagged.
SEVER_FACTOR = 1000.0
#: A fill spans the inside of a bend rather than a hole if this share lies across the axis.
FILL_ACROSS = 0.5
#: A fill within this distance of an end plane closes an end and no bend, grid nodes.
LID_NODES = 6.0
#: Fills that span a bend cost this many times more.
ACROSS_FACTOR = 40.0

Kind = Literal["part", "slit", "cut", "fill", "island", "cavity", "uncus"]

PAD = ((1, 1), (1, 1), (2, 2))
"""Room round a field for plates and free space."""
INNER = (slice(1, -1), slice(1, -1), slice(2, -2))
"""The field in its padded array."""
FIRST = np.array([1, 1, 2])
"""Index of the field's first node in its padded array."""

_LEVELS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
_STUMP = 3  # nodes from a cut within which its stumps are looked at
_SLOPE = 0.4  # of a smoothed step per node, at the body's surface


class Edit(NamedTuple):
    """One change of a padded body."""

    kind: Kind
    nodes: Index
    """(N, 3) nodes of the padded array."""
    cost: float = 0.0
    """Evidence overruled by a membrane, before it was thickened: sum of the field."""
    doubtful: bool = False
    """Whether it contradicts the run of the ribbon along the axis."""
    alternative: Index | None = None
    """(M, 3) nodes of a membrane of the other kind that removes the same tunnel and costs little
    more; None if there is none."""


def with_plates(state: NDArray[Any], value: float) -> NDArray[Any]:
    """Return a copy with solid plates beyond both ends."""
    solid = state.copy()
    solid[1:-1, 1:-1, 1] = value
    solid[1:-1, 1:-1, -2] = value
    return solid


def euler(state: Bool, *, plates: bool = False) -> int:
    """Find the Euler number of a padded body, with or without plates on both ends."""
    return digital.euler_number(with_plates(state, True) if plates else state)


def apply_membranes(
    state: Bool,
    values: NDArray[np.float32],
    ranked: NDArray[np.float32],
    lifted: NDArray[np.float32],
    settings: TopologySettings,
    *,
    plates: bool,
    contact: Callable[[Index], bool],
) -> list[Edit]:
    """Apply the cheapest membranes (in place): all small ones, or one large one.

    Without plates, tunnels of the body itself are searched; with plates, pieces of an end's
    cross-section that are connected only further inside. ``ranked`` is the order by `rank`;
    ``lifted`` receives the values of filled holes. ``contact`` returns whether two turns of the
    sheet touch at nodes (N, 3).
    """
    solid = with_plates(state, True) if plates else state
    if plates:
        ranked = with_plates(ranked, float(ranked.max()) + 1.0)
    grown = digital.grow(_inner_ball(solid, ranked), solid, ranked, FIELD_LEVELS)
    shrunk = digital.shrink(_outer_ball(solid, ranked), solid, ranked, FIELD_LEVELS)
    membranes: tuple[tuple[Kind, Bool], ...] = (("cut", solid & ~grown), ("fill", shrunk & ~solid))
    proposals = [
        Edit(kind, nodes)
        for kind, membrane in membranes
        for nodes in _pieces(membrane)
        # Nothing can be changed in the plates.
        if not (plates and np.isin(nodes[:, 2], (1, solid.shape[2] - 2)).any())
    ]
    candidates = _priced(proposals, solid, values, settings, contact)
    edits: list[Edit] = []
    for number, (cost, edit) in enumerate(candidates):
        kind, nodes = edit.kind, edit.nodes
        if edits and cost > SMALL_COST:
            break
        if edits and _gain(solid, nodes, kind) <= 0:
            continue  # another membrane has already removed this tunnel
        alternative = _alternative(cost, edit, candidates[number + 1 :], state)
        solid[tuple(nodes.T)] = kind == "fill"
        state[tuple(nodes.T)] = kind == "fill"
        if kind == "fill":
            nodes = _thicken(state, lifted, nodes)
        edits.append(edit._replace(nodes=nodes, alternative=alternative))
        if cost > SMALL_COST:
            break
    return edits


def _alternative(
    price: float, edit: Edit, dearer: list[tuple[float, Edit]], state: Bool
) -> Index | None:
    """Find the nodes of another kind of membrane for the same tunnel at nearly the same price."""
    if edit.cost < ALTERNATIVE_COST:
        return None
    for dearer_price, alternative in dearer:
        if dearer_price > ALTERNATIVE_PRICE * price:
            break
        gap = np.asarray(cKDTree(edit.nodes).query(alternative.nodes)[0]).min()
        if gap > ALTERNATIVE_REACH or alternative.kind == edit.kind:
            continue
        if alternative.kind == "cut":
            return alternative.nodes
        filled = state.copy()
        filled[tuple(alternative.nodes.T)] = True
        return _thicken(filled, np.zeros(state.shape, dtype=np.float32), alternative.nodes)
    return None


def _pieces(membrane: Bool) -> list[Index]:
    """Nodes (N, 3) of each connected piece."""
    pieces, _ = ndimage.label(membrane, structure=CUBE)
    return [
        digital.positions(pieces[around] == number) + digital.low_corner(around)
        for number, around in enumerate(ndimage.find_objects(pieces), start=1)
    ]


def _priced(
    proposals: list[Edit],
    solid: Bool,
    values: NDArray[np.float32],
    settings: TopologySettings,
    contact: Callable[[Index], bool],
) -> list[tuple[float, Edit]]:
    """Price per tunnel of the membranes that remove one, cheapest first.

    A cut from a hole to an end plane removes none once the ends are closed; one through a
    strand along that plane does not either, but closing the ends opens its tunnel. So of such
    cuts only as many keep their price as there are additional tunnels without closed ends.
    """
    closed = with_plates(solid, True)
    open_tunnels = digital.euler_number(closed) - digital.euler_number(solid)
    any_hole = digital.euler_number(closed) != 1
    candidates = []
    for kind, nodes, *_ in proposals:
        gain = _gain(solid, nodes, kind)
        if gain <= 0:
            continue
        cost = float(np.abs(values[tuple(nodes.T)]).sum())
        factor = _implausibility(kind, nodes, solid)
        if kind == "cut" and factor > 1 and contact(nodes):
            factor = 1.0
        at_end = kind == "cut" and any_hole and _gain(closed, nodes, kind) <= 0
        doubtful = factor > 1 and (kind == "cut" or cost > settings.doubtful_fill_cost)
        candidates.append((factor * cost / gain, Edit(kind, nodes, cost, doubtful), at_end))
    candidates.sort(key=lambda c: c[0])
    priced = []
    for price, edit, at_end in candidates:
        wrong = at_end and open_tunnels <= 0
        open_tunnels -= at_end
        priced.append(
            (price * ACROSS_FACTOR, edit._replace(doubtful=True)) if wrong else (price, edit)
        )
    return sorted(priced, key=lambda c: c[0])


def rank(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Order in which nodes are added or removed: by value, and by depth where values saturate.

    So membranes lie midway across a wide hole, where the field is flat.
    """
    inside = values > 0
    depth = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
    return np.asarray(values + DEPTH_RANK * depth, dtype=np.float32)


def _inner_ball(solid: Bool, values: NDArray[np.float32]) -> Bool:
    """Find a ball to grow from: the largest level set that is one, or a single voxel."""
    for level in _LEVELS:
        pieces, count = ndimage.label(solid & (values > level), structure=FACES)
        if not count:
            break
        part = pieces == digital.piece_sizes(pieces).argmax()
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
        part = pieces == pieces[tuple(digital.positions(solid)[0])]
        if _is_ball(part):
            return np.asarray(part)
    return box


def _is_ball(mask: Bool) -> bool:
    """Whether one 6-connected piece has neither tunnels nor cavities."""
    return digital.euler_number(mask) == 1 and ndimage.label(~mask, structure=CUBE)[1] == 1


def _gain(state: Bool, nodes: Index, kind: Kind) -> int:
    """Change of the Euler number if these voxels change sides."""
    low, high = nodes.min(axis=0) - 1, nodes.max(axis=0) + 2
    block = state[digital.box(low, high)].copy()
    before = digital.euler_number(block)
    block[tuple((nodes - low).T)] = kind == "fill"
    return digital.euler_number(block) - before


def _implausibility(kind: Kind, nodes: Index, solid: Bool) -> float:
    """Factor by which the price of membranes across the long axis rises.

    The ribbon runs along the axis, so what fills a hole in it lies along the axis too, and so does
    what cuts a bridge between two of its turns. A cut whose stumps face each other along the axis
    severs a strip of the ribbon next to a hole. So does one that lies across the axis with ribbon
    before and behind it, unless its stumps face each other across. A fill across the axis spans
    the inside of a bend, unless it is the lid of a tunnel that opens at an end plane.
    """
    areas = np.array(
        [len(np.unique(np.delete(nodes, axis, axis=1), axis=0)) for axis in range(3)], dtype=float
    )
    oriented = len(nodes) >= ORIENTED_NODES
    across = areas[2] ** 2 / float(areas @ areas)
    if kind == "cut":
        along = _stumps_along(nodes, solid)
        lies_across = oriented and across > CUT_ACROSS and along > BRIDGE_ALONG
        severs = along > SEVER_ALONG or (lies_across and _continues(nodes, solid))
        return SEVER_FACTOR if severs else 1.0
    level = float(nodes[:, 2].mean()) - FIRST[2]
    last = solid.shape[2] - 2 * FIRST[2] - 1
    lid = min(level, last - level) < LID_NODES
    spans = oriented and across > FILL_ACROSS and not lid
    return ACROSS_FACTOR if spans else 1.0


def _stumps_along(nodes: Index, solid: Bool) -> float:
    """Squared cosine between the axis and the line that joins the two stumps of a cut.

    Stumps are the largest two pieces of what lies within a few nodes of the cut; 0 if there is only
    one, or the cut is a single node, which has no direction.
    """
    if len(nodes) == 1:
        return 0.0
    low = np.maximum(nodes.min(axis=0) - _STUMP, 0)
    high = np.minimum(nodes.max(axis=0) + _STUMP + 1, solid.shape)
    cut = np.zeros(high - low, dtype=bool)
    cut[tuple((nodes - low).T)] = True
    near = ndimage.distance_transform_edt(~cut) <= _STUMP
    pieces, count = ndimage.label(solid[digital.box(low, high)] & near & ~cut, structure=FACES)
    if count < 2:  # noqa: PLR2004 -- one on each side
        return 0.0
    largest = np.argsort(-digital.piece_sizes(pieces), kind="stable")[:2]
    first, second = (np.argwhere(pieces == number).mean(axis=0) for number in largest)
    line = second - first
    return float(line[2] ** 2 / (line @ line))


def _continues(nodes: Index, solid: Bool) -> bool:
    """Whether the body continues along the axis on both sides of most of a membrane's nodes.

    It may deviate by a node; beyond an end plane it counts as continued.
    """
    wide = ndimage.maximum_filter(solid, size=(3, 3, 1))
    continued = np.ones(len(nodes), dtype=bool)
    a, b, w = nodes.T
    for step in range(1, SEVER_REACH + 1):
        for level in (w - step, w + step):
            beyond = (level < FIRST[2]) | (level >= solid.shape[2] - FIRST[2])
            continued &= beyond | wide[a, b, np.clip(level, 0, solid.shape[2] - 1)]
    return bool(continued.mean() > SEVER_SHARE)


def _thicken(state: Bool, lifted: NDArray[np.float32], nodes: Index) -> Index:
    """Make a filled membrane as thick as the wall around it (in place), if the topology allows.

    Half the wall's thickness at a node of the membrane is the mean depth of the nearest nodes along
    the wall's middle, which are sought within ``plug_reach`` nodes.
    """
    reach = PLUG_REACH
    low = np.maximum(nodes.min(axis=0) - reach, FIRST)
    high = np.minimum(nodes.max(axis=0) + reach + 1, np.array(state.shape) - FIRST)
    around = digital.box(low, high)
    block = state[around]
    membrane = np.zeros_like(block)
    membrane[tuple((nodes - low).T)] = True
    off, nearest = ndimage.distance_transform_edt(~membrane, return_indices=True)
    at = _half_thickness(block & ~membrane, nodes - low)
    thickness = np.zeros(block.shape)
    thickness[tuple((nodes - low).T)] = at
    half = thickness[tuple(nearest)]
    plug = np.clip(_SLOPE * (half - off), -0.5, 0.5).astype(np.float32)
    added = (plug > 0) & ~block
    trial = state.copy()
    trial[around] |= added
    if digital.euler_number(trial) != digital.euler_number(state):
        return nodes
    state[around] |= added
    lifted[around] = np.maximum(lifted[around], np.where(off < half + 1, plug, -1))
    return np.vstack([nodes, digital.positions(added) + low])


def _half_thickness(wall: Bool, nodes: Index) -> Float:
    """Half the thickness of a wall, in nodes, (N,): the depth of its middle near (N, 3) nodes."""
    padded = np.pad(wall, 1, mode="edge")  # no surface where the wall continues beyond the block
    depth = ndimage.distance_transform_edt(padded)[1:-1, 1:-1, 1:-1]
    ridge = wall & (depth >= ndimage.maximum_filter(depth, 3))
    middle = np.argwhere(ridge)
    if not len(middle):
        return np.ones(len(nodes))
    count = min(PLUG_NEIGHBORS, len(middle))
    _, nearest = cKDTree(middle).query(nodes, k=count)
    # A node's depth is the distance from the next node outside, half a step beyond the surface.
    depths = depth[tuple(middle.T)][nearest.reshape(len(nodes), count)]
    return np.asarray(depths.mean(axis=1) - 0.5)
