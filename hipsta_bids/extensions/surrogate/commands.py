"""The command of single slices."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli import participant
from hipsta_bids.cli.console import echo, echo_table, warn
from hipsta_bids.cli.parser import Parser, parser_of
from hipsta_bids.errors import ExitCode


def surrogate_parser() -> Parser:
    """Describe ``hipsta-bids surrogate``."""
    parser, add = parser_of("surrogate", "hipsta_bids.extensions.surrogate")
    add("bids_dir", "BIDS_DIR", type=Path)
    add("output_dir", "OUT_DIR", type=Path)
    participant.add_selection(parser)
    participant.add_segmentations(parser)
    add("--settings", "FILE.toml")
    return parser


def run_surrogate(arguments: Sequence[str]) -> ExitCode:
    """Measure thickness in single slices."""
    parsed = surrogate_parser().parse_args(arguments)
    # Options of the participant level that this command lacks have their defaults.
    defaults = participant.build_parser().parse_args(
        [str(parsed.bids_dir), str(parsed.output_dir), participant.LEVELS[0]]
    )
    defaults.probabilities = "never"
    options = argparse.Namespace(**vars(defaults) | vars(parsed))
    participant.check_folders(options)
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    settings = load_settings(options.settings)
    from hipsta_bids.extensions.surrogate.crosscheck import crosscheck  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs import account, search  # noqa: PLC0415  (heavy)

    request = participant.input_request(options)
    findings = search.find_inputs(request)
    for note in (*search.dataset_notes(request, findings.items), *findings.notes):
        echo(f"note: {note}")
    if options.dry_run:
        echo_table(account.selection_table(findings.items))
        echo_table(account.ignored_table(findings.ignored))
        return ExitCode.OK
    participant.check_output_is_no_input(options.output_dir, findings.items)
    return crosscheck(findings.items, options.output_dir, settings, echo, warn)
