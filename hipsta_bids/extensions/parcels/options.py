"""Option of regions."""

from hipsta_bids.cli.parser import Parser, adder
from hipsta_bids.extensions.parcels import SUBFIELDS, THIRDS


def add_options(parser: Parser) -> None:
    """Add the option of regions."""
    adder(parser.add_argument_group("regions of the sheet"))(
        "--regions",
        "REGIONS",
        f"test means of thickness (or --measures) over {SUBFIELDS}, {THIRDS} (thirds of these),"
        " or regions of a file, as of --roi",
        type=str,
    )
