"""The other commands: protocols, settings, the demonstration, phantoms and others."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from hipsta_bids.cli import participant
from hipsta_bids.cli.console import echo, echo_table
from hipsta_bids.cli.parser import Parser, bids_label, from_namespace, parser_of
from hipsta_bids.errors import ArgumentError, ExitCode, UsageError

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

    return parser

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

    return ExitCode.OK
