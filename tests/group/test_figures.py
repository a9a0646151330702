"""Where figures put what they show: surfaces in the plane, borders and names of subfields."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hipsta_bids.group.classify import Area, calibrate
from hipsta_bids.group.figures import (
    draw_calibration,
    draw_mesh,
    draw_roc,
    draw_sections,
    panels,
    scale_of,
)
from hipsta_bids.group.settings import ClassificationSettings
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.io.gifti import sheet_triangles
from hipsta_bids.types import Mesh

GRID = (11, 6)
SCALE = scale_of("viridis", 0.0, 1.0)


def surface(length, width, height):
    """A grid bent upward along its length; heights of its points are the second answer."""
    u, v = np.meshgrid(*(np.linspace(-1, 1, n) for n in GRID), indexing="ij")
    points = np.stack([length * u, width * v, height * u**2], axis=-1).reshape(-1, 3) / 2
    return Mesh(points=points, triangles=sheet_triangles(*GRID).astype(np.int64)), points[:, 2]


def drawn(mesh, values):
    _, axes = panels(1, 1, (3.0, 3.0))
    return axes[0, 0], draw_mesh(axes[0, 0], mesh, values, SCALE)


def test_a_folded_surface_is_seen_along_its_thinnest_direction():
    """Wherever in the scanner it lies, and however it is turned; what is in front covers the rest.

    The mean of its heights is not zero, and all axes are those of its points about their mean.
    """
    mesh, height = surface(20.0, 8.0, 3.0)
    turned = Rotation.from_euler("xyz", [50, -30, 70], degrees=True).apply(mesh.points)
    placed = Mesh(points=turned + np.array([30.0, -25.0, -12.0]), triangles=mesh.triangles)
    axis, colors = drawn(placed, height)
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("second axis", "longest axis")
    assert np.ptp(axis.get_xlim()) == pytest.approx(8.0)
    assert np.ptp(axis.get_ylim()) == pytest.approx(20.0)
    steps = np.diff(colors.get_array())
    assert (steps >= -1e-12).all() or (steps <= 1e-12).all()  # rounding


@pytest.mark.parametrize(("size", "words"), [((20.0, 8.0), "yx"), ((8.0, 20.0), "xy")])
def test_a_flat_surface_is_drawn_upright_in_its_own_coordinates(size, words):
    mesh, _ = surface(*size, 0.015)  # thinner than a thousandth of its length
    axis, _ = drawn(mesh, np.zeros(len(mesh.points)))
    assert axis.get_xlabel() == f"{words[0]} of the surface"
    assert axis.get_ylabel() == f"{words[1]} of the surface"
    assert axis.get_xlim() == (-4.0, 4.0)
    # Its x, from anterior to posterior, goes down where it is the longer one.
    assert axis.get_ylim() == ((10.0, -10.0) if words == "yx" else (-10.0, 10.0))


def test_triangles_without_a_value_are_left_out():
    mesh, _ = surface(20.0, 8.0, 0.0)
    values = np.full(len(mesh.points), 0.5)
    values[0] = np.nan
    _, colors = drawn(mesh, values)
    assert len(colors.get_array()) == len(mesh.triangles) - (mesh.triangles == 0).any(axis=1).sum()
    _, colors = drawn(mesh, np.full(len(mesh.points), np.nan))
    assert not colors.get_visible()


def test_legends_of_curves_are_beside_them_and_small_groups_have_no_calibration():
    score = np.linspace(-1, 1, 12)
    calibration = calibrate(score, score > 0, ClassificationSettings(least_calibrated=2))
    one = SimpleNamespace(
        auc=Area(0.6, 0.1, 0.4, 0.8),
        cross_validation=SimpleNamespace(auc=0.07),
        score=score,
        calibration=calibration,
    )
    model = SimpleNamespace(base=one, full=one, separated=False)
    pair = SimpleNamespace(control="CN", case="AD", comparison=model, is_case=score > 0)
    analysis = SimpleNamespace(pairs=[("L", "thickness_mean", pair)])
    for draw in (draw_roc, draw_calibration):
        figure = draw(analysis)
        figure.draw_without_rendering()
        (axis,) = figure.axes
        legend = axis.get_legend().get_window_extent()
        assert not legend.overlaps(axis.get_window_extent())
        assert legend.y0 >= 0  # not cut off
        assert legend.x0 >= 0
    one.calibration = calibrate(score, score > 0, ClassificationSettings())
    assert not draw_calibration(analysis).axes[0].axison


def test_subfields_are_named_inside_them_and_end_at_lines_across_the_wall():
    x, y, z = np.meshgrid(np.arange(9.0), np.arange(7.0), np.arange(3.0), indexing="ij")
    wall = np.moveaxis(np.stack([x, y, z], axis=-1), 2, 0)  # mm; (3, x, y, 3)
    shape = AverageShape(mean=wall, by_group={"CN": wall}, counts={"CN": 3})
    fields = np.repeat([-1, 0, 0, 0, 1, 1, 1, 1, 1], 7).reshape(9, 7)
    left = SimpleNamespace(subfield=fields, maps=SimpleNamespace(names=("Sub", "CA1", "CA2")))
    cohort = SimpleNamespace(y=0.3 * np.arange(-3, 4))
    figure = draw_sections(cohort, SimpleNamespace(fitted={"L": left}), {"L": shape, "R": shape})
    axes = np.reshape(figure.axes, (2, 3))
    for axis in axes[0]:
        # The left side's lateral is against x; the center is at 4 and 1 mm.
        texts = {text.get_text(): text.get_position() for text in axis.texts}
        assert texts == {"Sub": (2.0, 0.0), "CA1": (-2.0, 0.0)}
        borders = [line.get_xydata().tolist() for line in axis.lines if line.get_color() == "0.3"]
        assert borders == [[[3.5, -1], [3.5, 1]], [[0.5, -1], [0.5, 1]]]
    for sign, row in zip((-1, 1), axes, strict=True):
        middle = row[0].lines[1].get_xydata()
        np.testing.assert_allclose(middle, np.stack([sign * (x[:, 0, 0] - 4), 0 * x[:, 0, 0]], 1))
    assert not any(axis.texts for axis in axes[1])  # nothing was fitted there
    places = [axis.get_title().partition(", ")[2] for axis in axes[0]]
    assert places == ["y = -0.6 (posterior)", "y = 0 (middle)", "y = 0.6 (anterior)"]
