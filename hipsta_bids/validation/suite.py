"""What a validation suite hands over: tables with targets, and figures.

A suite is a module of this package with ``run(full: bool) -> Suite``, named in :data:`SUITES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A float is shown with the table's number of digits, a bool as met or missed, None as n/a.
Cell = str | int | float | bool | None

#: Suites in the order of the report: name, and the module whose ``run`` makes it.
SUITES: Mapping[str, str] = MappingProxyType(
    {
        "accuracy": "hipsta_bids.validation.accuracy",
        "limits": "hipsta_bids.validation.limits",
        "slices": "hipsta_bids.validation.slices",
        "convergence": "hipsta_bids.validation.convergence",
        "invariance": "hipsta_bids.validation.invariance",
        "defects": "hipsta_bids.validation.defects",
        "group": "hipsta_bids.validation.group",
        "surrogate": "hipsta_bids.validation.surrogate",
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
    """Run one suite.

    Parameters
    ----------
    name : str
        One of ``SUITES``.
    full : bool
        All cases instead of a quick selection.
    labels : Path, optional
        A BIDS dataset with real segmentations, for the suites that can use them.

    Returns
    -------
    Suite
    """
    module: Any = import_module(SUITES[name])
    suite: Suite = module.run(full, labels) if name in WITH_LABELS else module.run(full)
    return suite
