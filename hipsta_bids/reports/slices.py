"""What the pictures of slices are drawn from: volumes of a byte per voxel, and where to cut."""

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from nibabel.affines import apply_affine
from numpy.typing import NDArray

from hipsta_bids.reports.results import Hemisphere, Views
from hipsta_bids.types import Float

#: Where along the body slices are shown.
POSITIONS = (0.1, 0.3, 0.5, 0.7, 0.9)

#: Axes of a picture (to the right, up) by the axis across it; 0 is right, 1 anterior, 2 superior.
_AXES = ((1, 2), (0, 2), (0, 1))
_SAGITTAL, _CORONAL = 0, 1

_PALE = 0.45  # opacity of labels, so that lines and the anatomical image show through
_MARGIN = 3.0  # mm round the body that are shown
_ASPECT = (1.5, 2.0)  # width of a slice over its height, so that four fit a screen
_MOST_VOXELS = 250_000  # of the anatomical image
_LEVELS = 64  # its grays


def stack_of(hemisphere: Hemisphere, views: Views) -> dict[str, Any] | None:
    """Collect what slices show: labels, body, anatomical image, and which slices; or nothing.

    A byte per voxel holds the number of its label in the list, from 1, plus 128 in the body.
    """
    panels = _panels(hemisphere, views)
    if not panels:
        return None
    stack = np.zeros(views.shape, dtype=np.uint8)
    for n, code in enumerate(views.names, start=1):
        stack[views.labels == code] = n
    if views.mask is not None:
        stack[views.mask] += 128
    scene = {
        "shape": views.shape,
        "affine": np.round(views.affine[:3], 4).tolist(),
        "inverse": np.round(np.linalg.inv(views.affine)[:3], 6).tolist(),
        "colors": [color for _, color in views.names.values()],
        "body": views.mask is not None,
        "stack": _packed(stack),
        "pale": _PALE,
        "panels": panels,
    }
    if views.anatomy is None:
        return scene
    extent = np.array(views.shape) * views.voxel
    count = extent / np.maximum(views.voxel, views.anatomy.voxel.min())
    count *= min(1.0, (_MOST_VOXELS / np.prod(count)) ** (1 / 3))
    grid = np.maximum(2, np.round(count)).astype(int)
    centers = (np.indices(grid) + 0.5).T / grid * np.array(views.shape) - 0.5
    grays = views.anatomy.grays(apply_affine(views.affine, centers)).T // (256 // _LEVELS)
    anatomy = {"name": views.anatomy.path.name, "shape": grid.tolist(), "stack": _packed(grays)}
    return scene | {"anatomy": anatomy, "levels": _LEVELS}


def _packed(values: NDArray[np.uint8]) -> str:
    """Compress bytes (zlib) as text."""
    return base64.b64encode(zlib.compress(values.tobytes(), 9)).decode()


def _panels(hemisphere: Hemisphere, views: Views) -> list[dict[str, Any]]:
    """Choose five slices across the body and one along it; none without a body."""
    centers = _centers(hemisphere, views)
    if not centers:
        return []
    words = [f"{share:.0%} from posterior" for share in POSITIONS]
    if hemisphere.measured and hemisphere.sheet.parts:
        for n, row in enumerate(hemisphere.sheet.rows_at(POSITIONS)):
            part = next(name for name, a, b in hemisphere.sheet.parts if a <= row <= b)
            words[n] = f"{part}, {words[n]}"
    across = [
        _panel(hemisphere, views, _CORONAL, center, text)
        for center, text in zip(centers, words, strict=True)
    ]
    middle = centers[len(centers) // 2]
    along = _panel(hemisphere, views, _SAGITTAL, middle, "along the body")
    _same_scale(across)
    _same_scale([along])
    return [*across, along]


def _centers(hemisphere: Hemisphere, views: Views) -> list[Float]:
    """Voxel indices of points inside the body at the positions that are shown; none without one."""
    if hemisphere.measured:
        middle = views.to_index(hemisphere.sheet.points["midthickness"])
        rows = hemisphere.sheet.rows_at(POSITIONS)
        return [np.asarray(np.nanmean(middle[:, row], axis=0)) for row in rows]
    index = np.argwhere(views.body)
    if not len(index):
        return []
    low, high = index[:, 1].min(), index[:, 1].max()
    levels = [round(low + share * (high - low)) for share in POSITIONS]
    middle = index.mean(axis=0)
    sections = [index[index[:, 1] == level] for level in levels]
    return [rows.mean(axis=0) if len(rows) else middle for rows in sections]


def _panel(
    hemisphere: Hemisphere, views: Views, across: int, center: Float, words: str
) -> dict[str, Any]:
    """Describe a slice through a voxel index; its box (2, 2) is mm from the corner of the stack."""
    axes = list(_AXES[across])
    level = int(np.clip(round(float(center[across])), 0, views.shape[across] - 1))
    pixels: Float = np.argwhere(np.take(views.body, level, axis=across)).astype(np.float64)
    if not len(pixels):
        pixels = center[None, axes]
        words += ": nothing of the body in this slice"
    box = np.stack([pixels.min(axis=0), pixels.max(axis=0) + 1.0]) * views.voxel[axes]
    position = (views.affine[:3, :3] @ center + views.affine[:3, 3])[across]
    name = "coronal" if across == _CORONAL else "sagittal"
    return {
        "across": across,
        "center": np.round(center, 2).tolist(),
        "box": box + np.array([[-_MARGIN], [_MARGIN]]),
        "caption": f"{name}, {words} ({'RAS'[across]} {position:.1f} mm)",
        "alt": f"{hemisphere.side} hemisphere, {name}, {words}: labels and body"
        f"{', surfaces and columns' if hemisphere.measured else ''}",
    }


def _same_scale(panels: Sequence[dict[str, Any]]) -> None:
    """Give slices boxes of one size about the same centers, so that they have one scale."""
    size = np.max([panel["box"][1] - panel["box"][0] for panel in panels], axis=0)
    narrowest, widest = _ASPECT
    size = np.maximum(size, [narrowest * size[1], size[0] / widest])
    for panel in panels:
        middle = panel["box"].mean(axis=0)
        panel["box"] = np.round([middle - size / 2, middle + size / 2], 2).tolist()
