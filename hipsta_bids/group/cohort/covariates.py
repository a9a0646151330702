"""Covariates of participants and sessions, from tables of a BIDS dataset and other tables."""

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.dataset import linked_path, read_links
from hipsta_bids.errors import InputError, MissingFileError, ModelError
from hipsta_bids.group.design.formula import as_factor, check_numbers, level_name, typed
from hipsta_bids.group.design.model import FIRST_AGE, VisitTime
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.opening import SETTINGS, read_bounded
from hipsta_bids.types import PARTICIPANT, SESSION

#: Number of rows that a message lists.
_MOST_NAMES = 6
#: Column of BIDS' sessions.tsv with dates, and columns that are made here.
_DATE, TIME, _ICV = "acq_time", "time", "icv"
_DAYS_PER_YEAR = 365.25
#: Levels of factors that are numbers, and characters of a name for one.
_CODE = re.compile(r"-?\d+(\.\d+)?")
_LONGEST_NAME = 40


def locate_sources(sources: Sequence[str], roots: Sequence[Path]) -> list[Path | None]:
    """Paths of segmentations, from their addresses in the quality records of datasets."""
    links = cache(read_links)
    pairs = zip(sources, roots, strict=True)
    return [linked_path(source, root, links(root)) for source, root in pairs]


def relocate(source: str, folders: Sequence[Path]) -> str:
    """Find a segmentation in folders where it may be now."""
    if not source.startswith("bids:"):
        return source
    inside = PurePosixPath(source.split(":", 2)[2])
    for folder in folders:
        # The image itself is not needed, only the subject's folder with its other files.
        if (folder / inside.parts[0]).is_dir():
            return str(folder / inside)
    return source


def read_covariates(visits: pd.DataFrame, bids_dir: Path, extra: Sequence[Path]) -> pd.DataFrame:
    """Join covariates to visits; cells stay text.

    In this order: ``participants.tsv``, ``sessions.tsv`` of the participants, ``phenotype/*.tsv``,
    and the user's own tables. A later table fills or replaces columns of the same name. Columns
    whose ``Levels`` a sidecar lists are factors, with the names of the levels instead of numbers.
    """
    joined = visits.copy()
    main = bids_dir / "participants.tsv"
    tables = [main] if main.is_file() else []
    described: dict[str, object] = {}
    if not bids_dir.is_dir():
        raise MissingFileError(f"{bids_dir}: no such folder; check its name")
    for path in (*tables, *sorted((bids_dir / "phenotype").glob("*.tsv")), *extra):
        table = _read(path)
        if path == main:
            _check_known(joined, table, path)
        joined = _join(joined, table, path)
        described |= _sidecar(path.with_suffix(".json"))
        if path == main:
            joined = _join_sessions(joined, bids_dir)
            described |= _sidecar(bids_dir / "sessions.json")
    for column in described.keys() & set(joined.columns):
        joined[column] = _with_levels(joined[column], described[column])
    return joined


def _sidecar(path: Path) -> dict[str, object]:
    return dict(files.read_json(path)) if path.is_file() else {}


def _with_levels(values: pd.Series, description: object) -> pd.Series:
    """Make a factor of a column all of whose values are ``Levels`` of its description."""
    listed = description.get("Levels") if isinstance(description, Mapping) else None
    if not isinstance(listed, Mapping):
        return values
    levels = {level_name(code): meaning for code, meaning in listed.items()}
    factor = as_factor(values)
    present = [str(code) for code in factor.cat.categories]
    if not present or not set(present) <= set(levels):
        return values
    names = [_level_word(levels[code]) for code in present]
    codes = all(_CODE.fullmatch(code) for code in present)
    if codes and all(names) and len(set(names)) == len(names):
        factor = factor.cat.rename_categories(names)
    return factor


def _level_word(meaning: object) -> str:
    """Name a level by what its description says, if that is short and may stand in a contrast."""
    if isinstance(meaning, Mapping):
        meaning = meaning.get("LongName") or meaning.get("Description")
    word = " ".join(str(meaning or "").split())
    return word if len(word) <= _LONGEST_NAME and not set(word) & set("[]=,") else ""


