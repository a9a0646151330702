"""The shape: sheet coordinates to scanner space and back, and what cannot exist."""

import numpy as np
import pytest

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom import KINDS, PhantomSpec, rigid_motion
from hipsta_bids.phantom.shape import CENTER, Body

EXACT = 1e-9  # mm or a fraction: rounding is 1e-13, any mistake is far larger
POSE = rigid_motion((20.0, -35.0, 50.0), (3.0, -4.0, 12.0))


def random_sheet(body, count=1000, seed=3):
    random = np.random.default_rng(seed)
    u, v = random.uniform(size=(2, count))
    v = 1.4 * v - 0.2  # head and tail too
    return u, v, random.uniform(-0.5, 0.5, count) * body.thickness(u, v)


@pytest.mark.parametrize("hemi", ["L", "R"])
@pytest.mark.parametrize("bend", [0.0, 0.02, -0.03])
@pytest.mark.parametrize("kind", KINDS)
def test_locating_inverts_placing(kind, bend, hemi):
    body = Body(PhantomSpec(kind=kind, bend=bend, variation=0.3))
    u, v, n = random_sheet(body)
    points = body.place(u, v, n, hemi=hemi, pose=POSE)
    found = body.locate(points, hemi=hemi, pose=POSE)
    np.testing.assert_allclose(found, np.column_stack([u, v, n]), atol=EXACT)


def test_a_slight_bend_tends_to_a_straight_axis():
    straight, bent = (Body(PhantomSpec(bend=bend)) for bend in (0.0, 1e-7))
    sheet = random_sheet(straight)
    # Displacement by a bend b is at most b (w^2 / 2 + p w) = 1e-7 * 200 mm2.
    np.testing.assert_allclose(bent.place(*sheet), straight.place(*sheet), atol=2e-5)


def test_bend_curves_the_long_axis_towards_the_midline():
    body = Body(PhantomSpec(kind="slab", bend=0.05))
    v = np.array([0.0, 0.5, 1.0])
    posterior, middle, anterior = body.place(0.5, v, 0.0)
    chord = anterior - posterior
    # Circle of radius 20 mm over 16 mm: chord and sagitta as textbooks have them.
    np.testing.assert_allclose(np.linalg.norm(chord), 40.0 * np.sin(0.4), atol=EXACT)
    sagitta = middle - (posterior + anterior) / 2.0
    np.testing.assert_allclose(np.linalg.norm(sagitta), 20.0 * (1 - np.cos(0.4)), atol=EXACT)
    assert sagitta[0] < 0.0  # the middle lies lateral of the chord, in the left hemisphere


def test_right_is_left_mirrored():
    body = Body(PhantomSpec(bend=0.02, variation=0.2))
    sheet = random_sheet(body)
    mirrored = body.place(*sheet) * [-1.0, 1.0, 1.0]
    np.testing.assert_array_equal(body.place(*sheet, hemi="R"), mirrored)


@pytest.mark.parametrize("hemi", ["L", "R"])
def test_pose_moves_the_points_last(hemi):
    body = Body(PhantomSpec())
    sheet = random_sheet(body)
    moved = body.place(*sheet, hemi=hemi) @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(body.place(*sheet, hemi=hemi, pose=POSE), moved, atol=EXACT)


@pytest.mark.parametrize("kind", KINDS)
def test_left_hemisphere_lies_as_in_a_brain(kind):
    body = Body(PhantomSpec(kind=kind))
    u, v = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 11), indexing="ij")
    points = body.place(u, v, 0.0)
    middle = (points.reshape(-1, 3).min(axis=0) + points.reshape(-1, 3).max(axis=0)) / 2.0
    assert np.linalg.norm(middle - CENTER) < 5.0  # mm: the centroid, not the middle, is there
    assert points[..., 0].max() < -10.0  # left of the midline
    assert points[:, -1, 1].mean() > points[:, 0, 1].mean() + 10.0  # v runs anterior
    assert points[:, -1, 2].mean() < points[:, 0, 2].mean()  # and down
    assert points[0, :, 0].mean() > points[50, :, 0].mean()  # u begins on the medial side


