"""Holes, bridges, islands, cavities and broken caps put into a ribbon, and repaired."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_cases import field_of, ribbon_mask, solid_of
from grids import straight_grid
from scipy import ndimage

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import membranes, topology
from hipsta_bids.geometry.digital import euler_number
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.mesh import extract_surface
from hipsta_bids.settings import SurfaceSettings, TopologySettings

TOPOLOGY = TopologySettings()
SHAPE = (42, 42, 30)
MIDDLE = 20.5  # of the ring, nodes; its mid-line has a radius of 12
SPACING = 0.5


def repaired(mask, **changes):
    """Repair a mask's field; check what must hold whatever was wrong."""
    # Unchecked: shares below zero make every cut sever.
    settings = TopologySettings().model_copy(update=changes)
    solid = solid_of(field_of(mask, spacing=SPACING), settings)
    positive = solid.field.values > 0
    assert euler_number(positive) == solid.euler_after == 1
    assert ndimage.label(positive)[1] == 1
    surface = extract_surface(solid.field, SurfaceSettings())  # refuses all but one sphere
    for cap in (surface.posterior_cap, surface.anterior_cap):
        assert cap.any()
    return solid


def only_repair(solid, kind):
    assert [repair.kind for repair in solid.repairs] == [kind]
    return solid.repairs[0]


def distance(repair, nodes):
    """From where a repair says it is to where it belongs, mm."""
    return float(np.linalg.norm(np.array(repair.position) - SPACING * np.asarray(nodes)))


def test_sound_ribbons_are_left_alone():
    field = field_of(ribbon_mask())
    solid = repaired(ribbon_mask())
    assert solid.repairs == ()
    assert solid.changed_fraction == 0
    assert solid.euler_before == 1
    assert not solid.touched.any()
    # Only values at the level itself may be moved off it.
    np.testing.assert_allclose(solid.field.values, field.values, atol=0.15)
    same = np.abs(field.values) > 0.1
    np.testing.assert_array_equal(solid.field.values[same], field.values[same])


def test_sound_phantoms_are_left_alone(case):
    assert case.solid.repairs == ()
    assert not case.solid.touched.any()
    assert case.solid.euler_before == case.solid.euler_after == 1


def with_hole():
    """A channel through the wall at the far side of the C."""
    mask = ribbon_mask()
    mask[:16, 19:22, 13:16] = False
    return mask, "fill", (MIDDLE - 12, 20, 14)


def with_bridge():
    """A rod between the two arms across the opening."""
    mask = ribbon_mask()
    mask[27:30, 10:32, 14:17] = True
    return mask, "cut", (28, MIDDLE, 15)


def with_island():
    mask = ribbon_mask()
    mask[19:23, 19:23, 10:15] = True
    return mask, "island", (20.5, 20.5, 12)


def with_cavity():
    mask = ribbon_mask(half=4.0)
    mask[7:10, 19:22, 13:16] = False
    return mask, "cavity", (8, 20, 14)


def with_slit():
    """A long narrow cut through the wall, along the body."""
    mask = ribbon_mask()
    mask[:16, 20:22, 8:22] = False
    return mask, "fill", (MIDDLE - 12, 20.5, 14.5)


@pytest.mark.parametrize("damage", [with_hole, with_bridge, with_island, with_cavity, with_slit])
def test_each_defect_is_named_and_placed(damage):
    mask, kind, where = damage()
    solid = repaired(mask)
    assert solid.euler_before != 1
    repair = only_repair(solid, kind)
    # Position is the center of what was changed; a cut falls anywhere along the bridge's 7 nodes.
    assert distance(repair, where) < 2.5
    assert repair.voxels > 0
    assert repair.cost > 0
    assert f"RAS {repair.position[0]:.1f}" in str(repair)
    before = field_of(mask).values > 0
    share = np.count_nonzero(solid.touched) / np.count_nonzero(before)
    assert solid.changed_fraction == pytest.approx(share)
    np.testing.assert_array_equal(solid.touched, before != (solid.field.values > 0))


def test_repairs_come_near_the_sound_ribbon():
    sound = field_of(ribbon_mask()).values > 0
    for damage in (with_hole, with_bridge, with_slit, with_island):
        mask, *_ = damage()
        before = field_of(mask).values > 0
        after = repaired(mask).field.values > 0
        # A repair takes back more of the damage than it adds to it.
        assert np.count_nonzero(after != sound) <= np.count_nonzero(before != sound)


