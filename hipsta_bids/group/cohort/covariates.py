"""Covariates of participants and sessions, from tables of a BIDS dataset and other tables."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.dataset import linked_path, read_links
from hipsta_bids.derivatives.names import natural_order
from hipsta_bids.errors import InputError, MissingFileError, ModelError
from hipsta_bids.group.model import VisitTime
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.io.files import MISSING, is_missing
from hipsta_bids.io.labels import match_labels
from hipsta_bids.opening import SETTINGS, read_bounded
from hipsta_bids.stats.design import FIRST_AGE
from hipsta_bids.stats.formula import as_factor, check_numbers, level_name, listed, typed
from hipsta_bids.types import PARTICIPANT, SESSION


class Spellings(Counter[tuple[str, str]]):
    """Numbers of cells that were read as missing, by column and spelling; also notes on labels."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []


#: Column of BIDS' sessions.tsv with dates, and columns that are made here.
_DATE, TIME, _ICV = "acq_time", "time", "icv"
_DAYS_PER_YEAR = 365.25
#: Levels of factors that are numbers, and characters of a name for one.
_CODE = re.compile(r"-?\d+(\.\d+)?")
_LONGEST_NAME = 40
#: A level among words, and a missing value among numbers.
_NO_DRUG = "none"
#: A level whose description is this long, and spells a missing value, is one.
_SHORTEST_MEANING = 5


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


def read_covariates(
    visits: pd.DataFrame, bids_dir: Path, extra: Sequence[Path], settings: GroupSettings
) -> tuple[pd.DataFrame, frozenset[str], Spellings]:
    """Join covariates to visits; cells stay text. Also who is not in participants.tsv.

    In this order: ``participants.tsv``, ``sessions.tsv`` of the participants, ``phenotype/*.tsv``,
    and the user's tables. A later table fills or replaces columns of the same name. Columns
    whose ``Levels`` a sidecar lists are factors, with the names of the levels instead of numbers.
    """
    joined = visits.copy()
    main = bids_dir / "participants.tsv"
    tables = [main] if main.exists() else []
    described: dict[str, object] = {}
    spelled = Spellings()
    absent: frozenset[str] = frozenset()
    if not bids_dir.is_dir():
        raise MissingFileError(f"{bids_dir}: folder not found; check its name")
    for path in (*tables, *sorted((bids_dir / "phenotype").glob("*.tsv")), *extra):
        table, sidecar = _read(path), _sidecar(path.with_suffix(".json"))
        _match(table, joined, path, spelled.notes)
        if path == main:
            _check_known(joined, table, path)
            absent = frozenset(joined[PARTICIPANT]) - frozenset(table[PARTICIPANT])
        table = table[table[PARTICIPANT].isin(joined[PARTICIPANT])]
        before, joined = joined, _join(joined, mark_missing(table, sidecar, spelled), path)
        if path in extra and SESSION not in table:
            spelled.notes += _replaced(before, joined, path)
        described |= sidecar
        if path == main and (parts := _read_sessions(joined, bids_dir)):
            sidecar = _sidecar(bids_dir / "sessions.json")
            table = pd.concat(parts, ignore_index=True)
            _match(table, joined, bids_dir / "sub-*_sessions.tsv", spelled.notes)
            table = mark_missing(table, sidecar, spelled)
            joined = _join(joined, table, bids_dir / "sub-*_sessions.tsv")
            described |= sidecar
    for column in described.keys() & set(joined.columns):
        joined[column] = _with_levels(joined[column], described[column])
    for column in joined.columns.difference([PARTICIPANT, SESSION]):
        if not isinstance(joined[column].dtype, pd.CategoricalDtype):
            joined[column] = _without_codes(joined[column], settings.design.missing_codes, spelled)
    folded = joined.columns.str.casefold()
    pair = joined.columns[folded.duplicated(keep=False) & folded.isin(_known_columns(settings))]
    if len(pair):
        by_name = sorted(pair, key=lambda name: (name.casefold(), name.swapcase()))
        raise InputError(f"columns {' and '.join(by_name)} differ in capitals only; keep one")
    return joined, absent, spelled


def mark_missing(
    table: pd.DataFrame, described: Mapping[str, object], spelled: Spellings
) -> pd.DataFrame:
    """Mark cells that spell a missing value, and count the spellings by column.

    A level that a sidecar lists is not missing, unless the sidecar marks it (``"9": "unknown"``),
    or lists it as one of ``MissingValues``. ``none`` is a level among words: no drug, no diagnosis.
    """
    marked = table.copy()
    for name in table.columns:
        description = described.get(name)
        levels, declared = _levels(description), _missing_values(description)
        words = [cell for cell in table[name].unique() if isinstance(cell, str)]
        missing = {word for word in words if _is_missing(word, levels)}
        if not all(map(_is_number, set(words) - missing)):
            missing -= {word for word in missing if word.strip().casefold() == _NO_DRUG}
        missing |= {word for word in words if level_name(word) in declared}
        is_cell_missing = table[name].isin(missing)
        cells = table.loc[is_cell_missing, name]
        spelled.update((str(name), cell) for cell in cells if cell.strip() not in {"", MISSING})
        if len(cells):
            marked[name] = table[name].where(~is_cell_missing, None)
    return marked


