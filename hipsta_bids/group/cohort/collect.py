"""Which hemispheres of the participant level enter the group level, and which are left out, why."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from sys import intern
from typing import Any, get_args

import pandas as pd

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.dataset import NOT_FINISHED, name_of, provenance_of, read_status
from hipsta_bids.derivatives.measures import read_compared
from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName, natural_order
from hipsta_bids.derivatives.outliers import FEWEST, TEXT
from hipsta_bids.derivatives.results import ResultPlace, list_results, read_record
from hipsta_bids.errors import InputError, MissingFileError, NothingToDoError
from hipsta_bids.group.cohort.covariates import relocate
from hipsta_bids.group.cohort.data import Grid
from hipsta_bids.group.cohort.exclusions import SHOWN, Choices, Condition, fulfilled
from hipsta_bids.group.cohort.quality import OUTLIER
from hipsta_bids.io import files
from hipsta_bids.io.files import checked_foreign
from hipsta_bids.protocols.toml import settings_hash
from hipsta_bids.settings import Settings
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import PARTICIPANT, SESSION, Decision, End, VisitKey

_ABSENT = "no labels of this side were measured; see inputs.tsv of the participant level"


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
    excluded: tuple[str, ...] = ()
    """Labels to leave out."""
    sessions: tuple[str, ...] = ()
    """Labels without ``ses-``; empty is all."""
    exclude_look: bool = False
    exclude_outliers: bool = False
    exclude_qc: tuple[Condition, ...] = ()
    exclude_table: Path | None = None
    """Participants, or single sessions and hemispheres, to leave out."""
    ratings: Path | None = None
    """Ratings of hemispheres, saved from the report."""
    segmentations: tuple[Path, ...] = ()
    """Where segmentations are now, if they have moved since they were measured."""

    def wants(self, subject: str, session: str | None) -> bool:
        """Check whether a visit is asked for, by its labels."""
        return (
            (not self.subjects or subject in self.subjects)
            and subject not in self.excluded
            and (not self.sessions or session in self.sessions)
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class SheetRecord:
    """One complete hemisphere."""

    result: ResultPlace
    settings_hash: str
    version: str
    source: str
    """Address of the segmentation."""
    provenance: tuple[str, ...]
    """Where its labels come from, in the order of ``PROVENANCE``."""
    ends: str
    """How the ends of the body were placed."""
    sheet: tuple[str, ...] = ()
    """Sessions that share its sheet; none if it has its own."""
    doubtful: bool = False
    """Whether the participant level asks to look before use, and nobody has rated it for use."""

    @property
    def visit(self) -> VisitKey:
        """Return subject and session."""
        return self.result.name.subject, self.result.name.session


@dataclass(frozen=True)
class Exclusion:
    """One hemisphere, or visit, that is excluded."""

    participant: str
    session: str | None
    hemi: str
    reason: str
    message: str

    @classmethod
    def of_sheet(cls, name: HemisphereName, reason: str, message: str) -> "Exclusion":
        """Exclude one hemisphere."""
        session = f"ses-{name.session}" if name.session else None
        return cls(f"sub-{name.subject}", session, name.hemi, reason, message)


def exclude_visits(table: pd.DataFrame, left_out: Mapping[str, tuple[str, str]]) -> list[Exclusion]:
    """Exclude visits of a table; the index names them, as it does their reasons and messages."""
    rows = table.loc[list(left_out), [PARTICIPANT, SESSION]].itertuples(name=None)
    return [
        Exclusion(participant, session, files.MISSING, *left_out[visit])
        for visit, participant, session in rows
    ]


@dataclass(frozen=True, kw_only=True)
class Collection:
    """Results found, by hemisphere."""

    grid: Grid
    """Of the sheets."""
    settings_hash: str
    """Of all settings of the participant level."""
    records: tuple[SheetRecord, ...] = ()
    """Sorted by subject, session, hemisphere."""
    exclusions: tuple[Exclusion, ...] = ()
    versions: tuple[str, ...] = ()
    ratings: Mapping[str, int] | None = None
    """Numbers of hemispheres by rating, if there is a table of these."""
    quality: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Participant, session, side, decision and rating of each hemisphere, also of failed ones."""
    notes: tuple[str, ...] = ()
    """What to know, one line each."""
    warnings: tuple[str, ...] = ()
    """What may make results wrong, one line each."""


