"""Lines and pictures of small SVG panels: arrays to what the browser draws."""

import base64
import io
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float
from hipsta_bids.bids.gifti import sheet_triangles


def cut(points: Float, axis: int, level: float) -> Float:
    """Cut a grid of points by a plane across one of their axes.

    Parameters
    ----------
    points : (Nx, Ny, 3) float64
    axis : int
        The plane is where this coordinate has the value ``level``.
    level : float

    Returns
    -------
    (N, 2, 3) float64
        Both ends of the line in each triangle that the plane meets.
    """
    triangles = points.reshape(-1, 3)[sheet_triangles(*points.shape[:2])]
    height = triangles[:, :, axis] - level
    above = height > 0
    met = above.any(axis=1) & ~above.all(axis=1)
    triangles, height, above = triangles[met], height[met], above[met]
    # The corner that is alone on its side comes first.
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    order = (lone[:, None] + np.arange(3)) % 3
    rows = np.arange(len(order))[:, None]
    triangles, height = triangles[rows, order], height[rows, order]
    share = height[:, :1] / (height[:, :1] - height[:, 1:])
    ends: Float = triangles[:, :1] + share[:, :, None] * (triangles[:, 1:] - triangles[:, :1])
    return ends


def outline(inside: NDArray[np.bool_]) -> Float:
    """Find the edges between pixels inside and outside.

    Parameters
    ----------
    inside : (I, J) bool

    Returns
    -------
    (N, 2, 2) float64
        Both ends of each edge, in pixels; the center of pixel (0, 0) is at (0, 0). Edges in one
        line are joined.
    """
    padded = np.pad(inside, 1)
    edges = []
    for axis in (0, 1):
        turned = padded if axis == 0 else padded.T
        change = turned[1:] != turned[:-1]
        for line in np.flatnonzero(change.any(axis=1)):
            steps = np.flatnonzero(np.diff(np.pad(change[line].astype(np.int8), 1)))
            for start, stop in steps.reshape(-1, 2):
                ends = np.array([[line - 0.5, start - 1.5], [line - 0.5, stop - 1.5]])
                edges.append(ends if axis == 0 else ends[:, ::-1])
    return np.array(edges).reshape(-1, 2, 2)


def path_data(lines: Float | Iterable[Float]) -> str:
    """Spell lines of points (N, 2) each as the data of an SVG path, to a hundredth of a mm."""
    return " ".join(
        "M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in line)
        for line in lines
        if np.isfinite(line).all()
    )


def png_address(pixels: NDArray[np.uint8]) -> str:
    """Encode (rows, columns, 3 or 4) pixels as a data address."""
    from PIL import Image  # noqa: PLC0415  (slow to load)

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
