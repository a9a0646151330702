"""Which subjects, sessions and files are wanted: labels, and fMRIPrep's filter files."""

import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from hipsta_bids.bids.inputs import HEMIS, InputRequest
from hipsta_bids.bids.scan import SubjectFolder, Visit
from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.schemes import Scheme, load_scheme

#: The entry of the filter file that applies to segmentations.
_QUERY = "dseg"

_Wanted = Callable[[str | None], bool]


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What the user asked for, ready to be applied."""

    subjects: frozenset[str] = frozenset()
    """Empty for all, as in the next one."""
    sessions: frozenset[str] = frozenset()
    hemis: tuple[str, ...] = HEMIS
    rules: Mapping[str, _Wanted] = field(default_factory=dict)
    """By entity, in pybids's long names; from the filter file."""
    fs_analysis: str | None = None
    """The FreeSurfer analysis to take."""
    scheme: Scheme | None = None
    """The user's protocol."""

    def wants_folder(self, folder: SubjectFolder) -> bool:
        """Say whether a subject's folder has to be looked into."""
        return (
            (not self.subjects or folder.subject in self.subjects)
            and (not self.sessions or folder.session is None or folder.session in self.sessions)
            and self._passes("subject", folder.subject)
        )

    def wants_visit(self, visit: Visit) -> bool:
        """Say whether a session of a subject is wanted."""
        return (
            not self.sessions or (visit.session is not None and visit.session in self.sessions)
        ) and self._passes("session", visit.session)

    def wanted_hemis(self) -> tuple[str, ...]:
        """List the hemispheres that are wanted."""
        return tuple(hemi for hemi in HEMIS if hemi in self.hemis and self._passes("hemi", hemi))

    def wants_file(self, path: Path) -> bool:
        """Say whether a file with BIDS entities in its name is wanted."""
        if not self.rules:
            return True
        found = _parse(path)
        return all(rule(found.get(key)) for key, rule in self.rules.items())

    def _passes(self, entity: str, value: str | None) -> bool:
        rule = self.rules.get(entity)
        return rule is None or rule(value)


def make_selection(request: InputRequest) -> Selection:
    """Prepare what the user asked for.

    Parameters
    ----------
    request : InputRequest

    Returns
    -------
    Selection

    Raises
    ------
    UsageError
        ``bad-label``, ``bad-hemisphere`` or ``bad-filter``.
    InputError
        ``unreadable-filter``.
    SchemeError
        If the user's protocol is not valid.
    """
    wrong = [hemi for hemi in request.hemis if hemi not in HEMIS]
    if wrong or not request.hemis:
        raise UsageError(
            f"--hemi {' '.join(map(str, wrong))}: choose among {', '.join(HEMIS)}",
            reason="bad-hemisphere",
        )
    return Selection(
        subjects=_labels(request.participant_labels, "sub-", "--participant-label"),
        sessions=_labels(request.session_labels, "ses-", "--session-label"),
        hemis=request.hemis,
        rules=_rules(request.bids_filter_file) if request.bids_filter_file else {},
        fs_analysis=request.fs_analysis,
        scheme=load_scheme(request.scheme) if request.scheme else None,
    )


def _labels(labels: Iterable[str], prefix: str, option: str) -> frozenset[str]:
    bare = frozenset(label.removeprefix(prefix) for label in labels)
    wrong = sorted(label for label in bare if not re.fullmatch("[A-Za-z0-9+]+", label))
    if wrong:
        raise UsageError(
            f"{option} {' '.join(wrong)}: labels consist of letters and digits "
            f"(with or without {prefix!r})",
            reason="bad-label",
        )
    return bare


def _rules(path: Path) -> dict[str, _Wanted]:
    """Read a filter file: ``{"dseg": {"session": "01", "space": ["T1w", "T2w"]}}``."""
    try:
        contents = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot read the filter file ({error.strerror}); check the path",
            reason="unreadable-filter",
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: the filter file is not JSON ({error})", reason="unreadable-filter"
        ) from error
    query = contents.get(_QUERY) if isinstance(contents, dict) else None
    if not isinstance(query, dict):
        raise UsageError(
            f"{path}: the filter file has no entry {_QUERY!r}, which is the one for segmentations",
            reason="bad-filter",
        )
    known = _entities()
    for key in query:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise UsageError(
                f"{path}: {key!r} in {_QUERY!r} is not a BIDS entity{hint}", reason="bad-filter"
            )
    return {key: _rule(value) for key, value in query.items()}


def _rule(value: Any) -> _Wanted:  # noqa: ANN401 (JSON)
    """Make one entity's test; null, ``*`` and ``Query.…`` mean what they mean in fMRIPrep."""
    if value is None or value == "Query.NONE":
        return lambda found: found is None
    if value in ("*", "Query.ANY"):
        return lambda found: found is not None
    if value == "Query.OPTIONAL":
        return lambda _: True
    values = value if isinstance(value, list) else [value]
    rules = [_rule(entry) for entry in values] if isinstance(value, list) else []
    texts = {str(entry) for entry in values}
    return lambda found: found in texts or any(rule(found) for rule in rules)


# pybids takes seconds to import and is needed only where a filter is given.
@cache
def _entities() -> dict[str, Any]:
    from bids.layout import Config  # noqa: PLC0415 (see above)

    configs = (Config.load(name) for name in ("bids", "derivatives"))
    return {name: entity for config in configs for name, entity in config.entities.items()}


def _parse(path: Path) -> dict[str, str]:
    from bids.layout import parse_file_entities  # noqa: PLC0415 (see above)

    found = parse_file_entities(str(path), entities=list(_entities().values()))
    return {key: str(value) for key, value in found.items()}
