"""The closed surface and its tetrahedra: sphere, planar caps, orientation, volume, quality."""

from types import SimpleNamespace

import numpy as np
import pytest
from geometry_cases import box_mesh, field_of, ribbon_mask, short_phantom
from grids import straight_grid
from scipy import sparse

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import mesh as meshing
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.mesh import (
    close_gaps,
    extract_surface,
    fill_surface,
    lateral_triangles,
    mean_wall_thickness,
    signed_volume,
    tetra_quality,
    tetra_volumes,
    triangle_areas,
    unique_edges,
)
from hipsta_bids.settings import SurfaceSettings, TetraSettings
from hipsta_bids.types import TetMesh

SMOOTH, RAW = SurfaceSettings(), SurfaceSettings(taubin_iterations=0)
SPACING = 0.5


def distance_field(kind, *, shape=(40, 40, 25)):
    """Signed distance of a box of 8 x 3 mm or a cylinder of radius 5 mm along +z, clipped."""
    a, b, _ = np.indices(shape) * SPACING
    x, y = a - 9.8, b - 9.7  # off the nodes
    if kind == "cylinder":
        inside = 5.0 - np.hypot(x, y)
    else:
        inside = np.minimum(4.0 - np.abs(x), 1.5 - np.abs(y))
    return Field(
        grid=straight_grid(shape, SPACING), values=np.clip(inside, -0.5, 0.5).astype(np.float32)
    )


LENGTH = 24 * SPACING


@pytest.mark.parametrize(
    ("kind", "volume", "wall"),
    [("box", 24.0 * LENGTH, 22.0 * LENGTH), ("cylinder", np.pi * 25 * LENGTH, np.pi * 10 * LENGTH)],
)
def test_volume_and_wall_area(kind, volume, wall):
    surface = extract_surface(distance_field(kind), RAW)
    # Chords instead of arcs; the box loses its four corners: 0.3 mm each of 22 mm.
    assert signed_volume(surface.vertices, surface.triangles) == pytest.approx(volume, rel=0.01)
    areas = triangle_areas(surface.vertices, surface.triangles)
    assert areas[lateral_triangles(surface)].sum() == pytest.approx(wall, rel=0.04)
    assert mean_wall_thickness(surface) == pytest.approx(2 * volume / wall, rel=0.04)


def test_gaps_of_two_triangles_are_closed():
    surface = extract_surface(distance_field("box"), RAW)
    faces, count = surface.triangles, len(surface.vertices)
    assert close_gaps(faces, count) is faces
    far = np.argmax(np.linalg.norm(surface.vertices - surface.vertices[faces[0, 0]], axis=1))
    lost = []
    for first in (0, int(np.flatnonzero((faces == far).any(axis=1))[0])):
        shared = np.isin(faces, faces[first]).sum(axis=1) == 2
        lost += [first, int(np.flatnonzero(shared)[0])]
    closed = close_gaps(np.delete(faces, lost, axis=0), count)
    assert len(closed) == len(faces)
    assert count - len(unique_edges(closed)) + len(closed) == 2
    volume = signed_volume(surface.vertices, faces)
    assert signed_volume(surface.vertices, closed) == pytest.approx(volume, rel=1e-3)


def test_a_surface_that_cannot_be_filled_is_smoothed_more(monkeypatch):
    field, steps = distance_field("box"), []

    def fill(*_):
        if len(steps) < 2:
            raise GeometryError("it intersects itself", reason="tetrahedralization")
        return box_mesh((1, 1, 1))

    def again(settings):
        steps.append(settings.taubin_iterations)
        return extract_surface(field, settings)

    monkeypatch.setattr(meshing, "tetrahedralize", fill)
    _, _, extra = fill_surface(extract_surface(field, SMOOTH), again, SMOOTH, TetraSettings())
    assert extra == 2
    assert steps == [32, 48]


def test_smoothing_keeps_the_volume():
    field = distance_field("cylinder")
    raw, smooth = (
        signed_volume(s.vertices, s.triangles)
        for s in (extract_surface(field, RAW), extract_surface(field, SMOOTH))
    )
    # Taubin's second step inflates what the first one shrank; plain averaging loses 3 per cent.
    assert smooth == pytest.approx(raw, rel=0.005)


