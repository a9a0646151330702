"""Small line charts as drawings in the page, which wrap on narrow screens."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hipsta_bids.artifacts import Float

#: Colors of groups that people who cannot tell red from green can tell (Okabe and Ito 2008).
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B07A00", "#56B4E9", "#000000")

_WIDTH, _HEIGHT = 320.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 8.0, 8.0, 34.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Line:
    """One curve."""

    x: Float
    y: Float
    color: str
    reach: Float | None = None
    """Half of the band round it, in units of y."""
    faint: bool = False
    """One of many."""
    dots: bool = False
    dashed: bool = False


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis of a chart."""

    label: str
    limits: tuple[float, float] | None = None
    """``None`` for those of the data."""
    ends: tuple[str, str] | None = None
    """Words at both ends instead of numbers."""


def chart(
    title: str, alt: str, lines: Sequence[Line], x: Axis, y: Axis, *, diagonal: bool = False
) -> dict[str, Any]:
    """Lay out a chart for the template.

    Parameters
    ----------
    title : str
    alt : str
        What it shows, for those who do not see it.
    lines : sequence of Line
    x, y : Axis
    diagonal : bool
        Whether y = x is drawn.

    Returns
    -------
    dict
        For the macro ``chart``.
    """
    limits_x = x.limits or _limits([line.x for line in lines])
    reached = [line.y + side * (0 if line.reach is None else line.reach)
               for line in lines for side in (-1, 1)]  # fmt: skip
    limits_y = y.limits or _limits(reached, margin=0.06)

    def place_x(values: Float) -> Float:
        return _LEFT + _share(values, limits_x) * (_WIDTH - _LEFT - _RIGHT)

    def place_y(values: Float) -> Float:
        return _HEIGHT - _BOTTOM - _share(values, limits_y) * (_HEIGHT - _TOP - _BOTTOM)

    drawn = []
    for line in lines:
        px = place_x(line.x)
        drawn.append(
            {
                "color": line.color,
                "d": _path(px, place_y(line.y)),
                "faint": line.faint,
                "dashed": line.dashed,
                "band": None
                if line.reach is None
                else _band(px, place_y(line.y - line.reach), place_y(line.y + line.reach)),
                "dots": [
                    (round(float(a), 1), round(float(b), 1))
                    for a, b in zip(px, place_y(line.y), strict=True)
                ]
                if line.dots
                else [],
            }
        )
    corners = np.array([max(limits_x[0], limits_y[0]), min(limits_x[1], limits_y[1])])
    return {
        "title": title,
        "alt": alt,
        "size": (_WIDTH, _HEIGHT),
        "box": (_LEFT, _TOP, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM),
        "lines": drawn,
        "x": {"label": x.label, "ends": x.ends, "ticks": _ticks(limits_x, place_x)},
        "y": {"label": y.label, "ticks": _ticks(limits_y, place_y)},
        "diagonal": _path(place_x(corners), place_y(corners)) if diagonal else None,
    }


def _limits(values: Sequence[Float], margin: float = 0.0) -> tuple[float, float]:
    every = np.concatenate([np.ravel(part) for part in values])
    every = every[np.isfinite(every)]
    if not len(every):
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    spare = margin * (high - low) or (0.0 if high > low else 0.5 * abs(high) or 1.0)
    return low - spare, high + spare


def _share(values: Float, limits: tuple[float, float]) -> Float:
    return (np.asarray(values, dtype=np.float64) - limits[0]) / (limits[1] - limits[0])


def _ticks(limits: tuple[float, float], place: Any) -> list[tuple[float, str]]:  # noqa: ANN401  (a local function)
    """Choose round numbers: their places and words."""
    raw = (limits[1] - limits[0]) / 4
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    values = np.arange(np.ceil(limits[0] / step - 1e-9), np.floor(limits[1] / step + 1e-9) + 1)
    places = place(values * step)
    return [
        (round(float(at), 1), f"{value * step + 0.0:.6g}".replace("-", "\N{MINUS SIGN}"))
        for at, value in zip(places, values, strict=True)
    ]


def _path(x: Float, y: Float) -> str:
    """Draw through known points; a gap parts the line."""
    parts, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if np.isfinite(a) and np.isfinite(b):
            parts.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(parts)


def _band(x: Float, low: Float, high: Float) -> str:
    known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    if not known.any():
        return ""
    round_x = np.concatenate([x[known], x[known][::-1]])
    return _path(round_x, np.concatenate([low[known], high[known][::-1]])) + "Z"
