"""Paths with placeholders, by which users say where other files of each hemisphere are."""

import glob
import re
import string
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids.errors import UsageError

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
class Found:
    """A file, and whose it is as far as its path says."""

    path: Path
    subject: str
    session: str | None
    hemi: str | None


def check_pattern(option: str, name: str, pattern: str) -> None:
    """Refuse placeholders that do not exist.

    Parameters
    ----------
    option, name : str
        What the pattern was given for, for the message.
    pattern : str

    Raises
    ------
    UsageError
        Names the placeholder.
    """
    try:
        unknown = fields_of(pattern) - set(PLACEHOLDERS)
    except ValueError:
        unknown = {pattern}
    if unknown:
        known = ", ".join(f"{{{field}}}" for field in PLACEHOLDERS)
        raise UsageError(
            f"{option} {name}: {min(unknown)!r} is not understood; placeholders are {known}",
            reason="usage",
        )


def fields_of(pattern: str) -> set[str]:
    """List the placeholders of a pattern; ``ValueError`` if braces do not match."""
    return {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}


def fill(pattern: str, subject: str, session: str | None, hemi: str) -> str:
    """Put one hemisphere's labels into a pattern.

    Parameters
    ----------
    pattern : str
    subject : str
        Without ``sub-``.
    session : str or None
        Without ``ses-``; if there is none, the session's part of the path is left out.
    hemi : str
        ``L`` or ``R``.
    """
    text = pattern if session else _SESSION.sub("", pattern)
    return text.format(subject=subject, session=session, hemi=hemi, side=_SIDES[hemi])


def find(name: str, root: Path) -> list[Path]:
    """Find the files of a name with wildcards, absolute or relative to a folder."""
    matches = glob.glob(name, root_dir=root, recursive=True)  # noqa: PTH207 (root_dir)
    return [root / match for match in sorted(matches)]


def scan(pattern: str, root: Path) -> list[Found]:
    """Find the files of all hemispheres, with sessions or without.

    Parameters
    ----------
    pattern : str
        Checked; needs ``{subject}``.
    root : Path
        What it is relative to.

    Returns
    -------
    list of Found
        Sorted by path.
    """
    found: dict[Path, Found] = {}
    for variant in dict.fromkeys((pattern, _SESSION.sub("", pattern))):
        expression = re.compile(_expression(variant))
        name = "".join(
            glob_part + ("" if field is None else "*")
            for glob_part, field, _, _ in string.Formatter().parse(variant)
        )
        for path in find(name, root):
            text = path.as_posix() if Path(variant).is_absolute() else _inside(path, root)
            if (match := expression.fullmatch(text)) and path.is_file():
                found.setdefault(path, _whose(path, match.groupdict()))
    return sorted(found.values(), key=lambda one: str(one.path))


def _inside(path: Path, root: Path) -> str:
    return str(path)[len(str(root)) :].lstrip("/") if str(root) != "." else str(path)


def _whose(path: Path, labels: dict[str, str]) -> Found:
    hemi = labels.get("hemi") or _HEMIS.get(labels.get("side", ""))
    return Found(path=path, subject=labels["subject"], session=labels.get("session"), hemi=hemi)


def _expression(pattern: str) -> str:
    """Regular expression with a group per placeholder; further ones of a kind must be equal."""
    return "".join(_parts(pattern))


def _parts(pattern: str) -> Iterator[str]:
    seen: set[str] = set()
    for literal, field, _, _ in string.Formatter().parse(pattern):
        for part in _WILDCARD.split(literal):
            is_set = part.startswith("[") and part.endswith("]")
            yield _WILDCARDS.get(part) or (_set(part) if is_set else re.escape(part))
        if field is not None:
            yield f"(?P={field})" if field in seen else f"(?P<{field}>{_LABELS[field]})"
            seen.add(field)


def _set(part: str) -> str:
    return f"[^{part[2:]}" if part.startswith("[!") else part
