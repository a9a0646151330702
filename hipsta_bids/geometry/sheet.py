"""Three harmonic coordinates of the body, and the sheet: a regular grid in these coordinates.

Layers of the sheet may be spaced evenly or by volume.
"""

import numpy as np
from lapy import TriaMesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.geometry.fem import Laplace, bare_mesh
from hipsta_bids.geometry.measures import labels_at
from hipsta_bids.geometry.mesh import cross, tetra_volumes
from hipsta_bids.protocols import rows_beyond
from hipsta_bids.settings import SheetSettings
from hipsta_bids.types import Bool, Coordinates, Finding, Float, Sheet, TetMesh

_CANDIDATES = 24
"""A point lies in one of so many tetrahedra, those whose middles are nearest."""

#: Lines of equal x and y of the mid-surface on which x is solved for.
X_LINES, Y_LINES = 81, 41
#: The outermost lines are sampled here and extended to the edge, where rounding would choose among
#: the tetrahedra.
X_OUTERMOST = 0.99
#: Spikes of an edge that are narrower than this do not count, mm; nor do notches.
SPIKE, NOTCH = 2.5, 8.0
#: Notches are filled with columns within this distance of the edge, mm, or so many depths.
FILL_REACH, FILL_DEPTHS = 4.0, 2.5
#: Notches that are deeper have no columns, mm.
DEEPEST = 1.6


def sample_sheet(mesh: TetMesh, coordinates: Coordinates, settings: SheetSettings) -> Sheet:
    """Find the points of the body that have the grid's coordinates.

    Each tetrahedron is also one in coordinate space; a grid node inside it has the same
    barycentric coordinates in the body.
    """
    axes = sheet_levels(settings)
    points = _invert(mesh, coordinates.values, axes)
    missing = np.asarray(~np.isfinite(points).all(axis=(2, 3)))
    share = float(missing.mean())
    if share > settings.max_filled:
        raise GeometryError(
            f"{share:.0%} of the sheet's columns lie in no tetrahedron: the coordinates fold; "
            "check the labels near the end planes",
            reason="sheet-incomplete",
        )
    return Sheet(points=_evenly(fill_points(points)), valid=~missing)


def sheet_levels(settings: SheetSettings, region: str = "body") -> tuple[Float, Float, Float]:
    """Coordinates of the grid's nodes along x, y and z.

    The rows of the body are as without the rest. Where the region has a head, as many again, less
    one, lie before them, and with a tail half as many behind them.
    """
    tail, head = rows_beyond(region, settings.y_nodes)
    extent, step = settings.y_extent, 2 * settings.y_extent / (settings.y_nodes - 1)
    rows = tail + settings.y_nodes + head
    return (
        np.linspace(-settings.x_extent, settings.x_extent, settings.x_nodes),
        np.linspace(-extent - tail * step, extent + head * step, rows),
        np.linspace(-settings.z_extent, settings.z_extent, settings.z_nodes),
    )


def whole_body(settings: SheetSettings) -> SheetSettings:
    """Describe the grid from medial to lateral edge, end to end and wall to wall.

    Columns on the edges themselves have no thickness, but lengths and areas need them.
    """
    # Within the strips x is 1 but for rounding, which would choose among their tetrahedra.
    whole = {"x_extent": 0.9999, "y_extent": 1.0, "z_extent": 1.0}
    return settings.changed(**whole, z_nodes=5, max_filled=1.0)


def folded_fraction(mesh: TetMesh, coordinates: Coordinates) -> float:
    """Fraction of the body's volume in which the coordinates' orientation is not the usual one."""
    volume = tetra_volumes(mesh.vertices, mesh.tetrahedra)
    inner = tetra_volumes(coordinates.values, mesh.tetrahedra)
    sign = np.sign((volume * inner).sum())
    return float(volume[inner * sign < 0].sum() / volume.sum())


