"""Questions of the group level other than comparisons: their options, and which go together."""

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder, factor_level
from hipsta_bids.errors import UsageError, did_you_mean
from hipsta_bids.extensions import find_parts

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions, GroupResult
    from hipsta_bids.group.settings import GroupSettings

#: Options that only sample sizes have; questions; and options that only comparisons have.
_POWER_ONLY = ("power_level", "dropout", "allocation", "visits")
_TRIALS, _NORMS = ("retest", "power"), ("fit_norms", "norms")
_COMPARISON_ONLY = (
    *("longitudinal", "endpoint", "paired", "asymmetry", "normative", "model", "contrast"),
    *("permutations", "blocks", "fdr_scope", "base", "no_classification"),
    *("joint", "joint_sides"),
    *("harmonize", "harmonize_model"),
)


def add_questions(parser: Parser) -> None:
    """Add all options of these questions."""
    add = adder(
        parser.add_argument_group("for trials (instead of a comparison; --formula: covariates)")
    )
    add(
        "--retest",
        "",
        "agreement of repeated sessions: within-subject SD, ICC(2,1), minimal detectable change",
    )
    add(
        "--power",
        "EFFECT=SHARE",
        "participants per arm to detect thinning=5%% of the mean or slowing=25%% of change, "
        "from these participants or --retest",
        type=_effect,
    )
    add("--power-level", "P", "power to reach (default: 0.8)", type=float)
    add(
        "--dropout",
        "SHARE",
        "share of the enrolled participants who drop out (default: 0)",
        type=float,
    )
    add(
        "--allocation",
        "A:B",
        "participants of the arms, as 2:1 (default: 1:1)",
        type=_allocation,
    )
    add(
        "--visits",
        "MONTHS",
        "when the trial measures, as 0,12,24; its end point is the slope (default: one visit)",
        type=_months,
    )
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
    add = adder(parser.add_argument_group("for trials and norms"))
    add(
        "--among",
        "COLUMN=LEVEL",
        "only participants like this, as group=AD",
        type=factor_level,
    )


def _effect(text: str) -> tuple[str, float]:
    """Read ``thinning=5%``."""
    kind, _, share = text.partition("=")
    try:
        value = float(share.removesuffix("%")) / 100
    except ValueError:
        value = 0.0
    kinds = ("thinning", "slowing")
    if kind not in kinds or not share.endswith("%") or not 0 < value <= 1:
        hint = "" if kind in kinds else did_you_mean([kind], kinds)
        raise argparse.ArgumentTypeError(
            f"{text!r} is not of the form thinning=5% or slowing=25%{hint}"
        )
    return kind, value


def _allocation(text: str) -> float:
    """Read ``2:1``: participants of the larger arm over the smaller arm."""
    first, _, second = text.partition(":")
    if not (first.isdecimal() and second.isdecimal() and int(first) * int(second)):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form 2:1")
    return max(int(first) / int(second), int(second) / int(first))


def _months(text: str) -> tuple[float, ...]:
    """Read ``0,12,24``."""
    try:
        months = tuple(float(part) for part in text.split(","))
    except ValueError:
        months = ()
    finite = all(0 <= month < float("inf") for month in months)
    if len(months) < 2 or not finite or list(months) != sorted(set(months)):  # noqa: PLR2004
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a list of two or more months in their order, as 0,12,24"
        )
    return months


def is_question(parsed: argparse.Namespace) -> bool:
    """Check whether something other than a comparison is asked."""
    return any(getattr(parsed, name) for name in (*_TRIALS, *_NORMS))


def run_comparison(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Compare participants."""
    from hipsta_bids.group.questions.compare import run_group  # noqa: PLC0415  (heavy)

    _refuse(parsed, (*_POWER_ONLY, "among"), "without --retest or --power")
    _refuse(parsed, ("controls",), "without --norms")
    multiplicity = settings.multiplicity
    if not settings.joint.measures and not multiplicity.method.startswith("permutation"):
        _refuse(
            parsed, ("permutations", "blocks"), "without permutations, by --correction or --joint"
        )
    elif multiplicity.permutations * multiplicity.alpha < 1:
        raise UsageError(
            f"{multiplicity.permutations} permutations cannot give p of"
            f" {multiplicity.alpha:g}; at least {math.ceil(1 / multiplicity.alpha)}"
            " are needed, and thousands are better"
        )
    if protocols := tuple(dict.fromkeys(parsed.seg))[1:]:
        from hipsta_bids.group.questions.several import run_protocols  # noqa: PLC0415  (heavy)

        return run_protocols(options, settings, (parsed.seg[0], *protocols))
    return run_group(options, settings)


def run_question(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Measure the agreement of sessions, find sample sizes, fit norms or score by them."""
    flags = [f"--{name.replace('_', '-')}" for name in (*_TRIALS, *_NORMS) if getattr(parsed, name)]
    if len(flags) > 1 and flags != ["--retest", "--power"]:
        raise UsageError(f"give one of {', '.join(flags)}")
    parts = [part.name for part in find_parts()]
    _refuse(parsed, (*_COMPARISON_ONLY, *parts), f"with {' and '.join(flags)}")
    if len(set(parsed.seg)) > 1:
        raise UsageError(f"--seg: name one protocol with {' and '.join(flags)}")
    if settings.harmonization.column:
        raise UsageError(
            f"{' and '.join(flags)}: harmonization is not possible; remove "
            "harmonization.column from the settings"
        )
    if parsed.power is None:
        _refuse(parsed, _POWER_ONLY, "without --power")
    if parsed.power is None or parsed.retest:
        _refuse(parsed, ("formula", "age_model"), f"with {flags[0]}")
    if parsed.norms is None:
        _refuse(parsed, ("controls",), "without --norms")
    else:
        _refuse(parsed, ("align", "template"), "with --norms, whose registration is taken")
    if parsed.fit_norms or parsed.norms:
        from hipsta_bids.group.questions.norming import run_norms  # noqa: PLC0415  (heavy)

        among, controls = parsed.among, parsed.controls
        return run_norms(options, settings, path=parsed.norms, among=among, controls=controls)
    from hipsta_bids.group.questions.trials import run_trial  # noqa: PLC0415  (heavy)
    from hipsta_bids.stats.trials import TrialEffect  # noqa: PLC0415  (heavy)

    effect = None
    if parsed.power is not None:
        kind, share = parsed.power
        effect = TrialEffect(kind=kind, share=share, visits=parsed.visits or ())
    return run_trial(options, settings, retest=parsed.retest, effect=effect, among=parsed.among)


def _refuse(parsed: argparse.Namespace, names: Sequence[str], context: str) -> None:
    """Refuse options that would have no effect."""
    flags = [f"--{name.replace('_', '-')}" for name in names if getattr(parsed, name)]
    if flags:
        raise UsageError(f"{', '.join(flags)}: has no effect {context}; remove the option")