def test_a_filled_hole_is_thick():
    mask, *_ = with_hole()
    after = repaired(mask).field.values > 0
    column = after[:20, 20, 14]
    assert np.count_nonzero(column) >= 3  # of 5 nodes; a bare membrane has one


def with_hole_at_the_edge():
    """A hole that leaves a strip of three nodes at one edge of the ribbon, 50 degrees round."""
    mask = ribbon_mask()
    a, b, w = np.indices(mask.shape)
    angle = np.degrees(np.arctan2(b - MIDDLE, a - MIDDLE))
    mask[(angle > 64) & (angle < 95) & (w >= 11) & (w < 18)] = False
    return mask


def test_a_strip_beside_a_hole_is_not_severed(monkeypatch):
    """The strip costs less than the hole; but a cut would leave a notch in the ribbon."""
    mask = with_hole_at_the_edge()
    repair = only_repair(repaired(mask), "fill")
    at = np.radians(79.5)
    assert distance(repair, (MIDDLE + 12 * np.cos(at), MIDDLE + 12 * np.sin(at), 14)) < 2.5
    monkeypatch.setattr(membranes, "SEVER_FACTOR", 1.0)
    careless = repaired(mask)
    assert only_repair(careless, "cut").cost < repair.cost


def test_a_membrane_that_costs_little_more_is_a_second_choice(monkeypatch):
    """Without the price of cuts that sever, filling the hole costs 5.4 times as much as a cut."""
    monkeypatch.setattr(membranes, "SEVER_FACTOR", 1.0)
    assert repaired(with_hole_at_the_edge()).rival is None
    monkeypatch.setattr(membranes, "ALTERNATIVE_PRICE", 6.0)
    solid = repaired(with_hole_at_the_edge())
    assert only_repair(solid, "cut")
    hole = with_hole_at_the_edge() != ribbon_mask()
    hole[ndimage.distance_transform_edt(ribbon_mask()) < 2] = False  # the middle of the wall
    assert (solid.field.values[hole] < 0).mean() > 0.5
    assert (solid.rival.values[hole] > 0).mean() > 0.5
    assert solid_of(solid.rival, TOPOLOGY).euler_after == 1


def test_a_cut_that_severs_the_ribbon_is_large_where_nothing_else_helps(monkeypatch):
    mask, *_ = with_bridge()
    assert not only_repair(repaired(mask, flag_cut_cost=1e9), "cut").large
    monkeypatch.setattr(membranes, "SEVER_ALONG", -1.0)
    monkeypatch.setattr(membranes, "SEVER_FACTOR", 1.001)
    assert only_repair(repaired(mask, flag_cut_cost=1e9), "cut").large


def test_a_cap_in_two_pieces_becomes_one():
    """A notch that divides the end's cross-section is a tunnel once the end is closed."""
    mask = ribbon_mask()
    mask[:16, 19:22, :4] = False
    solid = repaired(mask)
    repair = only_repair(solid, "fill")
    assert distance(repair, (MIDDLE - 12, 20, 1)) < 2.5
    for plane in (0, -1):
        assert ndimage.label(solid.field.values[..., plane] > 0)[1] == 1


def test_a_bridge_in_an_end_plane_is_cut():
    """It would leave one outline in two at the cap: the C closed to an O."""
    mask = ribbon_mask()
    mask[27:30, 10:32, :2] = True
    solid = repaired(mask)
    assert only_repair(solid, "cut").position[2] < 2.0
    for plane in (0, -1):
        section = np.pad(solid.field.values[..., plane] > 0, 1)
        assert ndimage.label(~section)[1] == 1


@pytest.mark.parametrize("hole", [False, True])
def test_a_strand_along_an_end_plane_is_cut(hole):
    """Closing the ends hides the tunnel under it, and nothing else that is wrong may speak for it.

    To fill the tunnel instead would make the wall thick there.
    """
    values = np.full((24, 16, 24), -0.5, dtype=np.float32)
    values[2:22, 4:12] = 0.5
    values[4:9, 7:9, :5] = -0.2  # a pit
    values[6, 7:9, 0] = 0.1  # the strand over it
    if hole:
        values[15:18, 4:12, 12:15] = -0.1
    field = Field(grid=straight_grid(values.shape, SPACING), values=values)
    first, *others = solid_of(field, TopologySettings()).repairs
    assert (first.kind, first.voxels) == ("cut", 1)
    assert first.position[2] == 0
    assert [repair.kind for repair in others] == (["fill"] if hole else []) + ["cavity"]


