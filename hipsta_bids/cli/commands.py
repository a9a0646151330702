"""The other commands: protocols, settings, the demonstration, phantoms and others."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from hipsta_bids.cli import parser as parsing
from hipsta_bids.cli import participant
from hipsta_bids.cli.console import echo, echo_table, warn
from hipsta_bids.cli.parser import Parser, bids_label, from_namespace, parser_of, site_path
from hipsta_bids.errors import ArgumentError, ExitCode, MissingFileError, UsageError

_DEMO_PROTOCOL = "freesurfer"  # the layout that the demo dataset has


def phantom_parser() -> Parser:
    """Describe ``hipsta-bids phantom``."""
    parser, add = parser_of("phantom")
    add("out", "OUT", type=Path)
    add("--layout", "NAME", default=_DEMO_PROTOCOL)
    add("--n-subjects", "N", default=20)
    add("--groups", "NAME", nargs="+", default=["control", "patient"])
    add("--thinning", "MM", default=0.3)
    add("--region", "NAME")
    add("--shift", "MM", default=0.0)
    add("--site", "NAME", default="")
    add("--kind", default="spiral")
    add("--cortex", "MM", default=0.0)
    add("--head", "N", type=int)
    add("--thickness", "MM", default=1.8)
    add("--voxel-size", "MM", nargs=3, type=float, default=[0.4, 0.4, 0.4])
    add("--probabilities")
    add("--seed", default=0)
    return parser


def surrogate_parser() -> Parser:
    """Describe ``hipsta-bids surrogate``."""
    parser, add = parser_of("surrogate")
    add("bids_dir", "BIDS_DIR", type=Path)
    add("output_dir", "OUT_DIR", type=Path)
    participant.add_selection(parser)
    participant.add_segmentations(parser)
    add("--settings", "FILE.toml")
    return parser


def compare_parser() -> Parser:
    """Describe ``hipsta-bids compare``."""
    parser, add = parser_of("compare")
    add("analyses", "FOLDER", nargs="+")
    add("out", "OUT", type=Path)
    add("--figures")
    return parser


def replicate_parser() -> Parser:
    """Describe ``hipsta-bids replicate``."""
    parser, add = parser_of("replicate")
    add("analysis", "FOLDER", type=Path)
    add("out", "OUT", type=Path)
    add("--groups", "CU MCI DAT")
    return parser


def resample_parser() -> Parser:
    """Describe ``hipsta-bids resample``."""
    parser, add = parser_of("resample")
    add("maps", "MAP", nargs="+", type=Path)
    add("out", "OUT", type=Path)
    add("--surface", "FILE", nargs="+", required=True)
    add("--sheet", "FILE", nargs="+", default=[])
    add("--to-surface", "FILE", nargs="+", default=[])
    add("--column", "NAME", default="thickness")
    add("--settings", "FILE.toml")
    return parser


def export_parser() -> Parser:
    """Describe ``hipsta-bids export``."""
    parser, add = parser_of("export")
    add("output_dir", "OUT_DIR", type=Path)
    add("folder", "DIR", type=Path)
    add("--format", choices=["freesurfer", "vtk", "ply", "template", "prov"], default="freesurfer")
    add("--name", "LABEL")
    add("--seg", "NAME")
    add("--region", "NAME", default="body")
    add("--participant-label", "LABEL", nargs="+", type=bids_label("sub-"), default=[])
    add("--space-of", "PATTERN", default="")
    return parser


def correlate_parser() -> Parser:
    """Describe ``hipsta-bids correlate``."""
    parser, add = parser_of("correlate")
    add("maps", "MAP", nargs=2)
    add("out", "OUT", type=Path)
    add("--surface", "FILE", type=Path, required=True)
    add("--permutations", "N", type=parsing.positive_int, default=10_000)
    add("--seed", "N", type=int, default=0)
    return parser


def figure_parser() -> Parser:
    """Describe ``hipsta-bids figure``."""
    parser, add = parser_of("figure")
    add("what", "", choices=["participant", "group", "contrast", "registration", "roc"])
    add("output_dir", "OUT_DIR", type=Path)
    add("-o --output", "FILE", required=True)
    add("--name", "NAME")
    add("--participant-label", "LABEL", type=bids_label("sub-"))
    add("--session-label", "LABEL", type=bids_label("ses-"))
    add("--measures", "NAME", nargs="+", default=[])
    add("--contrasts", "NAME", nargs="+", default=[])
    add("--columns", "", type=int, choices=[1, 2])
    add("--limits", "LOW HIGH", type=float)
    add("--dpi", "N", default=300)
    return parser


def list_protocols(arguments: Sequence[str]) -> ExitCode:
    """List the protocols that are known."""
    parser_of("protocols")[0].parse_args(arguments)
    from hipsta_bids.protocols.load import protocol_table  # noqa: PLC0415  (heavy)

    echo_table(protocol_table())
    return ExitCode.OK


def print_settings(arguments: Sequence[str]) -> ExitCode:
    """Print the default settings of a level as TOML."""
    parser, add = parser_of("settings")
    add("level", nargs="?", choices=["group"])
    group = parser.parse_args(arguments).level == "group"
    from hipsta_bids.group.settings import GroupSettings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.protocols.toml import settings_toml  # noqa: PLC0415  (start-up time)
    from hipsta_bids.settings import Settings  # noqa: PLC0415  (start-up time)

    echo(settings_toml(GroupSettings() if group else Settings()).rstrip())
    return ExitCode.OK


def write_demo_data(arguments: Sequence[str]) -> ExitCode:
    """Write the demo dataset."""
    folder = _demo_folder("demo-data", arguments)
    _write_demo(folder)
    echo(f"demo dataset: {folder}")
    return ExitCode.OK


def run_demo(arguments: Sequence[str]) -> ExitCode:
    """Write the demo dataset, run on it, and print true and measured thickness."""
    folder = _demo_folder("demo", arguments)
    data, out = folder / "bids", folder / "out"
    _write_demo(data)
    code = participant.run_participant_level(
        participant.build_parser().parse_args([str(data), str(out), participant.LEVELS[0]])
    )
    for line in compare_with_truth(data, out):
        echo(line)
    return code


def _demo_folder(command: str, arguments: Sequence[str]) -> Path:
    parser, add = parser_of(command)
    add("folder", "DIR")
    folder: Path = parser.parse_args(arguments).folder
    return folder


def _write_demo(folder: Path) -> None:
    """Write the demo dataset, never into a folder that holds something else."""
    from hipsta_bids.phantom import refuse_taken, write_demo_dataset  # noqa: PLC0415  (heavy)

    refuse_taken(folder, "a demo dataset")
    write_demo_dataset(folder)


def compare_with_truth(data: Path, out: Path) -> Iterator[str]:
    """Compare measured with true mean thickness, one line per hemisphere."""
    from hipsta_bids.derivatives.dataset import identity, read_status, row_key  # noqa: PLC0415  (heavy)
    from hipsta_bids.derivatives.names import HemisphereName, output_path  # noqa: PLC0415  (heavy)
    from hipsta_bids.io import files  # noqa: PLC0415  (heavy)
    from hipsta_bids.phantom import TRUTH_TABLE  # noqa: PLC0415  (heavy)

    ended = {row_key(row): row for row in read_status(out)}
    for row in files.read_tsv(data / TRUTH_TABLE):
        subject = row["subject"].removeprefix("sub-")
        name = HemisphereName(subject=subject, session=None, hemi=row["hemi"], seg=_DEMO_PROTOCOL)
        title = f"{row['subject']} {row['hemi']} ({row['kind']})"
        decision = ended.get(row_key(identity(name)), {}).get("decision", "not run")
        true = float(row["thickness_mean"])
        summary = out / output_path(name, "summary")
        if not summary.exists():
            yield f"{title}: true mean thickness {true:.3f} mm, not measured ({decision})"
            continue
        (values,) = files.read_tsv(summary)
        measured = float(values["thickness_mean"])
        yield (
            f"{title}: true mean thickness {true:.3f} mm, measured {measured:.3f} mm,"
            f" difference {measured - true:+.3f} mm ({decision})"
        )


def write_phantoms(arguments: Sequence[str]) -> ExitCode:
    """Write a cohort of phantoms."""
    options = phantom_parser().parse_args(arguments)
    from hipsta_bids.phantom.cohort import CohortPlan, write_cohort  # noqa: PLC0415  (heavy)

    options.region = options.region or ("CA1-anterior" if options.head is None else "head")
    plan = from_namespace(CohortPlan, options)
    write_cohort(options.out, plan, layout=options.layout, voxel_size=tuple(options.voxel_size))
    echo(f"synthetic dataset of {plan.n_subjects} subjects: {options.out}")
    return ExitCode.OK


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
    from hipsta_bids.inputs import account, search  # noqa: PLC0415  (heavy)
    from hipsta_bids.participant.surrogate import crosscheck  # noqa: PLC0415  (heavy)

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


def run_compare(arguments: Sequence[str]) -> ExitCode:
    """Compare finished analyses."""
    options = compare_parser().parse_intermixed_args(arguments)
    from hipsta_bids.group.questions import several  # noqa: PLC0415  (heavy)

    several.check_folder(options.out)
    entries = several.read_entries([site_path(text) for text in options.analyses])
    command = "hipsta-bids", "compare", *arguments
    for note in several.compare_analyses(entries, options.out, command, figures=options.figures):
        echo(f"note: {note}")
    echo(f"results: {options.out}")
    echo(f"report: {options.out}.html")
    return ExitCode.OK


def run_replicate(arguments: Sequence[str]) -> ExitCode:
    """Compare the published numbers with the numbers of an analysis."""
    options = replicate_parser().parse_intermixed_args(arguments)
    from hipsta_bids.group.questions.replicate import replicate  # noqa: PLC0415  (heavy)

    echo_table(replicate(options.analysis, options.out, options.groups))
    echo(f"results: {options.out / 'replicate.tsv'}")
    return ExitCode.OK


#: Options of ``figure`` that have another name than its arguments in Python.
_FIGURE_OPTIONS = {"file": "output", "participant": "participant-label", "session": "session-label"}


def draw_figure(arguments: Sequence[str]) -> ExitCode:
    """Draw a figure for a paper from results."""
    options = figure_parser().parse_intermixed_args(arguments)
    from hipsta_bids.api.figures import figure  # noqa: PLC0415  (heavy)

    try:
        figure(
            options.what,
            options.output_dir,
            name=options.name,
            participant=options.participant_label,
            session=options.session_label,
            measures=options.measures,
            contrasts=options.contrasts,
            columns=options.columns,
            limits=options.limits and tuple(options.limits),
            dpi=options.dpi,
            file=options.output,
        )
    except ArgumentError as error:
        option = _FIGURE_OPTIONS.get(error.argument, error.argument)
        raise UsageError(f"--{option} {error.problem}") from error
    echo(f"figure: {options.output}")
    return ExitCode.OK


def run_resample(arguments: Sequence[str]) -> ExitCode:
    """Move maps between the whole sheet and HippUnfold's surfaces."""
    options = resample_parser().parse_intermixed_args(arguments)
    from hipsta_bids.participant.unfolded import resample  # noqa: PLC0415  (heavy)
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    sheet = load_settings(options.settings).sheet
    files = options.maps, options.out, options.surface
    between = {"sheets": options.sheet, "targets": options.to_surface}
    echo(resample(*files, sheet, column=options.column, **between))
    return ExitCode.OK