def _check_known(visits: pd.DataFrame, table: pd.DataFrame, path: Path) -> None:
    """Refuse a table of other participants: labels may differ."""
    if not set(visits[PARTICIPANT]) & set(table[PARTICIPANT]):
        raise InputError(
            f"{path}: names none of the participants here; it has {table[PARTICIPANT].iloc[0]} ...,"
            f" here are {visits[PARTICIPANT].iloc[0]} ..."
        )


def _read(path: Path) -> pd.DataFrame:
    rows = files.read_tsv(path)
    if not rows:
        raise InputError(
            f"{path}: has no rows; it needs a column participant_id, and a row per participant",
            reason="bad-table",
        )
    table = pd.DataFrame(rows, dtype=object)
    if PARTICIPANT not in table.columns:
        raise InputError(
            f"{path}: has no column participant_id; columns are separated by tabs",
            reason="bad-table",
        )
    return _cleaned(table)


def _cleaned(table: pd.DataFrame) -> pd.DataFrame:
    """Take off blanks round cells, add prefixes that labels lack, and mark missing cells."""
    table = table.map(str.strip)
    for column, prefix in ((PARTICIPANT, "sub-"), (SESSION, "ses-")):
        if column in table.columns:
            has_prefix = (table[column] == files.MISSING) | table[column].str.startswith(prefix)
            table[column] = table[column].where(has_prefix, prefix + table[column])
    return table.where(table != files.MISSING, None)


def _join_sessions(joined: pd.DataFrame, bids_dir: Path) -> pd.DataFrame:
    parts = []
    for participant in joined.loc[joined[SESSION].notna(), PARTICIPANT].unique():
        path = bids_dir / participant / f"{participant}_sessions.tsv"
        if path.is_file():
            part = pd.DataFrame(files.read_tsv(path), dtype=object)
            if SESSION not in part.columns:
                raise InputError(f"{path}: has no column session_id", reason="bad-table")
            parts.append(_cleaned(part).assign(**{PARTICIPANT: participant}))
    if not parts:
        return joined
    return _join(joined, pd.concat(parts, ignore_index=True), bids_dir / "sub-*_sessions.tsv")


