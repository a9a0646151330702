"""The commands that compare finished analyses and maps."""

from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli.console import echo, echo_table
from hipsta_bids.cli.parser import Parser, parser_of, positive_int, site_path
from hipsta_bids.errors import ExitCode

_PACKAGE = "hipsta_bids.extensions.agreement"


def compare_parser() -> Parser:
    """Describe ``hipsta-bids compare``."""
    parser, add = parser_of("compare", _PACKAGE)
    add("analyses", "FOLDER", nargs="+")
    add("out", "OUT", type=Path)
    add("--figures")
    return parser


def replicate_parser() -> Parser:
    """Describe ``hipsta-bids replicate``."""
    parser, add = parser_of("replicate", _PACKAGE)
    add("analysis", "FOLDER", type=Path)
    add("out", "OUT", type=Path)
    add("--groups", "CU MCI DAT")
    return parser


def correlate_parser() -> Parser:
    """Describe ``hipsta-bids correlate``."""
    parser, add = parser_of("correlate", _PACKAGE)
    add("maps", "MAP", nargs=2)
    add("out", "OUT", type=Path)
    add("--surface", "FILE", type=Path, required=True)
    add("--permutations", "N", type=positive_int, default=10_000)
    add("--seed", "N", type=int, default=0)
    return parser


def run_compare(arguments: Sequence[str]) -> ExitCode:
    """Compare finished analyses."""
    options = compare_parser().parse_intermixed_args(arguments)
    from hipsta_bids.extensions.agreement import several  # noqa: PLC0415  (heavy)

    several.check_folder(options.out)
    entries = several.read_entries([site_path(text) for text in options.analyses])
    command = "hipsta-bids", "compare", *arguments
    for note in several.compare_analyses(entries, options.out, command, figures=options.figures):
        echo(f"note: {note}")
    echo(f"results: {options.out}")
    echo(f"report: {options.out}.html")
    return ExitCode.OK


def run_replicate(arguments: Sequence[str]) -> ExitCode:
    """Put the published numbers beside the numbers of an analysis."""
    options = replicate_parser().parse_intermixed_args(arguments)
    from hipsta_bids.extensions.agreement.replicate import replicate  # noqa: PLC0415  (heavy)

    echo_table(replicate(options.analysis, options.out, options.groups))
    echo(f"results: {options.out / 'replicate.tsv'}")
    return ExitCode.OK


def run_correlate(arguments: Sequence[str]) -> ExitCode:
    """Correlate two maps of the group level."""
    options = correlate_parser().parse_intermixed_args(arguments)
    from hipsta_bids.extensions.agreement.correlate import correlate  # noqa: PLC0415  (heavy)

    first, second = options.maps
    numbers = {"permutations": options.permutations, "seed": options.seed}
    row = correlate(first, second, options.surface, **numbers, out=options.out)
    echo(f"r = {row['pearson']:.3f}, p = {row['pearson_p']:.3g}, {row['n']} points")
    echo(f"results: {options.out}")
    return ExitCode.OK
