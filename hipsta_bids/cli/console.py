"""What a run prints on the terminal."""

import os
import re
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

from hipsta_bids import __version__
from hipsta_bids.progress import listening

if TYPE_CHECKING:
    from hipsta_bids.participant.job import Outcome
    from hipsta_bids.participant.run import RunResult


#: How many warnings of a kind are printed.
_LISTED_ROWS = 3

#: Escape codes by what they mark: statuses, and the beginnings of lines.
_COLORS = {
    "use": "32",
    "look": "33",
    "failed": "1;31",
    "hipsta-bids:": "1;31",
    "warning:": "33",
    "note:": "36",
}
#: What names of files may do to a terminal: move its cursor, or change its title.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_WORD = re.compile(r"^(hipsta-bids:|warning:|note:)|(?<![^\s(])(use|look|failed)(?=[,\s)]|$)")

#: Bars of stages with parts, and of those without.
_PARTS = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"
_WHOLE = "{desc} [{elapsed}]"

_SEARCH = "segmentations"

#: Narrowest that a column of a table is made, and the space between two.
_NARROWEST, _GAP = 16, 2


def has_color(stream: TextIO) -> bool:
    """Check whether a stream shows colors: a terminal, unless the environment forbids them.

    ``NO_COLOR`` and ``FORCE_COLOR`` count if they are not empty, in this order, then ``TERM=dumb``.
    """
    if os.environ.get("NO_COLOR"):
        return False
    return bool(os.environ.get("FORCE_COLOR")) or (
        os.environ.get("TERM") != "dumb" and stream.isatty()
    )


def _print(text: str, stream: TextIO) -> None:
    text = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)
    if stream.isatty():
        text = "\n".join(_wrapped(line) for line in text.splitlines())
    if has_color(stream):
        text = _WORD.sub(lambda word: f"\033[{_COLORS[word[0]]}m{word[0]}\033[0m", text)
    stream.write(f"{text}\n")
    stream.flush()


def _wrapped(line: str) -> str:
    """Break a line at words where it is wider than the terminal; paths stay whole."""
    width = shutil.get_terminal_size().columns
    if len(line) <= width:
        return line
    options: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.fill(line, width, subsequent_indent="    ", **options)


def echo(text: str) -> None:
    """Print a line of results."""
    _print(text, sys.stdout)


def warn(text: str) -> None:
    """Print one line about a problem, to the standard error."""
    _print(" ".join(text.split()), sys.stderr)


