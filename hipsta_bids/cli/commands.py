"""The other commands: protocols, settings, the demonstration, phantoms and others."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from hipsta_bids.cli import participant
from hipsta_bids.cli.console import echo, echo_table, warn
from hipsta_bids.cli.parser import Parser, adder, from_namespace, given_settings
from hipsta_bids.errors import ExitCode, UsageError

_DEMO_PROTOCOL = "freesurfer"  # the layout that the demo dataset has

PHANTOM_EPILOG = """\
regions: presubiculum, subiculum, CA1, CA2-3 or all, alone or with -anterior or -posterior

what is written:
  derivatives/LAYOUT/       segmentations, for the participant level
  participants.tsv          group, age, sex, intracranial volume, site
  phantom_truth.tsv         true thickness, extents, areas and volume of each hemisphere
                            and region
  phantom_maps/             true maps of each hemisphere (without --head)
  phantom_ends.tsv          ends of the body, for --ends (with --head)
  phantom_effect.tsv        where the effect was planted, and how large it is
"""


def phantom_parser() -> Parser:
    """Describe ``hipsta-bids phantom``."""
    parser = Parser(
        prog="hipsta-bids phantom",
        description="write a synthetic BIDS dataset of hippocampi with known truth",
        epilog=PHANTOM_EPILOG,
    )
    add = adder(parser)
    parser.add_argument(
        "out", type=Path, metavar="OUT", help="new folder, or one of phantoms to replace"
    )
    add(
        "--layout",
        "NAME",
        "freesurfer (default), hippunfold, ashs (the atlas ABC-3T) or ashsPMC",
        default="freesurfer",
    )
    add("--n-subjects", "N", "in all groups (default: 20)", default=20)
    add(
        "--groups",
        "NAME",
        "the first has no effect, the second has it once, the third twice"
        " (default: control patient)",
        nargs="+",
        default=["control", "patient"],
    )
    add(
        "--thinning",
        "MM",
        "planted effect: by how much the wall is thinner in the region (default: 0.3)",
        default=0.3,
    )
    add("--region", "NAME", "where (default: CA1-anterior, of a head: head), see below")
    add(
        "--shift",
        "MM",
        "planted shift along x, to lateral, of the wall's pattern and subfields (default: 0)",
        default=0.0,
    )
    add("--site", "NAME", "site of all, which labels begin with (default: two sites)", default="")
    add("--kind", "", "slab, arc, spiral (default), s-shape or tight", default="spiral")
    add(
        "--cortex",
        "MM",
        "neighboring cortex beside the subiculum, for --region extended and entorhinal"
        " of the participant level; needs a layout of ASHS (default: 0)",
        default=0.0,
    )
    add(
        "--head",
        "N",
        "hippocampi with a tail and a head, which has N digitations (0 to 4), for --region headbody"
        " of the participant level; with --layout hippunfold for --region whole",
        type=int,
    )
    add("--thickness", "MM", "cohort mean (default: 1.8)", default=1.8)
    add(
        "--voxel-size",
        "MM",
        "left-right, superior-inferior, anterior-posterior (default: 0.4 0.4 0.4)",
        nargs=3,
        type=float,
        default=[0.4, 0.4, 0.4],
    )
    add("--seed", "", "the same seed gives the same files (default: 0)", default=0)
    return parser


def surrogate_parser() -> Parser:
    """Describe ``hipsta-bids surrogate``."""
    parser = Parser(
        prog="hipsta-bids surrogate",
        description="measure thickness in single slices, without a mesh, and compare it with"
        " the\nsheet if OUT_DIR has one",
        epilog="exit codes are those of the participant level; the setting surrogate.positions"
        " says\nwhich slices are taken (default: the middle of the body)",
    )
    parser.add_argument("bids_dir", type=Path, metavar="BIDS_DIR", help="a BIDS dataset")
    parser.add_argument(
        "output_dir", type=Path, metavar="OUT_DIR", help="the output dataset, new or with results"
    )
    participant.add_selection(parser)
    participant.add_segmentations(parser)
    adder(parser)("--settings", "FILE.toml", "those of the results in OUT_DIR")
    return parser


def meta_parser() -> Parser:
    """Describe ``hipsta-bids meta``."""
    parser = Parser(
        prog="hipsta-bids meta",
        description="combine the summaries of several sites, which `group --export-summary` writes:"
        "\nfixed and random effects at each point and of summary measures",
        epilog="results: OUT/meta/; begin with OUT/meta.html\n\nexit codes: 0 done; 64 wrong use;"
        " 65 a summary cannot be read, or sites do not agree; 73 cannot write",
    )
    parser.add_argument(
        "sites", nargs="+", metavar="SITE", help="summary.json of a site, or NAME=summary.json"
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for the results")
    add = adder(parser)
    add(
        "--random",
        "",
        "variance between sites: restricted maximum likelihood with t tests (reml, the default),"
        " or DerSimonian and Laird (dl)",
        choices=["reml", "dl"],
    )
    add(
        "--correction",
        "",
        "false discovery rate over points (default: fdr2)",
        choices=["fdr2", "bh"],
    )
    add(
        "--fdr-scope",
        "",
        "what is one family of tests (default: map)",
        choices=["map", "hemispheres"],
    )
    add(
        "--settings",
        "FILE.toml",
        "settings of the group level, of which meta and multiplicity count",
    )
    return parser


def resample_parser() -> Parser:
    """Describe ``hipsta-bids resample``."""
    parser = Parser(
        prog="hipsta-bids resample",
        description="move maps of the whole sheet (--region whole, experimental) to HippUnfold's"
        " vertices,\nor maps of HippUnfold to the whole sheet, by the same share of the way between"
        " the same sides",
        epilog="exit codes: 0 done; 64 wrong use; 65 a file cannot be read or does not fit;"
        " 73 cannot write",
    )
    parser.add_argument(
        "maps",
        nargs="+",
        type=Path,
        metavar="MAP",
        help="of the whole sheet: _morph.tsv, .shape.gii or _map.tsv; or HippUnfold's: .shape.gii,"
        " .func.gii or .dscalar.nii; one file of each side",
    )
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help=".shape.gii, .func.gii, .dscalar.nii (of one or both sides), or .tsv of a sheet",
    )
    add = adder(parser)
    add(
        "--surface",
        "FILE",
        "HippUnfold's own space-unfold_..._label-hipp_midthickness.surf.gii of the density of its"
        " maps; one, or one of each side",
        nargs="+",
        required=True,
    )
    add(
        "--sheet",
        "FILE",
        "the sheet's own desc-proximodistal_morph.shape.gii, which agrees better with HippUnfold's"
        " coordinate than x does; one of each side",
        nargs="+",
        default=[],
    )
    add("--column", "NAME", "of a table (default: thickness)", default="thickness")
    add("--settings", "FILE.toml", "those of the sheets, if not the defaults")
    return parser


def list_protocols(arguments: Sequence[str]) -> ExitCode:
    """List the protocols that are known."""
    Parser("hipsta-bids protocols", "list the segmentation protocols").parse_args(arguments)
    from hipsta_bids.protocols.load import protocol_table  # noqa: PLC0415  (heavy)

    echo_table(protocol_table())
    return ExitCode.OK


def print_settings(arguments: Sequence[str]) -> ExitCode:
    """Print the default settings of a level as TOML."""
    parser = Parser("hipsta-bids settings", "print all settings with their meaning, as TOML")
    parser.add_argument("level", nargs="?", choices=["group"], help="whose settings")
    group = parser.parse_args(arguments).level == "group"
    from hipsta_bids.group.design.settings import GroupSettings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.protocols.toml import settings_toml  # noqa: PLC0415  (start-up time)
    from hipsta_bids.settings import Settings  # noqa: PLC0415  (start-up time)

    echo(settings_toml(GroupSettings() if group else Settings()).rstrip())
    return ExitCode.OK


def write_demo_data(arguments: Sequence[str]) -> ExitCode:
    """Write the demo dataset."""
    folder = _demo_folder("demo-data", "write a synthetic dataset with known thickness", arguments)
    _write_demo(folder)
    echo(f"demo dataset: {folder}")
    return ExitCode.OK


def run_demo(arguments: Sequence[str]) -> ExitCode:
    """Write the demo dataset, run on it, and print true beside measured thickness."""
    text = "write a synthetic dataset, run on it, and compare with the truth"
    folder = _demo_folder("demo", text, arguments)
    data, out = folder / "bids", folder / "out"
    _write_demo(data)
    code = participant.run_participant_level(
        participant.build_parser().parse_args([str(data), str(out), participant.LEVELS[0]])
    )
    for line in compare_with_truth(data, out):
        echo(line)
    return code


def _demo_folder(command: str, text: str, arguments: Sequence[str]) -> Path:
    parser = Parser(f"hipsta-bids {command}", text)
    parser.add_argument("folder", type=Path, metavar="DIR", help="new folder, or one of a demo")
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
        status = ended.get(row_key(identity(name)), {}).get("status", "not run")
        true = float(row["thickness_mean"])
        summary = out / output_path(name, "summary")
        if not summary.exists():
            yield f"{title}: true mean thickness {true:.3f} mm, not measured ({status})"
            continue
        (values,) = files.read_tsv(summary)
        measured = float(values["thickness_mean"])
        yield (
            f"{title}: true mean thickness {true:.3f} mm, measured {measured:.3f} mm,"
            f" difference {measured - true:+.3f} mm ({status})"
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


def run_meta_analysis(arguments: Sequence[str]) -> ExitCode:
    """Combine summaries of sites."""
    options = meta_parser().parse_intermixed_args(arguments)
    from hipsta_bids.group.design.settings import load_group_settings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.group.questions.consortium import run_meta  # noqa: PLC0415  (heavy)

    choices = {
        "meta": {"random": options.random},
        "multiplicity": {"method": options.correction, "scope": options.fdr_scope},
    }
    settings = load_group_settings(options.settings).changed(**given_settings(choices))
    paths = [_site(text) for text in options.sites]
    page, notes = run_meta(paths, options.out, settings, ("hipsta-bids", "meta", *arguments))
    for note in notes:
        echo(f"note: {note}")
    echo(f"results: {options.out / 'meta'}")
    echo(f"what was done and found: {page}")
    return ExitCode.OK


def _site(text: str) -> tuple[str | None, Path]:
    """Read ``NAME=PATH``, or a path."""
    name, equals, path = text.partition("=")
    if equals and name and "/" not in name:
        return name, Path(path)
    return None, Path(text)


def run_resample(arguments: Sequence[str]) -> ExitCode:
    """Move maps between the whole sheet and HippUnfold's surfaces."""
    options = resample_parser().parse_intermixed_args(arguments)
    from hipsta_bids.participant.unfolded import resample  # noqa: PLC0415  (heavy)
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    sheet = load_settings(options.settings).sheet
    files = options.maps, options.out, options.surface
    echo(resample(*files, sheet, column=options.column, sheets=options.sheet))
    return ExitCode.OK


def run_validation(arguments: Sequence[str]) -> ExitCode:
    """Refuse, as validation is no part of the package; takes any arguments."""
    raise UsageError(
        "validate: run it from a checkout of hipsta_bids, by `make validation` or"
        f" `{' '.join(('python -m validation', *arguments))}`",
    )
