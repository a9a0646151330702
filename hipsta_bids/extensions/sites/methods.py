"""Text of methods: how effects of sites were removed."""

from collections.abc import Callable, Iterator

from hipsta_bids.extensions.sites.harmonize import part_of
from hipsta_bids.extensions.sites.planning import SitePlan
from hipsta_bids.extensions.sites.settings import HarmonizationSettings
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
    text = (
        f"Effects of {column} ({counts} participants) on"
        f"{' registered' if analysis.registered else ''} maps and summary measures were removed by"
        f" ComBat {sources}. ComBat estimated a shift and a scale of each {column} from the"
        f" residuals of a linear model at each point, and preserved {_preserved(plan)}."
    )
    if plan.estimated and settings.of(HarmonizationSettings).pooling:
        text += (
            " Shifts and scales were pooled over the points of each map by empirical Bayes;"
            " summary measures were harmonized separately."
        )
    if plan.visits.participant is not None:
        text += (
            " Random intercepts of participants were preserved; the scale describes variation"
            f" within participants {cite('beer')}."
        )
    text += _earlier_parameters(plan)
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


def _preserved(plan: SitePlan) -> str:
    text = code(plan.formula) if plan.names else "no variable"
    return text if plan.icv is None else f"{text}, and for {SIZES} also {escaped(plan.icv)}"


def _earlier_parameters(plan: SitePlan) -> str:
    if plan.saved is None:
        return ""
    count = len(plan.counts.keys() & plan.saved.sites.keys())
    new = escaped(", ".join(plan.estimated))
    text = f"; parameters of {new} were estimated here" if new else ""
    return f" Parameters of {count} levels were taken from an earlier analysis{text}."