def warn_if_lost(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> None:
    """Warn of results that end with a container: in its layers, or in its memory."""
    if "HIPSTA_BIDS_CONTAINER_TYPE" not in os.environ or not mounts.is_file():
        return
    fields = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    kinds = {Path(place.replace(r"\040", " ")): kind for _, place, kind, *_ in fields}
    real = folder.resolve()
    present = next(path for path in (real, *real.parents) if path.exists())
    if not os.access(present, os.W_OK):
        return  # nothing can be written there, as will be said
    place = next((path for path in (real, *real.parents) if path in kinds), Path("/"))
    if place == Path("/") or (place == Path("/tmp") and kinds[place] == "tmpfs"):  # noqa: S108
        warn(f"warning: {folder} is lost with the container; mount a folder, as -v HOST:{folder}")


def echo_start(level: str, bids_dir: Path) -> None:
    """Print at once what runs: finding the inputs can take a while."""
    echo(f"hipsta_bids {__version__}, {level} level of {bids_dir}")


def echo_ignored(options: Sequence[tuple[str, str]]) -> None:
    """Print which options of other BIDS Apps were given, and why they change nothing."""
    for name, reason in dict(options).items():
        echo(f"note: {name} has no effect: {reason}")


@contextmanager
def quiet(enabled: bool) -> Iterator[None]:
    """Print only problems, if that is wanted."""
    if not enabled:
        yield
        return
    with Path(os.devnull).open("w", encoding="utf-8") as sink, redirect_stdout(sink):
        yield


class Progress:
    """One line per hemisphere or stage, and a bar with the time left where there is a terminal."""

    def __init__(self, verbosity: int) -> None:
        self._verbosity = verbosity
        self._has_bar = verbosity >= 0 and sys.stderr.isatty()
        self._stage, self._start = "", 0.0
        self._bar: Any = None
        self._listening = ExitStack()

    def __enter__(self) -> Self:
        self._listening.enter_context(listening(self.show))
        if self._has_bar and threading.current_thread() is threading.main_thread():
            self._listening.enter_context(_every_second(self._tick))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._listening.close()
        self._close(announced=kind is None)

    def show(self, stage: str, count: int | None = 0, total: int = 0, current: str = "") -> None:
        """Show the current stage; a stage ends with a line that has its time."""
        if stage != self._stage:
            self._close(announced=True)
            self._stage, self._start = stage, time.monotonic()
            if self._has_bar:
                self._bar = _bar(stage, total)
        if self._bar is not None:
            self._bar.set_description_str(f"{stage} ({current})" if current else stage)
            self._bar.update(0 if count is None else count - self._bar.n)

    def _tick(self) -> None:
        with suppress(RuntimeError):  # it came while a line was written
            if self._bar is not None:
                self._bar.refresh()

    def report(self, outcome: "Outcome") -> None:
        """Show one outcome."""
        if self._bar is not None:
            self._bar.clear()
        if outcome.decision == "failed":
            warn(summary_line(outcome))
            if outcome.trace and self._verbosity > 0:
                sys.stderr.write(outcome.trace)
        elif not outcome.skipped or self._verbosity > 0:
            echo(summary_line(outcome))
        if self._bar is not None:
            self._bar.update()

    def _close(self, *, announced: bool) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        if announced and self._stage not in {"", _SEARCH, "hemispheres"}:  # these have a line each
            echo(f"  {self._stage:<18}{time.monotonic() - self._start:6.1f} s")


@contextmanager
def searching(*, has_bar: bool) -> Iterator[None]:
    """Show that segmentations are sought; the results have separate lines."""
    with Progress(0 if has_bar else -1) as progress:
        progress.show(_SEARCH)
        yield


@contextmanager
def _every_second(tick: Callable[[], None]) -> Iterator[None]:
    """Call a function every second of the block, without a thread, which would forbid forking."""
    before = signal.signal(signal.SIGALRM, lambda *_: tick())
    signal.setitimer(signal.ITIMER_REAL, 1.0, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _bar(stage: str, total: int) -> Any:  # noqa: ANN401  (tqdm's)
    from tqdm import tqdm  # noqa: PLC0415  (not needed elsewhere)

    tqdm.monitor_interval = 0  # its thread would keep workers from being forked
    style = _PARTS if total else _WHOLE
    return tqdm(total=total or None, desc=stage, file=sys.stderr, leave=False, bar_format=style)


def summary_line(outcome: "Outcome") -> str:
    """Summarize one hemisphere: name, status, mean thickness, time, and remarks."""
    name = outcome.job.result.name
    parts = [name.title, str(outcome.decision)]
    if outcome.thickness is not None:
        parts.append(f"mean thickness {outcome.thickness:.3f} mm (by area)")
    if outcome.seconds is not None:
        parts.append(f"{outcome.seconds:.1f} s")
    if outcome.job.item.edited:
        parts.append(f"edited {' and '.join(outcome.job.item.edited)}")
    if outcome.skipped:
        parts.append("unchanged, skipped")
    parts += outcome.notes
    if outcome.repairs:
        parts.append(f"{outcome.repairs} repair{'s' if outcome.repairs > 1 else ''}")
    if outcome.reason:
        parts.append(f"[{outcome.reason}] {outcome.headline}")
    return "  ".join(parts)


def echo_result(result: "RunResult", out_dir: Path, *, has_pages: bool) -> None:
    """Print the folder of the outputs, and the number of hemispheres by decision."""
    counts = ", ".join(f"{n} {decision}" for decision, n in sorted(result.counts.items()))
    missing = result.n_requested - len(result.outcomes)
    counts += f", {missing} not run" if missing else ""
    skipped = sum(outcome.skipped for outcome in result.outcomes)
    unchanged = f" ({skipped} unchanged, skipped)" if skipped else ""
    echo(f"{result.n_requested} hemispheres: {counts}{unchanged}")
    echo(f"maps: {out_dir}")
    echo(f"table of all hemispheres: {out_dir / 'measures.tsv'}")
    page = out_dir / "report.html"
    if has_pages and page.exists():
        echo(f"report: {page}")
    for copy in result.copies[:_LISTED_ROWS]:
        warn(f"warning: {copy}")
    if len(result.copies) > _LISTED_ROWS:
        warn(f"warning: {len(result.copies) - _LISTED_ROWS} more groups of copies, see status.tsv")
    for problem in result.page_problems:
        warn(f"warning: report: {problem}")
    echo(f"log: {result.log}")


def echo_table(rows: Sequence[Mapping[str, str]]) -> None:
    """Print rows as aligned columns; omit empty columns, and tables without rows.

    On a terminal wide columns are wrapped and long words, as paths, lose their middle, so that a
    row fits; where that takes narrow columns, each cell has a line. Elsewhere all is there.
    """
    if not rows:
        return
    columns = [c for c in rows[0] if any(row[c] for row in rows)]
    widths = {c: max(len(c), *(len(row[c]) for row in rows)) for c in columns}
    room = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
    while sum(widths.values()) + _GAP * (len(columns) - 1) > room:
        widest = max(columns, key=lambda c: widths[c])
        widths[widest] -= 1
        if widths[widest] < _NARROWEST:
            _echo_records(rows, columns, room)
            return
    for row in [{c: c for c in columns}, *rows]:
        cells = [_fitted(row[c], widths[c]) for c in columns]
        for line in zip_longest(*cells, fillvalue=""):
            texts = (text.ljust(widths[c]) for c, text in zip(columns, line, strict=True))
            echo((" " * _GAP).join(texts).rstrip())


def _echo_records(rows: Sequence[Mapping[str, str]], columns: Sequence[str], room: int) -> None:
    """Print each row as separate lines, one per cell that has something."""
    indent = " " * (2 * _GAP)
    for row in rows:
        head, *cells = (f"{c}: {row[c]}" for c in columns if row[c])
        for i, cell in enumerate((head, *cells)):
            first, *continuation = _fitted(cell, max(room - len(indent), _NARROWEST))
            for line in (
                f"{indent[:_GAP] if i else ''}{first}",
                *(indent + text for text in continuation),
            ):
                echo(line)


def _fitted(text: str, width: int) -> list[str]:
    """Break a text into lines of a width; longer words lose their middle."""
    if len(text) <= width:
        return [text]
    end = (width - 3) // 2
    words = [
        word if len(word) <= width else f"{word[: width - 3 - end]}...{word[-end:]}"
        for word in text.split()
    ]
    return textwrap.wrap(" ".join(words), width, break_on_hyphens=False)
