"""Slices and cross-sections as small SVG pictures that wrap on narrow screens."""

import base64
import io
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from nibabel.affines import apply_affine
from numpy.typing import NDArray

from hipsta_bids.io.gifti import sheet_triangles
from hipsta_bids.reports.results import SURFACES, Hemisphere, SheetTable, Views
from hipsta_bids.types import Float

#: Axes of a picture (to the right, up) and across it; 0 is right, 1 anterior, 2 superior.
_AXES = {"coronal": (0, 2, 1), "sagittal": (1, 2, 0), "axial": (0, 1, 2)}
_LETTERS = (("L", "R"), ("P", "A"), ("I", "S"))

#: Where along the body slices and cross-sections are shown.
POSITIONS = (0.1, 0.3, 0.5, 0.7, 0.9)

_PALE = 0.45  # opacity of labels, so that lines and the anatomical image show through
_MARGIN = 3.0  # mm round the body that are shown
_NEAR = 22.0  # mm across, of a window about a point that a message names
_REACH = 7.0  # mm, how far the line of an end plane extends up and down
_PIXEL = 0.4  # mm, finest pixels of the anatomical image
_QUALITY = 80  # of its compression as JPEG
_MOST_VOXELS = 250_000  # of the anatomical image in the viewer of slices
_LEVELS = 64  # grays in that viewer


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture; lengths are mm, y runs downwards."""

    window: tuple[float, float, float, float]
    """Left, top, width and height of what is shown."""
    caption: str
    alt: str
    image: str | None = None
    """Data address of the labels' picture."""
    size: tuple[float, float] = (0.0, 0.0)
    """Width and height of the labels' picture, whose corner is (0, 0)."""
    anatomy: str | None = None
    """Data address of the anatomical image, which fills the window."""
    at: Mapping[str, Any] = field(default_factory=dict)
    """Where the viewer of slices opens: ``across`` (an axis), ``level`` and, marked, ``point``."""
    paths: Mapping[str, str] = field(default_factory=dict)
    """SVG path data by CSS class."""
    lines: tuple[tuple[str, str], ...] = ()
    """Colored lines: path data and color."""
    marks: tuple[tuple[float, float], ...] = ()
    letters: tuple[str, str, str, str] | None = None
    """What is at the left, right, lower and upper edge."""
    note: str = ""
    """A word in the middle, where there is nothing to draw."""


def cut(points: Float, axis: int, level: float) -> Float:
    """Cut a grid of points (Nx, Ny, 3) by a plane across an axis: line segments (N, 2, 3)."""
    triangles = points.reshape(-1, 3)[sheet_triangles(*points.shape[:2])]
    height = triangles[:, :, axis] - level
    above = height > 0
    crossing = above.any(axis=1) & ~above.all(axis=1)
    triangles, height, above = triangles[crossing], height[crossing], above[crossing]
    # The corner that is alone on its side comes first.
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    order = (lone[:, None] + np.arange(3)) % 3
    rows = np.arange(len(order))[:, None]
    triangles, height = triangles[rows, order], height[rows, order]
    share = height[:, :1] / (height[:, :1] - height[:, 1:])
    ends: Float = triangles[:, :1] + share[:, :, None] * (triangles[:, 1:] - triangles[:, :1])
    return ends


def outline(inside: NDArray[np.bool_]) -> Float:
    """Find the edges (N, 2, 2) between pixels inside and outside; pixel centers are integers."""
    padded = np.pad(inside, 1)
    edges = []
    for axis in (0, 1):
        rows = padded if axis == 0 else padded.T
        change = rows[1:] != rows[:-1]
        for line in np.flatnonzero(change.any(axis=1)):
            steps = np.flatnonzero(np.diff(np.pad(change[line].astype(np.int8), 1)))
            for start, stop in steps.reshape(-1, 2):
                ends = np.array([[line - 0.5, start - 1.5], [line - 0.5, stop - 1.5]])
                edges.append(ends if axis == 0 else ends[:, ::-1])
    return np.array(edges).reshape(-1, 2, 2)


