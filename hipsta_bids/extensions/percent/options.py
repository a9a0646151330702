"""Option of percent differences."""

from hipsta_bids.cli.parser import Parser, adder


def add_option(parser: Parser) -> None:
    """Add the option."""
    adder(parser.add_argument_group("effects in percent"))(
        "--percent", "", "also write differences of groups in percent of the reference's mean"
    )
