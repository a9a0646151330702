"""Files that users name by paths with labels.

Paths have placeholders, such as ``{subject}``, that stand for the labels of each hemisphere.
"""

import glob
import re
import string
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import UsageError
from hipsta_bids.types import Visit

#: What a pattern may contain; the side is the hemisphere as FreeSurfer spells it.
PLACEHOLDERS = ("subject", "session", "hemi", "side")

_SIDES = {"L": "lh", "R": "rh"}
_HEMIS = {side: hemi for hemi, side in _SIDES.items()}

#: A session's part of a path, which goes where there are no sessions.
_SESSION = re.compile(r"(?:^|(?<=/))ses-\{session\}/|_ses-\{session\}|\{session\}")

#: What a placeholder stands for.
_LABELS = {"subject": "[A-Za-z0-9]+", "session": "[A-Za-z0-9]+", "hemi": "[LR]", "side": "[lr]h"}
#: Wildcards as regular expressions; the others mean the same in both.
_WILDCARDS = {"**/": "(?:[^/]+/)*", "**": ".*", "*": "[^/]*", "?": "[^/]"}
_WILDCARD = re.compile(r"(\*\*/|\*\*|\*|\?|\[[^\]]+\])")


@dataclass(frozen=True, kw_only=True)
class Found(Visit):
    """A file, and its participant as far as the path has it."""

    path: Path
    hemi: str | None


def check_pattern(option: str, name: str, pattern: str) -> None:
    """Refuse placeholders that do not exist."""
    try:
        unknown = fields_of(pattern) - set(PLACEHOLDERS)
    except ValueError:
        unknown = {pattern}
    if unknown:
        placeholders = ", ".join(f"{{{field}}}" for field in PLACEHOLDERS)
        raise UsageError(
            f"{option} {name}: {min(unknown)!r} is not understood; placeholders are {placeholders}"
        )


def fields_of(pattern: str) -> set[str]:
    """List the placeholders of a pattern; ``ValueError`` if braces do not match."""
    return {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}


def fill(pattern: str, subject: str, session: str | None, hemi: str) -> str:
    """Put one hemisphere's labels into a pattern."""
    text = pattern if session else _SESSION.sub("", pattern)
    return text.format(subject=subject, session=session, hemi=hemi, side=_SIDES[hemi])


def find(name: str, root: Path) -> list[Path]:
    """Find the files of a name with wildcards, absolute or relative to a folder."""
    matches = glob.glob(name, root_dir=root, recursive=True)  # noqa: PTH207 (root_dir)
    return [root / match for match in sorted(matches)]


def scan(pattern: str, root: Path) -> list[Found]:
    """Find the files of all hemispheres, with sessions or without."""
    matches: dict[Path, Found] = {}
    for variant in dict.fromkeys((pattern, _SESSION.sub("", pattern))):
        expression = re.compile(_expression(variant))
        name = "".join(
            literal + ("" if field is None else "*")
            for literal, field, _, _ in string.Formatter().parse(variant)
        )
        for path in find(name, root):
            text = path if Path(variant).is_absolute() else path.relative_to(root)
            if (match := expression.fullmatch(text.as_posix())) and path.is_file():
                labels = match.groupdict()
                entry = Found(
                    path=path,
                    subject=labels["subject"],
                    session=labels.get("session"),
                    hemi=labels.get("hemi") or _HEMIS.get(labels.get("side", "")),
                )
                matches.setdefault(path, entry)
    return sorted(matches.values(), key=lambda entry: str(entry.path))


def _expression(pattern: str) -> str:
    """Regular expression with a group per placeholder; further ones of a kind must be equal."""
    expression = ""
    used_fields: set[str] = set()
    for literal, field, _, _ in string.Formatter().parse(pattern):
        for part in _WILDCARD.split(literal):
            is_set = part.startswith("[") and part.endswith("]")
            expression += _WILDCARDS.get(part) or (
                part.replace("[!", "[^", 1) if is_set else re.escape(part)
            )
        if field is not None:
            expression += (
                f"(?P={field})" if field in used_fields else f"(?P<{field}>{_LABELS[field]})"
            )
            used_fields.add(field)
    return expression