def is_left_handed(points: Float) -> bool:
    """Whether x cross y points from exterior to interior on most of a sheet (Nx, Ny, Nz, 3).

    The two hemispheres are mirror images, so that one of them always is.
    """
    middle = points[:, :, points.shape[2] // 2]
    along_x = middle[1:, :-1] - middle[:-1, :-1]
    along_y = middle[:-1, 1:] - middle[:-1, :-1]
    outward = (points[:, :, -1] - points[:, :, 0])[:-1, :-1]
    volume = np.einsum("ijk,ijk->ij", np.cross(along_x, along_y), outward)
    return bool(np.nansum(volume) < 0)


def is_flipped(sheet: Sheet, hemi: str) -> bool:
    """Whether interior and exterior of a sheet are exchanged for its hemisphere.

    The interior side of the cortex is the one that continues the interior side of the hippocampus:
    its outer (pial) surface. Bending does not decide, since the cortex bends round its white matter
    and the hippocampus round the dentate gyrus. But medial to lateral, posterior to anterior and
    interior to exterior are a right-handed system on the left and a left-handed one on the right,
    all along the sheet and however it bends.
    """
    return is_left_handed(sheet.points) == (hemi == "L")


def check_flipped(sheet: Sheet, hemi: str) -> Finding:
    """Flag a sheet whose interior side, by labels, does not fit its hemisphere."""
    return Finding(
        reason="side-doubtful",
        value=float(is_flipped(sheet, hemi)),
        limit=0,
        text="the labels of the dentate gyrus lie on the exterior side of the sheet",
        remedy="look at the map",
        share=1.0,
        change=0.0,
    )


def label_sheet(sheet: Sheet, body: Body) -> NDArray[np.uint8]:
    """Subfield of each column, (Nx, Ny): the most frequent of the labels along it."""
    labels = labels_at(sheet.points.reshape(-1, 3), body).reshape(sheet.points.shape[:3])
    kinds = np.unique(labels)
    votes = np.stack([(labels == kind).sum(axis=2) for kind in kinds], axis=-1)
    return np.asarray(kinds[votes.argmax(axis=-1)], dtype=np.uint8)


def _evenly(points: Float) -> Float:
    """Space the points of each column evenly between its ends.

    Where the sheet bends, z = 0 lies towards the interior of the middle: half way between two
    cylinders, a harmonic function is zero at the geometric mean of their radii.
    """
    count = points.shape[2]
    steps = np.linalg.norm(np.diff(points, axis=2), axis=3)
    depth = np.concatenate([np.zeros((*steps.shape[:2], 1)), steps.cumsum(axis=2)], axis=2)
    targets = depth[..., -1:] * np.linspace(0, 1, count)
    below = (depth[..., None, :-1] <= targets[..., 1:-1, None]).sum(axis=-1) - 1
    first = np.take_along_axis(depth, below, axis=2)
    share = (targets[..., 1:-1] - first) / np.take_along_axis(steps, below, axis=2)
    start = np.take_along_axis(points, below[..., None], axis=2)
    end = np.take_along_axis(points, below[..., None] + 1, axis=2)
    inner = start + share[..., None] * (end - start)
    return np.concatenate([points[:, :, :1], inner, points[:, :, -1:]], axis=2)


def _invert(mesh: TetMesh, values: Float, axes: tuple[Float, Float, Float]) -> Float:
    """(Nx, Ny, Nz, 3) points with the grid's coordinates; NaN where no tetrahedron has them."""
    shape = tuple(len(axis) for axis in axes)
    first = np.array([axis[0] for axis in axes])
    step = np.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in axes])
    nodes = (values - first) / step
    corners = nodes.take(mesh.tetrahedra.T, axis=0)
    slack = 1e-6  # nodes on the outer faces must not fall out by rounding
    low = np.maximum(np.ceil(corners.min(axis=0) - slack), 0).astype(int)
    high = np.minimum(np.floor(corners.max(axis=0) + slack), np.array(shape) - 1).astype(int)
    count = np.maximum(high - low + 1, 0)
    number = count[:, 0] * count[:, 1] * count[:, 2]
    hits = np.flatnonzero(number)
    number = number[hits]
    cell = np.repeat(hits, number)
    rank = np.arange(len(cell)) - np.repeat(np.cumsum(number) - number, number)
    node = np.column_stack(
        [
            rank // (count[cell, 1] * count[cell, 2]),
            rank // count[cell, 2] % count[cell, 1],
            rank % count[cell, 2],
        ]
    )
    node += low[cell]
    weights, regular = _barycentric(corners.take(cell, axis=1), node.astype(float))
    worst = np.where(regular, weights.min(axis=0), -np.inf)
    flat = np.ravel_multi_index(tuple(node.T), shape)
    inside = worst > -1e-3  # noqa: PLR2004 -- a thousandth of a tetrahedron bridges rounding gaps
    # Where folds make two tetrahedra claim a node, the one that holds it most centrally wins.
    order = np.lexsort((worst[inside], flat[inside]))
    winner = np.flatnonzero(inside)[order]
    owner = flat[winner]
    last = np.append(owner[1:] != owner[:-1], True)
    winner, owner = winner[last], owner[last]
    points = np.full((int(np.prod(shape)), 3), np.nan)
    around = mesh.vertices[mesh.tetrahedra[cell[winner]]]
    points[owner] = np.einsum("in,nid->nd", weights[:, winner], around)
    return points.reshape(*shape, 3)


