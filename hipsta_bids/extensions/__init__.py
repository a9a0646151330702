"""Features beyond the published analysis. Each is a folder that can be deleted."""

from functools import cache
from importlib import import_module
from importlib.util import find_spec

from hipsta_bids.joints import Extension, Part

#: Folders, in the order of the help.
NAMES = ("consortia",)


@cache
def find_extensions() -> tuple[Extension, ...]:
    """Find the extensions whose folders exist."""
    specs = {name: find_spec(f"{__name__}.{name}") for name in NAMES}
    # A folder without its files has no origin.
    present = [name for name, spec in specs.items() if spec is not None and spec.origin]
    return tuple(import_module(f"{__name__}.{name}").EXTENSION for name in present)


def find_parts() -> tuple[Part, ...]:
    """Find what extensions add to the results of a comparison."""
    return tuple(part for extension in find_extensions() for part in extension.parts)
