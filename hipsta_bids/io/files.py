"""Reading and atomic writing of text, JSON and BIDS tables; names, hashes and locks of files.

A written file appears whole or not at all: it is written aside, flushed to the disk, then renamed
over its final name. The same values give the same bytes.
"""

import contextlib
import errno
import fcntl
import glob
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from hipsta_bids import opening, types
from hipsta_bids.errors import InputError, MissingFileError, OutputError
from hipsta_bids.types.tables import Table, first_mistake

LOGS = "logs"
"""Folder of an output dataset that holds the run logs, and the file whose bytes are the locks."""

MISSING = types.MISSING
"""A missing value in BIDS tables."""

#: Spellings of a missing value, without capitals, blanks and signs; Excel's errors begin with #.
_MISSING = re.compile(
    r"(#?nan?|<na>|nil|none|#?null|unk|unkn|unknown|tbd|blank|1#(qnan|ind)|#(div0|name|num|ref|value)"
    r"|missing(data|values?)?|no(answer|data|response|value)|un(defined|disclosed|specified)"
    r"|not(applicable|assessed|available|collected|done|known|measured|recorded|reported|specified"
    r"|stated|tested)|prefernotto(answer|say)|desconocido|inconnu|keineangabe|unbekannt)?"
)
#: A cell as R writes text.
_QUOTED = re.compile(r'^\s*"([^"]*)"\s*$')
_SIGNS = re.compile(r"[\s?!.*/\\|()\[\]_\u2010-\u2015\u2026\u2212-]+")

_DEEPEST = 100  # lists and objects within each other in JSON
_HALF_LETTERS = r"\ud"  # with two digits more, a half of a letter beyond the first plane

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EROFS, errno.EACCES, errno.EPERM}
_TEMPORARY = ".tmp"

DATASET = "dataset"
"""Name of the lock on the files of the whole dataset."""

_LOCK_FILE = ".lock"


def is_disk_full(error: OSError) -> bool:
    """Check whether a system error means that no space is left (or no quota, or a size limit)."""
    return error.errno in _FULL


def output_error(path: Path, error: OSError) -> OutputError:
    """Translate a system error on writing into one that a user can act on."""
    detail = error.strerror or error
    if is_disk_full(error):
        reason = "disk-full"
        problem = f"no space left ({detail}); free some and run the same command again"
    elif error.errno in _FORBIDDEN:
        reason = "read-only"
        problem = (
            f"not allowed to write there ({detail}); choose another output folder or change its"
            " permissions"
        )
    else:
        reason = "not-writable"
        problem = f"cannot be written ({detail}); choose another output folder"
    return OutputError(f"{path}: {problem}", reason=reason)


def make_folder(path: Path) -> None:
    """Make a folder and its parents; one that exists already is fine."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(path, error) from error


def check_writable(folder: Path) -> None:
    """Make a folder if need be and prove that files can be written there."""
    make_folder(folder)
    probe = _aside(folder / "write-probe")
    try:
        # A whole block, since an empty file can still be made on a full disk.
        _write_through(probe, b"\0" * 4096)
        probe.unlink(missing_ok=True)  # another run may tidy up
    except OSError as error:
        with contextlib.suppress(OSError):
            probe.unlink()
        raise output_error(folder, error) from error


def scratch_folder(kind: str) -> Path:
    """Make a temporary folder of this process; its name has the process in it."""
    return Path(tempfile.mkdtemp(prefix=f"{_scratch_prefix()}{os.getpid()}-{kind}-"))


def _scratch_prefix() -> str:
    """Process numbers mean something on one machine only, and folders may be shared by several."""
    return f"hipsta-bids-{platform.node()}-"


def remove_left_scratch(folder: Path) -> None:
    """Remove temporary folders that processes of this machine left when they were killed."""
    prefix = _scratch_prefix()
    for left in folder.glob(f"{glob.escape(prefix)}*"):
        number = left.name.removeprefix(prefix).partition("-")[0]
        with contextlib.suppress(OSError):
            if number.isdigit() and left.stat().st_uid == os.getuid() and not _runs(int(number)):
                shutil.rmtree(left, ignore_errors=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        pass
    return True


def check_scratch(folder: Path | None = None) -> None:
    """Prove that temporary files can be written, in a folder or where the system has them.

    What killed processes left there is removed.
    """
    if folder is not None:
        check_writable(folder)
        remove_left_scratch(folder)
        return
    try:
        tempfile.gettempdir()
    except FileNotFoundError as error:
        raise OutputError(
            "no folder for temporary files can be written; set TMPDIR to one (in a container,"
            " mount one at /tmp)"
        ) from error
    remove_left_scratch(Path(tempfile.gettempdir()))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically, making its folder if need be."""
    make_folder(path.parent)
    temporary = _aside(path)
    try:
        try:
            _write_through(temporary, content)
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
    except OSError as error:
        raise output_error(path, error) from error


