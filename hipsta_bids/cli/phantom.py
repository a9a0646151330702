"""What ``hipsta-bids phantom``, ``surrogate`` and ``validate`` look like. Loads nothing heavy."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from hipsta_bids.cli.participant import Parser, add_segmentations, add_selection
from hipsta_bids.derivatives.names import HemisphereName, output_path
from hipsta_bids.derivatives.status import identity, read_status, row_key
from hipsta_bids.io import files
from hipsta_bids.phantom import TRUTH_TABLE, refuse_taken, write_demo_dataset

PHANTOM_EPILOG = """\
regions: presubiculum, subiculum, CA1, CA2-3 or all, alone or with -anterior or -posterior

what is written:
  derivatives/LAYOUT/       segmentations, for the participant level
  participants.tsv          group, age, sex, intracranial volume, site
  phantom_truth.tsv         true thickness, extents, areas and volume of each hemisphere
                            and region
  phantom_maps/             true maps of each hemisphere
  phantom_effect.tsv        where the effect was planted, and how large it is
"""


def phantom_parser() -> Parser:
    """Describe ``hipsta-bids phantom``."""
    parser = Parser(
        prog="hipsta-bids phantom",
        description="write a synthetic BIDS dataset of hippocampal bodies with known truth",
        epilog=PHANTOM_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("out", type=Path, metavar="OUT", help="new folder, or one of phantoms to write anew")
    add(
        "--layout",
        default="freesurfer",
        metavar="NAME",
        help="freesurfer (default), ashs (the atlas ABC-3T) or ashsPMC",
    )
    add("--n-subjects", type=int, default=20, metavar="N", help="in all groups (default: 20)")
    add(
        "--groups",
        nargs="+",
        default=["control", "patient"],
        metavar="NAME",
        help="the first has no effect, the second has it once, the third twice"
        " (default: control patient)",
    )
    add(
        "--thinning",
        type=float,
        default=0.3,
        metavar="MM",
        help="planted effect: the wall is so much thinner in the region (default: 0.3)",
    )
    add(
        "--region",
        default="CA1-anterior",
        metavar="NAME",
        help="where (default: CA1-anterior), see below",
    )
    add(
        "--shift",
        type=float,
        default=0.0,
        metavar="MM",
        help="planted shift along x, to lateral, of the wall's pattern and subfields (default: 0)",
    )
    add("--kind", default="spiral", help="slab, arc, spiral (default), s-shape or tight")
    add(
        "--cortex",
        type=float,
        default=0.0,
        metavar="MM",
        help="so much neighboring cortex beside the subiculum, for --region extended and entorhinal"
        " of the participant level; needs a layout of ASHS (default: 0)",
    )
    add("--thickness", type=float, default=1.8, metavar="MM", help="cohort mean (default: 1.8)")
    add(
        "--voxel-size",
        nargs=3,
        type=float,
        default=[0.4, 0.4, 0.4],
        metavar="MM",
        help="left-right, superior-inferior, anterior-posterior (default: 0.4 0.4 0.4)",
    )
    add("--seed", type=int, default=0, help="the same seed gives the same files (default: 0)")
    return parser


def surrogate_parser() -> Parser:
    """Describe ``hipsta-bids surrogate``."""
    parser = Parser(
        prog="hipsta-bids surrogate",
        description="measure thickness in single slices, without a mesh, and compare it with the"
        " sheet if OUT_DIR has one",
        epilog="Exit codes are those of the participant level. The setting surrogate.positions says"
        " which slices are taken (default: the middle of the body).",
        allow_abbrev=False,
    )
    parser.add_argument("bids_dir", type=Path, metavar="BIDS_DIR", help="a BIDS dataset")
    parser.add_argument(
        "output_dir", type=Path, metavar="OUT_DIR", help="the output dataset, new or with results"
    )
    add_selection(parser)
    add_segmentations(parser)
    parser.add_argument(
        "--settings", type=Path, metavar="FILE.toml", help="those of the results in OUT_DIR"
    )
    return parser


def validate_parser() -> Parser:
    """Describe ``hipsta-bids validate``."""
    parser = Parser(
        prog="hipsta-bids validate",
        description="measure phantoms with known truth; write tables and figures",
        epilog="The exit code is 0 whether or not targets are met: the report says which are.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--full", action="store_true", help="all cases, minutes instead of a quick selection")
    add(
        "--out",
        type=Path,
        default=Path("docs"),
        metavar="DIR",
        help="folder for validation.md and images/ (default: docs)",
    )
    add("--suite", nargs="+", default=[], metavar="NAME", help="only these suites")
    add(
        "--group",
        action="append_const",
        dest="suite",
        const="group",
        help="only the group level: simulated cohorts",
    )
    add(
        "--labels",
        type=Path,
        metavar="BIDS_DIR",
        help="a dataset with fine segmentations, to be measured in thick slices as well",
    )
    return parser


# The demonstration: a synthetic dataset, and how near the measured thickness is to the truth.


_PROTOCOL = "freesurfer"  # the layout that the demo dataset has


def write_demo_data(folder: Path) -> None:
    """Write the demo dataset, never into a folder that holds something else."""
    refuse_taken(folder, "a demo dataset")
    write_demo_dataset(folder)


def compare_with_truth(data: Path, out: Path) -> Iterator[str]:
    """Set measured beside true mean thickness."""
    ended = {row_key(row): row for row in read_status(out)}
    for row in files.read_tsv(data / TRUTH_TABLE):
        name = HemisphereName(
            subject=row["subject"].removeprefix("sub-"),
            session=None,
            hemi=row["hemi"],
            seg=_PROTOCOL,
        )
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