def _barycentric(corners: Float, points: Float) -> tuple[Float, Bool]:
    """Weights (4, N) of corners (4, N, 3), and whether the tetrahedron is not flat."""
    a, b, c = corners[1:] - corners[0]
    faces = np.stack([cross(b, c), cross(c, a), cross(a, b)])
    det = np.einsum("ij,ij->i", a, faces[0])
    regular = np.abs(det) > 1e-12  # noqa: PLR2004 -- grid steps cubed
    weights = np.empty((4, len(points)))
    weights[1:] = np.einsum("ij,kij->ki", points - corners[0], faces) / np.where(regular, det, 1.0)
    weights[0] = 1 - weights[1:].sum(axis=0)
    return weights, regular


def coordinates_at(mesh: TetMesh, coordinates: Coordinates, points: Float) -> Float:
    """Coordinates (N, 3) of points (N, 3), RAS mm; NaN outside of the mesh."""
    corners = mesh.vertices.take(mesh.tetrahedra.T, axis=0)
    near = np.asarray(cKDTree(corners.mean(axis=0)).query(points, k=_CANDIDATES)[1])
    weights, regular = _barycentric(
        corners.take(near.ravel(), axis=1), points.repeat(_CANDIDATES, axis=0)
    )
    worst = np.where(regular, weights.min(axis=0), -np.inf).reshape(near.shape)
    best = np.arange(len(points)), worst.argmax(axis=1)
    weights = weights.reshape(4, *near.shape)[:, *best]
    values = coordinates.values[mesh.tetrahedra[near[best]]]
    inner: Float = np.einsum("in,nik->nk", weights, values)
    return np.where((worst[best] > -1e-3)[:, None], inner, np.nan)  # noqa: PLR2004 -- rounding


def fill_points(points: Float) -> Float:
    """Replace missing points by normalized averages of their neighbors in the same z level."""
    missing = np.asarray(~np.isfinite(points).all(axis=-1))
    if not missing.any():
        return points
    filled = (~missing).astype(float)
    values = np.where(missing[..., None], 0.0, points)
    sigma = (1.0, 1.0, 0.0)
    while missing.any():
        weight = ndimage.gaussian_filter(filled, sigma, truncate=4.0)
        mean = ndimage.gaussian_filter(values, (*sigma, 0.0), truncate=4.0)
        reach = missing & (weight > 1e-4)  # noqa: PLR2004 -- some neighbor within the kernel
        if not reach.any():
            break
        values[reach] = mean[reach] / weight[reach][:, None]
        filled[reach] = 1.0
        missing &= ~reach
    return np.where(missing[..., None], np.nan, values)


def solve_coordinates(laplace: Laplace, boundaries: Boundaries) -> Coordinates:
    """Solve Laplace's equation between each pair of opposite boundaries.

    Each function is -1 on the first boundary (medial, posterior, interior), 1 on the second, and
    has no flux through the rest of the surface (Diers et al. 2023, section 2.1.4).
    """
    values = (
        laplace.between(boundaries.medial, boundaries.lateral),
        laplace.between(boundaries.posterior, boundaries.anterior),
        laplace.between(boundaries.interior, boundaries.exterior),
    )
    return Coordinates(values=np.column_stack(values))


