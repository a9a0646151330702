"""Selection of inputs by options and the filter file, and choice among several files."""

import difflib
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from hipsta_bids import opening
from hipsta_bids.errors import HipstaError, InputError, ProtocolError, UsageError
from hipsta_bids.inputs import scan, tree
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Protocol

#: The entry of the filter file that applies to segmentations.
_QUERY = "dseg"

_Rule = Callable[[str | None], bool]


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What the user asked for, ready to be applied."""

    subjects: frozenset[str] = frozenset()
    """Empty for all, as in ``sessions``."""
    excluded: frozenset[str] = frozenset()
    sessions: frozenset[str] = frozenset()
    hemis: tuple[str, ...] = scan.HEMIS
    rules: Mapping[str, _Rule] = field(default_factory=dict)
    """By entity, in pybids's long names; from the filter file."""
    fs_analysis: str | None = None
    """The FreeSurfer analysis to take."""
    protocol: Protocol | None = None
    """The user's protocol."""

    def describes(self, tool: str) -> bool:
        """Check whether the user's protocol is one for the files of a tool."""
        return self.protocol is not None and self.protocol.tool in ("", tool)

    def wants_folder(self, folder: tree.SubjectFolder) -> bool:
        """Check whether a subject's folder has to be looked into."""
        return (
            (not self.subjects or folder.subject in self.subjects)
            and folder.subject not in self.excluded
            and (not self.sessions or folder.session is None or folder.session in self.sessions)
            and self._passes("subject", folder.subject)
        )

    def misses(self, entry: tree.Ignored) -> bool:
        """Check whether an entry that was not used belongs to a subject that is wanted."""
        subject = entry.subject
        return subject is None or (
            (not self.subjects or subject in self.subjects) and subject not in self.excluded
        )

    def wants_visit(self, visit: tree.VisitFolders) -> bool:
        """Check whether a session of a subject is wanted."""
        is_selected = not self.sessions or visit.session in self.sessions
        return is_selected and self._passes("session", visit.session)

    def wanted_hemis(self) -> tuple[str, ...]:
        """List the hemispheres that are wanted."""
        return tuple(
            hemi for hemi in scan.HEMIS if hemi in self.hemis and self._passes("hemi", hemi)
        )

    def wants_file(self, path: Path) -> bool:
        """Check whether a file with BIDS entities in its name is wanted."""
        if not self.rules:
            return True
        from bids.layout import parse_file_entities  # noqa: PLC0415 (takes seconds)

        file_entities = parse_file_entities(str(path), entities=list(_entities().values()))
        texts = {
            # Numbers keep their zeros in pybids, but are compared as numbers.
            key: str(int(value)) if isinstance(value, int) else str(value)
            for key, value in file_entities.items()
        }
        return all(rule(texts.get(key)) for key, rule in self.rules.items())

    def _passes(self, entity: str, value: str | None) -> bool:
        rule = self.rules.get(entity)
        return rule is None or rule(value)


@dataclass(frozen=True, kw_only=True)
class LabelFile:
    """A file with labels, by its name."""

    path: Path
    hemi: str | None
    """None for both."""
    traits: Mapping[str, str | None]
    """Groups of its layout's pattern, and entities."""
    longitudinal: bool = False
    rank: tuple[Any, ...] = ()
    """Order of preference, the least first."""

    @property
    def remark(self) -> str:
        """For the explanation, where the file is one of both hemispheres."""
        return "" if self.hemi else ", both hemispheres in one file"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Which protocol a file has, and why."""

    protocol: Protocol
    parts_protocol: Protocol | None = None
    explanation: str
    problem: HipstaError | None = None
    notes: tuple[str, ...] = ()
    provenance: dict[str, str | None] = field(default_factory=dict)
    """What the file's name does not show."""


