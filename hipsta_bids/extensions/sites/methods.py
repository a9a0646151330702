"""Text of methods: how effects of sites were removed."""

from collections.abc import Callable, Iterator

from hipsta_bids.extensions.sites.harmonize import part_of
from hipsta_bids.group.cohort.data import SIZES
from hipsta_bids.group.output.citations import code, escaped
from hipsta_bids.group.output.results import Analysis


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how effects of sites were removed."""
    harmonization, settings = part_of(analysis), analysis.request.settings
    plan = harmonization.plan
    counts = ", ".join(f"{escaped(site)} {n}" for site, n in plan.counts.items())
    column = escaped(plan.column)
    sources = f"{cite('johnson')}, {cite('combat')}"
    preserved = code(plan.formula) if plan.names else "no variable"
    if plan.icv is not None:
        preserved += f", and for {SIZES} also {escaped(plan.icv)}"
    text = (
        f"Effects of {column} ({counts} participants) on"
        f"{' registered' if analysis.registered else ''} maps and summary measures were removed by"
        f" ComBat {sources}. ComBat estimated a shift and a scale of each {column} from the"
        f" residuals of a linear model at each point, and preserved {preserved}."
    )
    if plan.estimated and settings.harmonization.pooling:
        text += (
            " Shifts and scales were pooled over the points of each map by empirical Bayes;"
            " summary measures were harmonized separately."
        )
    if plan.visits.participant is not None:
        text += (
            " Random intercepts of participants were preserved; the scale describes variation"
            f" within participants {cite('beer')}."
        )
    if plan.saved is not None:
        saved_sites = sum(site in plan.saved.sites for site in plan.counts)
        text += f" Parameters of {saved_sites} levels were taken from an earlier analysis"
        new = escaped(", ".join(plan.estimated))
        text += f"; parameters of {new} were estimated here." if new else "."
    if plan.estimated and not analysis.comparison.sessions.later:
        columns_lost = len(plan.counts) - 1
        text += (
            f" Because shifts were estimated from the same participants, {column} was also a factor"
            f" of the model, at a cost of {columns_lost}"
            f" degree{'s' if columns_lost > 1 else ''} of freedom {cite('nygaard')}."
        )
    if analysis.pairs and analysis.groups and harmonization.leaks(analysis.groups.column):
        text += (
            " Classifiers used the measures before harmonization, because parameters estimated"
            " with known groups would leak group membership into the cross-validation."
        )
    yield text