def collect_sheets(request: GroupRequest, *, may_lack: bool = False) -> Collection:
    """Find all complete hemispheres of one protocol, made with the same settings."""
    _check_folders(request.segmentations)
    roots = [root for root in request.roots if root.is_dir() or not may_lack]
    results = list(chain.from_iterable(_wanted_results(root, request) for root in roots))
    places = [result for result in results if result.name.region == request.region]
    notes = _other_regions(results, request)
    if may_lack and not places:
        return Collection(grid=Grid(), settings_hash=settings_hash(Settings()), notes=notes)
    seg = _one_protocol(places, results, request)
    places = [result for result in places if result.name.seg == seg]
    _refuse_twice(places)
    visits = [(result.name.subject, result.name.session) for result in results]
    choices = Choices(request.exclude_table, request.ratings, visits)
    judged = _judge_all(places, roots, request, choices)
    _refuse_unfinished(request, seg, choices)
    _refuse_none(judged, request)
    records = tuple(judged.records)
    digest, grid = _one_settings(records), grid_of(records[0].result.root)
    _refuse_several_sheets(records)
    return Collection(
        records=records,
        exclusions=(*judged.excluded, *_without_result(judged)),
        grid=grid,
        settings_hash=digest,
        quality=pd.DataFrame(judged.quality),
        versions=tuple(sorted({record.version for record in records})),
        ratings=choices.counts(judged.digests),
        notes=(
            *notes,
            *_shared_sheets(grid),
            *(_not_compared(judged.quality) if request.exclude_outliers else ()),
            *choices.excluded.notes(_with_digests(results)),
            *choices.rated.notes(_with_digests(results)),
        ),
        warnings=_several_versions(records),
    )


def _check_folders(folders: Iterable[Path]) -> None:
    for folder in folders:
        if not folder.is_dir():
            raise MissingFileError(f"{folder}: folder not found; check --segmentations")


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """Hemispheres in their order."""

    records: list[SheetRecord] = field(default_factory=list)
    excluded: list[Exclusion] = field(default_factory=list)
    quality: list[dict[str, str | None]] = field(default_factory=list)
    digests: list[tuple[HemisphereName, str | None]] = field(default_factory=list)


def _judge_all(
    places: Iterable[ResultPlace], roots: Sequence[Path], request: GroupRequest, choices: Choices
) -> _Judged:
    """Take or exclude each hemisphere, with its decision, its rating and its hash."""
    compared = {root: read_compared(root) for root in roots}
    judged = _Judged(excluded=[e for root in roots for e in _excluded_labels(root, request)])
    for result in sorted(places, key=_key):
        record = read_record(result)
        row = compared[result.root].get(result.name.title)
        outlier = None if row is None else row[TEXT].replace(files.MISSING, "")
        entry = _judge(result, record, request, choices, outlier)
        if isinstance(entry, Exclusion):
            judged.excluded.append(entry)
        else:
            judged.records.append(entry)
        judged.quality.append(_quality(result.name, record, choices, outlier))
        judged.digests.append((result.name, _digest(record)))
    return judged


def _refuse_none(judged: _Judged, request: GroupRequest) -> None:
    if not judged.records:
        counts = Counter(exclusion.reason for exclusion in judged.excluded)
        reasons = ", ".join(f"{n} {reason}" for reason, n in counts.items())
        raise NothingToDoError(
            f"{request.roots[0]}: no hemisphere is left for the group level ({reasons})"
        )


