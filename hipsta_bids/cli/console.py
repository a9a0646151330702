"""What a run prints on the terminal."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hipsta_bids import __version__

if TYPE_CHECKING:
    from hipsta_bids.participant.job import Outcome
    from hipsta_bids.participant.run import RunResult


#: How many warnings of a kind are printed.
_SHOWN = 3


def echo(text: str) -> None:
    """Print a line of results."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def warn(text: str) -> None:
    """Print one line about what went wrong, to the standard error."""
    sys.stderr.write(" ".join(text.split()) + "\n")
    sys.stderr.flush()


def echo_start(level: str, bids_dir: Path) -> None:
    """Print at once what runs: finding the inputs can take a while."""
    echo(f"hipsta_bids {__version__}, {level} level of {bids_dir}")


class Progress:
    """One line per hemisphere, and a bar below them where there is a terminal."""

    def __init__(self, total: int, verbosity: int) -> None:
        self._verbosity = verbosity
        self._bar: Any = None
        if verbosity >= 0 and sys.stderr.isatty():
            from tqdm import tqdm  # noqa: PLC0415  (not needed elsewhere)

            tqdm.monitor_interval = 0  # its thread would keep workers from being forked
            self._bar = tqdm(total=total, unit="hemisphere", file=sys.stderr, leave=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def report(self, outcome: "Outcome") -> None:
        """Show one outcome."""
        if self._bar is not None:
            self._bar.clear()
        if outcome.status == "failed":
            warn(summary_line(outcome))
            if outcome.trace and self._verbosity > 0:
                sys.stderr.write(outcome.trace)
        elif not outcome.skipped or self._verbosity > 0:
            echo(summary_line(outcome))
        if self._bar is not None:
            self._bar.update()


def summary_line(outcome: "Outcome") -> str:
    """Summarize one hemisphere: name, status, mean thickness, time, and remarks."""
    name = outcome.job.place.name
    parts = [f"{name.stem}_{name.protocol}", str(outcome.status)]
    if outcome.thickness is not None:
        parts.append(f"mean thickness {outcome.thickness:.3f} mm (by area)")
    if outcome.seconds is not None:
        parts.append(f"{outcome.seconds:.1f} s")
    if outcome.job.item.edited:
        parts.append(f"edited {' and '.join(outcome.job.item.edited)}")
    if outcome.skipped:
        parts.append("unchanged, skipped")
    if outcome.status == "repaired" and outcome.message:
        parts.append(f"{outcome.message.count('; ') + 1} repairs, see its quality metrics")
    elif outcome.reason:
        parts.append(f"[{outcome.reason}] {outcome.message}")
    return "  ".join(parts)


def echo_result(result: "RunResult", out_dir: Path) -> None:
    """Print where the outputs are and how many hemispheres ended with which status."""
    counts = ", ".join(f"{n} {status}" for status, n in sorted(result.counts.items()))
    missing = result.n_requested - len(result.outcomes)
    counts += f", {missing} not run" if missing else ""
    skipped = sum(outcome.skipped for outcome in result.outcomes)
    unchanged = f" ({skipped} unchanged, skipped)" if skipped else ""
    echo(f"{result.n_requested} hemispheres: {counts}{unchanged}")
    echo(f"maps: {out_dir}")
    echo(f"table of all hemispheres: {out_dir / 'status.tsv'}")
    page = out_dir / "report.html"
    if page.exists():
        echo(f"report: {page}")
    for copy in result.copies[:_SHOWN]:
        warn(f"warning: {copy}")
    if len(result.copies) > _SHOWN:
        warn(f"warning: {len(result.copies) - _SHOWN} more such groups, see status.tsv")
    for problem in result.page_problems:
        warn(f"warning: report: {problem}")
    echo(f"log: {result.log}")


def echo_table(rows: Sequence[Mapping[str, str]]) -> None:
    """Print rows as aligned columns; empty columns are left out, and tables without rows."""
    if not rows:
        return
    columns = [c for c in rows[0] if any(row[c] for row in rows)]
    widths = {c: max(len(c), *(len(row[c]) for row in rows)) for c in columns}
    for row in [{c: c for c in columns}, *rows]:
        echo("  ".join(row[c].ljust(widths[c]) for c in columns).rstrip())
