"""Effects of sites as a file, for other people of the same sites, or of new ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids import __version__
from hipsta_bids.errors import ModelError
from hipsta_bids.group.combat import SiteEffects
from hipsta_bids.group.data import Float, Int
from hipsta_bids.group.formula import check_names, listed, typed
from hipsta_bids.group.grammar import CONTEXT, closed_formula
from hipsta_bids.group.settings import DesignSettings
from hipsta_bids.io import files

#: Of the files.
_FORMAT = 1
_LARGEST = 1_000_000_000  # bytes
_DIGITS = 9
_PLAIN = ("column", "formula", "levels", "columns", "sites", "repeated", "icv", "templates")
_ARRAYS = tuple(one.name for one in fields(SiteEffects))
#: Column that is not kept: sites have the means.
INTERCEPT = "Intercept"
_FLAT = frozenset({"mean", "sd", "ratio"})

Effects = Mapping[tuple[str, str], SiteEffects]
"""By hemisphere and measure."""


@dataclass(frozen=True, kw_only=True)
class SavedEffects:
    """Parameters of an analysis, for others."""

    file: str
    """Where it was read, for messages."""
    column: str
    formula: str
    """What they kept."""
    levels: Mapping[str, Sequence[str]]
    columns: tuple[str, ...]
    sites: Mapping[str, int]
    """Participants by site."""
    repeated: bool
    """Whether participants had several visits."""
    icv: str | None
    """Column that volumes kept besides."""
    templates: Mapping[str, str]
    """Digest of the template of registration by hemisphere."""
    maps: Effects
    summaries: Effects
    """Each is a single point."""


def save_effects(path: Path, effects: SavedEffects) -> None:
    """Write parameters, to be read by :func:`load_effects`."""
    content = {
        "Description": "effects of sites on maps and summary measures (ComBat)",
        "Format": _FORMAT,
        "Version": __version__,
        **{name.capitalize(): getattr(effects, name) for name in _PLAIN},
        "Maps": _nested(effects.maps),
        "Summaries": _nested(effects.summaries),
    }
    files.write_json(path, content)


def _nested(effects: Effects) -> dict[str, dict[str, Any]]:
    """Write lists by hemisphere and measure; what is missing is null."""
    nested: dict[str, dict[str, Any]] = {}
    for (hemi, measure), one in effects.items():
        arrays = {name: as_lists(getattr(one, name)) for name in _ARRAYS}
        nested.setdefault(hemi, {})[measure] = arrays
    return nested


def as_lists(values: Float) -> list[Any]:
    """Write an array as lists of rounded numbers, as files for others have them."""
    if values.ndim > 1:
        return [as_lists(row) for row in values]
    return [float(f"{one:.{_DIGITS}g}") if np.isfinite(one) else None for one in values.tolist()]


def load_effects(path: Path) -> SavedEffects:
    """Read what :func:`save_effects` wrote; nothing in it is run.

    Raises
    ------
    ModelError
        If the file is too large, of another format, or its parts do not fit each other.
    """
    where = str(path)
    if path.is_file() and path.stat().st_size > _LARGEST:
        raise damaged(where, f"larger than {_LARGEST / 1e9:g} GB")
    content = files.read_json(path)
    try:
        if content.get("Format") != _FORMAT:
            raise damaged(where, f"format {content.get('Format')!r}, not {_FORMAT}")
        sites = {str(one): int(n) for one, n in content["Sites"].items()}
        columns, icv = tuple(map(str, content["Columns"])), content["Icv"]
        shapes = {len(sites)}, {len(columns), len(columns) + (icv is not None)}
        formula = str(content["Formula"])
        closed_formula(formula)
        return SavedEffects(
            file=where,
            column=str(content["Column"]),
            formula=formula,
            levels={str(n): tuple(map(str, one)) for n, one in content["Levels"].items()},
            columns=columns,
            sites=sites,
            repeated=bool(content["Repeated"]),
            icv=None if icv is None else str(icv),
            templates={str(h): str(one) for h, one in content["Templates"].items()},
            maps=_read(where, content["Maps"], *shapes),
            summaries=_read(where, content["Summaries"], *shapes),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise damaged(where, f"{type(error).__name__}: {error}") from error


def _read(
    where: str, content: Mapping[str, Any], sites: set[int], columns: set[int]
) -> dict[tuple[str, str], SiteEffects]:
    found = {}
    for hemi, measures in content.items():
        for measure, entry in measures.items():
            arrays = {name: np.array(entry[name], dtype=np.float64) for name in _ARRAYS}
            points = len(arrays["mean"])
            arrays["slopes"] = arrays["slopes"].reshape(-1, points)  # without columns: (0,)
            for name, values in arrays.items():
                rows = columns if name == "slopes" else sites
                known = {(points,)} if name in _FLAT else {(row, points) for row in rows}
                if values.shape not in known:
                    raise damaged(where, f"{name} of {measure}, {hemi}, has {values.shape}")
                if name in {"sd", "scale"} and (values <= 0).any():
                    raise damaged(where, f"{name} of {measure}, {hemi}, is not positive")
            found[str(hemi), str(measure)] = SiteEffects(**arrays)
    return found


def level_labels(values: pd.Series, settings: DesignSettings) -> pd.Series:
    """Names of levels, whatever they look like; ``None`` where missing."""
    names = typed(values, settings).astype(object)
    return names.map(lambda one: one if one is None else _label(one)).where(names.notna(), None)


def _label(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def columns_of(
    table: pd.DataFrame,
    formula: str,
    levels: Mapping[str, Sequence[str]],
    settings: DesignSettings,
    where: str,
) -> tuple[Float, tuple[str, ...], Int]:
    """Make columns of a formula with given levels, without intercept; and rows that have all."""
    closed = closed_formula(formula)
    names = sorted(closed.names)
    if not names:
        return np.empty((len(table), 0)), (), np.arange(len(table))
    check_names(names, table.columns)
    used = pd.DataFrame(
        {
            n: level_labels(table[n], settings) if n in levels else typed(table[n], settings)
            for n in names
        }
    )
    complete = used.notna().all(axis=1).to_numpy()
    used = used[complete].copy()
    for name, known in levels.items():
        if unknown := sorted(set(used[name]) - set(known)):
            raise ModelError(
                f"{where}has no {name!r} {listed(unknown)}, only {listed(known)}; leave these"
                " participants out, or harmonize anew",
                reason="harmonization-file",
            )
        used[name] = pd.Categorical(used[name], categories=list(known))
    if text := [name for name in names if name not in levels and used[name].dtype == object]:
        raise ModelError(
            f"{where}{listed(text)} should be numbers, as where it was made",
            reason="harmonization-file",
        )
    made = Formula(closed.text).get_model_matrix(used, na_action="raise", context=dict(CONTEXT))
    inside = [str(name) for name in made.columns if str(name) != INTERCEPT]
    return made[inside].to_numpy(np.float64), tuple(inside), np.flatnonzero(complete)


def damaged(where: str, what: str) -> ModelError:
    """Say that a file cannot be used."""
    return ModelError(
        f"{where}: not a file of harmonization ({what}); use the harmonization.json of another"
        " analysis",
        reason="harmonization-file",
    )
