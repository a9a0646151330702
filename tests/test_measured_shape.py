"""Every shape measure, from labels to numbers, against the phantom's analytic value."""

import numpy as np
import pytest
from measured_phantoms import measure, measured, sheet_coordinates, spiral

from hipsta_bids import participant
from hipsta_bids.artifacts import Sheet
from hipsta_bids.geometry.catalog import MAPS, SECTIONS
from hipsta_bids.geometry.sheet import sample_sheet
from hipsta_bids.geometry.summary import SUMMARY
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.phantom.truth import cut_sections
from hipsta_bids.settings import Settings, SheetSettings

SHAPES = [
    PhantomSpec(kind="slab", thickness=2.0),
    PhantomSpec(kind="arc", thickness=2.0),
    PhantomSpec(kind="spiral", thickness=1.2),
    PhantomSpec(kind="spiral", thickness=2.0, bend=0.03),
    PhantomSpec(kind="arc", thickness=2.0, bend=-0.03),
]
SIZE = 0.02  # relative; the acceptance limit
CURVED = 0.05  # the same for curvatures, away from the tips

#: Sums and means that do not depend on where along x they are taken.
SIZES = [row.name for row in SUMMARY if "curvature" not in row.name]

BY_VOLUME = Settings(sheet=SheetSettings(depths="volume"))

#: Away from rims and ends, where phantoms are sharp and hippocampi are not.
INNER = np.s_[6:-6, 3:-3]


@pytest.fixture(params=SHAPES, ids=lambda s: f"{s.kind}-{s.thickness}-{s.bend}")
def case(request):
    return measured(request.param)


def true_maps(case):
    u, v, _ = np.moveaxis(sheet_coordinates(case), -1, 0)
    return case.phantom.truth(np.clip(u, 0, 1), np.clip(v, 0, 1))


def test_sizes_are_those_of_the_phantom(case):
    found, truth = case.maps.summary, case.truth
    errors = {name: found[name] / truth[name] - 1 for name in SIZES}
    assert {name: error for name, error in errors.items() if abs(error) > SIZE} == {}


def test_cross_sections_are_those_of_the_phantom(case):
    v = np.clip(np.nanmean(sheet_coordinates(case)[10:-10, :, 1], axis=0), 0, 1)
    truth = cut_sections(case.phantom.body, v)
    for row in SECTIONS[1:]:  # the position is the error of where sections are, not of their size
        found = case.maps.sections[row.name] / truth[row.name]
        # Means over sections; single ones have the roughness of 0.4 mm voxels.
        assert found.mean() == pytest.approx(1, abs=SIZE), row.name
        assert found == pytest.approx(np.ones(21), abs=0.05), row.name
    position = case.maps.sections["position"]
    assert (np.diff(position) > 0).all()
    assert position[-1] == pytest.approx(truth["position"][-1], rel=SIZE)


def test_extents_along_each_line_are_those_of_the_phantom(case):
    truth = true_maps(case)
    for name in ("extent_x", "extent_y"):
        ratio = case.maps.maps[name] / getattr(truth, name)
        assert ratio.mean() == pytest.approx(1, abs=SIZE), name
        assert ratio == pytest.approx(np.ones((41, 21)), abs=0.03), name  # single lines


@pytest.mark.parametrize("surface", ["", "_interior", "_exterior"])
def test_gaussian_curvature_is_zero_on_straight_extrusions(surface):
    for spec in SHAPES:
        case = measured(spec)
        found = case.maps.maps[f"gaussian_curvature{surface}"][INNER]
        if spec.bend:
            continue
        assert np.sqrt((found**2).mean()) < 0.0025  # 1/mm2, half of the limit
        assert np.quantile(np.abs(found), 0.97) < 0.005  # single points, rough by voxels
    assert any(not spec.bend for spec in SHAPES)


@pytest.mark.parametrize("bend", [0.03, -0.03])
def test_gaussian_curvature_where_the_axis_bends(bend):
    kind = "spiral" if bend > 0 else "arc"
    case = measured(PhantomSpec(kind=kind, thickness=2.0, bend=bend))
    truth = true_maps(case)
    for surface in ("", "_interior", "_exterior"):
        found = case.maps.maps[f"gaussian_curvature{surface}"][INNER]
        wanted = getattr(truth, f"gaussian_curvature{surface}")[INNER]
        assert np.abs(found - wanted).mean() < 0.0015  # 1/mm2
        assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.95
        slope = (found * wanted).sum() / (wanted**2).sum()
        assert slope == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("surface", ["", "_interior", "_exterior"])
