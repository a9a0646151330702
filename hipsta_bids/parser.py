"""What the command line looks like. Loads nothing heavy, so that ``--help`` is instant."""

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from hipsta_bids import __version__
from hipsta_bids.errors import EXIT_MEANINGS, UsageError
from hipsta_bids.shard import Shard, parse_shard

COLLECT = "collect"
LEVELS = ("participant", COLLECT)
REGIONS = ("body", "extended", "entorhinal")

EPILOG = """\
other commands:
  hipsta-bids schemes          list the segmentation protocols that are known
  hipsta-bids settings         print all settings with their meaning, as TOML
  hipsta-bids demo-data DIR    write a synthetic dataset with known thickness
  hipsta-bids demo DIR         write it, run on it, and compare with the truth
  hipsta-bids phantom DIR      write a synthetic cohort with a known effect (see its --help)
  hipsta-bids surrogate IN OUT measure thickness in single slices to cross-check maps
  hipsta-bids validate         measure accuracy on phantoms, write a report (see its --help)
  hipsta-bids --bids-exec-spec print the Boutiques descriptor of both levels

exit codes:
""" + "".join(f"  {int(code):<4} {meaning}\n" for code, meaning in EXIT_MEANINGS.items())

_MEMORY_UNITS = {"K": 1e-6, "M": 1e-3, "G": 1.0, "T": 1e3}


class Parser(argparse.ArgumentParser):
    """Raises instead of exiting, so that there is one place that makes exit codes."""

    def error(self, message: str) -> NoReturn:
        """Turn argparse's complaint into the package's own error."""
        raise UsageError(f"{message} (see {self.prog} --help)", reason="usage")


