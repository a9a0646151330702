"""``python -m validation``: run the suites and write their tables; from a checkout."""

import sys
from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli.console import echo, warn
from hipsta_bids.cli.parser import Parser, adder
from hipsta_bids.errors import HipstaError
from validation.report import validate


def build_parser() -> Parser:
    """Describe the command."""
    parser = Parser(
        prog="python -m validation",
        description="measure phantoms with known truth; write tables; resume",
        epilog="the exit code is 0 whether or not targets are met: the tables show which are",
    )
    add = adder(parser)
    add("--full", "", "all cases, minutes instead of a quick selection")
    add(
        "--out",
        "DIR",
        "folder for the files of these suites; others stay (default: build/validation)",
        default=Path("build/validation"),
    )
    add("--suite", "NAME", "only these suites", nargs="+", default=[])
    add(
        "--group",
        "",
        "only the group level: simulated cohorts",
        action="append_const",
        dest="suite",
        const="group",
    )
    add(
        "--labels",
        "BIDS_DIR",
        "a dataset with segmentations, to be measured as well, as is a folder hippunfold beside it",
        type=Path,
    )
    add("--again", "", "repeat suites whose record in DIR is of this code and this command")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the suites, and return the exit code."""
    options = build_parser().parse_args(arguments)
    try:
        missed = validate(
            options.out,
            full=options.full,
            names=options.suite,
            labels=options.labels,
            again=options.again,
            report=echo,
        )
    except HipstaError as error:
        warn(f"{error}")
        return error.exit_code
    echo(f"targets missed: {missed}; report: {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