def test_mean_curvature_of_an_arc(surface):
    case = measured(PhantomSpec(kind="arc", thickness=2.0))
    found, name = case.maps, f"curvature{surface}"
    wanted = case.truth[f"{name}_median"]
    assert found.maps[name][INNER].mean() == pytest.approx(wanted, rel=CURVED)
    assert found.summary[f"{name}_median"] == pytest.approx(wanted, rel=CURVED)


def test_profiles_are_means_of_maps():
    maps = measured(spiral()).maps
    assert maps.sheet.valid.all()
    for name in (row.name for row in MAPS):
        np.testing.assert_allclose(maps.profiles["x"][name], maps.maps[name].mean(axis=1))
        np.testing.assert_allclose(maps.profiles["y"][name], maps.maps[name].mean(axis=0))


def test_left_and_right_agree():
    left, right = (measured(spiral(bend=0.02), hemi=hemi).maps for hemi in "LR")
    for name in SIZES:
        # The voxels are mirrored exactly; the triangles that cut them are not.
        assert right.summary[name] == pytest.approx(left.summary[name], rel=0.01), name
    for surface in ("", "_interior", "_exterior"):
        for kind, limit in (("curvature", 0.004), ("gaussian_curvature", 0.0005)):
            name = f"{kind}{surface}_median"
            assert right.summary[name] == pytest.approx(left.summary[name], abs=limit), name


def test_layers_by_volume_leave_every_measure_alone():
    plain = measured(spiral())
    moved = measured(spiral(), settings=BY_VOLUME).maps
    assert plain.maps.layers is plain.maps.sheet
    np.testing.assert_array_equal(moved.sheet.points, plain.maps.sheet.points)
    assert dict(moved.summary) == pytest.approx(dict(plain.maps.summary), nan_ok=True, rel=1e-12)
    assert moved.flags == plain.maps.flags
    # The wall curls round its interior, so half of its volume lies beyond the middle.
    n = np.moveaxis(
        plain.phantom.body.locate(moved.layers.points[10:-10, 4:-4, 4].reshape(-1, 3)), -1, 0
    )[2]
    curvature = plain.maps.curvature[10:-10, 4:-4].ravel() * 2
    # To first order by thickness^2 * curvature / 8; 0.03 mm is the error of the middle itself.
    assert n.mean() == pytest.approx((4.0 * curvature / 8).mean(), abs=0.03)


def test_folding_layers_are_one_flag_and_the_rest_is_unharmed(monkeypatch):
    monkeypatch.setattr(participant, "sample_sheet", with_fold)
    volume = measured(spiral()).volume
    plain, moved = measure(volume), measure(volume, settings=BY_VOLUME)
    assert dict(moved.summary) == pytest.approx(dict(plain.summary), nan_ok=True, rel=1e-12)
    for row in MAPS:
        np.testing.assert_array_equal(moved.maps[row.name], plain.maps[row.name])
    assert [flag.reason for flag in moved.flags] == [
        *(flag.reason for flag in plain.flags),
        "layers-fold",
    ]
    assert np.isfinite(moved.layers.points).all()
    # The fold's columns keep their layers, all others have moved.
    np.testing.assert_array_equal(moved.layers.points[20, 10], plain.sheet.points[20, 10])
    assert np.abs(moved.layers.points[20:30, 2, 4] - plain.sheet.points[20:30, 2, 4]).max() > 0.01


def with_fold(*arguments):
    """Sample the sheet, and let two neighboring columns' interior ends trade places."""
    sheet = sample_sheet(*arguments)
    points = sheet.points.copy()
    points[[19, 21], 10, 0] = points[[21, 19], 10, 0]
    return Sheet(points=points, valid=sheet.valid)


def test_every_map_has_an_analytic_value():
    truth = Phantom(SHAPES[0]).truth(np.linspace(0, 1, 3), 0.5)
    missing = [row.name for row in MAPS if np.shape(getattr(truth, row.name, None)) != (3,)]
    assert missing == []