def _without_result(judged: _Judged) -> Iterator[Exclusion]:
    """List sides that others have, and of which a visit has no result, not even a failure."""
    sides = {record.result.name.hemi for record in judged.records}
    present = {(name.subject, name.session, name.hemi) for name, _ in judged.digests}
    for name in (record.result.name for record in judged.records):
        for hemi in sides - {name.hemi}:
            if (name.subject, name.session, hemi) not in present:
                yield Exclusion.of_sheet(replace(name, hemi=hemi), "no-result", _ABSENT)


def _not_compared(quality: Iterable[Mapping[str, str | None]]) -> Iterator[str]:
    """Note hemispheres that were not compared with enough others to be outliers."""
    count = sum(q["outlier status"] is None and q["decision"] != Decision.FAILED for q in quality)
    if count:
        yield (
            f"--exclude-outliers: {count} hemispheres were not compared with {FEWEST} or more"
            " others; run the participant level without --shard to compare"
        )


def _quality(
    name: HemisphereName, record: Mapping[str, Any], choices: Choices, outlier: str | None
) -> dict[str, str | None]:
    """Return who, which side, the decision, the rating, and whether it is an outlier, if known."""
    return {
        PARTICIPANT: f"sub-{name.subject}",
        SESSION: f"ses-{name.session}" if name.session else None,
        "side": name.hemi,
        "decision": str(record.get("decision")),
        "rating": choices.rating(name, _digest(record)),
        "outlier status": None if outlier is None else OUTLIER[bool(outlier)],
    }


def _digest(record: Mapping[str, Any]) -> str | None:
    """Return the hash of a hemisphere's input and settings, if its record has one."""
    digest = record.get("input_hash")
    return None if digest is None else str(digest)


def _with_digests(
    results: Iterable[ResultPlace],
) -> Iterator[tuple[HemisphereName, str | None]]:
    """Return the names of hemispheres with the hashes of their records, as they are asked for."""
    return ((result.name, _digest(read_record(result))) for result in results)


def _several_versions(records: Sequence[SheetRecord]) -> tuple[str, ...]:
    """Say which hemispheres another version has measured: versions may give other numbers."""
    counts = Counter(record.version for record in records)
    if len(counts) < 2:  # noqa: PLR2004 -- one is as it should be
        return ()
    usual = counts.most_common(1)[0][0]
    stems = [record.result.name.stem for record in records if record.version != usual]
    text = (
        f"hemispheres were measured by several versions, {dataset.counts_text(counts)}; measure"
        f" {listed(stems, SHOWN)} with {usual}: a version may change numbers"
    )
    return (text,)


def wanted_by(
    request: GroupRequest, visits: Iterable[VisitKey]
) -> Callable[[str, str | None, str], bool]:
    """Check whether a hemisphere of some visits is asked for, and not in a table of exclusions."""
    choices = Choices(request.exclude_table, request.ratings, visits)

    def is_wanted(subject: str, session: str | None, hemi: str) -> bool:
        name = HemisphereName(subject=subject, session=session, hemi=hemi, seg="")
        return request.wants(subject, session) and not choices.reason_to_leave_out(name, None)

    return is_wanted


def _wanted_results(root: Path, request: GroupRequest) -> list[ResultPlace]:
    if not root.is_dir():
        raise MissingFileError(f"{root}: folder not found; run the participant level first")
    return [
        result
        for result in list_results(root)
        if request.wants(result.name.subject, result.name.session)
    ]


def _excluded_labels(root: Path, request: GroupRequest) -> Iterator[Exclusion]:
    """List the hemispheres of participants whom --exclude-participant-label names."""
    included = replace(request, excluded=()) if request.excluded else request
    for result in list_results(root) if request.excluded else ():
        name = result.name
        is_same = (name.region, name.seg) == (request.region, request.seg or name.seg)
        if (
            is_same
            and name.subject in request.excluded
            and included.wants(name.subject, name.session)
        ):
            yield Exclusion.of_sheet(name, "listed", "--exclude-participant-label")


