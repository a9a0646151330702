"""Option of regions, and what it reads."""

import argparse
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder
from hipsta_bids.extensions.parcels import SUBFIELDS, THIRDS

if TYPE_CHECKING:
    from hipsta_bids.group.cohort.sources import Source


def add_options(parser: Parser) -> None:
    """Add the option of regions."""
    adder(parser.add_argument_group("regions of the sheet"))(
        "--regions",
        "REGIONS",
        "also test means of --measures (default: thickness) over regions: a file as for --roi"
        f" (x, y, region), {SUBFIELDS}, or {THIRDS} (their thirds along the long axis)",
    )


def make_sources(parsed: argparse.Namespace) -> "tuple[Source, ...]":
    """Return the regions that the option names."""
    from hipsta_bids.extensions.parcels.means import Regions  # noqa: PLC0415  (heavy)
    from hipsta_bids.stats.formula import left_side  # noqa: PLC0415  (heavy)

    measures = tuple(parsed.measures) or left_side(parsed.formula or "")
    return (Regions(choice=parsed.regions, measures=measures),) if parsed.regions else ()