def test_a_tunnel_that_opens_at_an_end_plane_is_closed():
    """A burrow from the posterior cap, along the wall, out through its side."""
    mask = ribbon_mask(half=4.0)
    mask[7:10, 19:22, :10] = False
    mask[:10, 19:22, 7:10] = False
    solid = repaired(mask)
    assert [repair.kind for repair in solid.repairs] == ["fill", "cavity"]  # a lid, then the rest
    for plane in (0, -1):
        section = np.pad(solid.field.values[..., plane] > 0, 1)
        assert ndimage.label(~section)[1] == 1


def test_a_pit_in_an_end_plane_is_filled():
    """Without it the cap would be a ring, and the wall two pieces."""
    mask = ribbon_mask(half=4.0)
    mask[7:10, 19:22, :5] = False
    repair = only_repair(repaired(mask), "cavity")
    assert distance(repair, (8, 20, 2)) < 1.0  # two nodes: the Gaussian closes the bottom


def test_a_tube_is_cut_open_and_not_filled():
    """Tips that touch all along the body make a tunnel from end to end."""
    mask = ribbon_mask(opening=0.0)
    mask[28:, 20:22] = False
    mask[30:35, 20:22] = True  # joined along the whole length
    solid = repaired(mask)
    assert {repair.kind for repair in solid.repairs} == {"cut"}
    assert solid.changed_fraction < 0.1


def test_a_pit_from_the_outside_is_no_defect():
    mask = ribbon_mask(half=4.0)
    mask[:9, 19:22, 13:16] = False
    assert repaired(mask).repairs == ()


def test_several_defects_are_all_found():
    mask = ribbon_mask()
    mask[:16, 19:22, 4:7] = False
    mask[27:30, 10:32, 14:17] = True
    mask[19:23, 19:23, 20:24] = True
    kinds = sorted(repair.kind for repair in repaired(mask).repairs)
    assert kinds == ["cut", "fill", "island"]


@pytest.mark.parametrize("kind", ["cut", "fill"])
def test_repairs_that_overrule_much_are_large(kind):
    mask, wanted, _ = with_bridge() if kind == "cut" else with_hole()
    assert wanted == kind
    cost = only_repair(repaired(mask), kind).cost
    name = f"flag_{kind}_cost"
    assert only_repair(repaired(mask, **{name: cost / 2}), kind).large
    assert not only_repair(repaired(mask, **{name: cost * 2}), kind).large


def test_repairs_of_much_of_the_body_are_large():
    mask, kind, _ = with_island()
    assert not only_repair(repaired(mask), kind).large
    assert only_repair(repaired(mask, flag_fraction=1e-3), kind).large


def test_an_interrupted_body_is_refused():
    mask = ribbon_mask()
    mask[..., 13:18] = False
    with pytest.raises(
        GeometryError, match=r"is interrupted at RAS \S+ \S+ 6.0 mm; fill in missing slices"
    ) as caught:
        solid_of(field_of(mask), TOPOLOGY)
    assert caught.value.reason == "body-interrupted"


def test_a_body_that_vanishes_is_refused():
    mask = np.zeros(SHAPE, dtype=bool)
    mask[20, 10:30] = True  # one node thick: gone after smoothing
    with pytest.raises(GeometryError, match="nothing is left of the body") as caught:
        solid_of(field_of(mask, sigma=1.2), TOPOLOGY)
    assert caught.value.reason == "sheet-too-thin"


def test_giving_up_is_an_error(monkeypatch):
    monkeypatch.setattr(topology, "ROUNDS", 0)
    mask, *_ = with_hole()
    with pytest.raises(GeometryError, match="cannot be repaired") as caught:
        solid_of(field_of(mask), TOPOLOGY)
    assert caught.value.reason == "topology"


def noisy_field(seed):
    """A ribbon with a share of its voxels flipped, so that every kind of defect occurs."""
    rng = np.random.default_rng(seed)
    mask = ribbon_mask((30, 30, 16), radius=8.0, half=2.5)
    share = rng.uniform(0.1, 0.35)
    near = ndimage.binary_dilation(mask, iterations=2)
    return field_of(mask ^ (near & (rng.random(mask.shape) < share)), sigma=0.7)


