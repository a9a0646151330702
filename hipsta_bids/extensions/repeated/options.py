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
    """Return the random effects that an option names; without a name, as set."""
    random = parsed.longitudinal if parsed.longitudinal != "auto" else None
    return {"longitudinal": {"random": random}}


def choose_sessions(parsed: argparse.Namespace, settings: "GroupSettings") -> "Sessions | None":
    """Return the sessions that options name; ``None`` without these options."""
    from hipsta_bids.extensions.repeated import sessions  # noqa: PLC0415  (heavy)

    if parsed.endpoint and (parsed.paired or parsed.longitudinal):
        raise UsageError("give one of --longitudinal, --paired and --endpoint")
    if parsed.longitudinal and parsed.paired:
        raise UsageError("give --longitudinal (all sessions) or --paired (two), not both")
    if parsed.endpoint:
        kind, *names = parsed.endpoint
        trial = sessions.Trial((kind, *(f"ses-{name.removeprefix('ses-')}" for name in names)))
        if parsed.asymmetry:
            raise UsageError("--endpoint: remove --asymmetry")
        return trial
    if parsed.paired:
        first, second = parsed.paired
        return sessions.Pair(f"ses-{first}", f"ses-{second}")
    if parsed.longitudinal:
        has_categories = settings.longitudinal.random == "visits"
        return sessions.Visits() if has_categories else sessions.Longitudinal()
    return None
