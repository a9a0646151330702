"""Progress of a long run: its stages and how much of a stage is done, for a listener.

Without a listener, as in the Python interface, nothing is reported. The command line listens.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

#: Takes the stage, how many of its parts are done (``None`` where that is as before), how many
#: there are (0 if it has none), and what is in work.
Listener = Callable[[str, int | None, int, str], None]

_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Report the stages inside the block to a listener."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def tell(stage: str, count: int | None = 0, total: int = 0, current: str = "") -> None:
    """Report the current stage. A stage ends when another begins."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage, count, total, current)


def each(stage: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield items, and report how many are done."""
    tell(stage, 0, len(items))
    for count, item in enumerate(items, start=1):
        yield item
        tell(stage, count, len(items))
