"""Finite elements: exact on linear functions, equal to LaPy, converging on eigenvalues."""

import lapy
import numpy as np
import pytest
from geometry_cases import box_mesh, cylinder, rigid
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.fem import (
    lumped_mass,
    smallest_eigenfunctions,
    solve_dirichlet,
    stiffness,
    triangle_stiffness,
)
from hipsta_bids.types import TetMesh

EXACT = 1e-10  # rounding in a sparse solve
SIZE = (2.0, 1.0, 3.0)


def wobbled(cells=(4, 3, 5), size=SIZE, seed=0):
    """A box whose inner vertices are moved, so that no symmetry hides a mistake."""
    mesh = box_mesh(cells, size)
    inner = ((mesh.vertices > 1e-9) & (mesh.vertices < np.array(size) - 1e-9)).all(axis=1)
    step = min(s / c for s, c in zip(size, cells, strict=True))
    shift = np.random.default_rng(seed).uniform(-0.2, 0.2, mesh.vertices.shape) * step
    return TetMesh(vertices=mesh.vertices + shift * inner[:, None], tetrahedra=mesh.tetrahedra)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_linear_functions_are_reproduced(axis):
    mesh = wobbled()
    place = mesh.vertices[:, axis]
    fixed = np.flatnonzero((place < 1e-9) | (place > SIZE[axis] - 1e-9))
    values = 2 * place / SIZE[axis] - 1
    matrix = stiffness(mesh.vertices, mesh.tetrahedra)
    np.testing.assert_allclose(solve_dirichlet(matrix, fixed, values[fixed]), values, atol=EXACT)


def test_stiffness_is_lapys(arc):
    for mesh in (wobbled(), arc.mesh):
        ours = stiffness(mesh.vertices, mesh.tetrahedra)
        tets = lapy.TetMesh(mesh.vertices.copy(), mesh.tetrahedra.copy())
        theirs = lapy.Solver(tets).stiffness
        # Rounding: sums of a dozen terms.
        assert abs(ours - theirs).max() < 1e-12 * abs(theirs).max()


