"""Drawing maps on axes of matplotlib."""

from functools import cache

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from measured_phantoms import measured, spiral

import hipsta_bids as hb


@cache
def found(side):
    return hb.measure(measured(spiral(), hemi=side, voxel=0.5).volume, side)


def drawn(axis):
    """The values, (y, x), of the map on axes."""
    (mesh,) = (one for one in axis.collections if isinstance(one, QuadMesh))
    return mesh


class TestSheet:
    @pytest.mark.parametrize("kind", ["measurement", "dataset"])
    def test_values_are_those_of_the_map(self, kind):
        data = found("L") if kind == "measurement" else found("L").dataset
        axis = hb.plot_sheet(data, "curvature", ax=Figure().subplots())
        np.testing.assert_array_equal(drawn(axis).get_array(), found("L").maps["curvature"].T)
        low, high = drawn(axis).get_clim()
        assert low == -high  # zero means something
        assert {text.get_text() for text in axis.texts} >= {"CA1", "Sub"}
        assert axis.figure.axes[1].get_ylabel() == "mean curvature [1/mm]"

    def test_a_map_alone_is_drawn_as_in_its_dataset(self):
        maps = found("L").dataset
        axis = hb.plot_sheet(maps["curvature"], ax=Figure().subplots())
        np.testing.assert_array_equal(drawn(axis).get_array(), found("L").maps["curvature"].T)
        assert axis.figure.axes[1].get_ylabel() == "mean curvature [1/mm]"
        unnamed = maps["thickness"].transpose("y", "x").rename(None)
        axis = hb.plot_sheet(unnamed, ax=Figure().subplots())
        np.testing.assert_array_equal(drawn(axis).get_array(), found("L").maps["thickness"].T)
        with pytest.raises(ValueError, match="thickness has the axes x; select one"):
            hb.plot_sheet(maps["thickness"].isel(y=0, drop=True), ax=Figure().subplots())

    def test_both_sides_lie_alike(self):
        """As on all pages."""
        axes = Figure().subplots(1, 2)
        for axis, data in zip(axes, (found("L"), found("R")), strict=True):
            hb.plot_sheet(data, ax=axis, colorbar=False)
        for axis in axes:
            assert axis.get_xlabel() == "medial  ←  mm  →  lateral"
            assert not axis.xaxis_inverted()
        assert len(axes[0].figure.axes) == 2

    def test_limits_are_taken(self):
        axis = hb.plot_sheet(found("L"), ax=Figure().subplots(), limits=(1.0, 3.0))
        assert drawn(axis).get_clim() == (1.0, 3.0)

    def test_size_is_in_millimeters(self):
        axis = hb.plot_sheet(found("R"), ax=Figure().subplots())
        expected = found("R").summary[["extent_x", "extent_y"]]
        corner = drawn(axis).get_coordinates()[-1, -1]
        np.testing.assert_allclose(corner, expected, rtol=0.03)

    def test_wrong_data_are_refused(self):
        with pytest.raises(ValueError, match="measure is 'depht'; choose 'thickness' or"):
            hb.plot_sheet(found("L"), "depht", ax=Figure().subplots())
        with pytest.raises(ValueError, match="select one protocol, participant, session, side and"):
            hb.plot_sheet(found("L").dataset, "depth", ax=Figure().subplots())


class TestSurface:
    @pytest.mark.parametrize("kind", ["measurement", "dataset"])
    def test_faces_lie_on_the_surface(self, kind):
        data = found("L") if kind == "measurement" else found("L").dataset
        axis = hb.plot_surface(data, ax=Figure().add_subplot(projection="3d"))
        (faces,) = axis.collections
        nx, ny = found("L").maps["thickness"].shape
        assert len(faces.get_facecolor()) == 2 * (nx - 1) * (ny - 1)
        points = found("L").surface().points
        np.testing.assert_allclose(axis.get_xlim(), (points[:, 0].min(), points[:, 0].max()))
        places = {text.get_text(): text.get_position_3d() for text in axis.texts}
        back, front = (points.reshape(nx, ny, 3)[:, row].mean(axis=0) for row in (0, -1))
        assert places["P"][1] < back[1] < front[1] < places["A"][1]

    def test_other_surfaces_are_drawn(self):
        axis = hb.plot_surface(
            found("L"), level="exterior", ax=Figure().add_subplot(projection="3d"), view=(0, 90)
        )
        assert (axis.elev, axis.azim) == (0, 90)
        points = found("L").surface("exterior").points
        np.testing.assert_allclose(axis.get_zlim(), (points[:, 2].min(), points[:, 2].max()))
        with pytest.raises(ValueError, match="no surface 'exterior'"):
            hb.plot_surface(found("L").dataset, level="exterior", ax=axis)

    def test_flat_axes_are_refused(self):
        with pytest.raises(ValueError, match="projection='3d'"):
            hb.plot_surface(found("L"), ax=Figure().subplots())


def fit_two_groups():
    random = np.random.default_rng(1)
    maps = {side: random.normal(2.0, 0.1, (20, 10, 4)) for side in "LR"}
    maps["L"][10:, :2] -= 0.5
    return hb.group(maps, pd.DataFrame({"group": ["CN"] * 10 + ["AD"] * 10}), "group")


class TestGroup:
    def test_effects_are_drawn_with_a_line_round_what_survives(self):
        fit = fit_two_groups()
        names = np.array([["Sub"] * 4] * 3 + [["CA1"] * 4] * 7)
        axis = hb.plot_group(fit, subfield=names, ax=Figure().subplots())
        np.testing.assert_array_equal(drawn(axis).get_array(), fit.maps["effect"][0, 0].T)
        assert {text.get_text() for text in axis.texts} == {"Sub", "CA1"}
        count = fit.significant[0, 0].sum()
        assert count >= 8
        assert axis.get_title() == f"left, CN-AD: {count} of 40 points survive"
        assert axis.figure.axes[1].get_ylabel() == "Cohen's d"
        without = hb.plot_group(fit, side="R", ax=Figure().subplots())
        assert without.get_title() == "right, CN-AD: 0 of 40 points survive"
        assert len(axis.collections) == len(without.collections) + 1

    def test_unknown_names_are_refused(self):
        fit = fit_two_groups()
        with pytest.raises(ValueError, match="contrast is 'AD-CN'; choose 'CN-AD'"):
            hb.plot_group(fit, "AD-CN", ax=Figure().subplots())
        with pytest.raises(ValueError, match="side is 'B'"):
            hb.plot_group(fit, side="B", ax=Figure().subplots())

    def test_maps_on_vertices_are_refused(self):
        table = pd.DataFrame({"age": np.arange(12.0)})
        maps = np.random.default_rng(0).normal(size=(12, 7))
        with pytest.raises(ValueError, match="vertices"):
            hb.plot_group(hb.group(maps, table, "age"), ax=Figure().subplots())