def test_smoothing_smooths():
    field = field_of(ribbon_mask(), sigma=0.3)  # steps of the voxels show
    raw, smooth = (_roughness(extract_surface(field, s)) for s in (RAW, SMOOTH))
    assert smooth < 0.7 * raw


def _roughness(surface):
    """Mean angle between the normals of neighboring triangles of the wall, rad."""
    triangles = surface.triangles[lateral_triangles(surface)]
    a, b, c = (surface.vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    count = len(surface.vertices)
    sides = np.sort(np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]))
    code = sides @ [count, 1]
    owner = np.tile(np.arange(len(triangles)), 3)[np.argsort(code, kind="stable")]
    code = np.sort(code)
    twin = np.flatnonzero(code[1:] == code[:-1])
    cosine = (normal[owner[twin]] * normal[owner[twin + 1]]).sum(axis=1)
    return float(np.arccos(np.clip(cosine, -1, 1)).mean())


def test_surface_is_one_closed_sphere(case):
    surface = case.surface
    edges = unique_edges(surface.triangles)
    assert len(surface.vertices) - len(edges) + len(surface.triangles) == 2
    directed = np.vstack([surface.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    count = len(surface.vertices)
    code = directed @ np.array([count, 1])
    assert len(np.unique(code)) == len(code)  # every edge once in each direction: orientable
    np.testing.assert_array_equal(np.unique(code), np.unique(directed[:, ::-1] @ [count, 1]))
    links = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    assert sparse.csgraph.connected_components(links, directed=False)[0] == 1


def test_triangles_point_outward(case):
    surface = case.surface
    assert signed_volume(surface.vertices, surface.triangles) > 0


def test_caps_lie_in_the_end_planes(case):
    surface, ends = case.surface, case.body.ends
    for cap, end in ((surface.posterior_cap, "posterior"), (surface.anterior_cap, "anterior")):
        heights = ends.height(surface.vertices, end)
        # Planar, even after smoothing, but for the rounding of vertices to a nanometre.
        assert np.abs(heights[cap]).max() < 2e-6
        assert np.abs(heights[~cap]).min() > 1e-4


def test_caps_carry_the_cross_section(arc):
    """The caps' areas are those of the drawn cross-section, 12 x 2 mm."""
    surface = arc.surface
    areas = triangle_areas(surface.vertices, surface.triangles)
    for cap in (surface.posterior_cap, surface.anterior_cap):
        area = areas[cap[surface.triangles].all(axis=1)].sum()
        # Rounded corners, and clamped sampling half a slice inside.
        assert area == pytest.approx(24.0, rel=0.07)
    assert not (surface.posterior_cap & surface.anterior_cap).any()


def test_volume_is_the_phantoms(case):
    truth = case.phantom.truth(0.5, 0.5).summary["volume"]
    # The Gaussian of a third of a millimeter rounds the rims of a wall of 2 mm.
    got = signed_volume(case.surface.vertices, case.surface.triangles)
    assert got == pytest.approx(truth, rel=0.04)


def test_two_pieces_are_refused():
    mask = np.zeros((20, 20, 12), dtype=bool)
    mask[3:7, 5:15] = mask[12:16, 5:15] = True
    with pytest.raises(GeometryError, match="Euler number 4, 2 pieces") as caught:
        extract_surface(field_of(mask), SMOOTH)
    assert caught.value.reason == "surface-topology"


def test_a_tunnel_is_refused():
    mask = ribbon_mask()
    mask[:16, 19:22, 13:16] = False
    with pytest.raises(GeometryError, match="Euler number 0, 1 pieces"):
        extract_surface(field_of(mask), SMOOTH)


def test_edges_of_cells():
    triangles = np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32)
    assert unique_edges(triangles).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    tetra = np.array([[3, 1, 0, 2]], dtype=np.int32)
    assert unique_edges(tetra).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_finer_grids_find_the_same_surface():
    """2 volume / wall area of the analytic box; it goes down with the rounding of its corners."""
    truth = 2 * 24.0 / 22.0
    for scale in (1, 2):
        field = distance_field("box")
        fine = Field(
            grid=straight_grid(tuple(scale * (n - 1) + 1 for n in (40, 40, 25)), SPACING / scale),
            values=np.kron(field.values[:1, :1, :1], 1).astype(np.float32),
        )
        index = np.indices(fine.grid.shape) * fine.grid.spacing
        inside = np.minimum(4.0 - np.abs(index[0] - 9.8), 1.5 - np.abs(index[1] - 9.7))
        values = np.clip(inside, -0.5, 0.5).astype(np.float32)
        surface = extract_surface(Field(grid=fine.grid, values=values), RAW)
        # Each of the four corners is cut by less than a step.
        assert mean_wall_thickness(surface) == pytest.approx(truth, rel=0.03 / scale)


def test_phantom_width_does_not_change_its_wall_thickness(arc):
    truth = short_phantom().truth(0.5, 0.5).summary
    rims = 2 * 2.0 * 8.0  # two rims, thickness times length
    wanted = 2 * truth["volume"] / (truth["area_interior"] + truth["area_exterior"] + rims)
    assert mean_wall_thickness(arc.surface) == pytest.approx(wanted, rel=0.03)  # rounded rims


def test_volume_is_that_of_the_surface(case):
    volumes = tetra_volumes(case.mesh.vertices, case.mesh.tetrahedra)
    surface = case.surface
    wanted = signed_volume(surface.vertices, surface.triangles)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(wanted, rel=1e-9)  # rounding of sums


def test_vertices_of_the_surface_come_first(case):
    surface = case.surface
    np.testing.assert_array_equal(case.mesh.vertices[: len(surface.vertices)], surface.vertices)


def test_faces_of_the_surface_are_kept(arc):
    """So boundary sets found on the surface bound the volume too."""
    cells = arc.mesh.tetrahedra
    faces = np.sort(np.vstack([np.delete(cells, k, axis=1) for k in range(4)]))
    count = len(arc.mesh.vertices)
    code, times = np.unique(faces.astype(np.int64) @ [count**2, count, 1], return_counts=True)
    outer = np.sort(np.sort(arc.surface.triangles).astype(np.int64) @ [count**2, count, 1])
    np.testing.assert_array_equal(code[times == 1], outer)
    assert times.max() == 2


def test_every_vertex_is_used(case):
    assert len(np.unique(case.mesh.tetrahedra)) == len(case.mesh.vertices)


def test_quality_of_known_tetrahedra():
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    corner = np.vstack([np.zeros(3), np.eye(3)])
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1e-9]], dtype=float)
    wanted = [1.0, 12 * (0.5) ** (2 / 3) / 9, 0.0]
    for vertices, value in zip((regular, corner, flat), wanted, strict=True):
        cell = [[0, 1, 2, 3]]
        if tetra_volumes(vertices, np.array(cell))[0] < 0:
            cell = [[0, 2, 1, 3]]
        mesh = TetMesh(vertices=vertices, tetrahedra=cell)
        assert tetra_quality(mesh)[0] == pytest.approx(value, abs=1e-5)  # (1e-9)^(2/3)


def test_quality_of_phantoms(case):
    quality = tetra_quality(case.mesh)
    assert quality.max() <= 1 + 1e-12
    assert np.median(quality) > 0.5  # TetGen's usual range at a radius-edge ratio of 2


def test_box_volumes():
    mesh = box_mesh((2, 3, 4), (1.0, 2.0, 3.0))
    volumes = tetra_volumes(mesh.vertices, mesh.tetrahedra)
    np.testing.assert_allclose(volumes, 6.0 / (24 * 6), rtol=1e-12)  # rounding


def test_the_sharpest_fold_is_the_edge_with_the_smallest_angle():
    """A wedge with a ridge of 2 mm, far from the origin; its other angles are larger."""
    points = np.array([[0, 0, 0], [0, 2, 0], [5, 0, 1], [5, 2, 1], [5, 0, -1], [5, 2, -1.0]])
    faces = [[0, 3, 1], [0, 2, 3], [0, 1, 5], [0, 5, 4], [2, 5, 3], [2, 4, 5], [0, 4, 2], [1, 3, 5]]
    wedge = SimpleNamespace(vertices=np.add(points, [50, -30, 20]), triangles=np.array(faces))
    np.testing.assert_allclose(meshing._sharpest_fold(wedge), [50, -29, 20])