@pytest.mark.parametrize("seed", range(60))
def test_noisy_ribbons_become_one_sphere(seed):
    field = noisy_field(seed)
    solid = solid_of(field, TOPOLOGY)
    positive = solid.field.values > 0
    assert euler_number(positive) == 1
    surface = extract_surface(solid.field, SurfaceSettings(taubin_iterations=0))
    assert surface.posterior_cap.any()
    assert surface.anterior_cap.any()
    # With plates beyond both ends it stays one ball: each cap is one disc.
    plated = np.pad(positive, ((1, 1), (1, 1), (0, 0)))
    plated = np.concatenate([np.ones_like(plated[..., :1]), plated, plated[..., :1] | True], axis=2)
    assert euler_number(plated) == 1


def test_noise_really_breaks_the_topology():
    numbers = [euler_number(noisy_field(seed).values > 0) for seed in range(60)]
    assert np.count_nonzero(np.array(numbers) != 1) > 40


def test_ambiguous_cubes_keep_foreground_corners_apart():
    """Two columns that touch along an edge only: two pieces for us, and for marching cubes."""
    mask = np.zeros((16, 16, 12), dtype=bool)
    mask[3:8, 3:8] = True
    mask[8:13, 8:13] = True
    mask[3:13, 3:13, 8:] = True
    values = np.where(mask, 0.5, -0.5).astype(np.float32)
    solid = solid_of(Field(grid=field_of(mask).grid, values=values), TOPOLOGY)
    extract_surface(solid.field, SurfaceSettings())
    assert euler_number(solid.field.values > 0) == 1


def test_separated_turns_are_reported(slab):
    separated = np.zeros(slab.field.grid.shape, dtype=bool)
    where = np.argwhere(slab.field.values > 0.3)[:5]  # fewer than 1 % of the body
    separated[tuple(where.T)] = True
    found = solid_of(replace(slab.field, separated=separated), TopologySettings())
    (repair,) = found.repairs
    assert (repair.kind, repair.voxels, repair.large) == ("part", 5, False)
    assert str(repair).startswith("two touching turns were parted by a slit of 5 grid nodes at RAS")
    assert found.touched[separated].all()


@pytest.mark.parametrize(("apart", "doubtful"), [(0, True), (6, False)])
def test_a_hole_beside_a_slit_between_turns_is_doubtful(apart, doubtful):
    """The slit has then gone through a wall instead of between two."""
    mask, *_ = with_hole()
    field = field_of(mask, spacing=SPACING)
    separated = np.zeros(mask.shape, dtype=bool)
    separated[6:10, 19:22, 16 + apart] = True
    found = solid_of(replace(field, separated=separated), TopologySettings())
    (fill,) = [repair for repair in found.repairs if repair.kind == "fill"]
    assert fill.large == doubtful


def test_each_slit_is_an_edit_with_its_nodes():
    slits = np.zeros((6, 3, 3), dtype=bool)
    slits[0, 0, 0] = slits[4:, 0, 0] = True
    field = SimpleNamespace(separated=None, slits=slits, cavities=None)
    edits = topology._before_smoothing(field)
    assert [(edit.kind, len(edit.nodes)) for edit in edits] == [("slit", 1), ("slit", 2)]


def test_a_filled_hole_is_as_thick_as_the_wall_beside_it():
    """Plates of 5 and, farther away, 9 nodes; the membrane lies in the middle of the first."""
    state = np.zeros((44, 24, 44), dtype=bool)
    state[2:42, 9:14, 2:42] = state[31:42, 7:16, 2:42] = True
    state[10:13, 9:14, 30:33] = False
    whole = state.copy()
    whole[10:13, 9:14, 30:33] = True
    nodes = np.stack(np.meshgrid([10, 11, 12], [11], [30, 31, 32], indexing="ij"), -1).reshape(
        -1, 3
    )
    state[tuple(nodes.T)] = True
    lifted = np.full(state.shape, -1.0, dtype=np.float32)
    added = membranes._thicken(state, lifted, nodes)
    np.testing.assert_array_equal(state, whole)
    assert len(added) == 5 * 9


def test_stumps_of_a_cut_lie_along_the_line_between_them():
    solid = np.zeros((9, 9, 12), dtype=bool)
    cut = np.array([[4, 5, 6], [5, 5, 6]])
    solid[3, 5, 4] = solid[6, 5, 8] = True
    assert membranes._stumps_along(cut[:1], solid) == 0
    assert membranes._stumps_along(cut, solid) == pytest.approx(16 / 25)
    solid[3, 5, 5] = solid[6, 6, 8] = solid[4, 7, 6] = True  # the third piece is smaller
    assert membranes._stumps_along(cut, solid) == pytest.approx(3.5**2 / (3**2 + 0.5**2 + 3.5**2))


