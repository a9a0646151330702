"""Layers of equal volume between surfaces whose volumes are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sheet_cases import grid, plates, sheet_of, shell, tube

from hipsta_bids.geometry.measures import column_area
from hipsta_bids.geometry.sheet import check_layers, equal_volume_layers, layer_depth
from hipsta_bids.types import Sheet


def test_layers_of_plates_stay():
    layers, folded = equal_volume_layers(plates())
    np.testing.assert_allclose(layers.points, plates().points, atol=1e-12)
    assert not folded.any()


@given(st.floats(2.0, 8.0), st.floats(0.5, 3.0))
@settings(max_examples=20, deadline=None)
def test_layers_of_a_pipe(radius, thickness):
    """Between radii r, volumes go with r^2; chords shrink all of them by the same share."""
    layers, folded = equal_volume_layers(tube(radius, thickness))
    inner, outer = radius - thickness / 2, radius + thickness / 2
    wanted = np.sqrt(np.linspace(inner**2, outer**2, 9))
    found = np.linalg.norm(layers.points[..., :2], axis=-1)
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), rtol=1e-9)
    assert not folded.any()


def test_layers_of_a_shell():
    layers, _ = equal_volume_layers(shell(radius=4.0))
    wanted = np.cbrt(np.linspace(3.0**3, 5.0**3, 9))
    found = np.linalg.norm(layers.points, axis=-1)
    # Areas between two layers are taken as linear: r^2 over steps of 0.25 mm.
    np.testing.assert_allclose(found[2:-2, 2:-2], np.broadcast_to(wanted, (37, 17, 9)), rtol=1e-3)


def test_the_same_volume_lies_between_any_two_layers():
    points = equal_volume_layers(tube())[0].points
    areas = [column_area(sheet_of(points[:, :, k : k + 1])).sum() for k in range(9)]
    steps = np.linalg.norm(np.diff(points, axis=2), axis=-1).mean(axis=(0, 1))
    volumes = [step * (areas[k] + areas[k + 1]) / 2 for k, step in enumerate(steps)]
    assert volumes == pytest.approx([np.mean(volumes)] * 8, rel=1e-6)  # trapezoids are exact


def test_turned_sheets_have_the_same_layers():
    still, _ = equal_volume_layers(tube())
    turned, _ = equal_volume_layers(sheet_of(tube().points[:, :, ::-1]))
    np.testing.assert_allclose(turned.points[:, :, ::-1], still.points, atol=1e-9)
    mirrored, folded = equal_volume_layers(sheet_of(tube().points * [-1, 1, 1]))
    np.testing.assert_allclose(mirrored.points * [-1, 1, 1], still.points, atol=1e-9)
    assert not folded.any()


def test_where_layers_fold_they_keep_equal_distances():
    x, y, z = grid()
    # A bend sharper than the wall is thick: the interior wall runs backwards in its middle.
    angle = 0.8 * np.pi * np.clip(3 * x - 1, 0, 1)
    radius, straight = 0.5 + 2.0 * z - 1.2, 6 * (x - np.clip(x, 1 / 3, 2 / 3))
    points = np.stack([radius * np.sin(angle), -radius * np.cos(angle), 10 * y], axis=-1)
    points += straight[..., None] * np.stack(
        [np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1
    )
    sheet = sheet_of(points)
    layers, folded = equal_volume_layers(sheet)
    assert folded[20].all()
    assert not folded[:10].any()
    np.testing.assert_array_equal(layers.points[folded], sheet.points[folded])
    assert np.isfinite(layers.points).all()
    found = check_layers(folded, sheet)
    assert (found.reason, found.raised) == ("layers-fold", True)
    assert f"{folded.sum()} of 861 columns" in found.text
    assert len(found.points) == folded.sum()


def test_a_fold_is_placed_by_its_first_column():
    folded = np.zeros((41, 21), dtype=bool)
    folded[[6, 7], [3, 1]] = True
    what = check_layers(folded, tube()).text
    assert "in 2 of 861 columns, the first at x 7, y 4," in what  # counted from 1


def test_no_fold_no_flag():
    assert not check_layers(np.zeros((41, 21), dtype=bool), tube()).raised


def test_depth_runs_from_wall_to_wall():
    np.testing.assert_allclose(layer_depth(tube())[3, 5], np.linspace(0, 2, 9))
    layers, _ = equal_volume_layers(tube())
    depth = layer_depth(layers)
    assert (np.diff(depth, axis=2) > 0).all()
    np.testing.assert_allclose(depth[:, :, -1], 2.0)
    assert (depth[:, :, 4] > 1.0).all()  # the outer half is wider


def test_undefined_columns_stay_undefined():
    points = tube().points.copy()
    points[3, 4] = np.nan
    sheet = Sheet(points=points, valid=np.isfinite(points).all(axis=(2, 3)))
    layers, _ = equal_volume_layers(sheet)
    assert np.isnan(layers.points[3, 4]).all()
    assert np.isfinite(layers.points[10:]).all()
