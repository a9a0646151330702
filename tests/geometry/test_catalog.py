"""What the tables' columns hold, of a wedge whose measures are known."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import box_mesh, plain_body, straight_ends
from sheet_cases import grid, sheet_of, shell, tube

from hipsta_bids.geometry import catalog
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SUMMARY, Measured
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings

TISSUES = (Tissue.SUBICULUM, Tissue.CA1, Tissue.CA3)


def wedge(*, along=0.0, sheet=None):
    """12 x 8 mm, flat inside; 1 mm thick medially, 2 mm laterally, and ``along`` more anteriorly.

    Nodes lie closer together medially. Subiculum, CA1 and CA3 are 4 mm wide each.
    """
    s, y, z = grid()
    x = s * s
    points = np.stack([12 * x, 8 * y, (1 + x + along * y) * z], axis=-1)
    whole = sheet_of(points)
    tissue = np.zeros((24, 16, 8), dtype=np.uint8)
    tissue[:8], tissue[8:16], tissue[16:] = TISSUES
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = 0.25
    part = np.clip(points[:, :, 4, 0] // 4, 0, 2).astype(int)
    return Measured(
        body=plain_body(tissue, affine, straight_ends(8.0)),
        mesh=box_mesh((12, 8, 2), (12.0, 8.0, 1.5)),
        subfield=np.array(TISSUES, dtype=np.uint8)[part],
        whole=whole,
        settings=Settings().changed(sheet={"y_extent": 0.8}),
        sheet=whole if sheet is None else sheet,
    )


def test_summary_of_a_wedge():
    found = catalog.summarize(wedge(), (*TISSUES, Tissue.CA2))
    mid, outer = 8 * np.hypot(12, 0.5), 8 * np.hypot(12, 1)
    share = (np.linspace(0, 1, 41) ** 2).mean()
    exact = {
        "thickness_mean": 1.5,
        "thickness_nodes": 1 + share,  # of nodes, more of which lie where it is thin
        "extent_x": mid / 8,
        "extent_y": 8.0,
        "extent_z": 1.5,
        "volume": 144.0,
        "area_interior": 96.0,
        "area_mid": mid,
        "area_exterior": outer,
        "area_ratio": 96 / outer,
        "surface_volume_ratio": (96 + outer) / 144,
        "circumference_mean": (96 + outer) / 8,
        "interior_exterior_ratio_mean": 96 / outer,
        "section_area_mean": 18.0,
        "shape_index_mean": (96 + outer) / 144,
        "curvature_mean": 0.0,
        "curvature_interior_mean": 0.0,
        "curvature_exterior_mean": 0.0,
        "gaussian_curvature_mean": 0.0,
        "gaussian_curvature_interior_mean": 0.0,
        "gaussian_curvature_exterior_mean": 0.0,
    }
    assert [row.name for row in SUMMARY] == [*exact]
    for name, value in exact.items():
        assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name
    rows = [f"{row.name}_{tissue.name}" for row in PER_SUBFIELD for tissue in (*TISSUES, Tissue.CA2)]
    assert [*found] == [*exact, *rows]
    for tissue, thickness in zip(TISSUES, (7 / 6, 9 / 6, 11 / 6), strict=True):
        # Places that are labeled lie 0.1 mm apart, nodes 0.4 mm.
        assert found[f"thickness_mean_{tissue.name}"] == pytest.approx(thickness, abs=0.02)
        assert found[f"area_{tissue.name}"] == pytest.approx(mid / 3, abs=0.8)
        assert found[f"volume_{tissue.name}"] == pytest.approx(48.0)
    assert np.isnan([found[f"{row.name}_CA2"] for row in PER_SUBFIELD]).all()


def test_sections_have_the_thickness_of_their_place():
    """The sheet spans 0.8 of the length of the body, whose ends are as thick as its ends."""
    found = catalog.measure_sections(wedge(along=1.0))
    place = np.linspace(-1, 1, 21) / 0.8
    np.testing.assert_allclose(found["thickness"], 1.5 + np.clip((1 + place) / 2, 0, 1), rtol=1e-9)
    np.testing.assert_allclose(found["position"][-1], np.hypot(8, 0.5), rtol=1e-9)


@pytest.mark.parametrize(("make", "radius"), [(tube, 4.0), (shell, 10.0)])
def test_maps_of_curvature_are_those_of_their_surface(make, radius):
    sheet = make(thickness=2.0)
    found = catalog.measure_maps(wedge(sheet=sheet))
    for ending, distance in (("", 0), ("_interior", -1), ("_exterior", 1)):
        first = 1 / (radius + distance)
        second = first if make is shell else 0.0
        middle = np.s_[20, 10]
        mean, product = found[f"curvature{ending}"], found[f"gaussian_curvature{ending}"]
        assert mean[middle] == pytest.approx((first + second) / 2, rel=0.012)
        assert product[middle] == pytest.approx(first * second, rel=0.025, abs=1e-6)
    np.testing.assert_allclose(found["thickness"], 2.0)
    np.testing.assert_allclose(found["extent_x"], np.hypot(12, 0.5))
    np.testing.assert_allclose(found["extent_y"], 8.0)
    rows = {row.name: row for row in MAPS}
    assert [rows[f"curvature{end}"].desc for end in ("", "_interior")] == [None, "interior"]
    assert rows["gaussian_curvature"].possible == (-1e4, 1e4)


def test_means_and_profiles_are_of_columns_that_were_measured():
    valid = np.ones((41, 21), dtype=bool)
    valid[:, 8:13] = valid[0] = False
    sheet = replace(wedge().sheet, valid=valid)
    measured = wedge(sheet=sheet)
    x, y = sheet.points[:, :, 4, 0], sheet.points[:, :, 4, 1]
    values = np.where(sheet.valid, x + 10 * y, 1e3)
    profiles = catalog.average_profiles({"a": values, "b": 2 * values}, sheet)
    assert np.isnan(profiles["x"]["a"][0])
    assert np.isnan(profiles["y"]["a"][8:13]).all()
    np.testing.assert_allclose(profiles["x"]["a"][1:], x[1:, 0] + 40)  # as many before as behind
    rows = np.r_[0:8, 13:21]
    weights = np.convolve(np.diff(x[:, 0], prepend=0, append=12), [1, 1], "valid")[1:]
    expected = np.average(x[1:, 0], weights=weights) + 10 * y[0, rows]
    np.testing.assert_allclose(profiles["y"]["b"][rows], 2 * expected)
    half = np.arange(41)[:, None] * np.ones(21) == 7
    assert measured.mean(values, half) == pytest.approx(x[7, 0] + 40)
    assert np.isnan(measured.mean(values, ~sheet.valid))


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("thickness", [1.0, 2.0, np.nan], None),
        ("thickness", [0.0, 2.0], "thickness reaches 0 mm, which no sheet does"),
        ("thickness", [1.0, 10.0], "thickness reaches 10 mm, which no sheet does"),
        ("thickness", [2.0, 2.0], "thickness is 2 mm at all points"),
        ("volume", [2.0], None),
        ("volume", [1e6], "volume reaches 1e+06 mm^3, which no sheet does"),
        ("extent_x", [999.0, 5.0], None),
        ("extent_x", [5.0, 1000.0], "extent_x reaches 1e+03 mm, which no sheet does"),
        ("area_CA1", [1e5], "area reaches"),
        ("curvature", [-100.0, 1.0], "curvature reaches -100 1/mm, which no sheet does"),
        ("gaussian_curvature_interior", [-9999.0, 9999.0], None),
        ("of_others", [-1.0, -1.0], None),
        ("thickness", [np.nan, np.nan], None),
    ],
)
def test_values_that_no_sheet_has_are_named(name, values, message):
    found = catalog.why_impossible(name, np.array(values))
    assert found is None if message is None else found.startswith(message.replace("area", name))