def _aside(path: Path) -> Path:
    """Name a file to write into before it is renamed, that no other process uses."""
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{_TEMPORARY}")


def _write_through(path: Path, content: bytes) -> None:
    """Write and wait until the disk has it: a rename must never precede its content."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def hide_home(text: str) -> str:
    """Write the home folder, which names the user, as ``~``."""
    home = os.path.expanduser("~")  # noqa: PTH111  (Path.home() fails where there is none)
    return text.replace(f"{home}/", "~/") if len(home) > 1 else text


def remove(paths: Iterable[Path]) -> None:
    """Remove files; missing files are fine."""
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise output_error(path, error) from error


def remove_leftovers(folder: Path, pattern: str) -> None:
    """Remove what a killed run left half-written."""
    remove(folder.glob(f".{pattern}.*{_TEMPORARY}"))


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically (see :func:`write_bytes`).

    Names of files that the locale cannot spell keep their bytes.
    """
    write_bytes(path, text.encode(errors="surrogateescape"))


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write strict JSON atomically: NaN and infinities become ``null``, key order is kept.

    Numpy scalars and arrays are written as numbers and lists.
    """
    text = json.dumps(plain(value), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def plain(value: Any) -> Any:  # noqa: ANN401  (JSON values have no narrower common type)
    """Reduce a value to what JSON knows: numbers, words, lists, objects, null."""
    if hasattr(value, "tolist"):  # numpy's arrays and scalars
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        items = sorted(value) if isinstance(value, (set, frozenset)) else value
        return [plain(item) for item in items]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float)):
        return value
    return str(value)


def read_json(path: Path, limit: float = opening.TABLE) -> dict[str, Any]:
    """Read a JSON object."""
    try:
        text = opening.read_text(path, limit)
        value = json.loads(text)
        if text.count("{") + text.count("[") > _DEEPEST:
            _check_depth(value)
        if _HALF_LETTERS in text.lower():  # can be read, but not be written
            json.dumps(value, ensure_ascii=False).encode()
    except FileNotFoundError as error:
        raise MissingFileError(
            f"{path}: file not found; check its name", reason="bad-json"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not readable as JSON ({error}); correct or restore it", reason="bad-json"
        ) from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: not a JSON object; correct or restore it", reason="bad-json")
    return value


def _check_depth(value: object) -> None:
    """Refuse what could be read but not be written again, which takes more calls per level."""
    level = [value] if isinstance(value, (dict, list)) else []
    for _ in range(_DEEPEST):
        entries = (part.values() if isinstance(part, dict) else part for part in level)
        level = [v for values in entries for v in values if isinstance(v, (dict, list))]
    if level:
        raise ValueError(f"more than {_DEEPEST} lists within lists")


def is_missing(cell: str) -> bool:
    """Check whether a cell of a table spells a missing value: ``n/a``, nothing, ``unknown`` ..."""
    return _MISSING.fullmatch(_SIGNS.sub("", cell.casefold())) is not None


def write_tsv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a BIDS table atomically."""
    lines = ["\t".join(columns)]
    lines += ["\t".join(" ".join(cell.split()) or MISSING for cell in row) for row in rows]
    write_text(path, "\n".join(lines) + "\n")


def read_tsv(path: Path) -> list[dict[str, str]]:
    """Read a BIDS table as text cells."""
    text = _read_table_text(path)
    lines = [line.split("\t") for line in text.split("\n")]
    lines = [[*map(_unquoted, cells)] for cells in lines] if '"' in text else lines
    rows = [(number, cells) for number, cells in enumerate(lines, 1) if any(map(str.strip, cells))]
    header = [name.strip() for name in _shortened(rows[0][1], 0)] if rows else []
    size = len(header)
    table = [(number, _shortened(cells, size)) for number, cells in rows[1:]]
    for number, cells in table:
        if len(cells) != size:
            raise InputError(
                f"{path}: line {number} has {len(cells)} cells, the header {size}; separate"
                " cells by one tab, and write n/a in empty ones",
                reason="bad-table",
            )
    if repeated := sorted({name for name in header if header.count(name) > 1}):
        raise InputError(
            f"{path}: column {repeated[0]!r} occurs more than once; keep one", reason="bad-table"
        )
    return [dict(zip(header, cells, strict=True)) for _, cells in table]


def _unquoted(cell: str) -> str:
    return _QUOTED.sub(r"\1", cell)


