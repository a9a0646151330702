"""Opening files that somebody else may have made: regular ones only, of a bearable size.

A pipe would be waited for, a device read without end, and a sparse file may have any size.
"""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

#: Most bytes of a file that is read at once: settings, filters and protocols; tables and JSON.
SETTINGS, TABLE = 2_000_000, 200_000_000

#: Places of the system, whose files may be regular but are none.
_SYSTEM = ("/proc/", "/sys/", "/dev/")

#: How files begin that stand for others: git-annex's unlocked ones, and those of Git LFS.
_POINTERS = (b"/annex/objects/", b"version https://git-lfs.github.com/")

#: Pointers are not larger than this, bytes.
_POINTER_SIZE = 1024


class UnfitFileError(OSError):
    """A file that is not read; its message has no number of the system."""

    def __str__(self) -> str:
        return str(self.strerror)


def not_fetched(path: Path) -> str | None:
    """Return the remedy if the content of a file is elsewhere; links and small files are opened."""
    try:
        status = path.lstat()
        if stat.S_ISLNK(status.st_mode) or 0 < status.st_size < _POINTER_SIZE:
            open_regular(path).close()
    except OSError as error:
        return error.strerror if error.errno == errno.ENODATA else None
    return None


def open_regular(path: Path) -> BufferedReader:
    """Open a file for reading, if it is a regular one and its content is here."""
    fetch = UnfitFileError(errno.ENODATA, f"its content was not fetched; run `datalad get {path}`")
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except IsADirectoryError as error:
        raise UnfitFileError(errno.EINVAL, "no regular file") from error
    except FileNotFoundError:
        if path.is_symlink() and "annex/objects" in str(path.readlink()):
            raise fetch from None
        raise
    status = os.fstat(file.fileno())
    is_pointer = 0 < status.st_size < _POINTER_SIZE and file.peek(1).startswith(_POINTERS)
    # Files of the system say that they are empty.
    is_system = not status.st_size and os.path.realpath(path).startswith(_SYSTEM)
    if not stat.S_ISREG(status.st_mode) or is_system or is_pointer:
        file.close()
        raise fetch if is_pointer else UnfitFileError(errno.EINVAL, "no regular file")
    return file


def read_bounded(path: Path, limit: float) -> bytes:
    """Read a regular file of no more than some bytes."""
    with open_regular(path) as file:
        # Memory for the limit would take longer to get than the file to read.
        size = min(os.fstat(file.fileno()).st_size, int(limit))
        content = file.read(size + 1)
        if len(content) > size:  # it grows, or its size is not known
            content += file.read(int(limit) + 1 - len(content))
    if len(content) > limit:
        raise UnfitFileError(errno.EFBIG, f"larger than {limit / 1e6:g} MB")
    return content


def read_text(path: Path, limit: float = TABLE, *, encoding: str = "utf-8") -> str:
    """Read a text of no more than some bytes; lines end as in Python."""
    text = read_bounded(path, limit).decode(encoding)
    return text.replace("\r\n", "\n").replace("\r", "\n")
