"""Listing folders, once each, without opening a file."""

import json
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hipsta_bids.errors import InputError

#: ``sub-X``, ``sub-X_ses-Y``, and FreeSurfer's longitudinal ``sub-X_ses-Y.long.BASE``.
_SUBJECT = re.compile(
    r"sub-(?P<subject>[A-Za-z0-9+]+)(?:_ses-(?P<session>[A-Za-z0-9+]+))?(?P<long>\.long\..+)?"
)
_SESSION = re.compile(r"ses-(?P<session>[A-Za-z0-9+]+)")

#: Folders below a subject or a session that can hold segmentations.
_INNER = re.compile(r"anat|mri|final|seg\w*")


@dataclass(frozen=True, kw_only=True)
class SubjectFolder:
    """A folder that belongs to a subject, by its name."""

    subject: str
    session: str | None
    longitudinal: bool
    path: Path


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A folder and the names of the files directly in it."""

    path: Path
    names: tuple[str, ...]
    longitudinal: bool = False


@dataclass(frozen=True, kw_only=True)
class Visit:
    """All candidate folders of one subject, or of one of its sessions."""

    subject: str
    session: str | None
    folders: tuple[Folder, ...]


def list_folder(path: Path) -> tuple[list[str], list[str]]:
    """List a folder.

    Parameters
    ----------
    path : Path

    Returns
    -------
    folders, files : list of str
        Sorted names; hidden ones are left out.

    Raises
    ------
    InputError
        ``missing-folder``, ``not-a-folder`` or ``unreadable-folder``.
    """
    folders: list[str] = []
    files: list[str] = []
    try:
        with os.scandir(path) as entries:
            for entry in entries:
                if not entry.name.startswith("."):
                    (folders if entry.is_dir() else files).append(entry.name)
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: no such folder; check the path", reason="missing-folder"
        ) from error
    except NotADirectoryError as error:
        raise InputError(
            f"{path}: is a file, but a folder is needed", reason="not-a-folder"
        ) from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot list the folder ({error.strerror}); check its permissions",
            reason="unreadable-folder",
        ) from error
    return sorted(folders), sorted(files)


def subject_folders(root: Path) -> list[SubjectFolder]:
    """List the subjects' folders of a dataset, sorted by name.

    Parameters
    ----------
    root : Path

    Returns
    -------
    list of SubjectFolder

    Raises
    ------
    InputError
        If the folder cannot be listed.
    """
    matches = ((name, _SUBJECT.fullmatch(name)) for name in list_folder(root)[0])
    return [
        SubjectFolder(
            subject=match["subject"],
            session=match["session"],
            longitudinal=match["long"] is not None,
            path=root / name,
        )
        for name, match in matches
        if match
    ]


def list_visits(folders: Iterable[SubjectFolder]) -> list[Visit]:
    """List the candidate files of some subjects.

    Parameters
    ----------
    folders : iterable of SubjectFolder

    Returns
    -------
    list of Visit
        One per subject and session; ``sub-X/ses-Y`` and ``sub-X_ses-Y`` are the same visit.

    Raises
    ------
    InputError
        If a folder cannot be listed.
    """
    found: dict[tuple[str, str | None], list[Folder]] = {}
    for folder in folders:
        for session, inner in _inner_folders(folder):
            found.setdefault((folder.subject, session), []).append(inner)
    return [
        Visit(subject=subject, session=session, folders=tuple(inner))
        for (subject, session), inner in found.items()
    ]


def _inner_folders(folder: SubjectFolder) -> Iterator[tuple[str | None, Folder]]:
    """Walk over a subject's folder: itself, its sessions, and the folders inside both."""
    waiting = [(folder.session, folder.path, True)]
    while waiting:
        session, path, outer = waiting.pop()
        names, files = list_folder(path)
        if files:
            yield (
                session,
                Folder(path=path, names=tuple(files), longitudinal=folder.longitudinal),
            )
        for name in names if outer else ():
            match = _SESSION.fullmatch(name)
            if match and session is None:
                waiting.append((match["session"], path / name, True))
            elif _INNER.fullmatch(name):
                waiting.append((session, path / name, False))


def read_description(root: Path) -> dict[str, Any] | None:
    """Read a dataset's ``dataset_description.json``.

    Parameters
    ----------
    root : Path

    Returns
    -------
    dict or None
        None if there is none; an empty one if it cannot be understood (nothing depends on it).
    """
    try:
        contents = json.loads((root / "dataset_description.json").read_text("utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return contents if isinstance(contents, dict) else {}


def generators(description: dict[str, Any] | None) -> frozenset[str]:
    """Name the software that a dataset says it was made with, in lower case.

    Parameters
    ----------
    description : dict or None
        Contents of ``dataset_description.json``.

    Returns
    -------
    frozenset of str
    """
    entries = (description or {}).get("GeneratedBy")
    if not isinstance(entries, list):
        entries = [(description or {}).get("PipelineDescription")]  # BIDS before 1.4
    return frozenset(
        str(entry["Name"]).lower()
        for entry in entries
        if isinstance(entry, dict) and "Name" in entry
    )
