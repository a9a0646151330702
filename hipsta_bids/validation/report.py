"""From suites to the page ``validation.md`` and its figures."""

import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from hipsta_bids import __version__
from hipsta_bids.errors import UsageError
from hipsta_bids.io import files
from hipsta_bids.reports.plotting import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# What a validation suite hands over: tables with targets, and figures.


#: A float is shown with the table's number of digits, a bool as met or missed, None as n/a.
Cell = str | int | float | bool | None

#: Suites in the order of the report: name, and the function that runs it.
SUITES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "accuracy:run",
        "limits": "convergence:run_limits",
        "slices": "invariance:run_slices",
        "convergence": "convergence:run",
        "invariance": "invariance:run",
        "defects": "defects:run",
        "group": "group:run",
        "surrogate": "slice_thickness:run",
    }
)


#: Suites that measure real segmentations too, where there are any.
WITH_LABELS = frozenset({"defects", "slices", "surrogate"})


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the report."""

    title: str
    columns: tuple[str, ...]
    """Headings, with units; a target and whether it was met have columns of their own."""
    rows: tuple[tuple[Cell, ...], ...]
    notes: str = ""
    """Markdown below the table: what was measured, and how to read it."""
    digits: int = 3
    """Decimals of float cells; for others, format the cell as str."""

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"table {self.title!r}: a row has not {len(self.columns)} cells")

    @property
    def missed(self) -> int:
        """Number of targets that were missed: cells that are False."""
        return sum(cell is False for row in self.rows for cell in row)

    @property
    def targets(self) -> int:
        """Number of targets: cells that are True or False."""
        return sum(isinstance(cell, bool) for row in self.rows for cell in row)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One figure of the report, drawn when it is written, so that suites need no plotting."""

    name: str
    """Of the file: ``validation-<name>.png``."""
    caption: str
    """One sentence or two: what is shown, units; also the text for those who cannot see it."""
    draw: "Callable[[Figure], None]"
    """Draws into an empty figure."""
    size: tuple[float, float] = (9.0, 4.0)
    """Width and height, inches."""


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


def run_suite(name: str, *, full: bool, labels: Path | None = None) -> Suite:
    """Run one suite."""
    module, function = SUITES[name].split(":")
    run: Callable[..., Suite] = getattr(import_module(f"hipsta_bids.validation.{module}"), function)
    return run(full, labels) if name in WITH_LABELS else run(full)


#: What is written, below the output folder.
PAGE = "validation.md"
IMAGES = "images"

_DPI = 100
_LIBRARIES = ("numpy", "scipy", "scikit-image", "lapy", "tetgen")


def validate(
    out: Path,
    *,
    full: bool,
    names: Sequence[str] = (),
    labels: Path | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Run suites and write their report."""
    unknown = [name for name in names if name not in SUITES]
    if unknown:
        raise UsageError(
            f"validate: suite {unknown[0]!r} is unknown; choose from {', '.join(SUITES)}",
            reason="unknown-suite",
        )
    files.check_writable(out)
    suites = []
    for name in names or SUITES:
        suite = run_suite(name, full=full, labels=labels)
        suites.append(suite)
        report(f"{suite.title}: {_score(suite)}")
    for suite in suites:
        for picture in suite.pictures:
            files.write_bytes(out / IMAGES / file_name(picture), render(picture))
    files.write_text(out / PAGE, page(suites, full=full, labels=labels is not None))
    return sum(table.missed for suite in suites for table in suite.tables)


def page(suites: Sequence[Suite], *, full: bool, labels: bool = False) -> str:
    """Write the page in Markdown."""
    names = [suite.name for suite in suites]
    some = "" if names == list(SUITES) else " --suite " + " ".join(names)
    command = (
        "hipsta-bids validate"
        + (" --full" if full else "")
        + some
        + (" --labels BIDS_DIR" if labels else "")
    )
    python = f"Python {platform.python_version()}"
    libraries = ", ".join([python, *(f"{name} {version(name)}" for name in _LIBRARIES)])
    intro = (
        f"Written by `{command}` of hipsta_bids {__version__} ({libraries}). The same command"
        " with the same versions gives the same numbers."
    )
    parts = [
        f"<!-- Written by `{command}`; do not edit, run it again. -->",
        "# Validation",
        intro,
        markdown(_overview(suites)),
        *(_section(suite) for suite in suites),
    ]
    return "\n\n".join(parts) + "\n"


def markdown(table: Table) -> str:
    """Write one table in Markdown."""
    lines = [
        f"**{table.title}**",
        "",
        _line(table.columns),
        _line(["---"] * len(table.columns)),
        *(_line([show(cell, table.digits) for cell in row]) for row in table.rows),
    ]
    return "\n".join([*lines, "", table.notes.strip()] if table.notes else lines)


def show(cell: Cell, digits: int) -> str:
    """Spell one cell."""
    if cell is None or cell != cell:  # noqa: PLR0124  (NaN)
        return "n/a"
    if isinstance(cell, bool):
        return "yes" if cell else "**no**"
    return f"{cell:.{digits}f}" if isinstance(cell, float) else str(cell)


def render(picture: Picture) -> bytes:
    """Draw a figure as PNG, without anything that changes from run to run."""
    figure = new_figure(picture.size, layout="compressed")
    picture.draw(figure)
    data = BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    return data.getvalue()


def file_name(picture: Picture) -> str:
    """Name the file of a figure."""
    return f"validation-{picture.name}.png"


def _overview(suites: Sequence[Suite]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (suite.title, table.title, table.targets, table.missed)
        for suite in suites
        for table in suite.tables
    ]
    return Table(
        title="Overview", columns=("suite", "table", "targets", "missed"), rows=tuple(rows)
    )


def _score(suite: Suite) -> str:
    targets = sum(table.targets for table in suite.tables)
    missed = sum(table.missed for table in suite.tables)
    return f"{targets - missed} of {targets} targets met"


def _section(suite: Suite) -> str:
    parts = [f"## {suite.title}"]
    if suite.text:
        parts.append(suite.text.strip())
    parts += [markdown(table) for table in suite.tables]
    parts += [
        f"![{picture.caption}]({IMAGES}/{file_name(picture)})\n\n*{picture.caption}*"
        for picture in suite.pictures
    ]
    return "\n\n".join(parts)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