@dataclass(frozen=True, kw_only=True)
class Context:
    """What the choice of a visit's files depends on."""

    source: scan.Source
    selection: Selection
    atlas: Protocol | None
    """Of ``--ashs-atlas``."""
    visit: tree.VisitFolders = tree.NO_VISIT
    identify_atlas: Callable[[LabelFile, str], Verdict] | None = None
    """Finds the atlas of a file of ASHS, and of one side."""
    longitudinal: bool = False
    """Which of FreeSurfer's runs the visit is represented by."""

    def input(
        self,
        hemi: str,
        verdict: Verdict,
        paths: Sequence[Path],
        passed_over: Iterable[tuple[Path, str]],
        *,
        bilateral: bool = False,
    ) -> scan.HemisphereInput:
        """Make the input of one hemisphere of the visit."""
        return scan.HemisphereInput(
            subject=self.visit.subject,
            session=self.visit.session,
            hemi=hemi,
            protocol=verdict.protocol,
            files=tuple(paths),
            parts_protocol=verdict.parts_protocol,
            bilateral=bilateral,
            source=self.source.name,
            source_path=self.source.path,
            explanation=verdict.explanation,
            passed_over=tuple(
                (path.name if path.parent == paths[0].parent else str(path), reason)
                for path, reason in passed_over
            ),
            problem=verdict.problem,
            notes=verdict.notes,
            provenance={key: text for key, text in verdict.provenance.items() if text},
        )

    def first(
        self,
        files: Sequence[LabelFile],
        verdict: Verdict,
        hemi: str,
        passed_over: Iterable[tuple[Path, str]],
        *,
        tool: str,
    ) -> scan.HemisphereInput:
        """Take the first file of a hemisphere, unless another one is as good."""
        best = files[0]
        verdict = replace(
            verdict,
            problem=verdict.problem or ambiguity(files),
            provenance=self.provenance(tool, best) | verdict.provenance,
        )
        return self.input(hemi, verdict, [best.path], passed_over, bilateral=best.hemi is None)

    def provenance(self, tool: str, file: LabelFile) -> dict[str, str | None]:
        """Determine the origin of a file by its name and place."""
        versions = [text for name, text in self.source.generators.items() if tool in name]
        parts, image = file.path.parts, re.search(r"(?<![A-Za-z])(?:crop)?(T[12]w)", file.path.name)
        analysis = file.traits.get("kind") or (image and image[1])
        if "HippUnfold" in parts[:-2]:  # the Human Connectome Project's folder of each contrast
            analysis = parts[parts.index("HippUnfold") + 1]
        return {
            "tool": tool,
            "version": versions[0] if versions else None,
            "analysis": analysis,
            "atlas": file.traits.get("atlas"),
            "space": file.traits.get("space"),
            "design": DESIGNS[file.longitudinal],
        }


#: Kinds of runs: each visit by itself, or all of a person's together.
DESIGNS = ("cross-sectional", "longitudinal")


def ambiguity(files: Sequence[LabelFile]) -> InputError | None:
    """Refuse to choose between files of which none is better."""
    equal_files = [file.path for file in files if file.rank == files[0].rank]
    if len(equal_files) == 1:
        return None
    folder = Path(os.path.commonpath([path.parent for path in equal_files]))
    names = " and ".join(str(path.relative_to(folder)) for path in equal_files)
    remedy = "keep one of them in the subject's folder"
    if len({path.name for path in equal_files}) < len(equal_files):
        remedy = "name the folder to use with --participants-map"
    elif files[0].traits.get("suffix") == "dseg":
        remedy = "choose by entities with --bids-filter-file"
    return InputError(f"{folder}: {names} are equally good; {remedy}", reason="several-files")


