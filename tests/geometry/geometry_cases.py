"""Small bodies, meshes and fields with known answers, shared by the tests of the geometry."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from grids import straight_grid
from scipy import ndimage

from hipsta_bids.geometry.body import Body, extract_body
from hipsta_bids.geometry.boundaries import Boundaries, find_boundaries
from hipsta_bids.geometry.ends import EndPlane, EndPlanes
from hipsta_bids.geometry.fem import Laplace, volume_laplace
from hipsta_bids.geometry.grid import Field, resample_body
from hipsta_bids.geometry.mesh import extract_surface, tetrahedralize
from hipsta_bids.geometry.sheet import sample_sheet, solve_coordinates
from hipsta_bids.geometry.topology import SolidField, repair_topology
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Coordinates, LabelVolume, Sheet, Surface, TetMesh


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """One phantom, what is known of it, and every stage's result."""

    phantom: Phantom
    volume: LabelVolume
    body: Body
    field: Field
    solid: SolidField
    surface: Surface
    mesh: TetMesh
    laplace: Laplace
    boundaries: Boundaries
    coordinates: Coordinates
    sheet: Sheet


#: Stages are tested on meshes whose caps lie in the end planes.
UP_TO_THE_PLANES = Settings().changed(grid={"beyond": 0.0})


def solve_case(phantom, *, protocol="freesurfer", settings=None, **drawing):
    """Run the stages of the participant level one after the other."""
    chosen = settings or UP_TO_THE_PLANES
    volume = phantom.label_volume(load_protocol(protocol), **drawing)
    body = extract_body(volume, chosen.body)
    field = resampled(body, chosen, drawing.get("hemi", "L"))
    solid = solid_of(field, chosen.topology)
    surface = extract_surface(solid.field, chosen.surface)
    mesh = tetrahedralize(surface, chosen.tetra, field.grid.frame)
    laplace = volume_laplace(mesh)
    boundaries = find_boundaries(surface, laplace, body, chosen.boundaries)
    coordinates = solve_coordinates(laplace, boundaries)
    return Case(
        phantom=phantom,
        volume=volume,
        body=body,
        field=field,
        solid=solid,
        surface=surface,
        mesh=mesh,
        laplace=laplace,
        boundaries=boundaries,
        coordinates=coordinates,
        sheet=sample_sheet(mesh, coordinates, chosen.sheet),
    )


def resampled(body, settings=None, hemi="L"):
    """The body's field with the settings of this stage."""
    chosen = settings or UP_TO_THE_PLANES
    return resample_body(body, hemi, chosen.grid, chosen.slices)


def short_phantom(**changes):
    """An 8 mm long phantom: everything at half the work."""
    spec = {"kind": "arc", "length": 8.0, "width": 12.0, "curvature": (0.2, 0.2)} | changes
    return Phantom(PhantomSpec(**spec))


def rotation(axis, degrees):
    """(3, 3) rotation about one of the three axes."""
    angle = np.radians(degrees)
    first, second = (k for k in range(3) if k != axis)
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second], matrix[second, first] = -np.sin(angle), np.sin(angle)
    return matrix


def rigid(degrees=(20.0, -35.0, 50.0), shift=(11.0, -7.0, 4.0)):
    """(4, 4) rigid motion."""
    pose = np.eye(4)
    for axis, angle in enumerate(degrees):
        pose[:3, :3] = rotation(axis, angle) @ pose[:3, :3]
    pose[:3, 3] = shift
    return pose


def solid_of(field, settings):
    """The field with its topology repaired; no subfield is named, and no turns touch."""
    return repair_topology(field, settings, lambda _: "", lambda _: False)


def straight_ends(length, *, tilt=0.0):
    """End planes of a body along +z from 0 to ``length`` mm; the anterior one may be tilted."""
    normal = rotation(1, tilt) @ [0.0, 0.0, 1.0]
    middle = normal + np.array([0.0, 0.0, 1.0])
    return EndPlanes(
        posterior=EndPlane(np.zeros(3), np.array([0.0, 0.0, 1.0]), "labels"),
        anterior=EndPlane(np.array([0.0, 0.0, length]), normal, "labels"),
        axis=middle / np.linalg.norm(middle),
        half_slice=0.0,
    )


def field_of(mask, *, sigma=0.8, spacing=0.5):
    """Smooth a mask as the resampling does; small sigma keeps details of a node or two."""
    smooth = ndimage.gaussian_filter(
        mask.astype(np.float32), sigma, mode=("constant", "constant", "nearest"), truncate=3.0
    )
    return Field(grid=straight_grid(mask.shape, spacing), values=(smooth - 0.5).astype(np.float32))


def ribbon_mask(shape=(42, 42, 30), *, radius=12.0, half=2.5, opening=100.0):
    """A C in each slice: arms of ``2 half`` nodes round the middle, open towards +a."""
    a, b, _ = np.indices(shape)
    x, y = a - (shape[0] - 1) / 2, b - (shape[1] - 1) / 2
    ring = np.abs(np.hypot(x, y) - radius) <= half
    return ring & (np.abs(np.degrees(np.arctan2(y, x))) > opening / 2)


def box_mesh(cells, size=(1.0, 1.0, 1.0)):
    """A box cut into cubes and each cube into six tetrahedra (Kuhn's division)."""
    axes = [np.linspace(0.0, length, n + 1) for n, length in zip(cells, size, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape([n + 1 for n in cells])
    corner = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 3)
    tetrahedra = []
    for order in permutations(range(3)):
        path = [corner]
        for axis in order:
            path.append(path[-1] + np.eye(3, dtype=int)[axis])
        cell = np.stack([number[tuple(p.T)] for p in path], axis=1)
        odd = np.linalg.det(np.eye(3)[list(order)]) < 0
        tetrahedra.append(cell[:, [0, 2, 1, 3]] if odd else cell)
    return TetMesh(vertices=points, tetrahedra=np.vstack(tetrahedra))


def cylinder(radius, edge, length=8.0, *, outward=True):
    """An open cylinder of nearly regular triangles."""
    around = round(2 * np.pi * radius / edge)
    rows = round(length / (edge * np.sqrt(0.75))) + 1
    angle = (np.arange(around) + 0.5 * (np.arange(rows)[:, None] % 2)) * 2 * np.pi / around
    height = np.broadcast_to(np.linspace(0, length, rows)[:, None], angle.shape)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    number = np.arange(rows * around).reshape(rows, around)
    a, b = number[:-1], np.roll(number, -1, axis=1)[:-1]
    c, d = number[1:], np.roll(number, -1, axis=1)[1:]
    even = np.arange(rows - 1)[:, None] % 2 == 0
    first = np.stack([a, b, np.where(even, c, d)], axis=-1).reshape(-1, 3)
    second = np.stack([np.where(even, b, a), d, c], axis=-1).reshape(-1, 3)
    triangles = np.vstack([first, second])
    return points.reshape(-1, 3), triangles if outward else triangles[:, ::-1]


def plain_body(tissue, affine, ends):
    """A body straight from an array of sheet tissue, all of it between the end planes."""
    return Body(
        tissue=tissue.astype(np.uint8),
        hippocampal=tissue.astype(np.uint8),
        region="body",
        interior=np.zeros(tissue.shape, dtype=bool),
        affine=affine,
        ends=ends,
        layer_voxels=0,
        inside=tissue > 0,
    )


def degrees_between(first, second):
    """Angle of two unit vectors, degrees."""
    return float(np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0))))