def _join(joined: pd.DataFrame, table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Add the columns of one table, by participant, and by session if it has sessions."""
    by_session = SESSION in table.columns and bool(table[SESSION].notna().any())
    keys = [PARTICIPANT, SESSION] if by_session else [PARTICIPANT]
    table = table.drop(columns=[SESSION]) if SESSION in table and not by_session else table
    table = table[table[PARTICIPANT].isin(joined[PARTICIPANT])]
    repeated = table.loc[table.duplicated(keys), keys].astype(str).agg(" ".join, axis=1)
    if len(repeated):
        names = sorted(set(repeated))
        ending = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
        raise InputError(
            f"{path}: {', '.join(names[:_MOST_NAMES])}{ending} occur more than once; keep one row"
            " each"
        )
    indexed = table.set_index(keys)
    rows = pd.MultiIndex.from_frame(joined[keys]) if by_session else joined[PARTICIPANT]
    aligned = indexed.reindex(rows)
    result = joined.copy()
    for column in indexed.columns:
        values = pd.Series(aligned[column].to_numpy(), index=joined.index, dtype=object)
        values = values.where(values.notna(), None)
        if column in result.columns:
            values = values.where(values.notna(), result[column])
        result[column] = values
    return result


def add_icv(
    table: pd.DataFrame, sources: Mapping[str, tuple[str, Path]], settings: GroupSettings
) -> tuple[pd.DataFrame, str | None]:
    """Find the column of intracranial volume, or make one from what the programs estimated.

    ``sources`` are addresses of segmentations, and the datasets whose records have them, by visit.
    """
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    for name in settings.model.icv_columns:
        if name in by_name:
            return table, by_name[name]
    sources_of_table = {name: sources[name] for name in table.index if name in sources}
    read = read_icv(
        [source for source, _ in sources_of_table.values()],
        [root for _, root in sources_of_table.values()],
    )
    if all(volume is None for volume in read):
        return table, None
    volumes = dict(zip(sources_of_table, read, strict=True))
    column = pd.array([volumes.get(name) for name in table.index], dtype=np.float64)
    return table.assign(**{_ICV: column}), _ICV


def read_icv(sources: Sequence[str], roots: Sequence[Path]) -> list[float | None]:
    """Intracranial volumes in mm^3 as the segmentations' own programs estimated them.

    FreeSurfer's ``stats/aseg.stats`` (EstimatedTotalIntraCranialVol) beside the ``mri`` folder, or
    ASHS's ``*_icv.txt`` beside or above the segmentation.
    """
    paths = locate_sources(sources, roots)
    return [None if path is None else _icv_beside(path) for path in paths]


def _icv_beside(path: Path) -> float | None:
    stats = path.parent.parent / "stats" / "aseg.stats"
    if stats.is_file():
        for line in read_bounded(stats, SETTINGS).decode(errors="replace").splitlines():
            if line.startswith("# Measure EstimatedTotalIntraCranialVol,"):
                return _number(line.split(",")[-2])
    for folder in (path.parent, path.parent.parent, path.parent.parent / "final"):
        for found in sorted(folder.glob("*icv.txt")):
            words = read_bounded(found, SETTINGS).decode(errors="replace").split()
            if words:  # subject and volume, or the volume alone
                return _number(words[-1])
    return None


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if value > 0 else None


def add_time(table: pd.DataFrame, settings: GroupSettings) -> VisitTime:
    """Find the time of each visit, or make it from dates or ages.

    A column of ``longitudinal.time_columns`` that varies between sessions of a participant; else
    ``acq_time``, in years since the participant's first session; else age, likewise. If age
    varies between sessions, the age at the first one is added, since age itself would explain part
    of the change.
    """
    covariates = tuple(settings.model.covariates)
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    people, columns = table[PARTICIPANT], dict[str, Any]()
    times, unit = None, 1.0
    if "age" in by_name:
        ages = typed(table[by_name["age"]])
        if pd.api.types.is_numeric_dtype(ages):
            check_numbers(ages, settings.design)
        if _varies(ages, people):
            times, columns[FIRST_AGE] = ages, ages.groupby(people).transform("first")
            covariates = tuple(
                FIRST_AGE if name.casefold() == "age" else name for name in covariates
            )
    names = [name.casefold() for name in settings.longitudinal.time_columns]
    named = {by_name[name]: table[by_name[name]] for name in names if name in by_name}
    candidates = ((name, typed(values)) for name, values in named.items())
    column, own = next((one for one in candidates if _varies(one[1], people)), (None, None))
    if column is None:
        if _DATE in table.columns and table[_DATE].notna().any():
            times, unit = _dates(table[_DATE]), _DAYS_PER_YEAR
        if times is not None:
            first = times.groupby(people).transform("min")
            column, own = TIME, (times - first) / unit
    if column is not None:
        columns[column] = own
    return VisitTime(table.assign(**columns), column, covariates)


def _varies(values: pd.Series, people: pd.Series) -> bool:
    """Whether numbers differ between sessions of a participant."""
    if not pd.api.types.is_numeric_dtype(values):
        return False
    grouped = values.groupby(people)
    return bool((grouped.transform("min") < grouped.transform("max")).any())


def _dates(values: pd.Series) -> pd.Series:
    """Days, from ISO dates."""
    try:
        dates = pd.to_datetime(values, format="ISO8601", utc=True)
    except (ValueError, TypeError) as error:
        raise ModelError(
            f"sessions: acq_time is not a date and time as 2001-02-03T04:05:06 ({error})"
        ) from error
    days = (dates - dates.min()) / pd.Timedelta(days=1)
    return days.astype(np.float64)
