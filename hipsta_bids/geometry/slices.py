"""Between thick slices: the shape of each slice is moved into the next one.

Where slices are much thicker than their pixels, the ribbon moves sideways by its thickness from
one slice to the next, and blending slices in place would break it. Each slice becomes a signed
distance from its outline (``outlines``); the ribbons of neighboring slices are aligned
(``ribbon``), or registered where one is none, and the shapes between them are blends of both, moved
along. Where head or tail labels hide how the sheet continues, its shapes are extrapolated from
inside. Turns of the ribbon that touch are kept apart. Where the shares of voxels are known,
outlines are corrected by what the shapes, averaged through each slice, differ from them.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.geometry import digital, outlines, ribbon
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.outlines import Stack
from hipsta_bids.geometry.shares import SOFT_WINDOW, softness
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END
from hipsta_bids.settings import SliceSettings
from hipsta_bids.types import Bool, Float

#: Half width of the ramp across the outline, mm.
RAMP_HALF_WIDTH = 0.2
#: Paths of the ribbon's nodes through the slices: from 0 (through their places in the slices) to
#: 1 (cubic B-splines with these as control points: half the variance of noise is left).
PATH_SMOOTHING = 1.0
#: Standard deviation of the window of the registration of slices, mm.
FLOW_WINDOW = 1.0
#: Added to the mean squared slope in a window, which is 1 where outlines fill it: keeps
#: displacements small where the outlines do not show them.
FLOW_RIDGE = 0.02
#: Standard deviation of the Gaussian on displacements after each iteration, mm.
FLOW_SMOOTHING = 0.5
#: Iterations of the registration per level.
FLOW_ITERATIONS = 5
#: What lies less deep than this inside an end plane is taken from inside, where the sheet's
#: labels end at the plane, mm.
HIDDEN_DEPTH = 0.1
#: At such ends, and beyond the last slice, shapes go on changing at this fraction of their pace.
EXTRAPOLATION = 0.5
#: Shapes are compared with shares up to this distance from the outlines, mm: three fourths of the
#: reach of distances.
FIT_REACH = 1.5
#: Levels in each slice at which shapes are compared with its shares.
FIT_LEVELS = 5
#: Shares are compared with the shapes in a Gaussian window of this SD, mm: a voxel of usual slices.
FIT_WINDOW = 0.4
#: Added to the share of the levels at which the wall crosses a voxel.
FIT_RIDGE = 0.1

_LEVELS = (2, 1)
"""Sizes of pixels in the registration, from coarse to those of the segmentation."""


def register_slices(images: Stack, pixel: float, settings: SliceSettings) -> Stack:
    """Register each outline (N, I, J), mm, to the next; fine pixels, (2, N - 1, I', J').

    Lucas & Kanade 1981, IJCAI:674-679, with a Gaussian window, from coarse to fine, all slices at
    once, on the pixels of the segmentation (``pixel``, mm). Displacements are defined halfway
    between both slices, so that no direction is preferred.
    """
    flow = np.zeros((2, len(images) - 1, 1, 1), dtype=np.float32)
    for level in _LEVELS:
        small = _shrunk(images, settings.upsampling * level)
        flow = _doubled(flow, small.shape[1:])
        for _ in range(FLOW_ITERATIONS):
            flow = _improved(small, flow, pixel * level)
    return np.asarray(settings.upsampling * flow, dtype=np.float32)


def _improved(images: Stack, flow: Stack, pixel: float) -> Stack:
    """Take one step of Gauss and Newton in a window around each pixel."""
    first, second = _moved(images[:-1], -0.5 * flow), _moved(images[1:], 0.5 * flow)
    slope_i, slope_j = np.gradient((0.5 / pixel) * (first + second), axis=(1, 2))
    error = (first - second) / pixel
    window = (FLOW_WINDOW / pixel,) * 2
    ii, ij, jj, ei, ej = (
        ndimage.gaussian_filter(product, (0, *window), truncate=2.5)
        for product in (
            slope_i * slope_i,
            slope_i * slope_j,
            slope_j * slope_j,
            slope_i * error,
            slope_j * error,
        )
    )
    # Along a straight edge only the shift across it is known; the ridge chooses the shortest.
    ii, jj = ii + FLOW_RIDGE, jj + FLOW_RIDGE
    det = ii * jj - ij * ij
    step = np.stack([(jj * ei - ij * ej) / det, (ii * ej - ij * ei) / det])
    width = FLOW_SMOOTHING / pixel
    return np.asarray(ndimage.gaussian_filter(flow + step, (0, 0, width, width)), dtype=np.float32)


def _moved(images: Stack, by: Stack) -> Stack:
    grid = np.indices(images.shape, dtype=np.float32)
    grid[1:] += by
    return _interpolated(images, *grid)


def _interpolated(images: Stack, number: Stack, row: Stack, column: Stack) -> Stack:
    """Interpolate linearly in images with these numbers, with the border's values beyond it.

    In one tall image of all: there are four pixels round a place, but eight in a stack.
    """
    height, width = images.shape[1:]
    row = np.clip(row, 0, height - 1) + number.astype(np.float64) * height
    return np.asarray(
        ndimage.map_coordinates(
            images.reshape(-1, width), [row, column], order=1, mode="nearest", output=np.float32
        )
    )


def _shrunk(images: Stack, factor: int) -> Stack:
    """Means over blocks of pixels; the border is repeated to whole blocks."""
    pad = [(0, -n % factor) for n in images.shape[1:]]
    whole = np.pad(images, [(0, 0), *pad], mode="edge")
    count, rows, columns = whole.shape
    blocks = whole.reshape(count, rows // factor, factor, columns // factor, factor)
    return np.asarray(blocks.mean(axis=(2, 4)), dtype=np.float32)


def _doubled(flow: Stack, shape: tuple[int, ...]) -> Stack:
    """Displacements at pixels of half the size, in these pixels."""
    images = flow.reshape(-1, *flow.shape[2:])
    at = (0.5 * np.arange(n, dtype=np.float32) - 0.25 for n in shape)
    grid = np.meshgrid(np.arange(len(images)), *at, indexing="ij")
    return 2 * _interpolated(images, *grid).reshape(*flow.shape[:2], *shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class _SliceStack:
    """Outlines of slices and the displacements from each to the next."""

    outlines: Stack
    """(N, I, J) signed distances at fine pixels, mm, positive inside; at least two slices."""
    ends: Stack
    """(2, N, I, J) signed distances of the medial and of the lateral subfields alone, mm."""
    flows: Stack
    """(2, N - 1, I', J') fine pixels from each slice to the next, halfway between them, at the
    pixels of the segmentation."""
    bends: Stack
    """(2, N, I', J') second differences of the places at which what moves through the slices meets
    the slice before, this one and the next, fine pixels; at the pixels of the segmentation."""
    settings: SliceSettings
    """Settings of the interpolation."""

    def blend(self, level: Stack, pixels: Stack) -> Stack:
        """Signed distance, mm, within the plane of the slices, from the outline at any level.

        Slits are excluded from pixels farther outside than the setting ``edge``.

        ``level`` (N,) counts slices, ``pixels`` (2, N) fine pixels.
        """
        last = len(self.outlines) - 1
        level = level + (EXTRAPOLATION - 1) * (level - np.clip(level, 0, last))
        below = np.clip(np.floor(level), 0, last - 1)
        share = level - below
        coarse = self.flows.shape[2] / self.outlines.shape[1]
        pixels = pixels - self._departure(below, share, (pixels + 0.5) * coarse - 0.5)
        step = np.zeros_like(pixels)
        # The flow is known halfway between the slices: find the point there that moves to here.
        for _ in range(3):
            middle = (pixels - (share - 0.5) * step + 0.5) * coarse - 0.5
            step = np.stack([_interpolated(part, below, *middle) for part in self.flows])
        middle = pixels - (share - 0.5) * step
        first, second = middle - 0.5 * step, middle + 0.5 * step

        def mixed(images: Stack, at: Bool) -> Stack:
            before = _interpolated(images, below[at], *first[:, at])
            after = _interpolated(images, below[at] + 1, *second[:, at])
            return np.asarray((1 - share[at]) * before + share[at] * after, dtype=np.float32)

        distance = mixed(self.outlines, np.ones(len(level), dtype=bool))
        near = distance > -RAMP_HALF_WIDTH
        medial, lateral = (mixed(images, near) for images in self.ends)
        distance[near] = np.minimum(distance[near], outlines.keep_apart(medial, lateral))
        return distance

    def _departure(self, below: Stack, share: Stack, middle: Stack) -> Stack:
        """Departure of the paths through the slices from straight ones, fine pixels, (2, N).

        In the setting's proportion of cubic B-splines, whose control points are the places in the
        slices, and of cubic Hermite splines through these with central differences as slopes
        (Catmull & Rom 1974, Computer Aided Geometric Design:317-326), both written in second
        differences.
        """
        s = PATH_SMOOTHING
        departure = np.zeros_like(middle)
        share = np.clip(share, 0, 1)  # beyond the last slice
        for level, near in ((below, 1 - share), (below + 1, share)):
            weight = s * near**3 / 6 - (1 - s) * 0.5 * near**2 * (1 - near)
            departure += weight * np.stack([_interpolated(b, level, *middle) for b in self.bends])
        return departure


def points_of_ends(body: Body) -> tuple[Float, Float]:
    """Voxels (N, 3) of the medial and of the lateral end of the ribbon, RAS mm."""
    index, points = body.inside_points()
    tissue = body.tissue[tuple(index.T)]
    medial, lateral = (points[np.isin(tissue, kinds)] for kinds in (MEDIAL_END, LATERAL_END))
    return medial, lateral


def has_thick_slices(affine: Float, settings: SliceSettings) -> bool:
    """Whether the longest voxel edge is long enough for interpolation by shape."""
    edges = np.sort(np.linalg.norm(affine[:3, :3], axis=0))
    return bool(edges[2] > settings.min_ratio * edges[1])


def sample_slices(body: Body, points: Float, settings: SliceSettings) -> Stack:
    """Sample the body's mask between and beyond its thick slices, at points (N, 3), RAS mm."""
    body = _in_slice_order(body)
    pixel = float(np.linalg.norm(body.affine[:3, :3], axis=0)[1:].mean())
    labeled = _labeled_ends(body)
    part = _bounds(body, outlines.DISTANCE_REACH / pixel, labeled)
    tissue = body.tissue[part].copy()
    labeled_tissue = body.tissue[part]
    for step, depth, is_labeled in zip((1, -1), _depths(body, part), labeled, strict=True):
        if not is_labeled:
            _extrapolate(tissue[::step], (depth < HIDDEN_DEPTH)[::step], pixel, settings)
    share = None
    if body.soft:  # what was extrapolated has the labels' walls
        share = np.where(tissue == labeled_tissue, body.soft.values[part], np.float32(tissue > 0))
    stack = _stacked(tissue, pixel, settings, share)
    voxels = body.to_voxels(points) - digital.low_corner(part)
    pixels = ((voxels[:, 1:] + 0.5) * settings.upsampling - 0.5).astype(np.float32).T
    distance = stack.blend(voxels[:, 0].astype(np.float32), pixels)
    return np.asarray(np.clip(distance / (2 * RAMP_HALF_WIDTH) + 0.5, 0, 1), dtype=np.float32)


