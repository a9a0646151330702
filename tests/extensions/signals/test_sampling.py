"""Other volumes on the sheet: known fields, missing values, the field of view, and regions."""

import numpy as np
import pytest
from measured_phantoms import measured, spiral

from hipsta_bids.extensions.signals.sampling import (
    Regions,
    sample_on_sheet,
    summarize_regions,
)
from hipsta_bids.extensions.signals.settings import MapSettings
from hipsta_bids.types import ScalarVolume, Sheet

#: 0.5 x 0.6 x 0.8 mm voxels, turned and shifted, so that mistakes in affines show.
ANGLE = np.deg2rad(30)
TURN = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1.0]]
)
AFFINE = np.eye(4)
AFFINE[:3, :3] = TURN @ np.diag([-0.5, 0.6, 0.8])
AFFINE[:3, 3] = TURN @ [4.0, -5.0, -6.0]
SHAPE = (17, 18, 16)


def centers():
    index = np.moveaxis(np.indices(SHAPE), 0, -1)
    return index @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def arc(*, thickness=1.6, nz=9):
    """A wall round a half cylinder of 2.5 mm radius, 3 mm long."""
    turn = np.linspace(0.2, np.pi - 0.2, 12)[:, None, None]
    radius = 2.5 + thickness * np.linspace(-0.5, 0.5, nz)[None, None]
    y = np.linspace(-1.5, 1.5, 7)[None, :, None]
    points = np.stack(
        np.broadcast_arrays(radius * np.cos(turn), y, radius * np.sin(turn) - 1.5), axis=-1
    )
    return Sheet(points=points, valid=np.ones(points.shape[:2], bool))


def volume(values, start=(0, 0, 0)):
    values = values if values.ndim == 4 else values[..., None]
    affine = AFFINE.copy()
    affine[:3, 3] += affine[:3, :3] @ np.array(start)
    stop = tuple(slice(a, None) for a in start)
    return ScalarVolume(values=values[stop], affine=affine, start=start, shape=values.shape[:3])


def sample(values, *, sheet=None, sampling="mid", interpolation="linear", start=(0, 0, 0)):
    return sample_on_sheet(
        volume(values, start),
        sheet or arc(),
        MapSettings(),
        sampling=sampling,
        interpolation=interpolation,
    )


def linear(points):
    return points @ [1.5, -2.0, 0.7] + 3


def middle(sheet):
    return sheet.points[:, :, sheet.middle]


@pytest.mark.parametrize("start", [(0, 0, 0), (1, 2, 1)])
def test_a_linear_field_is_exact(start):
    found = sample(linear(centers()), start=start)
    # Trilinear interpolation of a linear field is the field; what is left is rounding.
    np.testing.assert_allclose(found.values[..., 0], linear(middle(arc())), atol=1e-12)
    assert (found.outside, found.unknown, found.missing) == (0, 0, 0)


def test_a_quadratic_field_is_within_the_interpolation_error():
    field = (centers() ** 2).sum(axis=-1)
    found = sample(field).values[..., 0] - (middle(arc()) ** 2).sum(axis=-1)
    # Linear interpolation along an axis of step h exceeds a parabola of second derivative 2 by up
    # to h^2 / 4 and never falls below it; the three axes add up. 1e-9: rounding.
    assert found.min() > -1e-9
    assert found.max() < (0.5**2 + 0.6**2 + 0.8**2) / 4 + 1e-9


def test_the_mean_over_depth_is_the_integral_from_wall_to_wall():
    sheet = arc()
    found = sample(linear(centers()), sheet=sheet, sampling="depth").values[..., 0]
    # Columns are straight and evenly spaced: the mean of a linear field is that of their middle.
    np.testing.assert_allclose(found, linear(middle(sheet)), atol=1e-12)


@pytest.mark.parametrize(
    ("sampling", "radius"), [("interior", 1.7), ("mid", 2.5), ("exterior", 3.3)]
)
def test_a_surface_is_sampled_where_it_is(sampling, radius):
    found = sample(linear(centers()), sampling=sampling).values[..., 0]
    turn, y = np.linspace(0.2, np.pi - 0.2, 12)[:, None], np.linspace(-1.5, 1.5, 7)
    place = np.broadcast_arrays(radius * np.cos(turn), y, radius * np.sin(turn) - 1.5)
    # A linear field is exact; what is left is rounding.
    np.testing.assert_allclose(found, linear(np.stack(place, axis=-1)), atol=1e-12)