def test_triangle_stiffness_is_lapys():
    vertices, triangles = cylinder(1.5, 0.4)
    mesh = lapy.TriaMesh(vertices, triangles)
    direction, _, least, _ = mesh.curvature_tria(smoothit=3)
    for strength in (0.0, 2.0, 20.0):
        slowed = np.exp(-strength * np.abs(least))
        ours = triangle_stiffness(vertices, triangles, direction, slowed)
        theirs = lapy.Solver(mesh, lump=True, aniso=(0.0, strength), aniso_smooth=3).stiffness
        # Rounding: sums of some terms.
        assert abs(ours - theirs).max() < 1e-12 * abs(theirs).max()


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.3])
def test_diffusion_is_slowed_along_the_direction_only(angle):
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij"), axis=-1)
    number = np.arange(20).reshape(5, 4)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    triangles = np.vstack([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    vertices = np.pad(grid.reshape(-1, 2), ((0, 0), (0, 1)))
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    share, slope = 0.3, np.array([0.7, -1.1, 0.0])
    matrix = triangle_stiffness(
        vertices,
        triangles.astype(np.int32),
        np.tile(direction, (len(triangles), 1)),
        np.full(len(triangles), share),
    )
    along = slope @ direction
    wanted = (slope @ slope - along**2 + share * along**2) * 12  # area of 4 x 3
    values = vertices @ slope
    assert values @ (matrix @ values) == pytest.approx(wanted, rel=EXACT)


def test_lumped_mass_is_lapys(arc):
    tets = lapy.TetMesh(arc.mesh.vertices.copy(), arc.mesh.tetrahedra.copy())
    theirs = lapy.Solver(tets, lump=True).mass.diagonal()
    ours = lumped_mass(arc.mesh.vertices, arc.mesh.tetrahedra)
    np.testing.assert_allclose(ours, theirs, rtol=1e-11)


def test_stiffness_is_symmetric_and_blind_to_constants():
    mesh = wobbled()
    matrix = stiffness(mesh.vertices, mesh.tetrahedra)
    assert abs(matrix - matrix.T).max() < 1e-14
    assert np.abs(matrix @ np.ones(len(mesh.vertices))).max() < 1e-13
    assert np.linalg.eigvalsh(matrix.toarray()).min() > -1e-12


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_energy_of_a_linear_function_is_its_slope_squared_times_volume(seed):
    rng = np.random.default_rng(seed)
    slope, mesh = rng.normal(size=3), wobbled(seed=seed)
    root = rng.normal(size=(3, 3))
    tensor = root @ root.T
    values = mesh.vertices @ slope
    for diffusion, wanted in ((None, slope @ slope), (tensor, slope @ tensor @ slope)):
        matrix = stiffness(mesh.vertices, mesh.tetrahedra, diffusion)
        assert values @ (matrix @ values) == pytest.approx(wanted * np.prod(SIZE), rel=EXACT)


def test_the_unit_tensor_changes_nothing():
    mesh = wobbled()
    plain = stiffness(mesh.vertices, mesh.tetrahedra)
    assert abs(stiffness(mesh.vertices, mesh.tetrahedra, np.eye(3)) - plain).max() < 1e-14


def test_a_tensor_is_a_stretch_of_space():
    """D = diag(4, 1, 1) on x acts like D = 1 on x / 2, up to the volume's own change."""
    mesh = wobbled()
    matrix = stiffness(mesh.vertices, mesh.tetrahedra, np.diag([4.0, 1.0, 1.0]))
    shrunk = stiffness(mesh.vertices * [0.5, 1.0, 1.0], mesh.tetrahedra)
    assert abs(matrix - 2 * shrunk).max() < 1e-13


@given(st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_renumbering_vertices_leaves_energies(seed):
    mesh = wobbled(cells=(3, 2, 3))
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    values = rng.normal(size=len(order))
    one = stiffness(mesh.vertices, mesh.tetrahedra)
    other = stiffness(mesh.vertices[order], place[mesh.tetrahedra])
    energy = values[order] @ (other @ values[order])
    assert energy == pytest.approx(values @ (one @ values), rel=EXACT)
    masses = lumped_mass(mesh.vertices[order], place[mesh.tetrahedra])
    np.testing.assert_allclose(masses, lumped_mass(mesh.vertices, mesh.tetrahedra)[order])


def test_rigid_motion_leaves_the_stiffness():
    mesh, pose = wobbled(), rigid()
    moved = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    difference = stiffness(moved, mesh.tetrahedra) - stiffness(mesh.vertices, mesh.tetrahedra)
    assert abs(difference).max() < 1e-12


def test_mass_is_the_volume():
    mesh = wobbled()
    mass = lumped_mass(mesh.vertices, mesh.tetrahedra)
    assert mass.min() > 0
    assert mass.sum() == pytest.approx(np.prod(SIZE))


def box_eigenvalue(cells):
    """First eigenvalue of a box whose third edge is the longest; (pi / 3)^2 is the truth."""
    mesh = box_mesh(cells, SIZE)
    matrix = stiffness(mesh.vertices, mesh.tetrahedra)
    values, functions = smallest_eigenfunctions(
        matrix, lumped_mass(mesh.vertices, mesh.tetrahedra), 2
    )
    return values, functions, mesh


def test_eigenvalues_of_a_box_converge_with_order_two():
    truth = (np.pi * np.array([1 / 3, 1 / 2])) ** 2  # along z, then along x
    errors = np.array([np.abs(box_eigenvalue((2 * n, n, 3 * n))[0] - truth) for n in (3, 6)])
    order = np.log2(errors[0] / errors[1])
    assert (errors[1] < 0.01 * truth).all()
    # Linear elements: two, reached as the mesh becomes fine.
    assert (np.abs(order - 2) < 0.25).all()


def test_first_eigenfunction_is_a_cosine_along_the_longest_edge():
    _, functions, mesh = box_eigenvalue((8, 4, 12))
    cosine = np.cos(np.pi * mesh.vertices[:, 2] / SIZE[2])
    assert abs(np.corrcoef(functions[:, 0], cosine)[0, 1]) > 0.9995  # second order in 1/12


def test_eigenfunctions_repeat_exactly():
    first, second = (box_eigenvalue((4, 3, 6))[1] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_harmonic_functions_keep_between_their_boundary_values(case):
    values = case.coordinates.values
    assert values.min() >= -1.01  # obtuse tetrahedra may overshoot by less than a per cent
    assert values.max() <= 1.01


@pytest.mark.parametrize("entry", [0.0, np.nan])
def test_a_system_without_solution_is_refused(entry):
    """Such as with a vertex that belongs to no tetrahedron."""
    matrix = sparse.csc_array(np.diag([1.0, entry, 1.0]))
    with pytest.raises(GeometryError, match=r"Laplace problem has no (finite )?solution") as caught:
        solve_dirichlet(matrix, np.array([0]), np.array([1.0]))
    assert caught.value.reason == "laplace"
