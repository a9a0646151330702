"""The command that moves maps between the whole sheet and HippUnfold's surfaces."""

from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli.console import echo
from hipsta_bids.cli.parser import Parser, parser_of
from hipsta_bids.errors import ExitCode


def resample_parser() -> Parser:
    """Describe ``hipsta-bids resample``."""
    parser, add = parser_of("resample", "hipsta_bids.extensions.regions")
    add("maps", "MAP", nargs="+", type=Path)
    add("out", "OUT", type=Path)
    add("--surface", "FILE", nargs="+", required=True)
    add("--sheet", "FILE", nargs="+", default=[])
    add("--to-surface", "FILE", nargs="+", default=[])
    add("--column", "NAME", default="thickness")
    add("--settings", "FILE.toml")
    return parser


def run_resample(arguments: Sequence[str]) -> ExitCode:
    """Move maps between the whole sheet and HippUnfold's surfaces."""
    options = resample_parser().parse_intermixed_args(arguments)
    from hipsta_bids.extensions.regions.unfolded import resample  # noqa: PLC0415  (heavy)
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    sheet = load_settings(options.settings).sheet
    files = options.maps, options.out, options.surface
    between = {"sheets": options.sheet, "targets": options.to_surface}
    echo(resample(*files, sheet, column=options.column, **between))
    return ExitCode.OK