@pytest.fixture(scope="module")
def depth_of_phantom():
    """A measured phantom of 2 mm, and the distance from its true mid-surface in fine voxels."""
    case = measured(spiral())
    low = case.maps.sheet.points.reshape(-1, 3).min(axis=0) - 1.0
    span = case.maps.sheet.points.reshape(-1, 3).max(axis=0) + 1.0 - low
    affine = np.diag([0.3, 0.3, 0.3, 1.0])
    affine[:3, 3] = low
    index = np.moveaxis(np.indices(np.ceil(span / 0.3).astype(int)), 0, -1)
    places = case.phantom.body.locate((index * 0.3 + low).reshape(-1, 3), reach=1.8)
    values = places[:, 2].reshape(*index.shape[:3], 1)
    return case, ScalarVolume(values=values, affine=affine, start=(0, 0, 0), shape=index.shape[:3])


@pytest.mark.parametrize(
    ("sampling", "depth"), [("interior", -1.0), ("mid", 0.0), ("exterior", 1.0), ("depth", 0.0)]
)
def test_depth_in_a_phantom_is_that_of_the_surface(depth_of_phantom, sampling, depth):
    case, volume = depth_of_phantom
    sampled = sample_on_sheet(
        volume, case.maps.sheet, MapSettings(), sampling=sampling, interpolation="linear"
    )
    found = sampled.values[4:-4, :, 0]
    # Labels of 0.4 mm voxels place the walls to a tenth of a voxel.
    assert np.nanmedian(np.abs(found - depth)) < 0.04
    assert np.nanmean(found) == pytest.approx(depth, abs=0.04)


def test_the_mean_over_depth_counts_walls_by_half():
    sheet = arc(nz=3)
    found = sample(centers()[..., 2] ** 2, sheet=sheet, sampling="depth").values[..., 0]
    parts = [
        sample(centers()[..., 2] ** 2, sheet=one_level(sheet, k)).values[..., 0] for k in range(3)
    ]
    np.testing.assert_allclose(found, (parts[0] + 2 * parts[1] + parts[2]) / 4, atol=1e-12)


def one_level(sheet, level):
    points = np.repeat(sheet.points[:, :, level : level + 1], 3, axis=2)
    return Sheet(points=points, valid=sheet.valid)


def test_several_volumes_are_sampled_alike():
    field = np.stack([linear(centers()), centers()[..., 1]], axis=-1)
    found = sample(field, sampling="depth")
    for number in range(2):
        alone = sample(field[..., number], sampling="depth")
        # Sums are taken in another order: rounding.
        np.testing.assert_allclose(found.values[..., number], alone.values[..., 0], rtol=1e-13)


@pytest.mark.parametrize("sampling", ["mid", "depth"])
def test_labels_remain_labels(sampling):
    labels = np.where(centers()[..., 0] > 0.3, 1017.0, 53.0)
    found = sample(labels, sampling=sampling, interpolation="nearest").values[..., 0]
    assert set(np.unique(found)) == {53.0, 1017.0}
    x = middle(arc())[..., 0]
    # Columns lean by up to 0.8 mm to either side, voxels by up to 0.55 mm: no doubt beyond.
    sure = np.abs(x - 0.3) > 1.4
    np.testing.assert_array_equal(found[sure], np.where(x > 0.3, 1017.0, 53.0)[sure])


def test_nearest_takes_the_voxel_that_holds_the_point():
    codes = np.arange(np.prod(SHAPE), dtype=float).reshape(SHAPE)
    found = sample(codes, interpolation="nearest").values[..., 0]
    index = np.rint((middle(arc()) - AFFINE[:3, 3]) @ np.linalg.inv(AFFINE[:3, :3]).T).astype(int)
    np.testing.assert_array_equal(found, codes[tuple(np.moveaxis(index, -1, 0))])


def test_most_frequent_label_of_equals_is_that_of_the_middle():
    sheet = arc(nz=3)
    # Interior wall, middle, exterior wall: weights 1/4, 1/2, 1/4; the walls together tie.
    radius = np.hypot(centers()[..., 0], centers()[..., 2] + 1.5)
    labels = np.where(np.abs(radius - 2.5) < 0.4, 7.0, 2.0)
    found = sample(labels, sheet=sheet, sampling="depth", interpolation="nearest").values
    mid = sample(labels, sheet=sheet, interpolation="nearest").values
    np.testing.assert_array_equal(found, mid)


def test_unknown_voxels_are_missing_and_not_zero():
    field = np.full(SHAPE, 5.0)
    hole = np.linalg.norm(centers() - middle(arc())[6, 3], axis=-1) < 1.0
    field[hole] = np.nan
    found = sample(field)
    assert np.isnan(found.values[6, 3, 0])
    assert 0 < found.missing < 0.5
    assert found.unknown == found.missing
    # Wherever there is a value, it is made of known voxels only: rounding is left.
    np.testing.assert_allclose(found.values[~np.isnan(found.values)], 5.0, rtol=1e-12)


def test_infinite_voxels_are_unknown():
    field = np.full(SHAPE, np.inf)
    assert sample(field).missing == 1
    assert sample(field, interpolation="nearest").missing == 1