def _in_slice_order(body: Body) -> Body:
    """Count the body's slices from posterior to anterior, first, and voxels from medial to lateral.

    So the order in which an image stores its voxels decides nothing. What refers to voxels by their
    indices is left as it was.
    """
    index, _ = body.inside_points()
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    through = int(np.argmax(edges))
    towards = (body.lateral - body.lateral.mean()) @ (index - index.mean(axis=0)) * edges
    towards[through] = body.ends.axis @ body.affine[:3, through]
    first, second = sorted((n for n in range(3) if n != through), key=lambda n: -abs(towards[n]))
    order, steps = (through, first, second), np.where(towards < 0, -1, 1)
    flips = tuple(slice(None, None, steps[n]) for n in order)
    affine = body.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ np.where(steps < 0, np.array(body.tissue.shape) - 1, 0)
    affine[:3, :3] = (affine[:3, :3] * steps)[:, order]
    names = ("tissue", "hippocampal", "interior", "inside")
    volumes = {name: getattr(body, name).transpose(order)[flips] for name in names}
    if body.soft:
        volumes["soft"] = body.soft._replace(values=body.soft.values.transpose(order)[flips])
    return replace(body, **volumes, affine=affine)


def _part_ribbons(
    images: Stack, tissue: NDArray[np.uint8], fine: float, settings: SliceSettings
) -> list[Float | None]:
    """Part doubled outlines and turns of ribbons in place, and return the nodes of ribbons."""
    ribbons = []
    for outline, labels in zip(images, tissue, strict=True):
        rank = outlines.ranks_of(labels, settings.upsampling)
        outlines.drop_doubles(outline, rank)
        ribbons.append(nodes := ribbon.ribbon_nodes(outline, rank, fine))
        if nodes is not None:
            ribbon.keep_whole(outline, nodes, fine)
            ribbon.part_turns(outline, nodes, fine)
    return ribbons