def between_planes(mesh: TetMesh, coordinates: Coordinates, ends: EndPlanes) -> Coordinates:
    """Scale y so that the mid-surface reaches from plane to plane between y = -1 and 1.

    The mesh extends beyond the planes. Lines of equal y follow the harmonic function there,
    at right angles to the walls, however obliquely a plane cuts them.
    """
    x, y = np.linspace(-0.98, 0.98, 41), np.linspace(-0.998, 0.998, 121)
    middle = middle_surface(mesh, coordinates, x, y)
    limits = []
    for height in (ends.height(middle, "posterior"), ends.height(middle, "anterior")):
        rising = np.maximum.accumulate(np.nan_to_num(height, nan=-np.inf), axis=1)
        limits.append([np.interp(0.0, row, y) for row in rising])
    values = coordinates.values.copy()
    low, high = (np.interp(values[:, 0], x, limit) for limit in limits)
    values[:, 1] = 2 * (values[:, 1] - low) / (high - low) - 1
    return Coordinates(values=values)


def middle_surface(mesh: TetMesh, coordinates: Coordinates, x: Float, y: Float) -> Float:
    """Points (Nx, Ny, 3) of the mid-surface at coordinates, RAS mm."""
    # No point has z of 2: only the level in the middle is sought.
    levels = _invert(mesh, coordinates.values, (x, y, np.array([-2.0, 0.0, 2.0])))
    return fill_points(levels[:, :, 1:2])[:, :, 0]


def straighten_rows(mesh: TetMesh, coordinates: Coordinates, solver: str) -> Coordinates:
    """Make x harmonic on the mid-surface, between its medial and lateral edge without notches.

    In a thin sheet the volume's harmonic x obeys div(t grad x) = 0 on the mid-surface, t its
    thickness: steps of x are short where the sheet is thin, so that a thin place moves columns of
    whole rows. The new x is a rising function of that one along each row: columns are numbered
    anew, and none of them moves. Columns at a notch are squeezed; the others keep their number.
    """
    x, y = np.linspace(-X_OUTERMOST, X_OUTERMOST, X_LINES), np.linspace(-0.998, 0.998, Y_LINES)
    middle = middle_surface(mesh, coordinates, x, y)
    for axis, lines in enumerate((x, y)):
        ends = np.moveaxis(middle, axis, 0)
        beyond = (lines[0] + 1) / (lines[1] - lines[0])
        ends[[0, -1]] += beyond * (ends[[0, -1]] - ends[[1, -2]])
        lines[[0, -1]] = -1, 1
    values = coordinates.values.copy()
    position = [
        np.interp(values[:, k], axis, np.arange(axis.size)) for k, axis in enumerate((x, y))
    ]
    values[:, 0] = ndimage.map_coordinates(_even_levels(middle, solver), position, order=1)
    return Coordinates(values=values)


def _even_levels(middle: Float, solver: str) -> Float:
    """Values (Nx, Ny) of the new x at points (Nx, Ny, 3) of the mid-surface, RAS mm."""
    number = np.arange(middle[..., 0].size, dtype=np.int32).reshape(middle.shape[:2])
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=-2)
    laplace = Laplace(bare_mesh(TriaMesh, middle.reshape(-1, 3), triangles.reshape(-1, 3)), solver)
    steps = np.diff(middle, axis=0)
    # Each triangle has one side along a row: the first half the lower one, the second the upper.
    along = np.stack([steps[:, :-1], steps[:, 1:]], axis=-2).reshape(-1, 3)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = laplace.integrate(along).reshape(number.shape)  # mm
    edges, depths = [], []
    for row, sign in ((0, -1.0), (-1, 1.0)):
        edge = sign * across[row]
        steps_y = np.linalg.norm(np.diff(middle[row], axis=0), axis=1)
        position = np.concatenate([[0.0], steps_y.cumsum()])
        closed = hull(-hull(-edge, position, SPIKE), position, NOTCH)
        edges.append(closed)
        depths.append(closed - edge)
    scale = 2 / float(np.median(edges[0] + edges[1]))
    fixed = np.concatenate([number[0], number[-1]])
    limits = np.concatenate([scale * depths[0] - 1, 1 - scale * depths[1]])
    levels = laplace.solve(fixed, limits).reshape(number.shape)
    for row, sign, depth in ((0, -1.0, depths[0]), (-1, 1.0, depths[1])):
        reach = np.maximum(FILL_REACH, FILL_DEPTHS * np.abs(depth))
        near = np.clip(1 - np.abs(across - across[row]) / reach, 0, 1)
        levels = levels + sign * scale * np.minimum(depth, DEEPEST) * near**2
    return np.asarray(np.maximum.accumulate(levels, axis=0))


