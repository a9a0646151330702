"""The option ``--uncertainty``."""

import argparse

from hipsta_bids.cli.parser import adder


def add_options(group: argparse._ArgumentGroup) -> None:
    """Add the number of copies."""
    text = (
        "measure K perturbed copies of the labels, for the SD of measures (default: 0; 8 take 7"
        " times as long)"
    )
    adder(group)("--uncertainty", "K", text, type=_copies, default=0)


def cost_of(copies: int) -> int:
    """Return how many times as long a hemisphere takes, at most."""
    return 1 + copies


def _copies(text: str) -> int:
    """Read a number of copies: an SD takes two."""
    if not text.isascii() or not text.isdigit() or int(text) == 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of copies; use 0, or 2 or more")
    return int(text)