def test_a_column_needs_half_of_its_depth():
    sheet = arc()
    radius = np.hypot(centers()[..., 0], centers()[..., 2] + 1.5)
    inner = np.where(radius < 2.2, 3.0, np.nan)  # 0.5 of 1.6 mm: less than half
    outer = np.where(radius > 2.0, 3.0, np.nan)  # more than half
    assert sample(inner, sheet=sheet, sampling="depth").missing == 1
    found = sample(outer, sheet=sheet, sampling="depth")
    assert found.missing == 0
    np.testing.assert_allclose(found.values, 3.0, rtol=1e-12)


def test_points_outside_are_missing_and_counted():
    sheet = arc()
    # Cut along the third voxel axis, which is z here.
    kept = 8
    found = sample(linear(centers())[:, :, :kept], sheet=sheet)
    limit = AFFINE[2, 3] + 0.8 * (kept - 0.5)
    beyond = middle(sheet)[..., 2] > limit
    assert 0 < beyond.mean() < 1
    assert found.outside == pytest.approx(beyond.mean())
    np.testing.assert_array_equal(np.isnan(found.values[..., 0]), beyond)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("last", [False, True])
def test_the_field_of_view_ends_at_the_outer_faces(axis, last):
    corner = np.array(SHAPE) - 1 if last else np.zeros(3)
    for beyond, outside in ((0.49, 0), (0.5, 0), (0.51, 1)):  # voxels; on a face is inside
        index = corner.astype(float)
        index[axis] += beyond if last else -beyond
        points = np.tile(AFFINE[:3, :3] @ index + AFFINE[:3, 3], (1, 1, 3, 1))
        found = sample(np.full(SHAPE, 2.0), sheet=Sheet(points=points, valid=np.ones((1, 1), bool)))
        assert found.outside == outside
        assert np.isnan(found.values).all() == outside


@pytest.mark.parametrize("interpolation", ["linear", "nearest"])
def test_the_mean_over_a_single_depth_is_its_value(interpolation):
    sheet = arc()
    single = Sheet(points=sheet.points[:, :, sheet.middle][:, :, None], valid=sheet.valid)
    field = linear(centers())
    found = sample(field, sheet=single, sampling="depth", interpolation=interpolation)
    wanted = sample(field, sheet=sheet, interpolation=interpolation)
    np.testing.assert_allclose(found.values, wanted.values, rtol=1e-12)  # rounding


def test_columns_without_a_position_are_missing_but_not_outside():
    points = np.array(arc().points)
    points[2, 3] = np.nan
    sheet = Sheet(points=points, valid=np.isfinite(points).all(axis=(2, 3)))
    for sampling in ("mid", "depth"):
        found = sample(linear(centers()), sheet=sheet, sampling=sampling)
        assert np.argwhere(np.isnan(found.values[..., 0])).tolist() == [[2, 3]]
        assert found.outside == 0


def flat():
    """A flat sheet of 5 x 4 nodes, 2 x 3 mm apart; one column is not valid."""
    x, y, z = np.meshgrid(2.0 * np.arange(5), 3.0 * np.arange(4), [0, 1, 2.0], indexing="ij")
    valid = np.ones((5, 4), bool)
    valid[1, 1] = False
    return Sheet(points=np.stack([x, y, z], axis=-1), valid=valid)


def regions():
    member = np.zeros((3, 5, 4), bool)
    member[0, 1:3, 1:3] = True
    member[1] = True
    member[2, 1, 1] = True
    return Regions(names=("middle", "all", "filled"), member=member)


def test_counts_and_areas():
    found = summarize_regions(regions(), flat(), {}, {})
    assert found.n_points.tolist() == [4, 20, 1]
    assert found.n_valid.tolist() == [3, 19, 0]
    # Four quarters of 6 mm2 each round inner nodes; 8 x 9 mm in all.
    assert found.area.tolist() == [24, 72, 6]


def test_moments_are_those_of_valid_and_known_points():
    values = np.arange(20.0).reshape(5, 4)
    values[2, 2] = np.nan
    found = summarize_regions(regions(), flat(), {"f": values}, {})
    kept = values[[1, 2], [2, 1]]
    assert found.mean["f"][0] == pytest.approx(kept.mean())
    assert found.sd["f"][0] == pytest.approx(kept.std(ddof=1))
    assert np.isnan([found.mean["f"][2], found.sd["f"][2]]).all()


def test_labels_are_summed_up_by_the_most_frequent():
    labels = np.full((5, 4), 3.0)
    labels[1:3, 1:3] = [[9, 11], [11, 4]]
    found = summarize_regions(regions(), flat(), {}, {"f": labels})
    assert found.mode["f"][:2].tolist() == [11, 3]
    assert np.isnan(found.mode["f"][2])


def test_labels_that_are_all_missing_have_no_mode():
    found = summarize_regions(regions(), flat(), {}, {"f": np.full((5, 4), np.nan)})
    assert np.isnan(found.mode["f"]).all()
