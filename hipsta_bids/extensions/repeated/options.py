"""Options of repeated sessions."""

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from hipsta_bids.cli.parser import bids_label
from hipsta_bids.errors import UsageError

if TYPE_CHECKING:
    from hipsta_bids.group.model import Sessions
    from hipsta_bids.group.settings import GroupSettings


def add_options(add: Callable[..., None]) -> None:
    """Add the options of repeated sessions."""
    add(
        "--longitudinal",
        "",
        "all sessions: mixed model with intercepts or slopes (default: slopes from 10 "
        "participants with three visits), or visits as categories",
        nargs="?",
        const="auto",
        choices=["auto", "intercept", "slope", "visits"],
    )
    add(
        "--endpoint",
        "MODEL...",
        "a trial: ancova, mmrm or clda, the session of the baseline, and later sessions",
    )
    add("--paired", "SES1 SES2", "the second session minus the first", type=bids_label("ses-"))


def given_settings(parsed: argparse.Namespace) -> Mapping[str, Mapping[str, Any]]:
    """Return the random effects that an option names."""
    return {"longitudinal": {"random": parsed.longitudinal}}


def choose_sessions(parsed: argparse.Namespace, settings: "GroupSettings") -> "Sessions | None":
    """Return the sessions that options name; ``None`` without these options."""
    from hipsta_bids.extensions.repeated.longitudinal import Longitudinal  # noqa: PLC0415  (heavy)
    from hipsta_bids.extensions.repeated.pair import Pair  # noqa: PLC0415  (heavy)
    from hipsta_bids.extensions.repeated.visits import Trial, Visits  # noqa: PLC0415  (heavy)

    if parsed.endpoint and (parsed.paired or parsed.longitudinal):
        raise UsageError("give one of --longitudinal, --paired and --endpoint")
    if parsed.longitudinal and parsed.paired:
        raise UsageError("give --longitudinal (all sessions) or --paired (two), not both")
    if parsed.endpoint:
        kind, *sessions = parsed.endpoint
        trial = Trial(kind, tuple(f"ses-{name.removeprefix('ses-')}" for name in sessions))
        if parsed.asymmetry:
            raise UsageError("--endpoint: remove --asymmetry")
        return trial
    if parsed.paired:
        first, second = parsed.paired
        return Pair(f"ses-{first}", f"ses-{second}")
    if parsed.longitudinal:
        return Visits() if settings.longitudinal.random == "visits" else Longitudinal()
    return None
