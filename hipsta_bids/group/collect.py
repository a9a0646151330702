"""Which hemispheres of the participant level enter the group level, and which are left out, why."""

import ast
import difflib
import operator
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.dataset import NOT_FINISHED, name_of, read_status
from hipsta_bids.derivatives.hemisphere import (
    ResultPlace,
    list_results,
    read_record,
)
from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName
from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.group.covariates import relocate
from hipsta_bids.io import files
from hipsta_bids.protocols.toml import resolve, settings_hash
from hipsta_bids.settings import Settings
from hipsta_bids.types import Status

#: Number of names that a note lists.
_SHOWN = 4
_ALLOWED = "may hold comparisons, and, or, not, + - * / only"
_LONGEST = 500  # characters of a condition
_OPERATORS: Mapping[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


def read_exclusions(path: Path | None) -> list[dict[str, str]]:
    """Read the user's table of participants, or single sessions and hemispheres, to leave out."""
    if path is None:
        return []
    rows = files.read_tsv(path)
    if rows and "participant_id" not in rows[0]:
        raise InputError(
            f"{path}: no column participant_id; it may have session_id, hemi, protocol, region and"
            " reason besides",
            reason="bad-table",
        )
    return rows


def lost_exclusions(
    path: Path | None, rows: Sequence[Mapping[str, str]], found: Sequence[HemisphereName]
) -> tuple[str, ...]:
    """Note rows of the user's table that match no hemisphere: labels may be misspelled.

    Those ``found`` are of all protocols and regions, as rows of a saved list may be.
    """
    if path is None:
        return ()
    if not rows:
        return (f"{path}: has no rows; nothing is excluded",)
    lost = [
        row["participant_id"] for row in rows if not any(is_listed(name, row) for name in found)
    ]
    if not lost:
        return ()
    more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
    return (f"{path}: matches no hemisphere here: {', '.join(lost[:_SHOWN])}{more}",)


def is_listed(name: HemisphereName, row: Mapping[str, str]) -> bool:
    """Whether a row of the user's table means this hemisphere; empty cells mean any.

    One without a protocol, of other programs' maps, is meant by rows of any protocol and region.
    """
    own = {"participant_id": name.subject, "session_id": name.session or "", "hemi": name.hemi}
    own |= {"protocol": name.seg, "region": name.region} if name.seg else {}
    for key, value in own.items():
        cell = row.get(key, files.MISSING).removeprefix("sub-").removeprefix("ses-")
        if cell not in {files.MISSING, "", value}:
            return False
    return True


class QualityCondition:
    """A condition on quality metrics, such as ``filled_fraction > 0.01 or voxels_across < 3``."""

    def __init__(self, text: str) -> None:
        self.text = text[:_LONGEST]
        if len(text) > _LONGEST:
            raise self._refusal(f"... is too long; {_LONGEST} characters are the limit")
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError) as error:  # ValueError: a null byte
            raise self._refusal("cannot be read; write it as filled_fraction > 0.01") from error

    def holds(self, metrics: Mapping[str, Any]) -> bool:
        """Evaluate the condition; comparisons with missing metrics do not hold."""
        return bool(self._value(self._tree, metrics))

    def _value(self, node: ast.expr, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- of the metric
        value: Any = None
        match node:
            case ast.Constant():
                value = node.value
            case ast.Name(id=name):
                value = self._metric(name, metrics)
            case ast.Compare():
                values = [self._value(part, metrics) for part in (node.left, *node.comparators)]
                pairs = zip(node.ops, pairwise(values), strict=True)
                value = all(self._act(sign, a, b) for sign, (a, b) in pairs)
            case ast.BoolOp(op=ast.And()):
                value = all(self._value(part, metrics) for part in node.values)
            case ast.BoolOp():
                value = any(self._value(part, metrics) for part in node.values)
            case ast.UnaryOp(op=ast.Not()):
                value = not self._value(node.operand, metrics)
            case ast.UnaryOp(op=ast.USub()):
                value = self._act(ast.Sub(), 0, self._value(node.operand, metrics))
            case ast.BinOp():
                a, b = self._value(node.left, metrics), self._value(node.right, metrics)
                value = self._act(node.op, a, b)
            case _:
                raise self._refusal(_ALLOWED)
        return value

    def _act(self, sign: ast.AST, a: Any, b: Any) -> Any:  # noqa: ANN401 -- as above
        if type(sign) not in _OPERATORS:
            raise self._refusal(_ALLOWED)
        if a is None or b is None:
            return None
        if isinstance(sign, ast.operator) and (isinstance(a, str) or isinstance(b, str)):
            raise self._refusal(f"cannot combine {a!r} and {b!r}")
        try:
            return _OPERATORS[type(sign)](a, b)
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
    excluded: tuple[str, ...] = ()
    """Labels to leave out."""
    sessions: tuple[str, ...] = ()
    """Labels without ``ses-``; empty is all."""
    exclude_flagged: bool = False
    exclude_quality: QualityCondition | None = None
    exclude_table: Path | None = None
    """Participants, or single sessions and hemispheres, to leave out."""
    segmentations: tuple[Path, ...] = ()
    """Where segmentations are now, if they have moved since they were measured."""

    def wants(self, subject: str, session: str | None) -> bool:
        """Tell whether a visit is asked for, by its labels."""
        return (
            (not self.subjects or subject in self.subjects)
            and subject not in self.excluded
            and (not self.sessions or session in self.sessions)
        )


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

    settings: Mapping[str, Any]
    """Those of the participant level, resolved."""
    settings_hash: str
    records: tuple[SheetRecord, ...] = ()
    """Sorted by subject, session, hemisphere."""
    exclusions: tuple[Exclusion, ...] = ()
    versions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    """What to know, one line each."""
    warnings: tuple[str, ...] = ()
    """What may make results wrong, one line each."""


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
        return Collection(
            settings=resolve(Settings()), settings_hash=settings_hash(Settings()), notes=notes
        )
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
        settings=settings_of(kept[0].place.root),
        settings_hash=digest,
        versions=tuple(sorted({record.version for record in kept})),
        notes=(
            *notes,
            *lost_exclusions(request.exclude_table, unwanted, [place.name for place in everything]),
        ),
        warnings=_several_versions(kept),
    )


