"""Finite elements: exact on linear functions, converging on eigenvalues, LaPy's own solutions."""

from dataclasses import replace

import lapy
import numpy as np
import pytest
from geometry_cases import box_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import marching_cubes

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import fem
from hipsta_bids.geometry.fem import Directed, Laplace, volume_laplace
from hipsta_bids.types import TetMesh

EXACT = 1e-10  # rounding in a sparse solve
SIZE = (2.0, 1.0, 3.0)
SOLVERS = pytest.mark.parametrize("solver", ["two-level", "lapy"])


def wobbled(cells=(4, 3, 5), size=SIZE, seed=0):
    """A box whose inner vertices are moved, so that no symmetry hides a mistake."""
    mesh = box_mesh(cells, size)
    inner = ((mesh.vertices > 1e-9) & (mesh.vertices < np.array(size) - 1e-9)).all(axis=1)
    step = min(s / c for s, c in zip(size, cells, strict=True))
    shift = np.random.default_rng(seed).uniform(-0.2, 0.2, mesh.vertices.shape) * step
    return TetMesh(vertices=mesh.vertices + shift * inner[:, None], tetrahedra=mesh.tetrahedra)


@SOLVERS
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_linear_functions_are_reproduced(axis, solver):
    mesh = wobbled()
    along = mesh.vertices[:, axis]
    fixed = np.flatnonzero((along < 1e-9) | (along > SIZE[axis] - 1e-9))
    values = 2 * along / SIZE[axis] - 1
    found = volume_laplace(mesh, solver).solve(fixed, values[fixed])
    np.testing.assert_allclose(found, values, atol=EXACT)


@SOLVERS
def test_between_two_sets_is_from_minus_one_to_one(solver):
    mesh = wobbled()
    low, high = (np.flatnonzero(np.abs(mesh.vertices[:, 2] - end) < 1e-9) for end in (0, SIZE[2]))
    values = volume_laplace(mesh, solver).between(low, high)
    np.testing.assert_allclose(values, 2 * mesh.vertices[:, 2] / SIZE[2] - 1, atol=EXACT)


@SOLVERS
def test_of_a_vertex_in_both_sets_the_second_counts(solver):
    mesh = wobbled()
    low = np.flatnonzero(mesh.vertices[:, 2] < 1e-9)
    high = np.flatnonzero(mesh.vertices[:, 2] > SIZE[2] - 1e-9)
    values = volume_laplace(mesh, solver).between(low, np.append(high, low[0]))
    assert values[low[0]] == 1
    assert (values[low[1:]] == -1).all()


def triangle_grid():
    """Vertices and triangles of 4 x 3 squares in a plane."""
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij"), axis=-1)
    number = np.arange(20).reshape(5, 4)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    triangles = np.vstack([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    return np.pad(grid.reshape(-1, 2), ((0, 0), (0, 1))), triangles.astype(np.int32)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.3])
def test_diffusion_is_slowed_along_the_direction_only(angle):
    vertices, triangles = triangle_grid()
    first = np.array([np.cos(angle), np.sin(angle), 0.0])
    second = np.array([-np.sin(angle), np.cos(angle), 0.0])
    share, slope = 0.3, np.array([0.7, -1.1, 0.0])
    directions = (np.tile(vector, (len(triangles), 1)) for vector in (first, second))
    speeds = np.tile([1.0, share], (len(triangles), 1))
    laplace = Directed(Laplace(lapy.TriaMesh(vertices, triangles)), *directions)(speeds)
    along = slope @ first
    wanted = (slope @ slope - along**2 + share * along**2) * 12  # area of 4 x 3
    values = vertices @ slope
    assert values @ (laplace.stiffness @ values) == pytest.approx(wanted, rel=EXACT)


@pytest.mark.parametrize("strength", [0.0, 5.0])
def test_directed_diffusion_is_that_of_lapy(strength):
    x, y, z = np.mgrid[-8:9, -10:11, -12:13]
    vertices, triangles, *_ = marching_cubes((x / 5) ** 2 + (y / 7) ** 2 + (z / 9) ** 2, 1.03)
    egg = lapy.TriaMesh(vertices.astype(float), triangles)
    egg.orient_()
    theirs = lapy.Solver(egg, lump=True, aniso=strength, aniso_smooth=2)
    across, along, least, most = egg.curvature_tria(2)
    speeds = np.exp(-strength * np.abs(np.column_stack([most, least])))
    ours = Directed(Laplace(egg), across, along)(speeds)
    scale = abs(theirs.stiffness).max()
    assert abs(ours.stiffness - theirs.stiffness).max() <= 1e-12 * scale  # rounding