def _other_regions(results: Sequence[ResultPlace], request: GroupRequest) -> tuple[str, ...]:
    """Say which results are left out because another region was asked for."""
    counts = Counter(
        result.name.region for result in results if request.seg in {None, result.name.seg}
    )
    return tuple(
        f"{count} hemispheres of region {region} are not in this analysis;"
        f" --region {region} takes them"
        for region, count in sorted(counts.items())
        if region != request.region
    )


def _key(result: ResultPlace) -> tuple[str, str, str]:
    return result.name.subject, result.name.session or "", result.name.hemi


def _one_protocol(
    places: Sequence[ResultPlace],
    results: Sequence[ResultPlace],
    request: GroupRequest,
) -> str:
    counts = Counter(result.name.seg for result in places)
    if not counts or request.seg not in {None, *counts}:
        request_text = f" with --seg {request.seg}" if request.seg else " as asked for"
        request_text += f" --region {request.region}" if request.region != "body" else ""
        kinds = sorted({(result.name.seg, result.name.region) for result in results})
        protocols = [
            seg if region == "body" else f"{seg} --region {region}" for seg, region in kinds
        ]
        hint = (
            f"there is {', '.join(protocols)}" if protocols else "run the participant level first"
        )
        raise NothingToDoError(f"{request.roots[0]}: no hemisphere{request_text}; {hint}")
    if request.seg is None and len(counts) > 1:
        raise InputError(
            f"{request.roots[0]}: hemispheres of several protocols,"
            f" {dataset.counts_text(counts)}; choose one by --seg"
        )
    return request.seg or next(iter(counts))


def _refuse_twice(places: Sequence[ResultPlace]) -> None:
    first: dict[tuple[str, str, str], Path] = {}
    for result in places:
        root = first.setdefault(_key(result), result.root)
        if root != result.root:
            raise InputError(
                f"{result.name.stem} is in {root} and in {result.root}; participants of different"
                " sites need different labels"
            )


def _judge(
    result: ResultPlace,
    record: Mapping[str, Any],
    request: GroupRequest,
    choices: Choices,
    outlier: str | None,
) -> SheetRecord | Exclusion:
    """Choose or exclude a hemisphere, given what makes it an outlier, if anything does."""
    decision = record.get("decision")
    reason, message = record.get("reason") or str(decision), record.get("message") or ""
    rated = result.name, _digest(record)
    unwanted = choices.reason_to_leave_out(*rated)
    if unwanted is not None:
        reason, message = unwanted
    elif decision == Decision.FAILED:
        reason = f"failed: {reason}"
    elif request.exclude_look and decision == Decision.LOOK and not choices.approves(*rated):
        reason = f"look: {reason}"
    elif request.exclude_outliers and outlier and not choices.approves(*rated):
        reason, message = "outlier", outlier
    elif request.exclude_qc and (condition := fulfilled(request.exclude_qc, _metrics(record))):
        reason, message = "quality", condition
    else:
        doubtful = decision == Decision.LOOK and not choices.approves(*rated)
        return _taken(result, record, request, doubtful=doubtful)
    return Exclusion.of_sheet(result.name, reason, message)


def _taken(
    result: ResultPlace, record: Mapping[str, Any], request: GroupRequest, *, doubtful: bool
) -> SheetRecord:
    inputs = record.get("inputs") or [{}]
    return SheetRecord(
        result=result,
        settings_hash=intern(str(record.get("settings_hash"))),
        version=intern(str(record.get("version"))),
        source=relocate(str(inputs[0].get("file", "")), request.segmentations),
        provenance=tuple(intern(text) for text in provenance_of(record).values()),
        ends=intern(_ends(record)),
        sheet=tuple(dict.fromkeys(str(v.get("session")) for v in record.get("visits") or ())),
        doubtful=doubtful,
    )


