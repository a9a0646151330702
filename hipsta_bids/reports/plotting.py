"""The drawing library, which is optional, slow to load, and used to having a home."""

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: What else a user has in the environment that would change figures.
_PREFERENCES = ("MPLBACKEND", "MATPLOTLIBRC")


def new_figure(size: tuple[float, float], layout: Literal["constrained", "compressed"]) -> "Figure":
    """Return an empty figure; it needs no screen and no home folder."""
    with contextlib.nullcontext() if "matplotlib" in sys.modules else _own_settings():
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to load)

    return Figure(figsize=size, layout=layout)


@contextlib.contextmanager
def _own_settings() -> Iterator[None]:
    """Let matplotlib load with a folder of its own, which is gone when this process ends.

    It keeps a list of fonts (made in 0.2 s) in the user's home, which may be missing or read-only
    in containers and on clusters, and would read that user's preferences there.
    """
    folder = tempfile.mkdtemp(prefix="hipsta-bids-fonts-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    before = {name: os.environ.pop(name, None) for name in (*_PREFERENCES, "MPLCONFIGDIR")}
    os.environ["MPLCONFIGDIR"] = folder
    try:
        yield
    finally:
        del os.environ["MPLCONFIGDIR"]
        os.environ.update({name: value for name, value in before.items() if value is not None})