def hull(values: Float, position: Float, width: float) -> Float:
    """Highest chord (N,) of a curve, over each of its points, of at most a width.

    ``position`` (N,) rises, in the unit of the width.
    """
    start, end = position[:, None, None], position[None, :, None]
    span = end - start
    share = np.where(span > 0, (position - start) / np.where(span > 0, span, 1.0), 0.0)
    chord = (1 - share) * values[:, None, None] + share * values[None, :, None]
    covers = (start <= position) & (position <= end) & (span <= width)
    return np.asarray(np.where(covers, chord, -np.inf).max(axis=(0, 1)))


def equal_volume_layers(sheet: Sheet) -> tuple[Sheet, Bool]:
    """Move the points along their columns so that the same volume lies between any two layers.

    The area of a column grows linearly between two layers, so the volume below a depth is a
    quadratic function of it, and inverted exactly.
    """
    area = _column_areas(sheet.points)
    folded = np.asarray(~(area > 0).all(axis=2))
    area = np.where(folded[..., None], 1.0, area)
    count = sheet.points.shape[2]
    volume = np.zeros_like(area)
    volume[:, :, 1:] = (0.5 * (area[:, :, 1:] + area[:, :, :-1])).cumsum(axis=2)
    targets = volume[:, :, -1:] * np.linspace(0, 1, count)[1:-1]
    below = (volume[:, :, None, 1:-1] <= targets[..., None]).sum(axis=-1)
    lower = np.take_along_axis(area, below, axis=2)
    growth = np.take_along_axis(area, below + 1, axis=2) - lower
    excess = targets - np.take_along_axis(volume, below, axis=2)
    share = 2 * excess / (lower + np.sqrt(np.maximum(lower**2 + 2 * growth * excess, 0)))
    start = np.take_along_axis(sheet.points, below[..., None], axis=2)
    end = np.take_along_axis(sheet.points, below[..., None] + 1, axis=2)
    points = sheet.points.copy()
    points[:, :, 1:-1] = start + share[..., None] * (end - start)
    points[folded] = sheet.points[folded]
    return Sheet(points=points, valid=sheet.valid), folded


def check_layers(folded: Bool, sheet: Sheet) -> Finding:
    """Flag a sheet whose layers fold, so that some columns have no equal-volume depths."""
    first = np.argwhere(folded)[:1] + 1
    return Finding(
        reason="layers-fold",
        value=float(np.count_nonzero(folded)),
        limit=0,
        text=f"layers fold in {folded.sum()} of {folded.size} columns"
        + "".join(f", the first at x {x}, y {y}" for x, y in first)
        + ", their layers are at equal distances instead",
        remedy="set sheet.depths to distance, or exclude these points",
        points=sheet.points[folded][:, sheet.middle],
        placed=True,
    )


def layer_depth(layers: Sheet) -> Float:
    """Distance of each point from the interior wall along its column, (Nx, Ny, Nz), mm."""
    steps = np.linalg.norm(np.diff(layers.points, axis=2), axis=3)
    return np.concatenate([np.zeros((*steps.shape[:2], 1)), steps.cumsum(axis=2)], axis=2)


def _column_areas(points: Float) -> Float:
    """Area of each layer per column, (Nx, Ny, Nz), mm2; negative where the layer is flipped."""
    along_x, along_y = np.gradient(points, axis=(0, 1))
    across = points[:, :, -1:] - points[:, :, :1]
    area = (np.cross(along_x, along_y) * across).sum(axis=-1)
    area /= np.linalg.norm(across, axis=-1)
    return np.asarray(area * np.sign(np.nansum(area)))
