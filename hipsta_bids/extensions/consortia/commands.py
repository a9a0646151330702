"""The command of several sites."""

from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli.console import echo
from hipsta_bids.cli.parser import Parser, given_settings, parser_of, site_path
from hipsta_bids.errors import ExitCode
from hipsta_bids.joints import is_present


def meta_parser() -> Parser:
    """Describe ``hipsta-bids meta``."""
    parser, add = parser_of("meta", "hipsta_bids.extensions.consortia")
    add("sites", "SITE", nargs="+")
    add("out", "OUT", type=Path)
    if is_present("norms"):
        add("--norms")
    add("--random", choices=["reml", "reml-adhoc", "dl"])
    add("--correction", choices=["fdr2", "bh"])
    add("--fdr-scope", choices=["map", "hemispheres", "all"])
    add("--settings", "FILE.toml")
    add("--figures")
    return parser


def run_meta_analysis(arguments: Sequence[str]) -> ExitCode:
    """Combine summaries of sites."""
    options = meta_parser().parse_intermixed_args(arguments)
    from hipsta_bids.extensions.consortia.meta import run_meta  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.settings import load_group_settings  # noqa: PLC0415  (start-up time)

    choices = {
        "meta": {"random": options.random},
        "multiplicity": {"method": options.correction, "scope": options.fdr_scope},
    }
    settings = load_group_settings(options.settings).changed(**given_settings(choices))
    paths = [site_path(text) for text in options.sites]
    if getattr(options, "norms", False):
        from hipsta_bids.extensions.consortia.norms import merge_norms  # noqa: PLC0415  (may be absent)

        norms, notes = merge_norms([path for _, path in paths], options.out, settings)
        for note in notes:
            echo(f"note: {note}")
        echo(f"norms: {norms}")
        return ExitCode.OK
    command = "hipsta-bids", "meta", *arguments
    page, notes = run_meta(paths, options.out, settings, command, figures=options.figures)
    for note in notes:
        echo(f"note: {note}")
    echo(f"results: {options.out / 'meta'}")
    echo(f"report: {page}")
    return ExitCode.OK