@pytest.mark.parametrize("kind", ["arc", "spiral", "tight"])
def test_interior_is_the_concave_side(kind):
    body = Body(PhantomSpec(kind=kind))
    u = np.linspace(0.0, 1.0, 201)
    interior, exterior = body.place(u, 0.5, -1.0), body.place(u, 0.5, 1.0)
    lengths = [np.linalg.norm(np.diff(x, axis=0), axis=1).sum() for x in (interior, exterior)]
    assert lengths[0] < lengths[1] - 5.0  # mm; twice the turning angle, which is above 4 rad


@pytest.mark.parametrize(("axis", "low"), [("x", 1.4), ("y", 1.4), ("xy", 1.4)])
def test_thickness_varies_as_asked(axis, low):
    body = Body(PhantomSpec(variation=0.3, variation_axis=axis))
    u, v = np.meshgrid(*[(np.arange(400) + 0.5) / 400] * 2, indexing="ij")
    thickness = body.thickness(u, v)
    # A sinusoid over whole periods averages to 0; its extremes fall between nodes by 1e-5.
    np.testing.assert_allclose(thickness.mean(), 2.0, atol=EXACT)
    np.testing.assert_allclose([thickness.min(), thickness.max()], [low, 2.6], atol=1e-4)
    assert bool(np.ptp(thickness, axis=0).max() > 0.1) == ("x" in axis)
    assert bool(np.ptp(thickness, axis=1).max() > 0.1) == ("y" in axis)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "tight", "thickness": 3.3}, "wall folds"),
        ({"kind": "arc", "width": 26.0}, "turns of the wall overlap"),
        ({"kind": "spiral", "width": 45.0, "thickness": 3.0}, "overlap"),
        ({"kind": "slab", "bend": 0.1}, "axis bends too sharply"),
        ({"kind": "arc", "bend": 0.09, "length": 40.0}, "too sharply"),
    ],
)
def test_impossible_shapes_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        Body(PhantomSpec(**changes))


def test_overlap_begins_where_a_ring_closes():
    ring = 2.0 * np.pi * 4.0
    Body(PhantomSpec(kind="arc", width=ring - 0.1))  # mm: a slit is still a slit
    with pytest.raises(SettingsError, match="turns of the wall overlap near u"):
        Body(PhantomSpec(kind="arc", width=ring + 0.1))


def test_overlap_depends_on_thickness_where_turns_are_nested():
    spiral = {"width": 34.0, "curvature": (0.1, 0.4)}
    Body(PhantomSpec(thickness=1.0, **spiral))
    with pytest.raises(SettingsError, match="overlap"):
        Body(PhantomSpec(thickness=3.0, **spiral))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "donut"}, "kind 'donut' is unknown; choose one of slab, arc"),
        ({"variation_axis": "z"}, "variation_axis 'z' is unknown"),
        ({"thickness": 0.0}, "thickness 0 is outside 0.1 to 10"),
        ({"thickness": np.nan}, "thickness nan is outside"),
        ({"variation": 1.0}, "variation 1 is outside 0 to 0.9"),
        ({"curvature": (0.1, np.inf)}, "curvature inf is outside"),
        ({"variation": 0.5, "layer_thickness": 1.2}, "layer_thickness 1.2 mm fills the wall"),
    ],
)
def test_senseless_specifications_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        PhantomSpec(**changes)


def test_own_curvature_replaces_the_kinds():
    body = Body(PhantomSpec(kind="arc", curvature=(0.1, 0.1)))
    np.testing.assert_array_equal(body.curve.curvature(np.array([0.0, 20.0])), [0.1, 0.1])


@pytest.mark.parametrize(
    "pose", [np.diag([1.1, 1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0]), np.full((4, 4), np.nan)]
)
def test_poses_that_are_not_rigid_are_refused(pose):
    with pytest.raises(SettingsError, match="not rigid"):
        Body(PhantomSpec()).place(0.5, 0.5, 0.0, pose=pose)


def test_unknown_hemisphere_is_refused():
    with pytest.raises(SettingsError, match="hemi 'lh' is unknown"):
        Body(PhantomSpec()).place(0.5, 0.5, 0.0, hemi="lh")
