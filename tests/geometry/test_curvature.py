"""Least curvature of triangle meshes: cylinders, and LaPy's own results."""

import numpy as np
import pytest
from geometry_cases import cylinder
from lapy import TriaMesh

from hipsta_bids.geometry.wall import least_curvature


def open_wall(case):
    """The wall of a phantom's surface, without its caps."""
    surface = case.surface
    caps = surface.posterior_cap[surface.triangles].all(axis=1)
    caps |= surface.anterior_cap[surface.triangles].all(axis=1)
    used, triangles = np.unique(surface.triangles[~caps], return_inverse=True)
    return surface.vertices[used], triangles.reshape(-1, 3).astype(np.int32)


@pytest.mark.parametrize("smoothing", [0, 2])
def test_curvature_is_lapys(arc, smoothing):
    vertices, triangles = open_wall(arc)
    directions, curvature = least_curvature(vertices, triangles, smoothing)
    mesh = TriaMesh(vertices.copy(), triangles.copy())
    wanted, _, least, _ = mesh.curvature_tria(smoothit=smoothing)
    # Rounding: sums of a dozen terms of size one.
    np.testing.assert_allclose(curvature, least, atol=1e-12)
    # Eigenvectors of nearly equal eigenvalues turn far by rounding; there direction means nothing.
    same = np.abs((directions * wanted).sum(axis=1)) > 1 - 1e-9
    assert same.mean() > 0.999


@pytest.mark.parametrize("radius", [1.0, 3.0])
def test_a_cylinder_bends_round_its_axis(radius):
    vertices, triangles = cylinder(radius, 0.3)
    directions, curvature = least_curvature(vertices, triangles, 2)
    height = vertices[triangles].mean(axis=1)[:, 2]
    inner = (height > 2) & (height < 6)
    # Regular triangles give edge / (2 sqrt(3) radius); 2 % for chords and the unequal edges.
    edges = np.linalg.norm(vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)], axis=2)
    wanted = -edges.mean() / (2 * np.sqrt(3) * radius)
    np.testing.assert_allclose(curvature[inner], wanted, rtol=0.06)
    assert np.abs(directions[inner, 2]).max() < 0.02  # across the axis, but for rounding of chords
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)


def test_orientation_decides_the_sign():
    vertices, triangles = cylinder(2.0, 0.35, outward=False)
    _, curvature = least_curvature(vertices, triangles, 2)
    assert abs(curvature.mean()) < 0.002  # the axis is straight: the other direction is the least
