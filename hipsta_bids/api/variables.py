"""Descriptions of variables and axes, and checks of choices; without xarray, as in images."""

from collections.abc import Mapping
from typing import Any

from hipsta_bids.derivatives.results import STATE
from hipsta_bids.errors import ArgumentError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.cohort.read import node_coordinates
from hipsta_bids.settings import SheetSettings

#: What is no column of the sheet's table: definition and unit.
_EXTRA_VARIABLES = {
    "position": ["position, scanner RAS", "mm"],
    "depth": ["distance from the interior wall along the column", "mm"],
}
_NODES = {
    "x": {"long_name": "medial to lateral", "units": "1"},
    "y": {"long_name": "posterior to anterior", "units": "1"},
}


def attributes(name: str) -> dict[str, str]:
    """Describe a variable: unit, definition and source."""
    for row in MAPS:
        if row.name == name:
            return {"units": row.unit, "long_name": row.definition, "source": row.source}
    return dict(zip(("long_name", "units"), (_EXTRA_VARIABLES | STATE)[name], strict=False))


def node_axes(grid: SheetSettings, region: str) -> dict[str, Any]:
    """Coordinates of the nodes, by the settings of the sheet."""
    axis_values = zip("xy", node_coordinates(grid, region), strict=True)
    return {axis: ([axis], values, _NODES[axis]) for axis, values in axis_values}


def check_choice(name: str, value: object, choices: Mapping[Any, object]) -> None:
    """Refuse a value that is not among the choices."""
    if value not in choices:
        raise ArgumentError(name, f"is {value!r}; choose {' or '.join(map(repr, choices))}")