def join_slurm(arguments: Sequence[str]) -> list[str]:
    """Attach the value of ``--slurm``, since argparse takes what begins with a dash for options."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == "--slurm":
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def build_parser() -> Parser:
    """Describe the participant level's command line.

    Returns
    -------
    Parser
        Raises :class:`UsageError` on wrong use.
    """
    parser = Parser(
        prog="hipsta-bids",
        description="BIDS App: hippocampal thickness, curvature and shape maps from subfield"
        " segmentations",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("bids_dir", type=Path, help="a BIDS dataset")
    parser.add_argument("output_dir", type=Path, help="where the output dataset goes")
    parser.add_argument(
        "analysis_level",
        type=_level,
        help="participant; collect, which completes status.tsv after runs with --shard; or group"
        " (which has a --help of its own)",
    )
    parser.add_argument("--version", action="version", version=f"hipsta_bids {__version__}")
    add_selection(parser)
    add_segmentations(parser)
    _add_signals(parser)
    _add_processing(parser)
    _add_machines(parser)
    return parser


def add_selection(parser: Parser) -> None:
    """Add the options that choose subjects, sessions and hemispheres."""
    group = parser.add_argument_group("what to process")
    _add(
        group,
        ("--participant-label", "--participant_label"),
        ("LABEL", "subjects, with or without sub- (default: all)"),
        nargs="+",
        type=_label("sub-"),
        default=[],
    )
    _add(
        group,
        ("--session-label", "--session_label"),
        ("LABEL", "sessions, with or without ses- (default: all)"),
        nargs="+",
        type=_label("ses-"),
        default=[],
    )
    _add(
        group,
        ("--hemi",),
        ("H", "hemispheres, L and R (default: both)"),
        nargs="+",
        type=_hemi,
        default=["L", "R"],
    )
    _add(
        group,
        ("--bids-filter-file", "--bids_filter_file"),
        ("FILE", "JSON with the entities of the segmentations, in fMRIPrep's form"),
        type=Path,
    )
    _add(
        group,
        ("--bids-database-dir", "--bids_database_dir"),
        ("DIR", "folder of a PyBIDS database, for speed"),
        type=Path,
    )
    _add(
        group,
        ("--skip-bids-validation", "--skip_bids_validation"),
        (None, "accepted for other BIDS Apps' sake; the raw dataset is never validated"),
        action="store_true",
    )
    _add(
        group,
        ("--dry-run", "--dry_run"),
        (None, "print what would be processed and why, and end"),
        action="store_true",
    )


def add_segmentations(parser: Parser) -> None:
    """Add the options that say where segmentations are."""
    group = parser.add_argument_group("where the segmentations are")
    _add(
        group,
        ("-d", "--derivatives"),
        (
            "NAME=PATH",
            "datasets with segmentations (default: BIDS_DIR/derivatives/*, BIDS_DIR/sourcedata/*)",
        ),
        nargs="+",
        action="extend",
        type=_named_path,
        default=[],
    )
    _add(
        group,
        ("--freesurfer-dir", "--freesurfer_dir", "--fs-subjects-dir", "--fs_subjects_dir"),
        ("DIR", "FreeSurfer's subjects folder"),
        type=Path,
    )
    _add(group, ("--ashs-dir", "--ashs_dir"), ("DIR", "folder of ASHS runs"), type=Path)
    _add(
        group,
        ("--hippunfold-dir", "--hippunfold_dir"),
        ("DIR", "HippUnfold's output dataset"),
        type=Path,
    )
    _add(
        group,
        ("--fs-analysis", "--fs_analysis"),
        ("NAME", "FreeSurfer analysis to use where there are several, such as T1 or T1-T2"),
    )
    _add(
        group,
        ("--ashs-atlas", "--ashs_atlas"),
        ("SCHEME", "atlas of the ASHS runs, a name from `hipsta-bids schemes`"),
    )
    _add(
        group,
        ("--scheme",),
        ("FILE.toml", "a protocol of your own for the BIDS dseg files"),
        type=Path,
    )
    _add(
        group,
        ("--edited-dir", "--edited_dir"),
        ("DIR", "labels (_desc-edited_dseg) and masks (_desc-edited_mask) corrected by hand"),
        type=Path,
    )


def _add_signals(parser: Parser) -> None:
    group = parser.add_argument_group("what else to bring to the sheet")
    _add(
        group,
        ("--map",),
        (
            "NAME=PATTERN",
            "volumes in the space of the labels: path (also in BIDS_DIR) with {subject}, {hemi}, *",
        ),
        nargs="+",
        action="extend",
        type=named_pattern,
        default=[],
    )
    _add(
        group,
        ("--map-sampling", "--map_sampling"),
        ("[NAME=]depth|mid", "mean from wall to wall (default), or on the mid-surface"),
        nargs="+",
        action="extend",
        type=_choice("depth", "mid"),
        default=[],
    )
    _add(
        group,
        ("--map-interpolation", "--map_interpolation"),
        ("[NAME=]linear|nearest", "between voxels (default: linear); nearest for labels"),
        nargs="+",
        action="extend",
        type=_choice("linear", "nearest"),
        default=[],
    )
    _add(
        group,
        ("--roi",),
        ("FILE.tsv", "regions drawn on the sheet: columns x, y, region; their means go to a table"),
        type=Path,
    )


def _add_processing(parser: Parser) -> None:
    group = parser.add_argument_group("how to process")
    _add(
        group,
        ("--settings",),
        ("FILE.toml", "settings that change results (see `hipsta-bids settings`)"),
        type=Path,
    )
    _add(
        group,
        ("--region",),
        ("NAME", "body (default), extended (with neighboring cortex), entorhinal (that alone)"),
        choices=REGIONS,
    )
    _add(
        group,
        ("--write-meshes", "--write_meshes"),
        (None, "also write the tetrahedral meshes (VTU)"),
        action="store_true",
    )
    _add(group, ("--force",), (None, "redo what is up to date"), action="store_true")
    pages = group.add_mutually_exclusive_group()
    _add(
        pages,
        ("--no-reports", "--no_reports"),
        (None, "make no pages to look at (OUT_DIR/*.html)"),
        action="store_true",
    )
    _add(
        pages,
        ("--reports-only", "--reports_only"),
        (None, "make these pages anew from the results that are there, and end"),
        action="store_true",
    )
    _add(
        group,
        ("--n-procs", "--nprocs", "--n_procs", "--n-cpus", "--n_cpus"),
        ("N", "hemispheres at the same time, one processor each (default: all processors)"),
        type=_positive_int,
        default=_processors(),
    )
    _add(
        group,
        ("--mem", "--mem-mb", "--mem_mb"),
        ("SIZE", "memory for all processes together: 8000 (MB) or 8G"),
        type=_gigabytes,
    )
    _add(
        group,
        ("--timeout",),
        ("S", "seconds after which a hemisphere is given up (default: 600)"),
        type=_positive_float,
        default=600.0,
    )
    _add(group, ("-w", "--work-dir", "--work_dir"), ("DIR", "scratch folder"), type=Path)
    _add(
        group,
        ("--stop-on-first-crash", "--stop_on_first_crash"),
        (None, "stop at the first hemisphere that fails"),
        action="store_true",
    )
    _add(
        group,
        ("-v", "--verbose"),
        (None, "say more; twice for still more"),
        action="count",
        default=0,
    )


def _add_machines(parser: Parser) -> None:
    group = parser.add_argument_group("many machines")
    _add(
        group,
        ("--shard",),
        ("I/N", "do the I-th of N equal parts of the subjects; slurm: as the array job says"),
        type=_shard,
    )
    _add(
        group,
        ("--dask-scheduler", "--dask_scheduler"),
        ("ADDRESS", "measure on the workers of this Dask scheduler (tcp://HOST:PORT, or its file)"),
    )
    _add(
        group,
        ("--slurm",),
        ("OPTIONS", "measure in --n-procs SLURM jobs: sbatch's options in quotes, as '-p short'"),
    )


def _add(
    group: Any,  # noqa: ANN401  (argparse has no public name for groups)
    flags: Sequence[str],
    texts: tuple[str | None, str],
    **options: Any,  # noqa: ANN401  (passed on)
) -> None:
    metavar, text = texts
    if metavar is not None:
        options["metavar"] = metavar
    group.add_argument(*flags, help=text, **options)


def _level(text: str) -> str:
    if text not in LEVELS:
        raise argparse.ArgumentTypeError(
            f"{text!r} does not exist; there are participant, collect and group"
        )
    return text


def _label(prefix: str) -> Any:  # noqa: ANN401  (a converter for argparse)
    def convert(text: str) -> str:
        label = text.removeprefix(prefix)
        if not label.isalnum():
            raise argparse.ArgumentTypeError(f"{text!r} is not a BIDS label (letters and digits)")
        return label

    return convert


def _hemi(text: str) -> str:
    hemi = text.upper()
    if hemi not in {"L", "R"}:
        raise argparse.ArgumentTypeError(f"{text!r} is not a hemisphere; use L or R")
    return hemi


def _named_path(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if equals and name and path:
        return name, Path(path)
    folder = Path(text)
    if equals or not folder.name:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PATH")
    return folder.name, folder


def named_pattern(text: str) -> tuple[str, str]:
    """Read ``NAME=PATTERN``."""
    name, equals, pattern = text.partition("=")
    if not (equals and name and pattern):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PATTERN")
    return name, pattern


def _choice(*values: str) -> Any:  # noqa: ANN401  (a converter for argparse)
    """Take one of some words, for all maps or (NAME=) for one."""

    def convert(text: str) -> tuple[str | None, str]:
        name, equals, value = text.rpartition("=")
        if value not in values or (equals and not name):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {' or '.join(values)}, alone or after NAME="
            )
        return name or None, value

    return convert


def _shard(text: str) -> Shard:
    return parse_shard(text, os.environ)


def _positive_int(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def _positive_float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _gigabytes(text: str) -> float:
    """Read a size as fMRIPrep does: megabytes unless a unit follows."""
    match = re.fullmatch(r"(\d+\.?\d*)\s*([KMGT]?)B?", text.strip().upper())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write 8000 (MB) or 8G")
    return _positive_float(match[1]) * _MEMORY_UNITS[match[2] or "M"]


def _processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
