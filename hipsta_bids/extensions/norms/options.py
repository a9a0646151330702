"""Options of norms, and what they ask."""

import argparse
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder, factor_level
from hipsta_bids.cli.questions import refuse
from hipsta_bids.errors import UsageError

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions, GroupResult
    from hipsta_bids.group.settings import GroupSettings


def add_options(parser: Parser) -> None:
    """Add the options of norms."""
    add = adder(parser.add_argument_group("norms (instead of a comparison)"))
    add(
        "--fit-norms",
        "",
        "norms of these participants: mean and SD by age, sex and site, per point and "
        "summary measure, without participants' values",
    )
    add(
        "--norms",
        "FILE",
        "score these participants by the norms.json of --fit-norms: deviations and centiles",
    )
    add(
        "--controls",
        "COLUMN=LEVEL",
        "controls that estimate shift and scale of new sites, as group=CN; at least 25 per site",
        type=factor_level,
    )


def add_normative(parser: Parser) -> None:
    """Add the option of scores within a cohort."""
    adder(parser.add_argument_group("scores within a cohort"))(
        "--normative",
        "FACTOR=LEVEL",
        "score each participant against these, as group=CN (w-scores)",
        type=factor_level,
    )


def check_normative(parsed: argparse.Namespace, settings: "GroupSettings") -> "GroupSettings":
    """Refuse scores of visits of a trial."""
    if parsed.normative and getattr(parsed, "endpoint", None):
        raise UsageError("--endpoint: not with --normative; remove one of them")
    return settings


def run(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Fit norms, or score participants by them."""
    from hipsta_bids.extensions.norms.norming import run_norms  # noqa: PLC0415  (heavy)

    if parsed.fit_norms and parsed.norms:
        raise UsageError("give one of --fit-norms, --norms")
    flag = "--fit-norms" if parsed.fit_norms else "--norms"
    refuse(parsed, ("formula", "age_model"), f"with {flag}")
    if parsed.norms is None:
        refuse(parsed, ("controls",), "without --norms")
    else:
        refuse(parsed, ("align", "template"), "with --norms, whose registration is taken")
    among, controls = parsed.among, parsed.controls
    return run_norms(options, settings, path=parsed.norms, among=among, controls=controls)
