"""Which hemispheres of the participant level enter the group level, and who is left out, why."""

import ast
import difflib
import operator
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.hemisphere import ResultPlace
from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName
from hipsta_bids.derivatives.read import (
    list_results,
    read_record,
    read_sheet,
    read_summary,
    read_units,
)
from hipsta_bids.derivatives.status import NOT_FINISHED, name_of, read_status
from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.covariates import relocate
from hipsta_bids.group.data import PARTICIPANT, SESSION, Float, Measures, SideMaps
from hipsta_bids.io import files
from hipsta_bids.settings import Settings, resolve, settings_hash
from hipsta_bids.types import Status

# The user's table of participants to leave out.


#: How many names a note lists.
_SHOWN = 4


def read_exclusions(path: Path | None) -> list[dict[str, str]]:
    """Read the user's table of participants, or single sessions and hemispheres, to leave out."""
    if path is None:
        return []
    rows = files.read_tsv(path)
    if rows and "participant_id" not in rows[0]:
        raise InputError(
            f"{path}: no column participant_id; it may have session_id, hemi and reason besides",
            reason="bad-table",
        )
    return rows


def lost_exclusions(
    path: Path | None, rows: Sequence[Mapping[str, str]], found: Sequence[HemisphereName]
) -> tuple[str, ...]:
    """Say which rows of the user's table are about nobody here: labels may be misspelled."""
    if path is None:
        return ()
    if not rows:
        return (f"{path}: lists nobody to exclude",)
    lost = [
        row["participant_id"] for row in rows if not any(is_listed(name, row) for name in found)
    ]
    if not lost:
        return ()
    more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
    return (f"{path}: not here, or not so, are {', '.join(lost[:_SHOWN])}{more}",)


def is_listed(name: HemisphereName, row: Mapping[str, str]) -> bool:
    """Whether a row of the user's table means this hemisphere; empty cells mean any."""
    own = {"participant_id": name.subject, "session_id": name.session or "", "hemi": name.hemi}
    for key, value in own.items():
        cell = row.get(key, files.MISSING).removeprefix("sub-").removeprefix("ses-")
        if cell not in {files.MISSING, "", value}:
            return False
    return True


# Conditions on quality metrics, such as ``filled_fraction > 0.01 or voxels_across < 3``.