def run_export(arguments: Sequence[str]) -> ExitCode:
    """Write surfaces and maps in formats of other programs."""
    options = export_parser().parse_intermixed_args(arguments)
    if not options.output_dir.is_dir():
        raise MissingFileError(f"{options.output_dir}: folder not found; check its name")
    if options.format == "template":
        from hipsta_bids.group.output.template import export_template  # noqa: PLC0415  (heavy)

        paths = export_template(options.output_dir, options.folder, options.name)
    elif options.format == "prov":
        from hipsta_bids.derivatives.provenance import export_provenance  # noqa: PLC0415  (heavy)

        paths = export_provenance(options.output_dir, options.folder)
    else:
        from hipsta_bids.participant.export import export_surfaces  # noqa: PLC0415  (heavy)

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


def run_correlate(arguments: Sequence[str]) -> ExitCode:
    """Correlate two maps of the group level."""
    options = correlate_parser().parse_intermixed_args(arguments)
    from hipsta_bids.group.questions.correlate import correlate  # noqa: PLC0415  (heavy)

    first, second = options.maps
    numbers = {"permutations": options.permutations, "seed": options.seed}
    row = correlate(first, second, options.surface, **numbers, out=options.out)
    echo(f"r = {row['pearson']:.3f}, p = {row['pearson_p']:.3g}, {row['n']} points")
    echo(f"results: {options.out}")
    return ExitCode.OK


def run_validation(arguments: Sequence[str]) -> ExitCode:
    """Refuse, as validation is no part of the package; takes any arguments."""
    raise UsageError(
        "validate: run it from a checkout of hipsta_bids, by `make validation` or"
        f" `{' '.join(('python -m validation', *arguments))}`"
    )