def _stacked(
    tissue: NDArray[np.uint8], pixel: float, settings: SliceSettings, share: Stack | None = None
) -> _SliceStack:
    """Outline and align slices; a single one is taken twice."""
    if len(tissue) == 1:
        tissue = np.concatenate([tissue, tissue])
        share = None if share is None else np.concatenate([share, share])
    soft = None
    if share is not None:
        reach = SOFT_WINDOW / pixel
        soft = np.minimum(softness(share, np.array([0, reach, reach])), 1)
    images = np.stack(
        [
            outlines.outline_slice(
                image,
                pixel,
                settings,
                list(tissue[max(n - 1, 0) : n + 2]),
                None if share is None or soft is None else (share[n], soft[n]),
            )
            for n, image in enumerate(tissue)
        ]
    )
    ends = np.array(
        [
            [outlines.part_distance(image, end, pixel, settings) for image in tissue]
            for end in (MEDIAL_END, LATERAL_END)
        ]
    )
    fine = pixel / settings.upsampling
    plain = images
    images = np.minimum(images, outlines.keep_apart(ends[0], ends[1]))
    images = outlines.cut_rings(images, fine)
    ribbons = _part_ribbons(images, tissue, fine, settings)
    if any(nodes is None for nodes in ribbons):
        flows = register_slices(images, pixel, settings)
    else:
        flows = np.zeros((2, len(images) - 1, *tissue.shape[1:]), dtype=np.float32)
    bends = np.zeros((2, len(images), *flows.shape[2:]), dtype=np.float32)
    _align(flows, bends, ribbon.align_nodes(ribbons, fine), settings)
    stack = _SliceStack(outlines=images, ends=ends, flows=flows, bends=bends, settings=settings)
    if share is not None and soft is not None:
        is_plain = _shrunk((images == plain).astype(np.float32), settings.upsampling) == 1
        images += _misfit(stack, share, is_plain, pixel, soft)
    return stack