def path_data(lines: Float | Iterable[Float]) -> str:
    """Write lines of points (N, 2) each as the data of an SVG path, to a hundredth of a mm.

    Lines that end where others begin are joined, so that pages stay small.
    """
    left = [
        [(round(100 * x), round(100 * y)) for x, y in line.tolist()]
        for line in lines
        if np.isfinite(line).all()
    ]
    ends: dict[tuple[int, int], list[int]] = {}
    for n, line in enumerate(left):
        for end in (line[0], line[-1]):
            ends.setdefault(end, []).append(n)
    joined: set[int] = set()
    paths = []
    for n, line in enumerate(left):
        if n in joined:
            continue
        joined.add(n)
        path = list(line)
        for _ in range(2):  # at its end, and then at its other end
            while link := next((m for m in ends[path[-1]] if m not in joined), None):
                joined.add(link)
                path += (left[link] if left[link][0] == path[-1] else left[link][::-1])[1:]
            path.reverse()
        paths.append(path)
    return "".join(map(_relative, paths))


def _relative(path: Sequence[tuple[int, int]]) -> str:
    """Write one line as SVG path data with relative steps; hundredths of a mm."""
    steps = [(c - a, d - b) for (a, b), (c, d) in pairwise(path)]
    moves = [(dx, dy) for dx, dy in steps if dx or dy]
    start = f"M{path[0][0] / 100:g} {path[0][1] / 100:g}"
    return start + "l" + " ".join(f"{dx / 100:g} {dy / 100:g}" for dx, dy in moves or [(0, 0)])


def image_address(pixels: NDArray[np.uint8], kind: str, **options: int) -> str:
    """Encode (rows, columns) grays, or (rows, columns, 4) pixels, as a data address."""
    from PIL import Image  # noqa: PLC0415  (slow to load)

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, format=kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode()