@SOLVERS
def test_first_eigenfunction_is_found_from_that_of_a_similar_operator(solver):
    x, y, z = np.mgrid[-8:9, -10:11, -12:13]
    vertices, triangles, *_ = marching_cubes((x / 5) ** 2 + (y / 7) ** 2 + (z / 9) ** 2, 1.03)
    egg = lapy.TriaMesh(vertices.astype(float), triangles)
    egg.orient_()
    across, along, least, most = egg.curvature_tria(2)
    bending = np.abs(np.column_stack([most, least]))
    directed = fem.Directed(Laplace(egg, solver), across, along)
    similar, other = directed(np.exp(-bending)), directed(np.exp(-20 * bending))
    start, wanted = (operator.eigenfunctions(1)[1][:, 0] for operator in (similar, other))
    found = other.first_near(start, similar)
    aligned = [abs(np.corrcoef(values, wanted)[0, 1]) for values in (start, found)]
    assert aligned[0] < 0.9  # they differ
    assert aligned[1] > 1 - 1e-3  # the square of a hundredth over the gap of the eigenvalues, 0.17


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_gradient_and_energy_of_a_linear_function_are_its_slope(seed):
    """Its sign, too: LaPy 1.7 returns the negative gradient on tetrahedra."""
    rng = np.random.default_rng(seed)
    slope, mesh = rng.normal(size=3), wobbled(seed=seed)
    laplace, values = volume_laplace(mesh), mesh.vertices @ slope
    np.testing.assert_allclose(laplace.gradient(values), np.tile(slope, (len(laplace.cells), 1)))
    energy = values @ (laplace.stiffness @ values)
    assert energy == pytest.approx(slope @ slope * np.prod(SIZE), rel=EXACT)


@pytest.mark.parametrize("sign", [-1, 1])
def test_gradient_is_right_whatever_the_sign_of_lapys(monkeypatch, sign):
    mesh = wobbled()
    lapys = fem.compute_gradient
    monkeypatch.setattr(fem, "compute_gradient", lambda *given: sign * lapys(*given))
    found = volume_laplace(mesh).gradient(mesh.vertices[:, 1])
    np.testing.assert_allclose(found, np.tile([0.0, 1.0, 0.0], (len(found), 1)), atol=EXACT)


def box_eigenfunctions(cells, solver="two-level"):
    """Of a box whose third edge is the longest; (pi / 3)^2 is the true first eigenvalue."""
    mesh = box_mesh(cells, SIZE)
    return *volume_laplace(mesh, solver).eigenfunctions(2), mesh


def test_eigenvalues_of_a_box_converge_with_order_two():
    truth = (np.pi * np.array([1 / 3, 1 / 2])) ** 2  # along z, then along x
    errors = np.array([np.abs(box_eigenfunctions((2 * n, n, 3 * n))[0] - truth) for n in (3, 6)])
    order = np.log2(errors[0] / errors[1])
    assert (errors[1] < 0.01 * truth).all()
    # Linear elements: two, reached as the mesh becomes fine.
    assert (np.abs(order - 2) < 0.25).all()


@SOLVERS
def test_first_eigenfunction_is_a_cosine_along_the_longest_edge(solver):
    _, functions, mesh = box_eigenfunctions((8, 4, 12), solver)
    cosine = np.cos(np.pi * mesh.vertices[:, 2] / SIZE[2])
    assert abs(np.corrcoef(functions[:, 0], cosine)[0, 1]) > 0.9995  # second order in 1/12


def test_eigenfunctions_are_lapys_but_for_the_sign():
    values, functions, _ = box_eigenfunctions((4, 3, 6))
    wanted, expected, _ = box_eigenfunctions((4, 3, 6), "lapy")
    np.testing.assert_allclose(values, wanted, rtol=EXACT)
    np.testing.assert_allclose(np.abs(functions), np.abs(expected), atol=1e-6)  # ARPACK's tolerance


def test_eigenfunctions_repeat_exactly():
    first, second = (box_eigenfunctions((4, 3, 6))[1] for _ in range(2))
    np.testing.assert_array_equal(first, second)


@SOLVERS
@pytest.mark.parametrize("place", ["first", "last"])
def test_a_vertex_without_a_tetrahedron_is_refused(place, solver):
    mesh = wobbled()
    alone = [[9.0, 9.0, 9.0]]
    if place == "first":
        mesh = TetMesh(
            vertices=np.vstack([alone, mesh.vertices]), tetrahedra=mesh.tetrahedra + np.int32(1)
        )
    else:
        mesh = replace(mesh, vertices=np.vstack([mesh.vertices, alone]))
    with pytest.raises(GeometryError, match=r"Laplace problem has no solution") as caught:
        volume_laplace(mesh, solver).solve(np.array([5]), np.array([1.0]))
    assert caught.value.reason == "laplace"