def _is_missing(cell: str, levels: Mapping[str, str]) -> bool:
    meaning = levels.get(level_name(cell))
    if meaning is None or cell == MISSING:
        return is_missing(cell)
    # Shorter words, as none, say nothing of whether the level is known.
    return len(meaning) >= _SHORTEST_MEANING and is_missing(meaning)


def _missing_values(description: object) -> set[str]:
    """Return what a description of a column lists as ``MissingValues``, one or several."""
    listed_values = description.get("MissingValues") if isinstance(description, Mapping) else None
    values = listed_values if isinstance(listed_values, list) else [listed_values]
    return {level_name(value) for value in values if value is not None}


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _without_codes(values: pd.Series, codes: Sequence[float], spelled: Spellings) -> pd.Series:
    """Mark codes of missing values, as -9999, where they are out of the range of all others."""
    numbers = pd.to_numeric(values, errors="coerce")
    is_code = numbers.isin([code for code in codes if code < 0])
    remaining = numbers[~is_code & numbers.between(-1e100, 1e100)]  # larger ones are refused
    low, high = (remaining.min(), remaining.max()) if len(remaining) else (0.0, 0.0)
    # A positive code may be a value; it is refused later.
    is_far = is_code & ((low >= 0) | (np.maximum(low - numbers, numbers - high) > high - low))
    spelled.update((str(values.name), str(cell)) for cell in values[is_far])
    return values.where(~is_far, None)


def spelled_note(spelled: Spellings, formula: str, settings: GroupSettings) -> str:
    """Note the cells read as missing, first in columns that a model is likely to have."""
    names = _known_columns(settings)
    keys = sorted(
        spelled, key=lambda key: (key[0].casefold() not in names and key[0] not in formula, key)
    )
    cells = listed(f"{name} {cell!r} ({spelled[name, cell]})" for name, cell in keys)
    return f"read as missing: {cells}; if one is a level, list it in Levels of the table's sidecar"


def _known_columns(settings: GroupSettings) -> set[str]:
    """Return the names, without capitals, of columns that are looked for in any case."""
    rules, factors = settings.model, settings.design.factors
    names = (*factors, *rules.group_columns, *rules.covariates, *rules.icv_columns)
    return {name.casefold() for name in names}


def _sidecar(path: Path) -> dict[str, object]:
    return dict(files.read_json(path)) if path.exists() else {}


def _with_levels(values: pd.Series, description: object) -> pd.Series:
    """Make a factor of a column all of whose values are ``Levels`` of its description."""
    levels = _levels(description)
    factor = as_factor(values)
    present = [str(code) for code in factor.cat.categories]
    if not present or not set(present) <= set(levels):
        return values
    names = [_level_word(levels[code]) for code in present]
    codes = all(_CODE.fullmatch(code) for code in present)
    if codes and all(names) and len(set(names)) == len(names):
        factor = factor.cat.rename_categories(names)
        names_of = dict(zip(present, names, strict=True))
        present = [names_of[code] for code in levels if code in names_of]
    else:
        present = [code for code in levels if code in present]
    # The order of the description, which the choice of a reference level follows.
    return factor.cat.reorder_categories(present, ordered=True)


def _levels(description: object) -> dict[str, str]:
    """Return what a description of a column says of each of its ``Levels``."""
    levels = description.get("Levels") if isinstance(description, Mapping) else None
    meanings = {}
    for code, meaning in levels.items() if isinstance(levels, Mapping) else ():
        text = meaning
        if isinstance(meaning, Mapping):
            text = meaning.get("LongName") or meaning.get("Description")
        meanings[level_name(code)] = " ".join(str(text or "").split())
    return meanings


def _level_word(meaning: str) -> str:
    """Name a level by what its description says, if that is short and may stand in a contrast."""
    return meaning if len(meaning) <= _LONGEST_NAME and not set(meaning) & set("[]=,") else ""


def _match(table: pd.DataFrame, data: pd.DataFrame, path: Path, notes: list[str]) -> None:
    """Write labels of participants and sessions as in the data, in place, and note it."""
    for column in (PARTICIPANT, SESSION):
        if column in table and data[column].notna().any():
            labels = table[column].dropna()
            matches, lines = match_labels(labels, data[column].dropna(), path.name)
            table[column] = table[column].replace(matches)
            notes += lines


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
        mark = next((mark for mark in ",;" if mark in table.columns[0]), None)
        problem = (
            f"columns are separated by {mark!r}; save it with tabs (.tsv)"
            if mark
            else "has no column participant_id; rename the column of participants"
        )
        raise InputError(f"{path}: {problem}", reason="bad-table")
    return _cleaned(table)


