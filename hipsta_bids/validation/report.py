"""Validation suites: their tables with targets, their figures, and the page ``validation.md``."""

import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from hipsta_bids import __version__
from hipsta_bids.errors import UsageError
from hipsta_bids.io import files
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.types import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Suites in the order of the report: name, and the function that runs it.
SUITES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "accuracy:run",
        "limits": "accuracy:run_limits",
        "slices": "thick_slices:run",
        "ends": "ends:run",
        "convergence": "accuracy:run_convergence",
        "invariance": "invariance:run",
        "uncertainty": "uncertainty:run",
        "mending": "mending:run",
        "defects": "defects:run",
        "population": "population:run",
        "group": "group:run",
        "trials": "trials:run",
        "surrogate": "surrogate:run",
        "hippunfold": "hippunfold:run",
    }
)

#: Suites that measure real segmentations too, where there are any.
WITH_LABELS = frozenset(
    {
        "defects",
        "ends",
        "hippunfold",
        "invariance",
        "mending",
        "population",
        "slices",
        "surrogate",
    }
)

#: What is written, below the output folder.
PAGE = "validation.md"
IMAGES = "images"

_DPI = 100
_LIBRARIES = ("numpy", "scipy", "scikit-image", "lapy", "tetgen")

#: A float is shown with the table's number of digits, a bool as met or missed, None as n/a.
Cell = str | int | float | bool | None

#: Cells by heading, with units; a target and whether it was met have headings of their own.
Cells = Mapping[str, Cell]


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the report."""

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

    @property
    def file(self) -> str:
        """Name of the file."""
        return f"validation-{self.name}.png"


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


def validate(
    out: Path,
    *,
    full: bool,
    names: Sequence[str] = (),
    labels: Path | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> int:
    """Run suites, write their report, and count the targets that were missed."""
    unknown = [name for name in names if name not in SUITES]
    if unknown:
        raise UsageError(
            f"validate: suite {unknown[0]!r} is unknown; choose from {', '.join(SUITES)}",
            reason="unknown-suite",
        )
    files.check_writable(out)
    suites, missed = [], 0
    for name in names or SUITES:
        suite = run_suite(name, full=full, labels=labels)
        suites.append(suite)
        targets = sum(table.targets for table in suite.tables)
        missing = sum(table.missed for table in suite.tables)
        missed += missing
        report(f"{suite.title}: {targets - missing} of {targets} targets met")
    for suite in suites:
        for picture in suite.pictures:
            files.write_bytes(out / IMAGES / picture.file, render(picture))
    files.write_text(out / PAGE, page(suites, full=full, labels=labels is not None))
    return missed


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
    overview: list[Cells] = [
        {
            "suite": suite.title,
            "table": table.title,
            "targets": table.targets,
            "missed": table.missed,
        }
        for suite in suites
        for table in suite.tables or (Table(title="left out", rows=()),)
    ]
    intro = (
        f"Written by `{command}` of hipsta_bids {__version__} ({libraries}). The same command"
        " with the same versions gives the same numbers."
    )
    parts = [
        f"<!-- Written by `{command}`; do not edit, run it again. -->",
        "# Validation",
        intro,
        markdown(Table(title="Overview", rows=overview)),
        *(_section(suite) for suite in suites),
    ]
    return "\n\n".join(parts) + "\n"


def _section(suite: Suite) -> str:
    parts = [f"## {suite.title}"]
    if suite.text:
        parts.append(suite.text.strip())
    parts += [markdown(table) for table in suite.tables]
    parts += [
        f"![{picture.caption}]({IMAGES}/{picture.file})\n\n*{picture.caption}*"
        for picture in suite.pictures
    ]
    return "\n\n".join(parts)


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
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def show(cell: Cell, digits: int) -> str:
    """Format one cell."""
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
