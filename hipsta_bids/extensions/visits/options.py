"""The option of common sheets."""

import argparse

from hipsta_bids.cli.parser import adder

OPTION = "--longitudinal"
#: Values of the setting ``sheet.frame`` by those of the option.
FRAMES = {"auto": "person", "shared": "shared"}


def add_options(group: argparse._ArgumentGroup) -> None:
    """Add the option."""
    text = (
        "measure all visits of a participant on one sheet, of their mean labels (shared: they"
        " share a space)"
    )
    adder(group)(OPTION, "", text, nargs="?", const="auto", choices=list(FRAMES))