def _ends(record: Mapping[str, Any]) -> str:
    """Name the ends of the body that were estimated, since labels of head or tail are missing."""
    metrics = record.get("metrics") or {}
    rules = {end: str(metrics.get(f"{end}_end_rule") or files.MISSING) for end in get_args(End)}
    if files.MISSING in rules.values():
        return files.MISSING
    estimated = [end for end, rule in rules.items() if rule not in {"labels", "user"}]
    return f"{' and '.join(estimated)} estimated" if estimated else "labeled"


def _metrics(record: Mapping[str, Any]) -> dict[str, Any]:
    """List what conditions can name: numbers and words of the record and of its metrics."""
    metrics = record.get("metrics") or {}
    merged = {**metrics, **{name: record.get(name) for name in ("decision", "undefined_columns")}}
    return {k: v for k, v in merged.items() if not isinstance(v, (list, dict))}


def _refuse_unfinished(request: GroupRequest, seg: str, choices: Choices) -> None:
    """Refuse a run of the participant level that was interrupted: the rest might differ."""
    pending = []
    for root in request.roots:
        for row in read_status(root):
            name = name_of(row)
            is_wanted = request.wants(name.subject, name.session)
            listed = choices.reason_to_leave_out(name, None) is not None
            matches = (name.seg, name.region) == (seg, request.region)
            if row.get("reason") == NOT_FINISHED and matches and is_wanted and not listed:
                pending.append(name.stem)
    if pending:
        names = ", ".join(pending[:SHOWN]) + (" ..." if len(pending) > SHOWN else "")
        raise InputError(
            f"{request.roots[0]}: {len(pending)} hemispheres ({names}) are not finished; run "
            "the same command again, or list them in --exclude",
            reason=NOT_FINISHED,
        )


def _one_settings(records: Sequence[SheetRecord]) -> str:
    counts = Counter(record.settings_hash for record in records)
    if len(counts) > 1:
        examples = {record.settings_hash: record.result for record in reversed(records)}
        parts = [
            f"{n} with {digest[:8]} (as {examples[digest].name.stem} in {examples[digest].root})"
            for digest, n in counts.most_common()
        ]
        raise InputError(
            f"hemispheres were measured with different settings: {'; '.join(parts)}; measure all"
            " with the same"
        )
    return next(iter(counts))


def _refuse_several_sheets(records: Iterable[SheetRecord]) -> None:
    """Refuse participants whose sessions were measured on sheets of different sessions."""
    sheets: dict[tuple[str, str], dict[tuple[str, ...], None]] = {}
    for record in records:
        side = record.result.name.subject, record.result.name.hemi
        sheets.setdefault(side, {})[tuple(sorted(record.sheet, key=natural_order))] = None
    mixed = {side: sessions for side, sessions in sheets.items() if len(sessions) > 1}
    for (subject, hemi), sessions in mixed.items():
        names = "; ".join(", ".join(sheet) for sheet in sessions)
        further = f", and {len(mixed) - 1} more" if len(mixed) > 1 else ""
        raise InputError(
            f"sub-{subject} hemi-{hemi}{further}: sessions are on different sheets ({names}); run"
            " participant --longitudinal without --session-label, and delete results of removed"
            " sessions"
        )


def _shared_sheets(grid: Grid) -> tuple[str, ...]:
    """Note that all visits of a participant share a sheet."""
    if grid.frame == "visit":
        return ()
    return ("all visits of a participant share a sheet (participant --longitudinal)",)


def grid_of(root: Path) -> Grid:
    """Read the grid of the sheets of an output dataset."""
    path = root / DATASET_FILES["settings"]
    settings = files.read_json(path).get("settings")
    grid = settings.get("sheet") if isinstance(settings, Mapping) else None
    if isinstance(grid, Mapping):  # other versions may have had more settings
        grid = {name: grid[name] for name in Grid.model_fields if name in grid}
    try:
        return checked_foreign(grid, Grid)
    except ValueError as error:
        raise InputError(
            f"{path}: no settings of a sheet: {error}; run the participant level again",
            reason="bad-json",
        ) from error
