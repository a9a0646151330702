"""Options of joint tests."""

import argparse
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder, given_settings

if TYPE_CHECKING:
    from hipsta_bids.group.settings import GroupSettings


def add_options(parser: Parser) -> None:
    """Add the options of joint tests."""
    add = adder(parser.add_argument_group("several measures together"))
    add(
        "--joint",
        "MEASURE...",
        "also test these maps together at each point, as thickness curvature, by permutation"
        " (non-parametric combination, family-wise error)",
    )
    add("--joint-sides", "", "with --joint: left and right together, too")


def with_settings(parsed: argparse.Namespace, settings: "GroupSettings") -> "GroupSettings":
    """Put measures and sides into the settings."""
    choices = {"measures": tuple(parsed.joint) or None, "sides": parsed.joint_sides or None}
    return settings.changed(**given_settings({"joint": choices}))
