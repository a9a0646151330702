"""Visits as categories: analyses of end points, and their contrasts."""

from collections.abc import Sequence

from hipsta_bids.errors import UsageError, did_you_mean

#: Column of visits as categories, by the labels of sessions.
VISIT = "visit"
#: Analyses of end points: adjusted for the baseline as a covariate, or with equal arms there.
ENDPOINTS = ("ancova", "mmrm", "clda")
#: Analysis, baseline, and a later session.
_SHORTEST = 3


def check_endpoint(endpoint: tuple[str, ...]) -> None:
    """Refuse an unknown analysis, or sessions that it cannot have."""
    sessions = endpoint[1:]
    is_valid = endpoint[0] in ENDPOINTS and len(set(sessions)) == len(sessions)
    if not is_valid or len(endpoint) < _SHORTEST:
        hint = "" if endpoint[0] in ENDPOINTS else did_you_mean(endpoint[:1], ENDPOINTS)
        raise UsageError(
            f"--endpoint {' '.join(endpoint)}: give ancova, mmrm or clda, the session of the"
            f" baseline, and later sessions{hint}"
        )
    if endpoint[0] == "ancova" and len(endpoint) > _SHORTEST:
        raise UsageError("--endpoint ancova has one later session; use mmrm for several")


def visit_contrasts(
    groups: Sequence[str], labels: Sequence[str], endpoint: tuple[str, ...] = ()
) -> list[str]:
    """Contrasts of visits as categories, from contrasts of groups.

    Changes since the first visit; of end points, differences of groups at each later visit.
    """
    first, *after = labels
    if not groups:
        changes = (f"change to {visit} = {VISIT}[{visit}] - {VISIT}[{first}]" for visit in after)
        return [] if endpoint else list(changes)
    if endpoint:
        terms = {
            visit: f"{VISIT}[{visit}]" for visit in (after if endpoint[0] == "clda" else labels)
        }
    else:
        terms = {f"change to {visit}": f"({VISIT}[{visit}] - {VISIT}[{first}])" for visit in after}
    pairs = [group.split(" = ") for group in groups]
    return [
        *([] if endpoint else groups),
        *(f"{name} in {p} = ({d}):{term}" for name, term in terms.items() for p, d in pairs),
    ]