def _read_table_text(path: Path) -> str:
    try:
        return opening.read_text(path, encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: file not found; check its name") from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not readable as a table: no UTF-8 text; save it as that (not as Excel's"
            " Unicode text)",
            reason="unreadable-table",
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: not readable as a table ({error}); save it as UTF-8 text with tabs",
            reason="unreadable-table",
        ) from error


def _shortened(cells: Sequence[str], size: int) -> list[str]:
    """Remove blank cells at the end of a row beyond a size, as spreadsheets write them."""
    last = max((i for i, cell in enumerate(cells, 1) if cell.strip()), default=0)
    return list(cells[: max(last, size)])


def sha256_of(path: Path) -> str:
    """Hash the content of a file."""
    try:
        with opening.open_regular(path) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that it exists and is readable",
            reason="unreadable-file",
        ) from error


@contextlib.contextmanager
def locked(root: Path, purpose: str) -> Iterator[bool]:
    """Let one process at a time work on something, on one machine or many; others wait.

    Yields whether the file system knows locks. A process may hold one lock at a time: with POSIX's
    record locks, releasing one releases all that it has on the same file.
    """
    folder = root / LOGS
    make_folder(folder)
    path = folder / _LOCK_FILE
    digest = hashlib.blake2b(purpose.encode(), digest_size=7).digest()
    try:
        handle = path.open("ab")
    except OSError as error:
        raise output_error(path, error) from error
    with handle:
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX, 1, int.from_bytes(digest, "big"))
        except OSError:
            yield False
        else:
            yield True


def entities(name: str) -> dict[str, str]:
    """Split a BIDS file name; keys are as in the name (``sub``), with ``suffix`` and ``extension``.

    pybids takes 30 times as long and seconds to import; a test compares the two.
    """
    stem, dot, extension = name.partition(".")
    *parts, suffix = stem.split("_")
    pairs = dict(part.split("-", 1) for part in parts if "-" in part)
    return {**pairs, "suffix": suffix, "extension": dot + extension}


#: Largest number of a file of another site; products and powers of such numbers stay finite.
LARGEST = 1e40
Number = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
FileNumbers = list[Number | None]
"""FileNumbers in JSON; null where one is missing."""
Nested = dict[str, dict[str, dict[str, list[Any]]]]
"""Arrays by hemisphere, measure and name as lists, for JSON."""

#: Characters of a mistake in a file.
_LONGEST = 300

#: Keys of the group level's files, in lower case, of which no other file has all.
_FOREIGN_KINDS = {
    "a summary of --export-summary": {"site", "axes", "models"},
    "norms of --fit-norms": {"knots", "norms"},
    "the harmonization.json of an analysis": {"repeated", "maps", "summaries"},
    "a template of registration": {"hemispheres"},
}


def read_foreign(path: Path, kind: type[Table], *, max_bytes: float) -> Table:
    """Read a JSON file of another site, which may hold anything; nothing in it is run.

    A mistake in it, or more than ``max_bytes``, is a ValueError of one line.
    """
    if path.is_file() and path.stat().st_size > max_bytes:
        raise ValueError(f"larger than {max_bytes / 1e6:g} MB")
    content = read_json(path, max_bytes)
    present_keys = {str(key).casefold() for key in content}
    for name, keys in _FOREIGN_KINDS.items():
        if keys <= present_keys and not keys <= set(kind.model_fields):
            raise ValueError(f"it is {name}")
    return checked_foreign(content, kind)


def checked_foreign(content: object, kind: type[Table]) -> Table:
    """Check the content of a file of another site; ValueError of one line if something is wrong."""
    try:
        return kind.model_validate(content)
    except RecursionError as error:
        raise ValueError("lists within lists without end") from error
    except ValidationError as error:
        mistake = first_mistake(error, kind).encode("unicode_escape").decode()
        raise ValueError(shorten(mistake, _LONGEST)) from error


def rounded(value: Any) -> Any:  # noqa: ANN401  (nested lists of numbers)
    """Round numbers to nine digits, in lists and arrays too; null where one is missing."""
    if isinstance(value, (list, np.ndarray)):
        return [rounded(entry) for entry in (value if isinstance(value, list) else value.tolist())]
    if isinstance(value, int):
        return value
    return float(f"{value:.9g}") if math.isfinite(value) else None


def as_nested(results: Mapping[tuple[str, str], object], names: Sequence[str]) -> Nested:
    """Write the named arrays of values by hemisphere and measure."""
    nested: Nested = {}
    for (hemi, measure), result in results.items():
        arrays = {name: rounded(getattr(result, name)) for name in names}
        nested.setdefault(hemi, {})[measure] = arrays
    return nested


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("a text without control characters")
    return text


Text = Annotated[str, Field(max_length=500), AfterValidator(_printable)]