def slice_panels(hemisphere: Hemisphere, views: Views) -> list[Panel]:
    """Draw five slices across the body, and one along it."""
    centers = _centers(hemisphere, views)
    if not centers:
        return []
    middle = centers[len(centers) // 2]
    across = [
        _slice(hemisphere, views, "coronal", center, words=f"{share:.0%} from posterior")
        for share, center in zip(POSITIONS, centers, strict=True)
    ]
    along = _slice(hemisphere, views, "sagittal", middle, words="along the body")
    return [_with_anatomy(panel, views) for panel in (*_same_windows(across), along)]


def point_panels(hemisphere: Hemisphere, views: Views, point: Sequence[float]) -> list[Panel]:
    """Draw the three slices through a point that a message names."""
    index = views.to_index(np.asarray(point, dtype=np.float64))
    panels = [_slice(hemisphere, views, name, index, mark=True) for name in _AXES]
    return [_with_anatomy(panel, views) for panel in panels]


def stack_of(views: Views) -> dict[str, Any]:
    """Collect what the viewer of slices shows: labels, body and anatomical image, compressed.

    A byte per voxel holds the number of its label in the list, from 1, plus 128 in the body.
    """
    stack = np.zeros(views.shape, dtype=np.uint8)
    for n, code in enumerate(views.names, start=1):
        stack[views.labels == code] = n
    if views.mask is not None:
        stack[views.mask] += 128
    scene = {
        "shape": views.shape,
        "affine": np.round(views.affine[:3], 4).tolist(),
        "colors": [color for _, color in views.names.values()],
        "body": views.mask is not None,
        "stack": _packed(stack),
        "pale": _PALE,
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


def _with_anatomy(panel: Panel, views: Views) -> Panel:
    """Put the anatomical image behind a slice."""
    if views.anatomy is None:
        return panel
    right, up, across = next(axes for axes in _AXES.values() if axes[2] == panel.at["across"])
    left, top, width, height = panel.window
    count = np.ceil(np.array([width, height]) / max(_PIXEL, views.anatomy.voxel.min() / 2))
    columns, rows = np.maximum(count, 2).astype(int).tolist()
    index = np.zeros((rows, columns, 3))
    x = left + (np.arange(columns) + 0.5) * width / columns
    y = top + (np.arange(rows) + 0.5) * height / rows
    index[..., right] = x / views.voxel[right] - 0.5
    index[..., up] = views.shape[up] - 0.5 - y[:, None] / views.voxel[up]
    index[..., across] = panel.at["level"]
    grays = views.anatomy.grays(apply_affine(views.affine, index))
    return replace(panel, anatomy=image_address(grays, "jpeg", quality=_QUALITY))


def section_panels(
    hemisphere: Hemisphere, colors: NDArray[np.str_], scale: tuple[float, float]
) -> list[Panel]:
    """Draw cross-sections of the sheet, with a line per column in the color of its thickness.

    ``scale`` is the thickness at both ends of the colors, mm.
    """
    sheet = hemisphere.sheet
    rows = zip(sheet.rows_at(POSITIONS), POSITIONS, strict=True)
    return _same_windows([_section(sheet, row, share, colors, scale) for row, share in rows])


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


def _same_windows(panels: Sequence[Panel]) -> list[Panel]:
    """Give panels windows of one size about the same centers, so that they have one scale."""
    width, height = (max(panel.window[n] for panel in panels) for n in (2, 3))
    resized = []
    for panel in panels:
        left, top, own_width, own_height = panel.window
        window = _window(left + own_width / 2, top + own_height / 2, width, height)
        resized.append(replace(panel, window=window))
    return resized


def _window(x: float, y: float, width: float, height: float) -> tuple[float, float, float, float]:
    """Left, top, width and height of a window about a center."""
    left, top = x - width / 2, y - height / 2
    return round(left, 2), round(top, 2), round(width, 2), round(height, 2)


def _slice(
    hemisphere: Hemisphere,
    views: Views,
    orientation: str,
    center: Float,
    *,
    words: str = "",
    mark: bool = False,
) -> Panel:
    """Draw one slice through a voxel index, about the body or, marked, about that point."""
    right, up, across = _AXES[orientation]
    level = int(np.clip(round(float(center[across])), 0, views.shape[across] - 1))
    edge, top = views.voxel[[right, up]], views.shape[up] - 0.5

    def flat(index: Float) -> Float:
        """Convert voxel indices to mm in the picture."""
        return np.stack(
            [(index[..., right] + 0.5) * edge[0], (top - index[..., up]) * edge[1]], axis=-1
        )

    width, height = views.shape[right] * edge[0], views.shape[up] * edge[1]
    span = np.array([[0.0, 0.0], [width, height]])
    paths = {}
    point = flat(np.asarray(center))
    empty = not np.take(views.body, level, axis=across).any()
    if empty:
        span = np.stack([point - _MARGIN, point + _MARGIN])
        words = f"{words}: nothing of the body in this slice".removeprefix(": ")
    if views.mask is not None:
        edges = outline(_picture(views.mask, across, level, right, up))
        index = np.zeros((*edges.shape[:2], 3))
        index[..., right], index[..., up] = edges[..., 0], edges[..., 1]
        lines = flat(index)
        paths["mask"] = path_data(lines)
        if len(lines):
            span = np.stack([lines.min(axis=(0, 1)), lines.max(axis=(0, 1))])
            span += np.array([[-_MARGIN], [_MARGIN]])
    if hemisphere.measured:
        for name in SURFACES:
            index = views.to_index(hemisphere.sheet.points[name])
            paths[name] = path_data(flat(cut(index, across, level)))
        if orientation == "sagittal":
            paths["plane"] = path_data(flat(_plane_lines(hemisphere, views)))
    position = views.affine[:3, :3] @ np.asarray(center) + views.affine[:3, 3]
    caption = (
        f"{orientation}{', ' if words else ''}{words} ({'RAS'[across]} {position[across]:.1f} mm)"
    )
    middle, size = (point, (_NEAR, _NEAR)) if mark else (span.mean(axis=0), span[1] - span[0])
    return Panel(
        window=_window(float(middle[0]), float(middle[1]), float(size[0]), float(size[1])),
        caption=caption,
        alt=f"{hemisphere.side} hemisphere, {caption}: labels with the outline of the body"
        f"{' and the measured surfaces' if hemisphere.measured else ''}",
        image=_label_image(views, across, level, right, up),
        size=(round(float(width), 2), round(float(height), 2)),
        paths=paths,
        marks=((round(float(point[0]), 2), round(float(point[1]), 2)),) if mark else (),
        at={"across": across, "level": level}
        | ({"point": " ".join(f"{n:.2f}" for n in center)} if mark else {}),
        letters=(*_LETTERS[right], *_LETTERS[up]),
        note="empty" if empty and not mark else "",
    )


def _picture(
    volume: NDArray[np.generic], across: int, level: int, right: int, up: int
) -> NDArray[np.bool_]:
    """One slice with its first axis to the right and its second up."""
    plane: NDArray[np.bool_] = np.take(volume, level, axis=across)
    return plane if right < up else plane.T


def _plane_lines(hemisphere: Hemisphere, views: Views) -> Float:
    """Find the end planes in a sagittal slice: both ends (2, 2, 3) of each line, voxel indices."""
    lines = []
    middle = hemisphere.sheet.points["midthickness"]
    first, last = hemisphere.sheet.ends or (0, -1)
    for end, row in (("posterior_plane", first), ("anterior_plane", last)):
        plane = hemisphere.metrics.get(end)
        if not plane:
            continue
        center = np.nanmean(middle[:, row], axis=0)
        point, normal = np.array(plane["point_ras_mm"]), np.array(plane["normal_ras"])
        center += ((point - center) @ normal) * normal
        along = np.cross(normal, [1.0, 0.0, 0.0])
        along *= _REACH / np.linalg.norm(along)
        lines.append(views.to_index(np.stack([center - along, center + along])))
    return np.array(lines).reshape(-1, 2, 3)


def _label_image(views: Views, across: int, level: int, right: int, up: int) -> str | None:
    if views.labels is None:
        return None
    plane = _picture(views.labels, across, level, right, up)
    pixels = np.zeros((*plane.shape, 4), dtype=np.uint8)
    for code, (_, color) in views.names.items():
        pixels[plane == code] = (*bytes.fromhex(color[1:]), round(255 * _PALE))
    return image_address(pixels.transpose(1, 0, 2)[::-1], "png")


def _section(
    sheet: SheetTable,
    row: int,
    share: float,
    colors: NDArray[np.str_],
    scale: tuple[float, float],
) -> Panel:
    """One row of the sheet, seen along the body from behind."""
    middle = sheet.points["midthickness"]
    low, high = max(0, row - 1), min(middle.shape[1] - 1, row + 1)
    forward = np.nanmean(middle[:, high] - middle[:, low], axis=0)
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) - forward[2] * forward
    up /= np.linalg.norm(up)
    right = np.cross(forward, up)
    flat = {
        name: np.stack([points[:, row] @ right, -(points[:, row] @ up)], axis=-1)
        for name, points in sheet.points.items()
    }
    if sheet.ends is not None:  # positions without values are no measurement
        flat = {n: np.where(sheet.valid[:, row, None], p, np.nan) for n, p in flat.items()}
    joined = np.concatenate(list(flat.values()))
    corner, far = np.nanmin(joined, axis=0) - 0.7, np.nanmax(joined, axis=0) + 0.7
    flat = {name: points - corner for name, points in flat.items()}
    thickness = sheet.columns["thickness"][:, row]
    part = "".join(f"{name}, " for name, a, b in sheet.parts if a <= row <= b)
    spread = (thickness - scale[0]) / max(scale[1] - scale[0], 1e-6)
    line_colors = np.rint(np.clip(np.nan_to_num(spread), 0, 1) * (len(colors) - 1)).astype(int)
    ends = np.stack([flat["interior"], flat["exterior"]], axis=1)
    lines = tuple(
        (path_data([line]), str(colors[n]))
        for line, n in zip(ends, line_colors, strict=True)
        if np.isfinite(line).all()
    )
    return Panel(
        window=(0.0, 0.0, float(far[0] - corner[0]), float(far[1] - corner[1])),
        caption=f"{part}{share:.0%} from posterior, mean {np.nanmean(thickness):.2f} mm",
        alt=f"cross-section at {share:.0%} of the body: interior, mid and exterior curve with"
        " thickness lines",
        paths={
            name: path_data([line] if sheet.ends is None else np.stack([line[:-1], line[1:]], 1))
            for name, line in flat.items()
        },
        lines=lines,
    )