def test_cuts_between_turns_that_touch_sever_nothing(monkeypatch):
    """Whether they touch is asked at the place of the cut."""
    mask, _, where = with_bridge()
    monkeypatch.setattr(membranes, "SEVER_ALONG", -1.0)
    places = []

    def touch(points):
        places.append(SPACING * np.array(where) - points.mean(axis=0))
        return True

    field = field_of(mask, spacing=SPACING)
    solid = topology.repair_topology(field, TOPOLOGY, lambda _: "", touch)
    assert only_repair(solid, "cut").excess < np.inf
    assert np.linalg.norm(places, axis=1).max() < 2.5


def test_fills_across_the_axis_cost_more_away_from_the_ends():
    solid = np.zeros((20, 20, 40), dtype=bool)
    across = np.argwhere(np.ones((5, 5, 1), dtype=bool)) + np.array([5, 5, 20])
    for shift, dear in ((0, True), (-12, True), (-13, False), (11, True), (12, False)):
        factor = membranes._implausibility("fill", across + np.array([0, 0, shift]), solid)
        assert factor == (membranes.ACROSS_FACTOR if dear else 1)
    assert membranes._implausibility("fill", across[:, [0, 2, 1]], solid) == 1
    assert membranes._implausibility("fill", across[:3], solid) == 1


def test_changes_beyond_the_end_planes_are_known():
    nodes = membranes.FIRST + np.array([[4, 4, level] for level in (2, 3, 16, 17)])
    field = SimpleNamespace(beyond=3, grid=SimpleNamespace(shape=(9, 9, 20)))
    between = topology._between_planes(membranes.Edit("cut", nodes), field)
    assert between.tolist() == [False, True, True, False]


def test_a_body_continues_two_nodes_before_and_behind_a_cut_or_beyond_an_end():
    nodes = np.array([[4, b, 10] for b in range(1, 11)])
    for first, last, continues in ((8, 12, True), (9, 12, False), (8, 11, False)):
        solid = np.zeros((9, 12, 16), dtype=bool)
        solid[4, 1, first : last + 1] = True  # and the node beside it: two of ten
        assert membranes._continues(nodes, solid) is continues
        assert not membranes._continues(nodes + np.array([0, 0, 2]), solid)
    solid[4, 1, 10:14] = True
    assert membranes._continues(nodes + np.array([0, 0, 2]), solid)


def test_alternatives_are_of_the_other_kind_near_and_hardly_dearer():
    """To a fill of price 3: within two nodes, and up to twice as dear."""
    state = np.zeros((30, 12, 12), dtype=bool)
    origin = np.array([[5, 5, 5], [5, 6, 5]])
    fill = membranes.Edit("fill", origin, cost=1.0)
    near, far = (membranes.Edit("cut", origin[:1] + np.array([gap, 0, 0])) for gap in (2, 3))
    for price, cut, chosen in ((6.0, near, True), (6.1, near, False), (4.0, far, False)):
        dearer = [(3.5, fill), (price, cut), (5.0, near._replace(nodes=origin + 9))]
        found = membranes._alternative(3.0, fill, dearer, state)
        assert (found is cut.nodes) is chosen
        assert (found is None) is not chosen
    cheap = fill._replace(cost=0.99)
    assert membranes._alternative(3.0, cheap, [(3.5, near)], state) is None
    other = membranes._alternative(3.0, near._replace(cost=1.0), [(3.5, fill)], state)
    assert other[:2].tolist() == origin.tolist()
    assert not state.any()


def test_balls_have_neither_tunnels_nor_cavities():
    box, ring = np.zeros((9, 9, 9), dtype=bool), np.zeros((9, 9, 9), dtype=bool)
    box[1:8, 1:8, 1:8] = ring[1:8, 1:8, 1:8] = True
    ring[6, 6] = False
    hollow, both = box.copy(), ring.copy()
    hollow[3, 3, 3] = both[3, 3, 3] = False  # both: the Euler number is that of a ball
    assert [membranes._is_ball(mask) for mask in (box, ring, hollow, both)] == [True] + [False] * 3
