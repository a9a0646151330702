"""Registration and models of the group level on arrays, without files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from hipsta_bids.errors import in_python
from hipsta_bids.group.cohort.covariates import Spellings, mark_missing, spelled_note
from hipsta_bids.group.cohort.read import leave_rare
from hipsta_bids.group.model import ModelRequest, choose_model
from hipsta_bids.group.output.tables import notebook_table
from hipsta_bids.group.output.write import stats_of, write_stats
from hipsta_bids.group.settings import GroupSettings, load_group_settings
from hipsta_bids.io.files import check_writable
from hipsta_bids.io.xarrays import make_dataset
from hipsta_bids.progress import tell
from hipsta_bids.stats import registration
from hipsta_bids.stats.arrays import Bool, Float, SideMaps
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.formula import with_factors
from hipsta_bids.stats.glm import FittedMaps, PointTest, RowModel, fit_maps
from hipsta_bids.stats.inference import Discoveries, MapKey, check_permutations, correct
from hipsta_bids.stats.warps import warp_labels, warp_values
from hipsta_bids.types import PARTICIPANT, Mesh, parts_of

_Number = TypeVar("_Number", np.float64, np.bool_)
_GRID, _VERTICES = 3, 2  # axes of the maps of a side, participants included
_TEXT_ROWS = 8  # rows of a table in the text of a fit
#: Arrays of the results: what they hold, and whether in the unit of the maps.
_ARRAYS = {
    "estimate": ("value of the contrast; of several rows (F) missing", True),
    "se": ("standard error of the estimate", True),
    "statistic": ("t, or F", False),
    "df": ("residual degrees of freedom", False),
    "p": ("of each point alone, two-sided unless the contrast has > or <", False),
    "p_corrected": ("corrected for the number of points", False),
    "effect": ("Cohen's d, or of F partial eta squared", False),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupFit:
    """A linear model at every point, its contrasts, and what survives."""

    measure: str
    unit: str
    design: Design
    """Matrix, its columns, the rows that are complete, and those left out with what they lack."""
    fitted: Mapping[str, FittedMaps]
    """By side."""
    found: Mapping[MapKey, Discoveries]
    axes: Mapping[str, Float]
    """Coordinates of the points, by axis; empty where they are not known."""

    def __repr__(self) -> str:
        text = f"GroupFit of {self.measure} by {', '.join(self.design.columns)}"
        arrays = f"  maps {self.significant.shape}: {', '.join(_ARRAYS)}"
        return f"{text}\n{self.table.to_string(index=False, max_rows=_TEXT_ROWS)}\n{arrays}"

    def _repr_html_(self) -> str:
        return notebook_table(repr(self).partition("\n")[0], self.table, _TEXT_ROWS)

    @property
    def sides(self) -> tuple[str, ...]:
        """Sides, in the order of the first axis of :attr:`maps`."""
        return tuple(self.fitted)

    @property
    def contrasts(self) -> tuple[str, ...]:
        """Contrasts, in the order of the second axis of :attr:`maps`."""
        return tuple(contrast.name for contrast in self.design.contrasts)

    def test(self, side: str, contrast: str) -> PointTest:
        """Return the test of one contrast at all points, with limits of the effect sizes."""
        return self._tests(side)[self.contrasts.index(contrast)]

    def _tests(self, side: str) -> tuple[PointTest, ...]:
        return self.fitted[side].fits[self.measure].tests

    def _found(self, side: str, test: PointTest) -> Discoveries:
        return self.found[MapKey(self.measure, test.contrast.name, side)]

    @cached_property
    def maps(self) -> Mapping[str, Float]:
        """Arrays (side, contrast, x, y), or (side, contrast, vertex); NaN where nothing is tested.

        ``estimate`` and ``se`` in the unit of the maps, ``statistic`` (t or F), ``df``, ``p``,
        ``p_corrected``, and ``effect`` (Cohen's d, or partial eta squared of F).
        """
        return {name: self._stacked(partial(self._values, name)) for name in _ARRAYS}

    @cached_property
    def significant(self) -> Bool:
        """Points that survive the correction, in the shape of :attr:`maps`."""
        return self._stacked(lambda side, test: self._found(side, test).rejected)

    def _values(self, name: str, side: str, test: PointTest) -> Float:
        if name == "p_corrected":
            return self._found(side, test).adjusted
        if name in {"estimate", "se"}:
            rows = getattr(test, name)
            return rows[0] if test.kind == "t" else np.full(rows.shape[1], np.nan)
        return np.asarray(getattr(test, name))

    def _stacked(self, values: Callable[[str, PointTest], NDArray[_Number]]) -> NDArray[_Number]:
        array = np.array([[values(one, test) for test in self._tests(one)] for one in self.sides])
        maps = self.fitted[self.sides[0]].maps
        inner = maps.shape if maps.mesh is None and maps.shape[1] > 1 else maps.shape[:1]
        return array.reshape(*array.shape[:2], *inner)

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per side and contrast: points that survive, and the largest effect."""
        rows = []
        for i, side in enumerate(self.sides):
            for j, test in enumerate(self._tests(side)):
                discoveries = self._found(side, test)
                effects = self.maps["effect"][i, j]
                is_tested = np.isfinite(effects).any()
                rows.append(
                    {
                        "side": side,
                        "contrast": test.contrast.name,
                        "test": test.kind,
                        "participants": len(self.fitted[side].rows),
                        "points": int(np.isfinite(test.p).sum()),
                        "significant": int(discoveries.rejected.sum()),
                        "alpha": discoveries.alpha,
                        "largest_effect": effects.flat[np.nanargmax(np.abs(effects))]
                        if is_tested
                        else np.nan,
                    }
                )
        return pd.DataFrame(rows)

    @cached_property
    def dataset(self) -> xr.Dataset:
        """The maps as a dataset of xarray, by side, contrast and points."""
        inner = ("x", "y") if self.significant.ndim > _GRID else ("vertex",)
        axes = ("side", "contrast", *inner)
        variables: dict[str, Any] = {
            name: (axes, values, {"long_name": words, "units": self.unit if has_unit else "1"})
            for (name, (words, has_unit)), values in zip(
                _ARRAYS.items(), self.maps.values(), strict=True
            )
        }
        variables["significant"] = (axes, self.significant, {"long_name": "survives"})
        coordinates: dict[str, Any] = {
            "side": (["side"], list(self.sides), {}),
            "contrast": (["contrast"], list(self.contrasts), {}),
        }
        coordinates |= {name: ([name], values, {}) for name, values in self.axes.items()}
        return make_dataset(variables, coordinates, {"measure": self.measure})

    def to_gifti(self, folder: str | Path) -> Path:
        """Write statistics, effect sizes and corrected p-values as GIFTI, of both sides as CIFTI-2.

        Values are in the order of ``maps[name].ravel()``, NaN where nothing is tested.
        """
        check_writable(Path(folder))
        tested = (
            (MapKey(self.measure, test.contrast.name, side), test, self._found(side, test))
            for side in self.sides
            for test in self._tests(side)
        )
        write_stats(Path(folder), stats_of(tested))
        return Path(folder)


@in_python()
def group(
    maps: xr.DataArray | Mapping[str, ArrayLike] | ArrayLike,
    table: pd.DataFrame,
    formula: str,
    *,
    contrasts: Sequence[str] = (),
    references: Mapping[str, str] | None = None,
    correction: str | None = None,
    triangles: ArrayLike | None = None,
    settings: GroupSettings | str | Path | None = None,
) -> GroupFit:
    """Fit one linear model at every point of maps, and correct for the number of points.

    The model is as of ``hipsta-bids ... group``, with one row per participant. Maps are taken as
    they are, see :func:`register`; repeated visits and the classification are the command's.

    Parameters
    ----------
    maps
        (participants, x, y) on the sheet, or (participants, vertices) on another surface, NaN for
        missing; a mapping of arrays by side, which are corrected together or not by the
        setting ``multiplicity.scope``; or an array of xarray with the axes ``participant``,
        perhaps ``side``, and x and y or vertices, of one session and protocol, as
        :func:`hipsta_bids.load` gives.
    table : DataFrame
        One row per participant, in the order of the maps. With an array of xarray, rows are found
        by the column ``participant_id``, and may be in any order. Cells that spell a missing value
        (``unknown``, ``-``) are missing; ``design.notes`` of the result counts them.
    formula : str
        Such as ``"group + age + sex"``; names are columns of the table.
    contrasts : sequence of str
        Such as ``"CN-AD = group[CN] - group[AD]"``. Without any, groups in the formula are compared
        with their reference. Else each column of the design is tested, of factors as reference
        minus level.
    references : mapping, optional
        Reference level by factor.
    correction : {"fdr2", "bh", "permutation-tfce", "permutation-max"}, optional
        Instead of the method of the settings (``fdr2``).
    triangles : array, optional
        (faces, 3) of maps on vertices: neighbors, for cluster enhancement.
    settings : GroupSettings, str or Path, optional
        Settings of the group level, or a TOML file with some.

    Returns
    -------
    GroupFit
        ``maps`` and ``significant`` as arrays by side and contrast, ``dataset`` with coordinates,
        ``table`` with one row per side and contrast, ``design``.

    Raises
    ------
    ValueError
        If maps and table do not fit.
    FileNotFoundError
        If the file of settings does not exist.
    ModelError
        With the reason why the model cannot be fitted.

    Examples
    --------
    Twenty participants; in the second group the wall of two of ten columns is .5 mm thinner:

    >>> import numpy as np, pandas as pd
    >>> import hipsta_bids as hb
    >>> random = np.random.default_rng(1)
    >>> table = pd.DataFrame({"group": ["CN"] * 10 + ["AD"] * 10, "age": random.normal(70, 5, 20)})
    >>> maps = random.normal(2.0, 0.1, (20, 10, 4))
    >>> maps[10:, :2] -= 0.5
    >>> fit = hb.group(maps, table, "group + age")
    >>> fit.contrasts
    ('CN-AD',)
    >>> fit.significant.shape  # side, contrast, x, y
    (1, 1, 10, 4)
    >>> fit.significant[0, 0, :2].sum(), fit.significant[0, 0, 2:].sum()
    (np.int64(8), np.int64(1))
    >>> print(f"{fit.maps['estimate'][0, 0, :2].mean():.1f} mm")
    0.5 mm
    """
    sides, axes, table, measure, unit = _arranged(maps, table, triangles)
    request = ModelRequest(
        formula=formula,
        contrasts=tuple(contrasts),
        references=tuple((references or {}).items()),
    )
    settings = _loaded(settings)
    if correction is not None:
        settings = settings.changed(multiplicity={"method": correction})
    if (
        settings.multiplicity.method == "permutation-tfce"
        and triangles is None
        and any(values.ndim == _VERTICES for values in sides.values())
    ):
        raise ValueError("clusters of vertices need triangles, (faces, 3)")
    spelled = Spellings()
    table = with_factors(mark_missing(table, {}, spelled), settings.design, settings.model)
    _, spec, _, levels = choose_model(request, table, settings)
    design = build_design(table, spec, settings.design, levels)
    if spelled:
        note = spelled_note(spelled, formula or "", settings)
        design = replace(design, notes={**design.notes, "missing": note})
    model, report = RowModel(design, settings.glm), partial(tell, "permutations")
    check_permutations(settings.multiplicity, settings.glm, design.contrasts)
    side_maps = {side: _side(values, measure, triangles) for side, values in sides.items()}
    fitted = {side: fit_maps(side, one, model) for side, one in side_maps.items()}
    return GroupFit(
        measure=measure,
        unit=unit,
        design=design,
        fitted=fitted,
        found=correct(fitted, model, table, settings.multiplicity, report=report),
        axes=axes,
    )


def _arranged(
    maps: xr.DataArray | Mapping[str, ArrayLike] | ArrayLike,
    table: pd.DataFrame,
    triangles: ArrayLike | None,
) -> tuple[dict[str, Float], dict[str, Float], pd.DataFrame, str, str]:
    """Arrays by side, coordinates, rows in the same order, and name and unit of the measure."""
    axes: dict[str, Float] = {}
    measure, unit = "maps", "1"
    if isinstance(maps, Mapping):
        sides = {str(side): np.asarray(values, np.float64) for side, values in maps.items()}
    elif isinstance(maps, xr.DataArray):
        sides, axes, names = _of_labeled(maps)
        measure, unit = str(maps.name or measure), str(maps.attrs.get("units", unit))
        if names is not None and PARTICIPANT in table:
            if table[PARTICIPANT].duplicated().any():
                raise ValueError(
                    f"table: a {PARTICIPANT} occurs twice; keep one row per participant"
                )
            table = table.set_index(PARTICIPANT, drop=False).reindex(names)
    else:
        sides = {"both": np.asarray(maps, np.float64)}
    for side, values in sides.items():
        if values.ndim not in ({_GRID, _VERTICES} if triangles is None else {_VERTICES}):
            raise ValueError(
                f"maps of side {side} have shape {values.shape}; they need one row per participant,"
                " and then x and y, or vertices"
            )
        if len(values) != len(table):
            raise ValueError(
                f"{len(values)} maps of side {side}, {len(table)} rows in the table; both need one"
                " per participant, in the same order"
            )
    if len({values.shape for values in sides.values()}) > 1:
        raise ValueError("maps of both sides need the same points")
    return sides, axes, table, measure, unit


def _of_labeled(
    maps: xr.DataArray,
) -> tuple[dict[str, Float], dict[str, Float], list[str] | None]:
    """Arrays by side, coordinates, and names of participants of an array of xarray."""
    single = [name for name in ("protocol", "session", "side") if maps.sizes.get(name) == 1]
    side = str(maps.coords["side"].to_numpy().ravel()[0]) if "side" in maps.coords else "both"
    maps = maps.squeeze(single, drop=True)
    if "participant" not in maps.dims or {"protocol", "session"} & set(maps.dims):
        raise ValueError(
            f"maps have the axes {', '.join(map(str, maps.dims))}; they need participant, one"
            " protocol, one session, and points"
        )
    names = maps.coords["participant"].to_numpy().tolist() if "participant" in maps.coords else None
    if "side" in maps.dims:
        side_names = [str(one) for one in maps.coords["side"].to_numpy()]
        arrays = {one: maps.sel(side=one) for one in side_names}
    else:
        arrays = {side: maps}
    order: list[str] = [name for name in ("x", "y") if name in maps.dims]
    sides = {
        one: np.asarray(values.transpose("participant", *order, ...), dtype=np.float64)
        for one, values in arrays.items()
    }
    axes = {name: maps.coords[name].to_numpy() for name in order if name in maps.coords}
    return sides, axes, names


def _side(values: Float, measure: str, triangles: ArrayLike | None) -> SideMaps:
    count = len(values)
    maps = values if values.ndim == _GRID else values[:, :, None]
    mesh = None
    if triangles is not None:
        faces = np.asarray(triangles, dtype=np.int64)
        mesh = Mesh(points=np.full((maps.shape[1], 3), np.nan), triangles=faces)
    return SideMaps(
        rows=np.arange(count),
        maps={measure: maps},
        subfield=np.full(maps.shape, -1, dtype=np.int8),
        names=(),
        summary=pd.DataFrame(index=range(count)),
        mesh=mesh,
    )


@in_python()
def register(
    maps: xr.Dataset | Mapping[str, ArrayLike],
    *,
    settings: GroupSettings | str | Path | None = None,
) -> xr.Dataset:
    """Align sheets by their curvature, so that a grid node means the same position in all.

    As in ``hipsta-bids ... group``: profiles of mean curvature along x are registered to a template
    made of all sheets of a side and protocol, and all maps follow. Select maps first: all are read.

    Parameters
    ----------
    maps : xarray.Dataset or mapping
        Maps by name, among them ``curvature`` (1/mm): maps of :func:`hipsta_bids.load`, or arrays
        (participants, x, y) of one side, NaN for missing.
    settings : GroupSettings, str or Path, optional
        Settings of the group level, or a TOML file with some.

    Returns
    -------
    xarray.Dataset
        The maps at registered nodes; ``shift`` (participant, x), registered minus original
        position in nodes, positive is lateral; ``explained_before`` and ``explained_after``, share
        of the variance of profiles that the mean profile explains.

    Raises
    ------
    ValueError
        If there is no curvature with axes participant, x and y.
    FileNotFoundError
        If the file of settings does not exist.
    ModelError
        If there are too few sheets for a template (setting ``registration.min_subjects``), or a
        sheet lacks too much of its profile.

    Examples
    --------
    >>> import hipsta_bids as hb
    >>> study = hb.example()
    >>> maps = hb.load(study.out_dir).maps[["thickness", "curvature"]]
    >>> aligned = hb.register(maps)
    >>> bool((aligned.explained_after > aligned.explained_before).all())
    True
    >>> hb.group(aligned.thickness, study.participants, "group + age").contrasts
    ('CN-AD',)
    """
    settings = _loaded(settings)
    maps, axes = _with_axes(maps)
    rows = [axis for axis in ("participant", "session") if axis in axes]
    outer = [axis for axis in axes if axis not in {*rows, "x", "y"}]
    labeled = {
        name: values.transpose(*outer, *rows, "x", "y", ...)
        for name, values in maps.data_vars.items()
        if set(axes) <= set(values.dims)
    }
    sizes = [int(np.prod([maps.sizes[axis] for axis in names])) for names in (outer, rows)]
    shape = (*sizes, maps.sizes["x"], -1)
    arrays = {name: values.to_numpy().reshape(shape).copy() for name, values in labeled.items()}
    shifts, explained = np.full(shape[:3], np.nan), np.full((2, sizes[0]), np.nan)
    has_rims = "y" in maps.coords and parts_of(maps["y"].to_numpy()) is not None
    for part in range(sizes[0]):
        pieces = {name: values[part] for name, values in arrays.items()}
        shifts[part], explained[:, part] = _register_part(pieces, settings, has_rims=has_rims)
    results: dict[str, Any] = {
        str(name): values.copy(data=arrays[name].reshape(values.shape)).transpose(*maps[name].dims)
        for name, values in labeled.items()
    }
    return maps.assign(results | _of_registration(maps, (*outer, *rows, "x"), shifts, explained))


def _of_registration(
    maps: xr.Dataset, axes: tuple[Any, ...], shifts: Float, explained: Float
) -> dict[str, Any]:
    """Name shifts and explained shares; axes of participants and sessions follow the outer ones."""
    lengths = [maps.sizes[axis] for axis in axes]
    n_outer = sum(axis not in {"participant", "session", "x"} for axis in axes)
    about = {"long_name": "registered minus original position", "units": "nodes"}
    arrays: dict[str, Any] = {"shift": (axes, shifts.reshape(lengths), about)}
    for name, shares in zip(("explained_before", "explained_after"), explained, strict=True):
        arrays[name] = axes[:n_outer], shares.reshape(lengths[:n_outer])
    return arrays


def _register_part(
    arrays: Mapping[Any, NDArray[Any]], settings: GroupSettings, *, has_rims: bool
) -> tuple[Float, Float]:
    """Register sheets (rows, x, points) in place; returns shifts (rows, x) and shares explained."""
    has_sheet = np.isfinite(arrays["curvature"]).any(axis=(1, 2))
    shifts, explained = np.full(arrays["curvature"].shape[:2], np.nan), np.full(2, np.nan)
    if has_sheet.any():
        curvature = arrays["curvature"][has_sheet]
        profiles = registration.mean_profiles(curvature, settings.registration)
        result = registration.register(profiles, settings.registration)
        shifts[has_sheet] = result.shifts
        explained[:] = result.explained_before, result.explained_after
        for values in arrays.values():
            values[has_sheet] = _carried(values[has_sheet], result.warps, has_rims=has_rims)
    return shifts, explained


def _loaded(settings: GroupSettings | str | Path | None) -> GroupSettings:
    if isinstance(settings, GroupSettings):
        return settings
    return load_group_settings(None if settings is None else Path(settings))


def _with_axes(maps: xr.Dataset | Mapping[str, ArrayLike]) -> tuple[xr.Dataset, tuple[Any, ...]]:
    """Name the axes of maps; also return those of curvature, by which sheets are registered."""
    if not isinstance(maps, xr.Dataset):
        sheets = ("participant", "x", "y")
        maps = xr.Dataset({name: (sheets, np.asarray(maps[name], np.float64)) for name in maps})
    axes = tuple(maps["curvature"].dims) if "curvature" in maps else ()
    if not {"participant", "x", "y"} <= set(axes):
        raise ValueError("registration needs curvature with the axes participant, x and y")
    return maps, axes


def _carried(values: NDArray[Any], warps: Float, *, has_rims: bool) -> NDArray[Any]:
    """Carry numbers or labels (sheets, x, points) to registered nodes along x."""
    if values.dtype.kind == "f":
        carried = warp_values(values, warps)
        if has_rims:
            leave_rare(carried)
        return carried
    names, codes = np.unique(values, return_inverse=True)
    return np.asarray(names[warp_labels(codes.reshape(values.shape).astype(np.int8), warps)])
