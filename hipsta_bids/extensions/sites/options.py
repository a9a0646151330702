"""Options of harmonization."""

import argparse
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder

if TYPE_CHECKING:
    from hipsta_bids.group.settings import GroupSettings

#: Columns for which what is harmonized stands in the default model.
_SITES = frozenset({"site", "scanner", "center"})


def add_options(parser: Parser) -> None:
    """Add the options of harmonization."""
    add = adder(parser.add_argument_group("sites and scanners"))
    add(
        "--harmonize",
        "COLUMN",
        "remove shifts and scales of sites or scanners (ComBat); effects of the model are "
        "kept, sites are added to it",
    )
    add(
        "--harmonize-model",
        "FILE",
        "harmonize by the harmonization.json of another analysis, its sites or new ones; "
        "with its --template",
    )


def with_settings(parsed: argparse.Namespace, settings: "GroupSettings") -> "GroupSettings":
    """Put the column into the settings, and into the default model instead of similar ones."""
    if not parsed.harmonize:
        return settings
    names = [name for name in settings.model.covariates if name.casefold() not in _SITES]
    return settings.changed(
        harmonization={"column": parsed.harmonize},
        model={"covariates": (*names, parsed.harmonize)},
    )
