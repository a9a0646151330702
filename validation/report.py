"""Validation suites: their tables with targets, their figures, and the files of both."""

import json
import os
import platform
import subprocess
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import wraps
from importlib import import_module, resources
from importlib.metadata import version
from inspect import signature
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec

from hipsta_bids import __version__
from hipsta_bids.errors import UsageError, did_you_mean
from hipsta_bids.io import files
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.types import Float
from validation.sources import changed, code_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TABLE = tomllib.loads((resources.files("validation") / "suites.toml").read_text("utf-8"))
#: Suites in the order of the report: name, and the function that runs it.
SUITES: Mapping[str, str] = {name: row["run"] for name, row in _TABLE.items()}
#: Suites that measure real segmentations too, where there are any.
WITH_LABELS = frozenset(name for name, row in _TABLE.items() if row.get("labels"))
#: What each suite asks, as the sentence that would hold if all its targets were met.
QUESTIONS: Mapping[str, str] = {name: row["question"] for name, row in _TABLE.items()}

#: Benchmarks whose records lie beside those of suites: the modules that decide their numbers.
BENCHMARKS: Mapping[str, tuple[str, ...]] = {
    "beside-hipsta": ("benchmarks.hipsta", "hipsta_bids.participant.run"),
    "cost": ("benchmarks.cohort", "hipsta_bids.participant.run"),
}

#: How a target that was met, or missed, is written.
MET, MISSED = "met", "missed"

_DPI = 100
_LIBRARIES = ("numpy", "scipy", "scikit-image", "lapy", "tetgen")

#: A float is shown with the table's number of digits, a bool as met or missed, None as n/a.
Cell = str | int | float | bool | None