def _misfit(stack: _SliceStack, share: Stack, usable: Bool, pixel: float, soft: Stack) -> Stack:
    """Compute how far outside the outlines the shares of pixels (N, I, J) are, mm; fine pixels.

    The shapes between slices give each pixel a share as well, its mean through the slice. The shift
    is one step of Gauss and Newton, in a window round each pixel, on the pixels that are ``usable``
    (N, I, J): not cut, dropped or thickened. It is in proportion to ``soft`` (N, I, J).
    """
    up = stack.settings.upsampling
    near = usable & (np.abs(_shrunk(stack.outlines, up)) < FIT_REACH)
    pixels = np.argwhere(near).T.astype(np.float32)
    places = (pixels[1:] + 0.5) * up - 0.5
    error, slope = share * near, np.zeros_like(share)
    for level in (np.arange(FIT_LEVELS, dtype=np.float32) + 0.5) / FIT_LEVELS - 0.5:
        distance = stack.blend(pixels[0] + level, places) / pixel
        error[near] -= np.clip(distance + 0.5, 0, 1) / FIT_LEVELS
        slope[near] += np.maximum(1 - np.abs(distance), 0) / FIT_LEVELS
    window = (0, FIT_WINDOW / pixel, FIT_WINDOW / pixel)
    step = pixel * ndimage.gaussian_filter(error, window)
    step /= ndimage.gaussian_filter(slope, window) + FIT_RIDGE
    shift = soft * np.clip(step, -pixel, pixel)
    grid = np.indices(stack.outlines.shape, dtype=np.float32)
    return _interpolated(shift, grid[0], *((grid[1:] + 0.5) / up - 0.5))


