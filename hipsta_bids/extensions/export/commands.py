"""The command of formats of other programs."""

from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.cli.console import echo
from hipsta_bids.cli.parser import Parser, bids_label, parser_of
from hipsta_bids.errors import ExitCode, MissingFileError


def export_parser() -> Parser:
    """Describe ``hipsta-bids export``."""
    parser, add = parser_of("export", "hipsta_bids.extensions.export")
    add("output_dir", "OUT_DIR", type=Path)
    add("folder", "DIR", type=Path)
    add("--format", choices=["freesurfer", "vtk", "ply", "template", "prov"], default="freesurfer")
    add("--name", "LABEL")
    add("--seg", "NAME")
    add("--region", "NAME", default="body")
    add("--participant-label", "LABEL", nargs="+", type=bids_label("sub-"), default=[])
    add("--space-of", "PATTERN", default="")
    return parser


def run_export(arguments: Sequence[str]) -> ExitCode:
    """Write surfaces and maps in formats of other programs."""
    options = export_parser().parse_intermixed_args(arguments)
    if not options.output_dir.is_dir():
        raise MissingFileError(f"{options.output_dir}: folder not found; check its name")
    if options.format == "template":
        from hipsta_bids.extensions.export.template import export_template  # noqa: PLC0415  (heavy)

        paths = export_template(options.output_dir, options.folder, options.name)
    elif options.format == "prov":
        from hipsta_bids.extensions.export.provenance import export_provenance  # noqa: PLC0415  (heavy)

        paths = export_provenance(options.output_dir, options.folder)
    else:
        from hipsta_bids.extensions.export.surfaces import export_surfaces  # noqa: PLC0415  (heavy)

        paths = export_surfaces(
            options.output_dir,
            options.folder,
            options.format,
            protocol=options.seg,
            region=options.region,
            participants=options.participant_label,
            image=options.space_of,
        )
    echo(f"{options.folder}: {len(paths)} files")
    return ExitCode.OK