#: Cells by heading, with units; a target and whether it was met have headings of their own.
Cells = Mapping[str, Cell]


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the report."""

    name: str = ""
    """As in ``suites.toml``; part of the file's name."""
    title: str
    rows: Sequence[Cells]
    """The longest one has all headings, in order; the others may lack cells."""
    notes: str = ""
    """Markdown below the table: what was measured, and how to read it."""
    digits: int = 3
    """Decimals of float cells; for others, format the cell as str."""

    def __post_init__(self) -> None:
        if stray := {heading for row in self.rows for heading in row} - set(self.columns):
            raise ValueError(f"table {self.title!r}: the longest row has no {sorted(stray)}")

    @property
    def columns(self) -> tuple[str, ...]:
        """Headings."""
        longest: Cells = max(self.rows, key=len, default={})
        return tuple(longest)

    @property
    def missed(self) -> int:
        """Number of targets that were missed: cells that are False."""
        return sum(cell is False for row in self.rows for cell in row.values())

    @property
    def targets(self) -> int:
        """Number of targets: cells that are True or False."""
        return sum(isinstance(cell, bool) for row in self.rows for cell in row.values())

    def file(self, suite: str) -> str:
        """Name the file of this table of a suite."""
        return f"{suite}--{self.name}.tsv"


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One figure of the report, drawn when it is written, so that suites need no plotting."""

    name: str
    """Of the suite, and of the file."""
    caption: str
    """One sentence or two: what is shown, units; also the text for those who cannot see it."""
    draw: "Callable[[Figure], None]"
    """Draws into an empty figure."""
    size: tuple[float, float] = (9.0, 4.0)
    """Width and height, inches."""

    @property
    def file(self) -> str:
        """Name of the file."""
        return f"{self.name}.png"


@dataclass(frozen=True, kw_only=True)
class Suite:
    """The result of one suite."""

    name: str
    """As in ``SUITES``."""
    title: str
    text: str = ""
    """Markdown above the tables."""
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @property
    def targets(self) -> int:
        """Number of targets of all tables."""
        return sum(table.targets for table in self.tables)

    @property
    def missed(self) -> int:
        """Number of targets that were missed."""
        return sum(table.missed for table in self.tables)


Given = ParamSpec("Given")

Content = Table | Picture | str | Mapping[str, object]
"""What suites are made of: tables, figures, more text, and numbers for the text."""


def table(
    name: str,
) -> Callable[[Callable[Given, Iterable[Cells | str]]], Callable[Given, Table]]:
    """Make a table of the rows that a function yields; texts that it yields follow the notes.

    ``name`` is ``suite.table`` in ``suites.toml``, which has title and notes. What these name in
    braces are constants of the function's module, or its arguments.
    """
    suite_name, _, key = name.partition(".")
    texts = _TABLE[suite_name]["tables"][key]

    def decorate(rows: Callable[Given, Iterable[Cells | str]]) -> Callable[Given, Table]:
        @wraps(rows)
        def make(*args: Given.args, **kwargs: Given.kwargs) -> Table:
            values = rows.__globals__ | signature(rows).bind(*args, **kwargs).arguments
            found = list(rows(*args, **kwargs))
            return Table(
                name=key,
                title=texts["title"].format_map(values),
                rows=[row for row in found if not isinstance(row, str)],
                notes=texts.get("notes", "").format_map(values)
                + "".join(text for text in found if isinstance(text, str)),
                digits=texts.get("digits", 3),
            )

        return make

    return decorate


def suite(name: str) -> Callable[[Callable[Given, Iterable[Content]]], Callable[Given, Suite]]:
    """Make a suite of the tables, figures, texts and numbers that a function yields.

    Title and text are those of ``suites.toml``; texts that are yielded follow. What the text names
    in braces are constants of the function's module, or numbers that are yielded.
    """
    texts = _TABLE[name]

    def decorate(run: Callable[Given, Iterable[Content]]) -> Callable[Given, Suite]:
        @wraps(run)
        def make(*args: Given.args, **kwargs: Given.kwargs) -> Suite:
            found, values = list(run(*args, **kwargs)), dict(run.__globals__)
            for numbers in found:
                if isinstance(numbers, Mapping):
                    values |= numbers
            return Suite(
                name=name,
                title=texts["title"],
                text=texts["text"].format_map(values)
                + "".join(text for text in found if isinstance(text, str)),
                tables=tuple(one for one in found if isinstance(one, Table)),
                pictures=tuple(one for one in found if isinstance(one, Picture)),
            )

        return make

    return decorate


def picture(
    name: str,
) -> Callable[[Callable[Concatenate["Figure", Given], None]], Callable[Given, Picture]]:
    """Make a figure of a function that draws into an empty one, with the texts of its suite."""
    texts = _TABLE[name]["picture"]

    def decorate(
        draw: Callable[Concatenate["Figure", Given], None],
    ) -> Callable[Given, Picture]:
        def make(*args: Given.args, **kwargs: Given.kwargs) -> Picture:
            width, height = texts["size"]
            return Picture(
                name=name,
                caption=texts["caption"],
                draw=lambda figure: draw(figure, *args, **kwargs),
                size=(width, height),
            )

        return make

    return decorate


def run_suite(name: str, *, full: bool, labels: Path | None = None) -> Suite:
    """Run one suite."""
    module, function = SUITES[name].split(":")
    run: Callable[..., Suite] = getattr(import_module(f"validation.{module}"), function)
    return run(full, labels) if name in WITH_LABELS else run(full)


def modules_of(name: str) -> tuple[str, ...]:
    """Return the modules whose code, with all that they import, decides the numbers of a record."""
    return BENCHMARKS.get(name) or (f"validation.{SUITES[name].partition(':')[0]}",)


def stale(name: str, record: Mapping[str, Any]) -> list[str]:
    """List the folders whose code changed since a record was written."""
    return changed(record, *modules_of(name))


def describe(name: str, command: str) -> dict[str, object]:
    """Return what a record says of its origin; to be called before anything is measured."""
    return {
        "command": command,
        "version": __version__,
        "commit": commit(),
        "code": code_of(*modules_of(name)),
        "date": datetime.now(UTC).date().isoformat(),
    }


def validate(
    out: Path,
    *,
    full: bool,
    names: Sequence[str] = (),
    labels: Path | None = None,
    again: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Run suites, write the files of each when it is done, and count the targets that were missed.

    Suites whose record is of this code, and of the same command, are skipped unless ``again``.
    """
    unknown = [name for name in names if name not in SUITES]
    if unknown:
        raise UsageError(
            f"validate: suite {unknown[0]!r} is unknown; choose from {', '.join(SUITES)}"
            f"{did_you_mean(unknown, SUITES)}",
            reason="unknown-suite",
        )
    files.check_writable(out)
    missed = 0
    for name in names or SUITES:
        options = [" --full"] * full + [" --labels BIDS_DIR"] * bool(labels and name in WITH_LABELS)
        command = f"python -m validation --suite {name}{''.join(options)}"
        if not again and _is_present(out, name, command):
            report(f"{name}: skipped, its record is of this code")
            continue
        origin, start = describe(name, command), os.times()
        suite = run_suite(name, full=full, labels=labels)
        spent = _spent(start, os.times())
        write(suite, out, {**origin, **spent})
        missed += suite.missed
        report(
            f"{suite.title}: {suite.targets - suite.missed} of {suite.targets} targets met;"
            f" {spent['seconds']:.0f} s, {spent['cpu_seconds']:.0f} s of CPU time"
        )
    return missed


