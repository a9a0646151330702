"""Turns between runs into one folder, on one machine or many.

One file holds all locks: each is on a byte of its own. They end with the process that holds them,
however it ends, so none is ever left behind.
"""

import contextlib
import fcntl
import hashlib
from collections.abc import Iterator
from pathlib import Path

from hipsta_bids.bids import files
from hipsta_bids.bids.names import DATASET_FILES

DATASET = "dataset"
"""Name of the lock on the files of the whole dataset."""

_FILE = ".lock"


@contextlib.contextmanager
def locked(root: Path, what: str) -> Iterator[bool]:
    """Let one process at a time work on something; others wait.

    A process may hold one lock at a time: with POSIX's record locks, to let go of one is to let go
    of all that it has on the same file.

    Parameters
    ----------
    root : Path
        The output dataset.
    what : str
        Any name.

    Yields
    ------
    bool
        Whether there is a lock: some network file systems have none, and single runs still work.

    Raises
    ------
    OutputError
        If the file of the locks cannot be made.
    """
    folder = root / DATASET_FILES["logs"]
    files.make_folder(folder)
    path = folder / _FILE
    digest = hashlib.blake2b(what.encode(), digest_size=7).digest()
    try:
        handle = path.open("ab")
    except OSError as error:
        raise files.output_error(path, error) from error
    with handle:
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX, 1, int.from_bytes(digest, "big"))
        except OSError:
            yield False
        else:
            yield True