def _cleaned(table: pd.DataFrame) -> pd.DataFrame:
    """Take off blanks round cells, and add prefixes that labels lack."""
    table = table.map(str.strip)
    for column, prefix in ((PARTICIPANT, "sub-"), (SESSION, "ses-")):
        if column in table.columns:
            labels = table[column].where(~table[column].map(is_missing), None)
            has_prefix = labels.isna() | labels.str.startswith(prefix).fillna(value=True)
            table[column] = labels.where(has_prefix, prefix + labels)
    return table


def _read_sessions(joined: pd.DataFrame, bids_dir: Path) -> list[pd.DataFrame]:
    parts = []
    for participant in joined.loc[joined[SESSION].notna(), PARTICIPANT].unique():
        path = bids_dir / participant / f"{participant}_sessions.tsv"
        if path.exists():
            part = pd.DataFrame(files.read_tsv(path), dtype=object)
            if SESSION not in part.columns:
                raise InputError(f"{path}: has no column session_id", reason="bad-table")
            parts.append(_cleaned(part).assign(**{PARTICIPANT: participant}))
    return parts


def _join(joined: pd.DataFrame, table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Add the columns of one table, by participant, and by session if it has sessions."""
    by_session = SESSION in table.columns and bool(table[SESSION].notna().any())
    keys = [PARTICIPANT, SESSION] if by_session else [PARTICIPANT]
    table = table.drop(columns=[SESSION]) if SESSION in table and not by_session else table
    repeated = table.loc[table.duplicated(keys), keys].astype(str).agg(" ".join, axis=1)
    if len(repeated):
        names = listed(sorted(set(repeated)))
        raise InputError(f"{path}: {names} occur more than once; keep one row each")
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


def _replaced(before: pd.DataFrame, joined: pd.DataFrame, path: Path) -> Iterator[str]:
    """Note values of earlier tables that a table of the user replaces."""
    for column in before.columns.difference([PARTICIPANT, SESSION]):
        former, current = before[column], joined[column]
        differs = former.notna() & (former.map(level_name) != current.map(level_name))
        if differs.any():
            people = listed(dict.fromkeys(joined.loc[differs, PARTICIPANT]))
            yield f"{column} of {people} differs between tables; {path.name} counts"


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
    """Intracranial volumes in mm^3 as the segmentations' programs estimated them.

    FreeSurfer's ``stats/aseg.stats`` (EstimatedTotalIntraCranialVol) next to the ``mri`` folder, or
    ASHS's ``*_icv.txt`` next to or above the segmentation.
    """
    paths = locate_sources(sources, roots)
    return [None if path is None else _icv_of(path) for path in paths]


def _icv_of(path: Path) -> float | None:
    stats = path.parent.parent / "stats" / "aseg.stats"
    if stats.exists():
        for line in _read_text(stats).splitlines():
            if line.startswith("# Measure EstimatedTotalIntraCranialVol,"):
                return _number(line.split(",")[-2])
    for folder in (path.parent, path.parent.parent, path.parent.parent / "final"):
        for report in sorted(folder.glob("*icv.txt")):
            words = _read_text(report).split()
            if words:  # subject and volume, or the volume alone
                return _number(words[-1])
    return None


def _read_text(path: Path) -> str:
    try:
        return read_bounded(path, SETTINGS).decode(errors="replace")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error}); check that it is a readable file"
        ) from error


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if value > 0 else None


def order_sessions(table: pd.DataFrame, settings: GroupSettings) -> list[str]:
    """List the sessions of a cohort by their median time; in natural order if some have none.

    Medians are of participants with several sessions, since a single one is always at time 0.
    """
    sessions = sorted(table[SESSION].dropna().unique(), key=natural_order)
    time = None
    with suppress(ModelError):  # a model with this time reports it
        time = add_time(table, settings)
    if time is None or time.column is None:
        return sessions
    values = typed(time.table[time.column]).astype(np.float64)
    is_repeated = table[PARTICIPANT].duplicated(keep=False)
    single = values.groupby(table[SESSION]).median()
    medians = values[is_repeated].groupby(table[SESSION]).median().combine_first(single)
    if medians.reindex(sessions).isna().any():
        return sessions
    return sorted(sessions, key=lambda name: float(medians[name]))


def _named_time(
    table: pd.DataFrame, time_columns: Iterable[str], by_name: Mapping[str, str]
) -> tuple[str | None, Any]:
    """Return the first column of time that varies between the sessions of a participant."""
    columns = [by_name[name] for name in map(str.casefold, time_columns) if name in by_name]
    candidates = ((column, typed(table[column])) for column in columns)
    varying = ((n, values) for n, values in candidates if _varies(values, table[PARTICIPANT]))
    return next(varying, (None, None))


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
    column, values = _named_time(table, settings.longitudinal.time_columns, by_name)
    if column is None:
        if _DATE in table.columns and table[_DATE].notna().any():
            times, unit = _dates(table[_DATE]), _DAYS_PER_YEAR
        if times is not None:
            first = times.groupby(people).transform("min")
            column, values = TIME, (times - first) / unit
    if column is not None:
        columns[column] = values
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