def _is_present(out: Path, name: str, command: str) -> bool:
    path = out / f"{name}.json"
    if not path.is_file():
        return False
    record = json.loads(path.read_text("utf-8"))
    return record.get("command") == command and not stale(name, record)


def _spent(start: os.times_result, end: os.times_result) -> dict[str, float]:
    """Return wall time, and the CPU time of this process and of its children."""
    *cpu, wall = (later - earlier for earlier, later in zip(start, end, strict=True))
    return {"seconds": round(wall, 1), "cpu_seconds": round(sum(cpu), 1)}


def write(suite: Suite, out: Path, origin: Mapping[str, object]) -> None:
    """Write a suite: a table per TSV file, its figures, and their texts as JSON.

    Replaces the files of this suite, and leaves those of others as they are. ``origin`` is what
    ``describe`` returns, with times.
    """
    files.remove(out.glob(f"{suite.name}--*.tsv"))
    for one in suite.tables:
        rows = [[show(row.get(name), one.digits) for name in one.columns] for row in one.rows]
        files.write_tsv(out / one.file(suite.name), one.columns, rows)
    for picture in suite.pictures:
        files.write_bytes(out / picture.file, render(picture))
    libraries = {name: version(name) for name in _LIBRARIES}
    texts = {
        "title": suite.title,
        "question": QUESTIONS.get(suite.name, suite.title),
        "text": suite.text.strip(),
        "tables": [
            {"file": one.file(suite.name), "title": one.title, "notes": one.notes.strip()}
            for one in suite.tables
        ],
        "figures": [{"file": one.file, "caption": one.caption} for one in suite.pictures],
        **origin,
        "libraries": {"python": platform.python_version(), **libraries},
    }
    files.write_json(out / f"{suite.name}.json", texts)


def commit() -> str:
    """Return the commit of this checkout; code that is not committed shows as ``-dirty``."""
    code = [":/hipsta_bids", ":/validation", ":/benchmarks"]
    try:
        name = _git("rev-parse", "--short=8", "HEAD")
        dirty = _git("status", "--porcelain", "--", *code)
    except OSError:
        return files.MISSING
    return f"{name}-dirty" if name and dirty else name or files.MISSING


def _git(*arguments: str) -> str:
    done = subprocess.run(  # noqa: S603  (fixed commands)
        ["git", *arguments],  # noqa: S607
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip()


def markdown(table: Table) -> str:
    """Write one table in Markdown."""
    columns = table.columns
    lines = [
        f"**{table.title}**",
        "",
        _line(columns),
        _line(["---"] * len(columns)),
        *(_line([show(row.get(name), table.digits) for name in columns]) for row in table.rows),
    ]
    return "\n".join([*lines, "", table.notes.strip()] if table.notes else lines)


def _line(cells: Sequence[str]) -> str:
    shown = (f"**{cell}**" if cell == MISSED else cell.replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(shown)} |"


def show(cell: Cell, digits: int) -> str:
    """Format one cell."""
    if cell is None or cell != cell:  # noqa: PLR0124  (NaN)
        return "n/a"
    if isinstance(cell, bool):
        return MET if cell else MISSED
    return f"{cell:.{digits}f}" if isinstance(cell, float) else str(cell)


def render(picture: Picture) -> bytes:
    """Draw a figure as PNG, without anything that changes from run to run."""
    figure = new_figure(picture.size, layout="compressed")
    picture.draw(figure)
    data = BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    return data.getvalue()


def show_map(
    axis: "Axes",
    values: Float,
    title: str,
    *,
    ends: tuple[str, str] = ("posterior", "anterior"),
    **style: Any,  # noqa: ANN401  (what matplotlib takes)
) -> Any:  # noqa: ANN401  (matplotlib's mappables have no common public type)
    """Draw a map of the sheet (Nx, Ny), medial to lateral and ``ends`` of y."""
    image = axis.imshow(values.T, origin="lower", aspect="auto", **style)
    axis.set_title(title)
    axis.set_xticks([0, values.shape[0] - 1], ["medial", "lateral"])
    axis.set_yticks([0, values.shape[1] - 1], list(ends))
    return image
