"""Draws maps on axes of matplotlib: unfolded sheets, surfaces, and results of a model."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hipsta_bids.api.drawing import add_color_bar, draw_map, map_kind
from hipsta_bids.api.maps import Measurement
from hipsta_bids.api.models import GroupFit
from hipsta_bids.api.variables import check_choice
from hipsta_bids.derivatives.results import STATE
from hipsta_bids.io.gifti import sheet_triangles
from hipsta_bids.reports import display
from hipsta_bids.reports.group_maps import EFFECT_NAMES
from hipsta_bids.reports.maps import draw_sheet
from hipsta_bids.reports.results import SheetTable
from hipsta_bids.types import Float, parts_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

_MIDDLE = 0.5  # coordinate of the layer of the mid-surface
_BEYOND = 0.12  # of the length, from an end to its letter
_SHADE = 0.45  # of the light that depends on direction
_VIEW = {"L": (38.0, -140.0), "R": (38.0, -40.0)}
"""Elevation and azimuth, degrees: from behind, above and lateral."""


def plot_sheet(
    data: Measurement | xr.Dataset | xr.DataArray,
    measure: str = "thickness",
    *,
    ax: "Axes | None" = None,
    limits: tuple[float, float] | None = None,
    colorbar: bool = True,
) -> "Axes":
    """Draw a map on the unfolded sheet, with borders and names of subfields.

    Maps of both sides lie alike: medial left, lateral right, anterior up. Doubtful
    columns are hatched; columns filled from their neighbors are crossed.

    Parameters
    ----------
    data : Measurement, xarray.Dataset or xarray.DataArray
        What :func:`hipsta_bids.measure` gave, or one hemisphere of :func:`hipsta_bids.load`, or
        one map of it.
    measure : str
        Name of a map; a DataArray that has a name keeps its own.
    ax : Axes, optional
        Where to draw; else the current axes of pyplot.
    limits : tuple of float, optional
        Values at both ends of the colors; else the limits of the pages for thickness and mean
        curvature, and percentiles of this map for others. Give the same to maps that are compared.
    colorbar : bool
        Whether to add one.

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the map does not exist, or the data are not of one hemisphere.

    Examples
    --------
    >>> import hipsta_bids as hb
    >>> from matplotlib.figure import Figure
    >>> left = hb.measure(hb.example().labels, side="L", protocol="freesurfer")
    >>> ax = hb.plot_sheet(left, ax=Figure().subplots(), limits=(1.2, 2.4))
    >>> ax.get_title(), ax.get_xlabel()
    ('left', 'medial  ←  mm  →  lateral')
    """
    if isinstance(data, xr.DataArray):
        measure = measure if data.name is None else str(data.name)
        data = data.to_dataset(name=measure)
    data = _one_hemisphere(data)
    columns, side = _columns(data, measure)
    ax = ax or _current_axes()
    draw_map(ax, _sheet(data, columns), measure, side, limits=limits, colorbar=colorbar)
    return ax


def plot_surface(
    data: Measurement | xr.Dataset,
    measure: str = "thickness",
    *,
    level: str = "midthickness",
    ax: "Axes3D | None" = None,
    limits: tuple[float, float] | None = None,
    view: tuple[float, float] | None = None,
    colorbar: bool = True,
) -> "Axes3D":
    """Draw a map on a surface of the sheet in three dimensions, shaded, without a GPU.

    Parameters
    ----------
    data, measure, limits, colorbar
        As of :func:`plot_sheet`.
    level : {"midthickness", "interior", "exterior"}
        Surface; of datasets from :func:`hipsta_bids.load` the first only.
    ax : Axes3D, optional
        Axes with ``projection="3d"``; else new ones in the current figure of pyplot.
    view : tuple of float, optional
        Elevation and azimuth, degrees; else from behind, above and lateral.

    Returns
    -------
    Axes3D
        In scanner RAS mm; A and P mark the anterior and the posterior end.

    Raises
    ------
    ValueError
        As :func:`plot_sheet`; if the surface is not there, or the axes are flat.

    Examples
    --------
    ::

        left = hb.measure("lh.hippoSfLabels-T1.v22.mgz", side="L", protocol="freesurfer")
        hb.plot_surface(left, "curvature", view=(60, -90))
    """
    from matplotlib import colormaps  # noqa: PLC0415  (slow to load)
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.colors import Normalize  # noqa: PLC0415
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # noqa: PLC0415

    data = _one_hemisphere(data)
    columns, side = _columns(data, measure)
    kind = map_kind(measure)
    points = _points(data, level)
    triangles = sheet_triangles(*points.shape[:2])
    corners = points.reshape(-1, 3)[triangles]
    values = columns[measure].ravel()[triangles].mean(axis=1)
    finite = np.isfinite(corners).all(axis=(1, 2))
    if ax is None:
        from matplotlib import pyplot as plt  # noqa: PLC0415  (as above)

        ax = plt.gcf().add_subplot(projection="3d")
    if not hasattr(ax, "zaxis"):
        raise ValueError("a surface needs axes in three dimensions: projection='3d'")
    elevation, azimuth = view or _VIEW.get(side, _VIEW["R"])
    ax.view_init(elev=elevation, azim=azimuth)
    scale = Normalize(*(limits or display.scale_of(kind, [columns[measure]])))
    colors = colormaps[kind.colors](scale(np.nan_to_num(values)))
    colors[~np.isfinite(values)] = (0.8, 0.8, 0.8, 1.0)
    colors[:, :3] *= _light(corners, elevation, azimuth)[:, None]
    faces = Poly3DCollection(
        corners[finite],
        facecolors=colors[finite],
        edgecolors=colors[finite],
        linewidths=0.3,
        clip_on=False,
    )
    ax.add_collection3d(faces)
    low, high = (limit(points, axis=(0, 1)) for limit in (np.nanmin, np.nanmax))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=1.1)
    ax.set_axis_off()
    ends = {"P": np.nanmean(points[:, 0], axis=0), "A": np.nanmean(points[:, -1], axis=0)}
    beyond = (ends["A"] - ends["P"]) * _BEYOND
    for letter, position in (("P", ends["P"] - beyond), ("A", ends["A"] + beyond)):
        ax.text(*position, letter, ha="center", va="center", weight="bold")
    if colorbar:
        add_color_bar(ax, ScalarMappable(scale, kind.colors), kind)
    return ax


def plot_group(
    fit: GroupFit,
    contrast: str | None = None,
    *,
    side: str | None = None,
    ax: "Axes | None" = None,
    subfield: Sequence[Sequence[str]] | NDArray[np.str_] | None = None,
    limits: tuple[float, float] | None = None,
    colorbar: bool = True,
) -> "Axes":
    """Draw the effect size of a contrast on the sheet, with a line round significant points.

    Parameters
    ----------
    fit : GroupFit
        What :func:`hipsta_bids.group` gave, of maps on the sheet.
    contrast : str, optional
        Its name; else the first.
    side : str, optional
        Its name; else the first.
    ax : Axes, optional
        Where to draw; else the current axes of pyplot.
    subfield : array of str, optional
        (x, y) names, to draw borders and names of subfields.
    limits : tuple of float, optional
        Effect sizes at both ends of the colors.
    colorbar : bool
        Whether to add one.

    Returns
    -------
    Axes
        Whose title names side, contrast, and how many points survive.

    Raises
    ------
    ValueError
        If the side or contrast does not exist, or the maps are not on the sheet.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> import hipsta_bids as hb
    >>> from matplotlib.figure import Figure
    >>> random = np.random.default_rng(1)
    >>> table = pd.DataFrame({"group": ["CN"] * 10 + ["AD"] * 10})
    >>> maps = random.normal(2.0, 0.1, (20, 10, 4))
    >>> maps[10:, :2] -= 0.5
    >>> fit = hb.group({"L": maps}, table, "group", contrasts=["thinner = group[CN] - group[AD]"])
    >>> ax = hb.plot_group(fit, "thinner", side="L", ax=Figure().subplots())
    >>> print(ax.get_title())
    left, thinner: 9 of 40 points survive
    """
    side = fit.sides[0] if side is None else side
    contrast = fit.contrasts[0] if contrast is None else contrast
    check_choice("side", side, dict.fromkeys(fit.sides))
    check_choice("contrast", contrast, dict.fromkeys(fit.contrasts))
    at = fit.sides.index(side), fit.contrasts.index(contrast)
    effect, significant = fit.maps["effect"][at], fit.significant[at]
    if effect.ndim == 1:
        raise ValueError("maps on vertices are not on the sheet; draw fit.maps['effect'] instead")
    ax = ax or _current_axes()
    finite = np.isfinite(effect)
    names = np.full(effect.shape, "") if subfield is None else np.asarray(subfield, dtype=np.str_)
    test = fit.test(side, contrast).kind
    colors = display.EFFECT_COLORS
    kind = replace(map_kind("effect"), title=EFFECT_NAMES[test], colors=colors, centered=True)
    sheet = _bare_sheet({"effect": effect}, {"subfield": names})
    statistic, df = (fit.maps[name][at] for name in ("statistic", "df"))
    reach = display.effect_reach([display.Effects(test, effect, statistic, df)])
    scale = limits or (-reach, reach)
    image = draw_sheet(ax, sheet, kind, scale, extents=(np.nan, np.nan), hemi=side)
    if significant.any() and not significant.all():
        x, y = (np.linspace(0, n, n) for n in effect.shape)
        ax.contour(x, y, significant.T.astype(float), levels=[0.5], colors="black", linewidths=1.8)
    count = f"{int(significant.sum())} of {int(finite.sum())} points survive"
    ax.set_title(f"{ax.get_title()}, {contrast}: {count}")
    ax.set_aspect("auto")
    ax.set_ylabel("  ←  nodes  →  ".join(display.Y_ENDS))
    if colorbar:
        add_color_bar(ax, image, kind)
    return ax


def _one_hemisphere(data: Measurement | xr.Dataset) -> Measurement | xr.Dataset:
    """Remove axes of length one."""
    if isinstance(data, Measurement):
        return data
    return data.squeeze(
        [name for name, n in data.sizes.items() if n == 1 and name not in {"x", "y"}]
    )


def _columns(data: Measurement | xr.Dataset, measure: str) -> tuple[dict[str, Float], str]:
    """Arrays (x, y) by name, the measure and extents, and the side."""
    if isinstance(data, Measurement):
        check_choice("measure", measure, data.maps)
        return dict(data.maps), data.side
    check_choice("measure", measure, dict.fromkeys(map(str, data.data_vars)))
    if set(data[measure].dims) != {"x", "y"}:
        raise ValueError(
            f"{measure} has the axes {', '.join(map(str, data[measure].dims))}; select one"
            " protocol, participant, session, side and layer"
        )
    names = [name for name in (measure, "extent_x", "extent_y") if name in data]
    columns = {name: data[name].transpose("x", "y").to_numpy() for name in names}
    side = data.coords["side"].item() if "side" in data.coords else data.attrs.get("side", "")
    return columns, str(side)


def _current_axes() -> "Axes":
    from matplotlib import pyplot as plt  # noqa: PLC0415  (loads a window system)

    return plt.gca()


def _sheet(data: Measurement | xr.Dataset, columns: dict[str, Float]) -> SheetTable:
    if isinstance(data, Measurement):
        return data.table
    state = {name: data[name].transpose("x", "y").to_numpy() for name in STATE if name in data}
    parts = parts_of(data.coords["y"].to_numpy()) if "y" in data.coords else None
    body = np.flatnonzero(parts == "body").tolist() if parts is not None else []
    return _bare_sheet(columns, state, (body[0], body[-1]) if body else None)


def _bare_sheet(
    columns: dict[str, Float], state: dict[str, NDArray[Any]], ends: tuple[int, int] | None = None
) -> SheetTable:
    """Make a sheet without positions, whose columns are valid unless the state says otherwise."""
    shape = next(iter(columns.values())).shape
    return SheetTable(
        columns=columns,
        subfield=state.get("subfield", np.full(shape, "")).astype(np.str_),
        valid=state.get("valid", np.ones(shape)).astype(np.bool_),
        repaired=state.get("repaired", np.zeros(shape)).astype(np.bool_),
        doubtful=state.get("doubtful", np.zeros(shape)).astype(np.bool_),
        points={},
        ends=ends,
    )


def _points(data: Measurement | xr.Dataset, level: str) -> Float:
    """(x, y, 3) RAS mm."""
    if isinstance(data, Measurement):
        shape = data.maps["thickness"].shape
        return data.surface(level).points.reshape(*shape, 3)
    if level != "midthickness" or "position" not in data:
        raise ValueError(f"this dataset has no surface {level!r}; hipsta_bids.measure gives all")
    position = data["position"]
    if "layer" in position.dims:
        position = position.sel(layer=_MIDDLE)
    return np.asarray(position.transpose("x", "y", "ras"), dtype=np.float64)


def _light(corners: Float, elevation: float, azimuth: float) -> Float:
    """Brightness of faces (N, 3, 3) that a lamp next to the viewer lights on both sides."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    high, around = np.radians([elevation + 15, azimuth + 15])
    lamp = [np.cos(high) * np.cos(around), np.cos(high) * np.sin(around), np.sin(high)]
    facing = np.abs(normals @ np.array(lamp)) / np.where(length > 0, length, 1)
    return np.asarray(1 - _SHADE + _SHADE * facing)