def make_selection(request: scan.InputRequest) -> Selection:
    """Prepare what the user asked for."""
    wrong = [hemi for hemi in request.hemis if hemi not in scan.HEMIS]
    if wrong or not request.hemis:
        raise UsageError(
            f"--hemi {' '.join(map(str, wrong))}: choose among {', '.join(scan.HEMIS)}"
        )
    choice = request.protocol or None

    def plain(labels: tuple[str, ...]) -> tuple[str, ...]:
        """Read names of folders as labels, where these may have any name."""
        return tuple(map(tree.plain_label, labels)) if request.any_name else labels

    return Selection(
        subjects=_labels(plain(request.participant_labels), "sub-", "--participant-label"),
        excluded=_labels(plain(request.excluded_labels), "sub-", "--exclude-participant-label"),
        sessions=_labels(request.session_labels, "ses-", "--session-label"),
        hemis=request.hemis,
        rules=_rules(request.bids_filter_file) if request.bids_filter_file else {},
        fs_analysis=request.fs_analysis,
        protocol=None
        if choice is None
        else measurable(load_protocol(Path(choice) if Path(choice).is_file() else str(choice))),
    )


def measurable(protocol: Protocol) -> Protocol:
    """Return a protocol, unless it is known to have no subfields."""
    if protocol.refused:
        raise ProtocolError(protocol.refused, reason="no-subfields")
    return protocol


def _labels(labels: Iterable[str], prefix: str, option: str) -> frozenset[str]:
    bare = frozenset(label.removeprefix(prefix) for label in labels)
    wrong = sorted(label for label in bare if not re.fullmatch("[A-Za-z0-9+]+", label))
    if wrong:
        raise UsageError(
            f"{option} {' '.join(wrong)}: labels consist of letters and digits "
            f"(with or without {prefix!r})"
        )
    return bare


def _rules(path: Path) -> dict[str, _Rule]:
    """Read a filter file: ``{"dseg": {"session": "01", "space": ["T1w", "T2w"]}}``."""
    try:
        contents = json.loads(opening.read_text(path, opening.SETTINGS))
    except OSError as error:
        raise InputError(
            f"{path}: cannot read the filter file ({error.strerror}); check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: the filter file is not JSON ({error})") from error
    query = contents.get(_QUERY, {}) if isinstance(contents, dict) else None
    if query == {}:
        raise UsageError(
            f"{path}: restricts nothing: segmentations are under {_QUERY!r}"
            f" (found {', '.join(map(repr, contents)) or 'nothing'}); leave --bids-filter-file out"
        )
    if not isinstance(query, dict):
        raise UsageError(
            f'{path}: the filter file is not of the form {{"{_QUERY}": {{ENTITY: VALUE}}}}'
        )
    known_keys = _entities()
    for key in query:
        if key not in known_keys:
            near = difflib.get_close_matches(key, known_keys, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise UsageError(f"{path}: {key!r} in {_QUERY!r} is not a BIDS entity{hint}")
    return {
        key: _rule(value, is_number=issubclass(known_keys[key].dtype, int))
        for key, value in query.items()
    }


def _rule(value: Any, *, is_number: bool) -> _Rule:  # noqa: ANN401 (JSON)
    """Make one entity's test; null, ``*`` and ``Query.…`` mean what they mean in fMRIPrep."""
    if value is None or value == "Query.NONE":
        return lambda text: text is None
    if value in ("*", "Query.ANY"):
        return lambda text: text is not None
    if value == "Query.OPTIONAL":
        return lambda _: True
    values = value if isinstance(value, list) else [value]
    rules = [_rule(v, is_number=is_number) for v in values] if isinstance(value, list) else []
    texts = {str(v) for v in values}
    if is_number:
        texts = {str(int(text)) if text.isdecimal() else text for text in texts}
    return lambda text: text in texts or any(rule(text) for rule in rules)


# pybids takes seconds to import and is needed only where a filter is given.
@cache
def _entities() -> dict[str, Any]:
    from bids.layout import Config  # noqa: PLC0415 (see above)

    configs = (Config.load(name) for name in ("bids", "derivatives"))
    return {name: entity for config in configs for name, entity in config.entities.items()}
