"""The rims of the sheet, found by distances inside the body."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, TetMesh
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.laplace import solve_dirichlet
from hipsta_bids.geometry.surface import unique_edges
from hipsta_bids.geometry.wall import Wall, edge_graph, end_to_end
from hipsta_bids.settings import BoundarySettings


def rim_paths(
    wall: Wall, mesh: TetMesh, body: Body, settings: BoundarySettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], tuple[Float, Float]]:
    """Paths from end to end along which the wall is farthest from the opposite rim.

    Distances run inside the volume and mostly across the long axis, as steps along it are
    stretched. The first ones start from the sheet's most lateral labels.

    Returns
    -------
    paths : two (N,) arrays of int
        Medial and lateral path, vertices of the wall.
    depths : two (V,) arrays
        How much nearer than the rim of their slice the wall's vertices are to the opposite rim, mm.
    """
    edges = unique_edges(mesh.tetrahedra)
    steps = np.diff(mesh.vertices[edges], axis=1)[:, 0]
    along = steps @ body.ends.axis
    stretch = settings.axial_stretch**2 - 1
    lengths = np.sqrt(np.einsum("ij,ij->i", steps, steps) + stretch * along**2)
    graph = edge_graph(edges, lengths, len(mesh.vertices))
    start = _most_lateral(mesh, body, settings)
    paths: list[NDArray[np.intp]] = []
    depths: list[Float] = []
    for _ in range(3):  # medial from labels, lateral from medial, medial again from lateral
        distance = sparse.csgraph.dijkstra(graph, indices=start, min_only=True)[wall.index]
        depth = _below_top(distance, wall.share)
        path = _rim_path(depth, wall, settings)
        start = wall.index[path].astype(np.intp)
        paths.append(path)
        depths.append(depth)
    return (paths[2], paths[1]), (depths[2], depths[1])


def guided_curves(
    wall: Wall,
    paths: tuple[NDArray[np.intp], NDArray[np.intp]],
    depths: tuple[Float, Float],
    thickness: float,
    settings: BoundarySettings,
) -> tuple[Float, Float] | None:
    """Middle lines between the two sides within the zones at the rims.

    Without the rim zones the wall falls into its two sides. The zero line of the harmonic
    function between them, with the same curvature-aware diffusion, runs along the rims.
    """
    zones = [
        (_below_rim(depth, path, wall) < settings.rim_zone * thickness)
        | wall.near(wall.vertices[path], settings.rim_reach * thickness)
        for path, depth in zip(paths, depths, strict=True)
    ]
    return middle_lines(wall, zones)


def center_curves(
    wall: Wall, curves: tuple[Float, Float], thickness: float, settings: BoundarySettings
) -> tuple[Float, Float]:
    """Move curves to the middle of the rims.

    The middle lines are found again in ever narrower bands of equal width on both sides: a side
    that bends more, or reaches farther into a zone, pulls the line towards itself.
    """
    for width in settings.rim_bands:
        bands = [wall.near(curve, width * thickness) for curve in curves]
        curves = middle_lines(wall, bands) or curves
    return curves


def middle_lines(wall: Wall, zones: Sequence[Bool]) -> tuple[Float, Float] | None:
    """Zero lines, within zones at the rims, of the harmonic function between the two sides."""
    sides = wall.sides(zones[0] | zones[1])
    if sides is None:
        return None
    fixed = np.flatnonzero(sides[0] | sides[1])
    values = np.where(sides[1][fixed], 1.0, -1.0)
    return end_to_end(wall, solve_dirichlet(wall.evenly_aware, fixed, values))


def _most_lateral(mesh: TetMesh, body: Body, settings: BoundarySettings) -> NDArray[np.intp]:
    """Vertices whose surroundings carry the most lateral labels."""
    _, points = body.inside_points()
    count = min(settings.label_neighbors, len(points))
    asked = np.arange(0, len(mesh.vertices), settings.label_stride)
    _, nearest = cKDTree(points).query(mesh.vertices[asked], k=count)
    mean = body.lateral[nearest].mean(axis=1)
    return np.asarray(asked[mean >= np.quantile(mean, 1 - settings.lateral_share)])


def _rim_path(depth: Float, wall: Wall, settings: BoundarySettings) -> NDArray[np.intp]:
    """Cheapest path from end to end; being away from the rim costs."""
    cost = wall.lengths * (
        settings.rim_floor + (np.maximum(depth, 0)[wall.edges].mean(axis=1)) ** 2
    )
    start = _lowest(depth, wall.posterior)
    end = _lowest(depth, wall.anterior)
    graph = edge_graph(wall.edges, cost, len(depth))
    _, before, _ = sparse.csgraph.dijkstra(
        graph, indices=np.array([start]), return_predecessors=True, min_only=True
    )
    path = [end]
    while path[-1] != start and len(path) <= len(depth):
        path.append(int(before[path[-1]]))
    return np.array(path)


def _lowest(depth: Float, where: Bool) -> int:
    return int(np.flatnonzero(where)[np.argmin(depth[where])])


def _below_top(values: Float, share: Float) -> Float:
    """How far values lie below the largest of their slice."""
    count = 40
    slices = np.minimum((share * count).astype(int), count - 1)
    top = np.full(count, -np.inf)
    np.maximum.at(top, slices, values)
    centres = (np.arange(count) + 0.5) / count
    known = np.isfinite(top)
    top = ndimage.median_filter(np.interp(centres, centres[known], top[known]), 5, mode="nearest")
    return np.asarray(np.interp(share, centres, top) - values)


def _below_rim(depth: Float, path: NDArray[np.intp], wall: Wall) -> Float:
    """Depth below the rim path of the same slice, mm."""
    order = np.argsort(wall.share[path], kind="stable")
    return np.asarray(depth - np.interp(wall.share, wall.share[path][order], depth[path][order]))
