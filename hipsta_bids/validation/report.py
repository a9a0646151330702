"""From suites to the page ``validation.md`` and its figures."""

import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

from hipsta_bids import __version__
from hipsta_bids.bids import files
from hipsta_bids.drawing import new_figure
from hipsta_bids.errors import UsageError
from hipsta_bids.validation.suite import SUITES, Cell, Picture, Suite, Table, run_suite

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
    """Run suites and write their report.

    Parameters
    ----------
    out : Path
        Folder for ``validation.md`` and ``images/validation-*.png``; made if need be.
    full : bool
        All cases instead of a quick selection.
    names : sequence of str
        Suites to run; all if empty.
    labels : Path, optional
        A BIDS dataset with real segmentations, for the suites that can use them.
    report : callable
        Receives one line per suite as it ends.

    Returns
    -------
    int
        Number of targets that were missed.

    Raises
    ------
    UsageError
        If a suite is unknown.
    OutputError
        If a file cannot be written.
    """
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
