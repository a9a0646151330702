"""Hemispheres that differ from the others of their side, protocol and region, and where.

Only a local difference counts: what a whole hemisphere, a row or a column of nodes has in common
is not compared, nor what others share, as atrophy is. Maps are compared as they are, without
registration; how positions vary is part of the variation among the others.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, dctn, idctn
from scipy.ndimage import (
    gaussian_filter,
    gaussian_filter1d,
    maximum_filter,
    uniform_filter,
    uniform_filter1d,
)

from hipsta_bids.derivatives.dataset import Row
from hipsta_bids.derivatives.results import ResultPlace, read_sheet, read_summary
from hipsta_bids.errors import InputError
from hipsta_bids.io import files
from hipsta_bids.types import MAD_TO_SD, Bool, Float

#: Least number of hemispheres that are compared: with fewer, the spread is too uncertain.
FEWEST = 10
#: More are compared in parts, which bounds the memory.
_PART = 1000
#: Least score of an outlier: of a patch of the map, and of a width or an extent. Chosen on drawn
#: cohorts, judged on others (tests/derivatives/test_outliers.py).
_PATCH, _NUMBER = 4.5, 4.2
#: Robust SDs above the median of all scores: cohorts vary more, or have longer tails.
_BEYOND = 2.5
#: Least size of an outlier, mm: of a patch, and of a width or an extent.
_SMALLEST_PATCH, _SMALLEST_NUMBER = 0.2, 1.5
#: Least SD, mm: thickness is rounded, and widths are counted in nodes.
_LEAST_SD, _LEAST_WIDTH_SD = 0.02, 0.3
#: Patches are about a sixth and a quarter of the sheet along x, a quarter and a third along y,
#: with edges as blurred as the ones of a voxel too many. Half widths and SDs are shares.
_HALF_X, _HALF_Y = (3 / 41, 5 / 41), (2 / 21, 3 / 21)
_EDGE_X, _EDGE_Y = 1 / 41, 0.6 / 21
#: Scores of numbers among n hemispheres are divided by 1 + 8 / n: few give an uncertain SD.
_SMALL_SAMPLE = 8
#: Components of the cosine transform along x and y that are no patch.
_SMOOTH = (3, 2)
#: Score that a tenth of all may exceed at a place: more of them share a difference.
_USUAL = 1.9
#: Nodes along x and y by which a shared difference may be displaced.
_NEARBY = (1, 9, 5)
#: Standardized values beyond this do not count in the spectrum of the others.
_CLIP = 3.0
#: Rows over which a width is averaged.
_ROWS = 5
#: Columns of ``measures.tsv``.
SIZE, TEXT = "cohort_outlier_mm", "cohort_outlier"


@dataclass(frozen=True, kw_only=True)
class Departures:
    """Largest difference of each of N hemispheres from the others."""

    score: Float
    """(N,) in SD among the others."""
    size: Float
    """(N,) mm; positive is more than the others have."""
    place: tuple[NDArray[np.intp], ...]
    """(N,) each: position in the map or the list of numbers."""

    def outliers(self, least: float, smallest: float) -> Bool:
        """(N,) whose score is beyond a limit and usual scores here, and whose size matters."""
        center = np.median(self.score)
        spread = MAD_TO_SD * np.median(np.abs(self.score - center))
        limit = max(least, center + _BEYOND * spread)
        return np.asarray((self.score > limit) & (np.abs(self.size) >= smallest))


def left_out_median(values: Float) -> Float:
    """(N, ...) medians of the others at each position, by the order of all."""
    n = len(values)
    order = np.argsort(values, axis=0)
    ordered, rank = np.take_along_axis(values, order, axis=0), np.argsort(order, axis=0)
    lower, upper = (n - 2) // 2, (n - 1) // 2
    pair = (np.where(rank <= k, ordered[k + 1], ordered[k]) for k in (lower, upper))
    return np.asarray(sum(pair) / 2, dtype=np.float64)


def _differences(values: Float) -> tuple[Float, Float]:
    """(N, ...) from the median of the others, and their robust SD; none where a value lacks."""
    present = np.isfinite(values)
    middle = np.nanmedian(np.where(present.any(axis=0), values, 0.0), axis=0)
    complete = np.where(present, values, middle)
    differences = complete - left_out_median(complete)
    return differences, MAD_TO_SD * left_out_median(np.abs(differences))


def find_patches(maps: Float) -> Departures:
    """Find the patch in which each map (N, Nx, Ny), mm, differs most from the others.

    Differences from the median of the others, without their smooth part and their profile along
    x, are divided by the robust SD of the others, which is smoothed over neighbors. A matched
    filter weighs them by the power spectrum of the others (Turin 1960); the size is the least
    squares estimate of the step at the edges of the patch.
    """
    count, nx, ny = maps.shape
    local_part = np.ones((nx, ny))
    local_part[: _SMOOTH[0], : _SMOOTH[1]] = local_part[:, 0] = 0
    transform = partial(dctn, axes=(1, 2), norm="ortho")
    inverse = partial(idctn, axes=(1, 2), norm="ortho")
    local = inverse(transform(_differences(maps)[0]) * local_part)
    squares = (MAD_TO_SD * left_out_median(np.abs(local))) ** 2
    sd = np.sqrt(gaussian_filter(squares, (0, 3, 3)) + _LEAST_SD**2)
    power = transform(np.clip(local / sd, -_CLIP, _CLIP)) ** 2
    power = gaussian_filter((power.sum(axis=0) - power) / (count - 1), (0, 0.5, 0.5))
    weights = local_part / np.maximum(power, np.finfo(np.float32).eps)
    weighted = inverse(transform(local / sd) * weights)
    best, size, place = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.intp)
    for half_x, half_y in product(_HALF_X, _HALF_Y):
        along_x, dct_x = _boxes(nx, half_x, _EDGE_X)
        along_y, dct_y = _boxes(ny, half_y, _EDGE_Y)
        energy = dct_x**2 @ weights @ (dct_y**2).T
        matched = along_x @ weighted @ along_y.T
        score = _less_shared(matched / np.sqrt(energy)).reshape(count, -1)
        at = np.arange(count), score.argmax(axis=1)
        window = (0, 2 * round(half_x * nx) + 1, 2 * round(half_y * ny) + 1)
        mm = (matched / energy * uniform_filter(sd, window)).reshape(count, -1)[at]
        better = score[at] > best
        best, size = np.where(better, score[at], best), np.where(better, mm, size)
        place = np.where(better, at[1], place)
    return Departures(score=best, size=size, place=np.unravel_index(place, (nx, ny)))


def _less_shared(score: Float) -> Float:
    """(N, Nx, Ny) absolute scores, less what a tenth of all exceed nearby, as with atrophy."""
    common = len(score) // 10 + 1
    shared = [np.sort(maximum_filter(sign * score, _NEARBY), axis=0)[-common] for sign in (1, -1)]
    common_score = np.maximum(np.where(score > 0, *shared) - _USUAL, 0.0)
    return np.asarray(np.abs(score) - common_score)


def _boxes(count: int, half: float, edge: float) -> tuple[Float, Float]:
    """(count, count) a blurred box round each node, a row each, and its cosine transform."""
    nodes = np.arange(count)
    box = (np.abs(nodes[:, None] - nodes) <= round(half * count)).astype(float)
    box = gaussian_filter1d(box, edge * count, axis=1)
    return box, dct(box, axis=1, norm="ortho")


def find_numbers(values: Float, sides: NDArray[np.str_], twins: NDArray[np.intp]) -> Departures:
    """Find the number, mm, that differs most in each of N hemispheres, of F numbers (N, F).

    Each is compared with the others of its side, and so is its difference from its twin, the other
    side of the same participant (row, -1 without one). The asymmetry counts for the side that is
    farther from the others of its side. ``place`` is the number, and whether it is asymmetry.
    """
    size, score = np.zeros((2, *values.shape)), np.zeros((2, *values.shape))
    for uneven, side in product((0, 1), np.unique(sides)):
        rows = np.flatnonzero((sides == side) & ((twins >= 0) | (uneven == 0)))
        if len(rows) < FEWEST:
            continue
        compared = values[rows] - uneven * values[twins[rows]]
        size[uneven, rows], sd = _differences(compared)
        sd = np.hypot(sd, _LEAST_WIDTH_SD) * (1 + _SMALL_SAMPLE / len(rows))
        score[uneven, rows] = np.abs(size[uneven, rows]) / sd
    score[1] *= score[0] >= score[0][twins]
    all_scores = score.transpose(1, 2, 0).reshape(len(values), -1)
    number, uneven_at = np.divmod(all_scores.argmax(axis=1), 2)
    return Departures(
        score=all_scores.max(axis=1),
        size=size[uneven_at, np.arange(len(values)), number],
        place=(number, uneven_at),
    )


def compare(places: Sequence[ResultPlace]) -> Iterator[tuple[ResultPlace, Row]]:
    """Compare hemispheres of a protocol and region.

    Returns the cells of each that was compared: the size of its patch, mm, and what makes it an
    outlier, if anything does. A sheet that cannot be read is not compared.
    """
    parts = -(-len(places) // _PART)
    for part in range(parts):
        sheets = {}
        for place in places:
            if crc32(place.name.subject.encode()) % parts == part:
                with suppress(InputError):
                    maps = read_sheet(place.path("sheet"), ("thickness", *"ras"), ["subfield"])
                    sheets[place] = maps, read_summary(place)
        counts = Counter(place.name.hemi for place in sheets)
        members = [place for place in sheets if counts[place.name.hemi] >= FEWEST]
        if len({sheets[place][0]["subfield"].shape for place in members}) == 1:
            yield from _compare(members, [sheets[place] for place in members])


def _compare(
    places: Sequence[ResultPlace],
    sheets: Sequence[tuple[Mapping[str, NDArray[Any]], Mapping[str, float]]],
) -> Iterator[tuple[ResultPlace, Row]]:
    """Compare hemispheres, with maps (Nx, Ny) and summaries, of sheets of one shape."""
    maps, labels = (np.array([m[key] for m, _ in sheets]) for key in ("thickness", "subfield"))
    sides = np.array([place.name.hemi for place in places])
    texts = _unusual_numbers(places, sheets, labels, sides)
    for side in np.unique(sides):
        rows = np.flatnonzero(sides == side)
        patches = find_patches(maps[rows])
        is_outlier = patches.outliers(_PATCH, _SMALLEST_PATCH)
        for n, row in enumerate(rows.tolist()):
            size, (x, y) = patches.size[n], (int(axis[n]) for axis in patches.place)
            if is_outlier[n]:
                texts[row].append(
                    f"thickness {abs(size):.2f} mm {'above' if size > 0 else 'below'} its"
                    f" surroundings, unlike in the others: {_position(sheets[row][0], x, y)}"
                )
            text = "; ".join(reversed(texts[row])) or files.MISSING
            yield places[row], {SIZE: f"{abs(size):.2f}", TEXT: text}


def _unusual_numbers(
    places: Sequence[ResultPlace],
    sheets: Sequence[tuple[Mapping[str, NDArray[Any]], Mapping[str, float]]],
    labels: NDArray[Any],
    sides: NDArray[Any],
) -> list[list[str]]:
    """Describe for each hemisphere unusual widths and extents; labels are (N, Nx, Ny)."""
    extents = np.array([[s.get(f"extent_{axis}", 0.0) for axis in "xy"] for _, s in sheets])
    visits = [(place.name.subject, place.name.session) for place in places]
    row_of = {key: row for row, key in enumerate(zip(visits, sides.tolist(), strict=True))}
    twins = [row_of.get((v, "LR"[h == "L"]), -1) for v, h in zip(visits, sides, strict=True)]
    names = sorted(set(labels.ravel().tolist()) - {""})
    shares = np.array([(labels == name).mean(axis=1) for name in names])  # (subfields, N, Ny)
    widths = uniform_filter1d(shares, _ROWS) * extents[:, :1]
    numbers = np.column_stack([*widths, extents])
    departures = find_numbers(np.nan_to_num(numbers), sides, np.array(twins))
    texts: list[list[str]] = [[] for _ in places]
    for row in np.flatnonzero(departures.outliers(_NUMBER, _SMALLEST_NUMBER)).tolist():
        (number, uneven), size = (int(axis[row]) for axis in departures.place), departures.size[row]
        name, y = divmod(number, labels.shape[2])
        is_sheet = name == len(names)
        word = (("narrower", "wider"), ("shorter", "longer"))[is_sheet and y][int(size > 0)]
        text = f"{'sheet' if is_sheet else names[name]} {abs(size):.1f} mm {word} than "
        text += f"{'on the other side, compared with' if uneven else 'in'} the others"
        if not is_sheet:
            nodes = np.flatnonzero(labels[row, :, y] == names[name]).tolist() or [0]
            text += f": {_position(sheets[row][0], nodes[len(nodes) // 2], y)}"
        texts[row].append(text)
    return texts


def _position(sheet: Mapping[str, NDArray[Any]], x: int, y: int) -> str:
    """Write where a node of the sheet is."""
    point = " ".join(f"{sheet[axis][x, y]:.0f}" for axis in "ras")
    return f"{sheet['subfield'][x, y] or 'no subfield'}, RAS {point} mm"