def _several_versions(kept: Sequence[SheetRecord]) -> tuple[str, ...]:
    """Say which hemispheres another version has measured: versions may give other numbers."""
    counts = Counter(record.version for record in kept)
    if len(counts) < 2:  # noqa: PLR2004 -- one is as it should be
        return ()
    usual = counts.most_common(1)[0][0]
    others = [record.place.name.stem for record in kept if record.version != usual]
    more = f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else ""
    found = ", ".join(f"{version} ({n})" for version, n in sorted(counts.items()))
    text = (
        f"hemispheres were measured by several versions, {found}; measure"
        f" {', '.join(others[:_SHOWN])}{more} with {usual}: a version may change numbers"
    )
    return (text,)


def wanted_by(request: GroupRequest) -> Callable[[str, str | None, str], bool]:
    """Tell whether a hemisphere is asked for, and not in the table of exclusions."""
    unwanted = read_exclusions(request.exclude_table)

    def is_wanted(subject: str, session: str | None, hemi: str) -> bool:
        name = HemisphereName(subject=subject, session=session, hemi=hemi, seg="")
        return request.wants(subject, session) and not any(is_listed(name, row) for row in unwanted)

    return is_wanted


def _wanted_results(root: Path, request: GroupRequest) -> list[ResultPlace]:
    if not root.is_dir():
        raise InputError(
            f"{root}: no such folder; run the participant level first", reason="no-derivatives"
        )
    return [
        place
        for place in list_results(root)
        if request.wants(place.name.subject, place.name.session)
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
            asked = request.wants(name.subject, name.session)
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


def settings_of(root: Path) -> Mapping[str, Any]:
    """Read the settings that the results of an output dataset share."""
    settings = files.read_json(root / DATASET_FILES["settings"]).get("settings")
    if not isinstance(settings, Mapping):
        raise InputError(
            f"{root / DATASET_FILES['settings']}: holds no settings; run the participant level"
            " again",
            reason="bad-json",
        )
    return settings
