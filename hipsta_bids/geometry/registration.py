"""The way from each slice to the next."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.settings import SliceSettings

Stack = NDArray[np.float32]

_LEVELS = (2, 1)  # sizes of pixels, those of the segmentation last


def register_slices(outlines: Stack, pixel: float, settings: SliceSettings) -> Stack:
    """Register each slice to the next, both sides alike.

    Parameters
    ----------
    outlines : (N, I, J) array of float32
        Signed distances at fine pixels, mm.
    pixel : float
        Edge of a pixel of the segmentation, ``upsampling`` times that of a fine one, mm. The
        registration works with them: fine ones would cost much and tell no more.
    settings : SliceSettings

    Returns
    -------
    (2, N - 1, I / upsampling, J / upsampling) array of float32
        Displacement u in fine pixels with first(x - u / 2) = second(x + u / 2).

    Notes
    -----
    Lucas & Kanade 1981, IJCAI:674-679, with a Gaussian window, from coarse to fine, all slices
    at once. Halfway between both slices, no direction is preferred, and one displacement serves
    both.
    """
    flow = np.zeros((2, len(outlines) - 1, 1, 1), dtype=np.float32)
    for level in _LEVELS:
        small = _shrunk(outlines, settings.upsampling * level)
        flow = _doubled(flow, small.shape[1:])
        for _ in range(settings.flow_iterations):
            flow = _improved(small, flow, pixel * level, settings)
    return np.asarray(settings.upsampling * flow, dtype=np.float32)


def _improved(images: Stack, flow: Stack, pixel: float, settings: SliceSettings) -> Stack:
    """One step of Gauss and Newton in a window around each pixel."""
    first, second = _moved(images[:-1], -0.5 * flow), _moved(images[1:], 0.5 * flow)
    slope_i, slope_j = np.gradient((0.5 / pixel) * (first + second), axis=(1, 2))
    error = (first - second) / pixel
    ii, ij, jj, ei, ej = (
        _windowed(product, settings.flow_window / pixel)
        for product in (
            slope_i * slope_i,
            slope_i * slope_j,
            slope_j * slope_j,
            slope_i * error,
            slope_j * error,
        )
    )
    # Along a straight edge only the way across it is known; the ridge chooses the shortest.
    ii, jj = ii + settings.flow_ridge, jj + settings.flow_ridge
    det = ii * jj - ij * ij
    step = np.stack([(jj * ei - ij * ej) / det, (ii * ej - ij * ei) / det])
    width = settings.flow_smoothing / pixel
    return np.asarray(ndimage.gaussian_filter(flow + step, (0, 0, width, width)), dtype=np.float32)


def _windowed(values: Stack, sigma: float) -> Stack:
    return np.asarray(ndimage.gaussian_filter(values, (0, sigma, sigma), truncate=2.5))


def _moved(images: Stack, by: Stack) -> Stack:
    where = np.indices(images.shape, dtype=np.float32)
    where[1:] += by
    return np.asarray(
        ndimage.map_coordinates(images, where, order=1, mode="nearest", output=np.float32)
    )


def _shrunk(images: Stack, factor: int) -> Stack:
    """Means over blocks of pixels; the border is repeated to whole blocks."""
    pad = [(0, -n % factor) for n in images.shape[1:]]
    whole = np.pad(images, [(0, 0), *pad], mode="edge")
    count, rows, columns = whole.shape
    blocks = whole.reshape(count, rows // factor, factor, columns // factor, factor)
    return np.asarray(blocks.mean(axis=(2, 4)), dtype=np.float32)


def _doubled(flow: Stack, shape: tuple[int, ...]) -> Stack:
    """Displacements at pixels of half the size, counted in them."""
    at = (0.5 * np.arange(n, dtype=np.float32) - 0.25 for n in shape)
    where = np.stack(
        np.meshgrid(*(np.arange(n) for n in flow.shape[:2]), *at, indexing="ij")
    ).astype(np.float32)
    return np.asarray(
        2 * ndimage.map_coordinates(flow, where, order=1, mode="nearest", output=np.float32)
    )