_COMPARISONS: Mapping[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_ARITHMETIC: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


class QualityCondition:
    """A condition under which a hemisphere is left out."""

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except SyntaxError as error:
            raise self._refusal("cannot be read; write it as filled_fraction > 0.01") from error

    def holds(self, metrics: Mapping[str, Any]) -> bool:
        """Evaluate the condition."""
        return bool(self._value(self._tree, metrics))

    def _value(self, node: ast.expr, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- of the metric
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return self._metric(node.id, metrics)
        if isinstance(node, ast.Compare) and all(type(sign) in _COMPARISONS for sign in node.ops):
            values = [self._value(part, metrics) for part in (node.left, *node.comparators)]
            signs = [_COMPARISONS[type(sign)] for sign in node.ops]
            return all(
                None not in {a, b} and self._act(sign, a, b)
                for sign, a, b in zip(signs, values, values[1:], strict=False)
            )
        return self._joined(node, metrics)

    def _joined(self, node: ast.expr, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- as above
        if isinstance(node, ast.BoolOp):
            both = isinstance(node.op, ast.And)
            parts = (self._value(part, metrics) for part in node.values)  # noqa: PD011  (of a syntax tree)
            return all(parts) if both else any(parts)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
            value = self._value(node.operand, metrics)
            if isinstance(node.op, ast.Not):
                return not value
            return None if value is None else self._act(operator.sub, 0, value)
        if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            a, b = self._value(node.left, metrics), self._value(node.right, metrics)
            return None if None in {a, b} else self._act(_ARITHMETIC[type(node.op)], a, b)
        raise self._refusal("may hold comparisons, and, or, not, + - * / only")

    def _act(self, act: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:  # noqa: ANN401 -- as above
        try:
            return act(a, b)
        except (TypeError, ZeroDivisionError) as error:
            raise self._refusal(f"cannot combine {a!r} and {b!r}") from error

    def _metric(self, name: str, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- as above
        if name not in metrics:
            near = difflib.get_close_matches(name, metrics, n=1)
            hint = f"did you mean {near[0]}?" if near else "see the desc-qc_metrics.json files"
            raise self._refusal(f"has {name!r}, which is no quality metric; {hint}")
        return metrics[name]

    def _refusal(self, what: str) -> UsageError:
        return UsageError(f"--exclude-qc {self.text!r} {what}", reason="quality-condition")


@dataclass(frozen=True, kw_only=True)
class GroupRequest:
    """What the user asked for."""

    roots: tuple[Path, ...]
    """Output datasets of the participant level."""
    seg: str | None = None
    """Segmentation protocol; ``None`` if there is but one."""
    region: str = "body"
    """What was measured: ``body``, ``extended`` or ``entorhinal``."""
    subjects: tuple[str, ...] = ()
    """Labels without ``sub-``; empty is all."""
    sessions: tuple[str, ...] = ()
    """Labels without ``ses-``; empty is all."""
    exclude_flagged: bool = False
    exclude_quality: QualityCondition | None = None
    exclude_table: Path | None = None
    """Participants, or single sessions and hemispheres, to leave out."""
    segmentations: tuple[Path, ...] = ()
    """Where segmentations are now, if they have moved since they were measured."""


@dataclass(frozen=True, kw_only=True)
class SheetRecord:
    """One complete hemisphere."""

    place: ResultPlace
    settings_hash: str
    version: str
    source: str
    """Address of the segmentation."""
    flagged: bool = False
    """Whether the participant level asks to look before use."""


@dataclass(frozen=True, kw_only=True)
class Exclusion:
    """One hemisphere, or visit, that is left out."""

    participant: str
    session: str | None
    hemi: str
    reason: str
    message: str


@dataclass(frozen=True, kw_only=True)
class Collection:
    """What was found."""

    records: tuple[SheetRecord, ...]
    """Sorted by subject, session, hemisphere."""
    exclusions: tuple[Exclusion, ...]
    settings: Mapping[str, Any]
    """Those of the participant level, resolved."""
    settings_hash: str
    versions: tuple[str, ...]
    notes: tuple[str, ...] = ()
    """What to know, one line each."""


def collect_sheets(request: GroupRequest, *, may_lack: bool = False) -> Collection:
    """Find all complete hemispheres of one protocol, made with the same settings."""
    for folder in request.segmentations:
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; check --segmentations", reason="no-folder")
    roots = [root for root in request.roots if root.is_dir() or not may_lack]
    everything = [place for root in roots for place in _wanted_results(root, request)]
    found = [place for place in everything if place.name.region == request.region]
    notes = _other_regions(everything, request)
    if may_lack and not found:
        return _nothing(notes)
    seg = _one_protocol(found, everything, request)
    found = [place for place in found if place.name.seg == seg]
    _refuse_twice(found)
    unwanted = read_exclusions(request.exclude_table)
    kept: list[SheetRecord] = []
    left_out: list[Exclusion] = []
    for place in sorted(found, key=_key):
        entry = _judge(place, request, unwanted)
        if isinstance(entry, Exclusion):
            left_out.append(entry)
        else:
            kept.append(entry)
    _refuse_unfinished(request, seg, unwanted)
    if not kept:
        reasons = ", ".join(f"{n} {why}" for why, n in Counter(e.reason for e in left_out).items())
        raise NothingToDoError(
            f"{request.roots[0]}: no hemisphere is left for the group level ({reasons})",
            reason="no-hemisphere",
        )
    digest = _one_settings(kept)
    return Collection(
        records=tuple(kept),
        exclusions=tuple(left_out),
        settings=_settings_of(kept[0].place.root),
        settings_hash=digest,
        versions=tuple(sorted({record.version for record in kept})),
        notes=(
            *notes,
            *lost_exclusions(request.exclude_table, unwanted, [place.name for place in found]),
        ),
    )


def _nothing(notes: tuple[str, ...]) -> Collection:
    return Collection(
        records=(),
        exclusions=(),
        settings=resolve(Settings()),
        settings_hash=settings_hash(Settings()),
        versions=(),
        notes=notes,
    )


def wanted_by(request: GroupRequest) -> Callable[[str, str | None, str], bool]:
    """Tell whether a hemisphere is asked for, and not in the table of exclusions."""
    unwanted = read_exclusions(request.exclude_table)

    def is_wanted(subject: str, session: str | None, hemi: str) -> bool:
        name = HemisphereName(subject=subject, session=session, hemi=hemi, seg="")
        return (
            (not request.subjects or subject in request.subjects)
            and (not request.sessions or session in request.sessions)
            and not any(is_listed(name, row) for row in unwanted)
        )

    return is_wanted


def _wanted_results(root: Path, request: GroupRequest) -> list[ResultPlace]:
    if not root.is_dir():
        raise InputError(
            f"{root}: no such folder; run the participant level first", reason="no-derivatives"
        )
    return [
        place
        for place in list_results(root)
        if (not request.subjects or place.name.subject in request.subjects)
        and (not request.sessions or place.name.session in request.sessions)
    ]


def _other_regions(everything: Sequence[ResultPlace], request: GroupRequest) -> tuple[str, ...]:
    """Say which results are left out because another region was asked for."""
    counts = Counter(
        place.name.region for place in everything if request.seg in {None, place.name.seg}
    )
    return tuple(
        f"{count} hemispheres of region {region} are not in this analysis;"
        f" --region {region} takes them"
        for region, count in sorted(counts.items())
        if region != request.region
    )


def _key(place: ResultPlace) -> tuple[str, str, str]:
    return place.name.subject, place.name.session or "", place.name.hemi


def _one_protocol(
    found: Sequence[ResultPlace], everything: Sequence[ResultPlace], request: GroupRequest
) -> str:
    counts = Counter(place.name.seg for place in found)
    if not counts or request.seg not in {None, *counts}:
        asked = f" with --seg {request.seg}" if request.seg else " as asked for"
        asked += f" --region {request.region}" if request.region != "body" else ""
        kinds = sorted({(place.name.seg, place.name.region) for place in everything})
        there = [seg if region == "body" else f"{seg} --region {region}" for seg, region in kinds]
        hint = f"there is {', '.join(there)}" if there else "run the participant level first"
        raise NothingToDoError(
            f"{request.roots[0]}: no hemisphere{asked}; {hint}", reason="no-hemisphere"
        )
    if request.seg is None and len(counts) > 1:
        names = ", ".join(f"{name} ({n})" for name, n in sorted(counts.items()))
        raise InputError(
            f"{request.roots[0]}: hemispheres of several protocols, {names}; choose one by --seg",
            reason="several-protocols",
        )
    return request.seg or next(iter(counts))


def _refuse_twice(found: Sequence[ResultPlace]) -> None:
    first: dict[tuple[str, str, str], Path] = {}
    for place in found:
        other = first.setdefault(_key(place), place.root)
        if other != place.root:
            raise InputError(
                f"{place.name.stem} is in {other} and in {place.root}; participants of different"
                " sites need different labels",
                reason="duplicate-rows",
            )


def _judge(
    place: ResultPlace, request: GroupRequest, unwanted: Sequence[Mapping[str, str]]
) -> SheetRecord | Exclusion:
    record = read_record(place)
    status = record.get("status")
    reason, message = record.get("reason") or str(status), record.get("message") or ""
    listed = next((row for row in unwanted if is_listed(place.name, row)), None)
    if listed is not None:
        reason, message = "listed", listed.get("reason", "in the table of --exclude")
    elif status == Status.FAILED:
        reason = f"failed: {reason}"
    elif request.exclude_flagged and status == Status.FLAGGED:
        reason = f"flagged: {reason}"
    elif request.exclude_quality is not None and request.exclude_quality.holds(_metrics(record)):
        reason, message = "quality", request.exclude_quality.text
    else:
        inputs = record.get("inputs") or [{}]
        return SheetRecord(
            place=place,
            settings_hash=str(record.get("settings_hash")),
            version=str(record.get("version")),
            source=relocate(str(inputs[0].get("file", "")), request.segmentations),
            flagged=status == Status.FLAGGED,
        )
    name = place.name
    return Exclusion(
        participant=f"sub-{name.subject}",
        session=f"ses-{name.session}" if name.session else None,
        hemi=name.hemi,
        reason=reason,
        message=message,
    )


def _metrics(record: Mapping[str, Any]) -> dict[str, Any]:
    """List what conditions can name: numbers and words of the record and of its metrics."""
    metrics = record.get("metrics") or {}
    both = {**metrics, **{name: record.get(name) for name in ("status", "undefined_columns")}}
    return {k: v for k, v in both.items() if not isinstance(v, (list, dict))}


def _refuse_unfinished(
    request: GroupRequest, seg: str, unwanted: Sequence[Mapping[str, str]]
) -> None:
    """Refuse a run of the participant level that was interrupted: the rest might differ."""
    pending = []
    for root in request.roots:
        for row in read_status(root):
            name = name_of(row)
            asked = (not request.subjects or name.subject in request.subjects) and (
                not request.sessions or name.session in request.sessions
            )
            listed = any(is_listed(name, one) for one in unwanted)
            same = (name.seg, name.region) == (seg, request.region)
            if row.get("reason") == NOT_FINISHED and same and asked and not listed:
                pending.append(name.stem)
    if pending:
        shown = ", ".join(pending[:_SHOWN]) + (" ..." if len(pending) > _SHOWN else "")
        raise InputError(
            f"{request.roots[0]}: the participant level has not finished {len(pending)} hemispheres"
            f" ({shown}); complete it by the same command, or list them in --exclude",
            reason=NOT_FINISHED,
        )


def _one_settings(kept: Sequence[SheetRecord]) -> str:
    counts = Counter(record.settings_hash for record in kept)
    if len(counts) > 1:
        examples = {record.settings_hash: record.place for record in reversed(kept)}
        parts = [
            f"{n} with {digest[:8]} (as {examples[digest].name.stem} in {examples[digest].root})"
            for digest, n in counts.most_common()
        ]
        raise InputError(
            f"hemispheres were measured with different settings: {'; '.join(parts)}; measure all"
            " with the same",
            reason="other-settings",
        )
    return next(iter(counts))


def _settings_of(root: Path) -> Mapping[str, Any]:
    settings = files.read_json(root / DATASET_FILES["settings"]).get("settings")
    if not isinstance(settings, Mapping):
        raise InputError(
            f"{root / DATASET_FILES['settings']}: holds no settings; run the participant level"
            " again",
            reason="bad-json",
        )
    return settings


# What the names of measures stand for: maps of the sheet, sampled maps, or summary measures.


#: What registration rests on.
CURVATURE = "curvature"
#: Maps that are analyzed unless others are asked for.
DEFAULT = ("thickness", CURVATURE)
#: Names of all maps in the sheet tables.
SHEET_MAPS = tuple(row.name for row in MAPS)
#: What begins the names of volumes that other programs give.
VOLUME = "volume_"

_MEASURES_SHOWN = 12


def choose_measures(
    wanted: Sequence[str], records: Sequence[SheetRecord], others: Sequence[str] = ()
) -> Measures:
    """Tell maps from summary measures."""
    own = DEFAULT if records else ()
    if not wanted:
        return Measures(maps=(*own, *others))
    summaries = _summary_names(records)
    maps, numbers = [], []
    for name in wanted:
        if name in others or (records and name in SHEET_MAPS) or _is_sampled(name, records):
            maps.append(name)
        elif name in summaries or name.startswith(VOLUME):
            numbers.append(name)
        else:
            known = [*(SHEET_MAPS if records else ()), *others, *_sampled(records), *summaries]
            near = difflib.get_close_matches(name, known, n=1)
            more = " ..." if len(known) > _MEASURES_SHOWN else ""
            hint = (
                f"did you mean {near[0]}?"
                if near
                else f"there are {', '.join(known[:_MEASURES_SHOWN])}{more}"
            )
            raise InputError(f"no measure is called {name!r}; {hint}", reason="unknown-measure")
    return Measures(maps=tuple(maps), summaries=tuple(numbers) or None)


def check_summaries(measures: Measures, sides: Mapping[str, SideMaps]) -> None:
    """Refuse summary measures that no hemisphere has."""
    known = sorted({str(name) for side in sides.values() for name in side.summary.columns})
    for name in measures.summaries or ():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else "are its tables there?"
            raise InputError(f"no measure is called {name!r}; {hint}", reason="unknown-measure")


def sampled_desc(name: str) -> str:
    """Name of the sampled map that a column belongs to: ``bold_3`` is the third of ``bold``."""
    return name.partition("_")[0]


def _is_sampled(name: str, records: Sequence[SheetRecord]) -> bool:
    desc = sampled_desc(name)
    return any(record.place.path("map_table", desc).is_file() for record in records)


def _sampled(records: Sequence[SheetRecord]) -> list[str]:
    """Names of maps that were sampled, as far as the first hemisphere has them."""
    if not records:
        return []
    pattern = records[0].place.path("map_table", "*")
    start, _, end = pattern.name.partition("*")
    found = pattern.parent.glob(pattern.name)
    return sorted(path.name.removeprefix(start).removesuffix(end) for path in found)


def _summary_names(records: Sequence[SheetRecord]) -> tuple[str, ...]:
    return tuple(read_summary(records[0].place)) if records else ()


# Reads the participant level's tables of many hemispheres into arrays.


#: Unit of sampled maps, whose own unit nobody told.
ARBITRARY = "arbitrary"


Visit = tuple[str, str | None]
"""Subject and session, without prefixes."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Sheets and summaries, before covariates are known."""

    visits: pd.DataFrame
    """Participant and session, one row per visit; the index names it."""
    sides: Mapping[str, SideMaps]
    x: Float
    y: Float
    units: Mapping[str, str]
    sources: Mapping[str, tuple[str, Path]]
    """Address of one segmentation, and dataset that it is said in, of visits with sheets."""


def read_sheets(
    records: Sequence[SheetRecord],
    settings: Mapping[str, Any],
    maps: Sequence[str],
    visits: Sequence[Visit] | None = None,
) -> Measured:
    """Read all sheets and summaries."""
    grid = settings["sheet"]
    shape = (int(grid["x_nodes"]), int(grid["y_nodes"]))
    visits = visits_of(records) if visits is None else visits
    row_of = {visit: row for row, visit in enumerate(visits)}
    names = tuple(dict.fromkeys((*maps, CURVATURE)))
    sides = {}
    for hemi in "LR":
        own = [record for record in records if record.place.name.hemi == hemi]
        rows = [row_of[r.place.name.subject, r.place.name.session] for r in own]
        if own:
            sides[hemi] = _read_side(own, np.array(rows, dtype=np.int64), shape, names)
    return Measured(
        visits=_visit_table(visits),
        sides=sides,
        x=_coordinates(grid["x_extent"], shape[0]),
        y=_coordinates(grid["y_extent"], shape[1]),
        units=(read_units(records[0].place) if records else {})
        | {n: ARBITRARY for n in names if n not in SHEET_MAPS},
        sources={
            visit_name(r.place.name.subject, r.place.name.session): (r.source, r.place.root)
            for r in reversed(records)
        },
    )


def visits_of(records: Sequence[SheetRecord]) -> list[Visit]:
    """List subjects and sessions that have sheets, each once."""
    return list(dict.fromkeys((r.place.name.subject, r.place.name.session) for r in records))


def _coordinates(extent: float, nodes: int) -> Float:
    """Coordinates of the nodes, without the rounding errors that would show in tables."""
    return np.asarray(np.linspace(-extent, extent, nodes).round(10) + 0.0, dtype=np.float64)


def visit_name(subject: str, session: str | None) -> str:
    """Spell a visit as the covariates' rows are named; labels have no prefixes."""
    return f"sub-{subject}_ses-{session}" if session else f"sub-{subject}"


def _visit_table(visits: Sequence[Visit]) -> pd.DataFrame:
    names = [f"sub-{subject}" for subject, _ in visits]
    sessions = [None if session is None else f"ses-{session}" for _, session in visits]
    index = [visit_name(*visit) for visit in visits]
    return pd.DataFrame(
        {PARTICIPANT: names, SESSION: pd.array(sessions, dtype=object)}, index=index
    )


def _read_side(
    records: Sequence[SheetRecord],
    rows: np.ndarray[Any, Any],
    shape: tuple[int, int],
    names: Sequence[str],
) -> SideMaps:
    maps = {name: np.full((len(records), *shape), np.nan) for name in names}
    measured = [name for name in names if name in SHEET_MAPS]
    sampled = [name for name in names if name not in SHEET_MAPS]
    subfield = np.empty((len(records), *shape), dtype=np.int8)
    codes: dict[str, int] = {}
    summaries = []
    for i, record in enumerate(records):
        columns = read_sheet(record.place.path("sheet"), measured, ["subfield"], shape)
        for name in sampled:
            path = record.place.path("map_table", sampled_desc(name))
            if path.is_file():
                columns |= read_sheet(path, [name], shape=shape)
        for name in maps.keys() & columns.keys():
            maps[name][i] = columns[name]
        subfield[i] = _encode(columns["subfield"], codes)
        summaries.append(read_summary(record.place))
    summary = pd.DataFrame(summaries).astype(np.float64)
    return SideMaps(rows=rows, maps=maps, subfield=subfield, names=tuple(codes), summary=summary)


def _encode(words: np.ndarray[Any, Any], codes: dict[str, int]) -> np.ndarray[Any, Any]:
    """Numbers instead of names, new names at the end; -1 where missing."""
    numbers, names = pd.factorize(words.ravel())
    known = np.array([codes.setdefault(name, len(codes)) if name else -1 for name in names])
    return np.asarray(known[numbers], dtype=np.int8).reshape(words.shape)
