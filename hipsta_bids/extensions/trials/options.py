"""Options of trials, and what they ask."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser, adder
from hipsta_bids.cli.questions import refuse
from hipsta_bids.errors import did_you_mean
from hipsta_bids.extensions.trials import POWER_ONLY

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions, GroupResult
    from hipsta_bids.group.settings import GroupSettings


def add_options(parser: Parser) -> None:
    """Add the options of trials."""
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


def given_settings(parsed: argparse.Namespace) -> Mapping[str, Mapping[str, object]]:
    """Return what options set, by table of the settings; ``None`` where an option is not given."""
    return {
        "power": {
            "power": parsed.power_level,
            "dropout": parsed.dropout,
            "allocation": parsed.allocation,
        }
    }


def run(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Measure the agreement of sessions, or find sample sizes."""
    from hipsta_bids.extensions.trials.sizes import TrialEffect  # noqa: PLC0415  (heavy)
    from hipsta_bids.extensions.trials.trial import run_trial  # noqa: PLC0415  (heavy)

    flag = "--retest" if parsed.retest else "--power"
    if parsed.power is None:
        refuse(parsed, POWER_ONLY, "without --power")
    if parsed.power is None or parsed.retest:
        refuse(parsed, ("formula", "age_model"), f"with {flag}")
    effect = None
    if parsed.power is not None:
        kind, share = parsed.power
        effect = TrialEffect(kind=kind, share=share, visits=parsed.visits or ())
    return run_trial(options, settings, retest=parsed.retest, effect=effect, among=parsed.among)


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
