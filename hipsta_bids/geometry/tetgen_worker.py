"""TetGen in a separate process.

TetGen aborts the whole process on some self-intersecting surfaces, sometimes without an exception.
This module is run as a program that meshes one surface after the other, and holds the client that
starts it, waits, and starts it again after a crash. Messages are pickles with their length in
front, over the standard streams. The file stands alone, with its types, because the program
must start fast and hold little memory: it loads nothing but NumPy and TetGen.
"""

import atexit
import contextlib
import os
import pickle
import platform
import select
import struct
import subprocess
import sys
import tempfile
import time
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int32]

_HEADER = struct.Struct("<Q")
_STARTS = 2
"""A process that ends twice with one surface ends because of it. Once it may have been killed, or
have lost the folder that it runs in; then another surface would be another map."""


class TetgenClient:
    """Sends surfaces to a worker process; one client per process of the caller."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0

    def mesh(
        self, vertices: Float, triangles: Int, options: dict[str, Any], timeout: float
    ) -> tuple[Float, NDArray[Any]] | str:
        """Return vertices (V, 3) and tetrahedra (T, 4) that fill a surface, or why none do."""
        code = None
        for _ in range(_STARTS):
            process = self._running()
            try:
                _write(_pipe(process.stdin), (vertices, triangles, options))
                reply = _read(_pipe(process.stdout), deadline=time.monotonic() + timeout)
            except (BrokenPipeError, EOFError):
                code = self._stop()
                continue
            except TimeoutError:
                self._stop()
                return f"TetGen took longer than {timeout:g} s"
            return reply if isinstance(reply, str) else (reply[0], reply[1])
        return f"TetGen crashed (exit status {code})"

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            self._stop()
            environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
            # A process that is isolated from the user's Python settings starts an isolated one.
            isolated = ["-I"] if sys.flags.isolated else []
            self._process = subprocess.Popen(  # noqa: S603 -- our module
                [sys.executable, *isolated, "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
            self._owner = os.getpid()
            atexit.register(self._stop)
        return self._process

    def _stop(self) -> int | None:
        process, self._process = self._process, None
        atexit.unregister(self._stop)
        if process is None or self._owner != os.getpid():
            return None
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()
        process.kill()
        return process.wait()


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    if stream is None:
        raise EOFError
    return stream


def _write(stream: IO[bytes], message: object) -> None:
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    stream.write(_HEADER.pack(len(data)))
    stream.write(data)
    stream.flush()


def _read(stream: IO[bytes], deadline: float | None = None) -> Any:  # noqa: ANN401 -- any message
    (size,) = _HEADER.unpack(_exactly(stream, _HEADER.size, deadline))
    return pickle.loads(_exactly(stream, size, deadline))  # noqa: S301 -- our child or parent


def _exactly(stream: IO[bytes], size: int, deadline: float | None) -> bytes:
    """Read ``size`` bytes past any buffer, or raise EOFError or TimeoutError."""
    parts = bytearray()
    while len(parts) < size:
        if deadline is not None:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([stream], [], [], left)[0]:
                raise TimeoutError
        part = os.read(stream.fileno(), min(size - len(parts), 1 << 20))
        if not part:
            raise EOFError
        parts += part
    return bytes(parts)


def _serve() -> None:
    """Answer requests until the caller ends."""
    # TetGen prints: keep that apart from the messages.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    while True:
        try:
            request = _read(sys.stdin.buffer)
        except EOFError:
            return
        try:
            _write(answers, _mesh(*request))
        except (RuntimeError, ValueError, TypeError) as error:
            _write(answers, f"TetGen failed: {error}")


def _mesh(vertices: Float, triangles: Int, options: dict[str, Any]) -> tuple[Float, NDArray[Any]]:
    from tetgen import TetGen  # noqa: PLC0415 -- only the worker process needs it

    # TetGen writes the triangles that it could not use into the working folder. The folder is named
    # as those of `io.files.scratch_folder`, so that it goes if this process is killed.
    name = f"hipsta-bids-{platform.node()}-{os.getpid()}-tetgen-"
    with (
        tempfile.TemporaryDirectory(prefix=name, ignore_cleanup_errors=True) as folder,
        contextlib.chdir(folder),
    ):
        points, cells, *_ = TetGen(vertices, triangles).tetrahedralize(**options)
    return np.asarray(points), np.asarray(cells)


if __name__ == "__main__":
    _serve()