def _align(
    flows: Stack, bends: Stack, ribbons: list[Float | None], settings: SliceSettings
) -> None:
    """Replace, in place, displacements between slices with nodes by those of the nodes."""
    up = settings.upsampling
    pixels = np.indices(flows.shape[2:]).reshape(2, -1).T.astype(np.float64)
    points = (pixels + 0.5) * up - 0.5
    for number, (first, second) in enumerate(pairwise(ribbons)):
        if first is not None and second is not None:
            moves = ribbon.moves_between(first, second, points)
            flows[:, number] = moves.T.reshape(flows[:, number].shape)
    for number in range(1, len(ribbons) - 1):
        before, current, after = ribbons[number - 1 : number + 2]
        if before is not None and current is not None and after is not None:
            half = 0.5 * (before - 2 * current + after)
            bend = ribbon.moves_between(current - half, current + half, points)
            bends[:, number] = bend.T.reshape(bends[:, number].shape)


def _labeled_ends(body: Body) -> tuple[bool, bool]:
    """Whether the sheet's labels go on beyond the first and beyond the last slice of the body."""
    points = digital.voxel_points(body.tissue > 0, body.affine)
    thickness = float(np.linalg.norm(body.affine[:3, 0]))
    are_labeled = []
    for depth in body.ends.depths(points):
        inner = np.count_nonzero((depth > 0) & (depth < thickness))
        outer = np.count_nonzero((depth < 0) & (depth > -thickness))
        are_labeled.append(
            bool(outer > 0.5 * inner)
        )  # a label that is only blurred at the plane is less
    return are_labeled[0], are_labeled[1]


def _bounds(body: Body, margin: float, labeled: tuple[bool, bool]) -> digital.Box:
    """Box round the sheet in the body's slices, and in one slice more where labels go on."""
    levels = np.flatnonzero(body.inside.any(axis=(1, 2)))
    first = max(int(levels[0]) - labeled[0], 0)
    last = int(levels[-1]) + labeled[1]
    index = digital.positions(body.tissue[first : last + 1] > 0) + np.array([first, 0, 0])
    room = np.ceil([0, margin, margin]).astype(int)
    low, high = index.min(axis=0) - room, index.max(axis=0) + 1 + room
    return digital.box(np.maximum(low, 0), np.minimum(high, body.inside.shape))


def _depths(body: Body, part: digital.Box) -> tuple[Float, Float]:
    """Depths of the box's voxels inside the planes at its first and last slices, mm."""
    index = np.meshgrid(*(np.arange(side.start, side.stop) for side in part), indexing="ij")
    points = digital.to_ras(np.stack(index, axis=-1), body.affine)
    return body.ends.depths(points)


def _extrapolate(
    tissue: NDArray[np.uint8], hidden: Bool, pixel: float, settings: SliceSettings
) -> None:
    """Extrapolate, in place, what end labels hide of oblique first slices.

    Left empty, the hidden part would thin the sheet up to a slice's thickness inside the plane.
    """
    cut = np.flatnonzero((hidden[:-2] & (tissue[1:-1] > 0)).any(axis=(1, 2)))
    up = settings.upsampling
    pixels = np.indices(tissue.shape[1:], dtype=np.float32).reshape(2, -1) * up + 0.5 * (up - 1)
    level = np.full(pixels.shape[1], -1.0, dtype=np.float32)
    for number in range(int(cut.max(initial=-1)), -1, -1):
        stack = _stacked(tissue[number + 1 : number + 3], pixel, settings)
        expected = stack.blend(level, pixels).reshape(tissue.shape[1:]) > 0
        inner = tissue[number + 1]
        nearest = ndimage.distance_transform_edt(
            inner == 0, return_distances=False, return_indices=True
        )
        filled = np.where(expected, inner[tuple(nearest)], 0)
        tissue[number] = np.where(hidden[number], filled, tissue[number])
