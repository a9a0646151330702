"""Text of methods: how maps were tested together."""

from collections.abc import Callable, Iterator

from hipsta_bids.extensions.combination.settings import JointSettings
from hipsta_bids.group.output.citations import joined
from hipsta_bids.group.output.results import Analysis


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how maps were tested together."""
    rules = analysis.request.settings.multiplicity
    joint = analysis.request.settings.of(JointSettings)
    by = (
        "as minus twice the sum of their logarithms (Fisher)"
        if joint.combine == "fisher"
        else "by the smallest (Tippett)"
    )
    family = "" if joint.sides else " of each side" if rules.scope == "map" else " of both sides"
    names = joined([name.replace("_", " ") for name in joint.measures])
    text = (
        f"Maps of {names}{', of the left and the right side,' if joint.sides else ''} were also"
        f" tested together by non-parametric combination {cite('joint')}. At each point, two-sided"
        f" p-values of the maps were combined {by}, and written as a normal quantile. Residuals of"
        f" the model without the contrast were permuted {rules.permutations} times (seed"
        f" {rules.seed}) {cite('freedman')} {cite('permutation')}. All maps were permuted alike,"
        " which preserved their dependence."
    )
    statistic = "combined evidence"
    if rules.method == "permutation-tfce":
        statistic = f"threshold-free cluster enhancement {cite('tfce')} of the evidence"
    yield (
        f"{text} The largest {statistic} controlled the family-wise error rate at {rules.alpha:g}"
        f" over the points{family}. The null hypothesis at a point is no effect in any of the maps."
    )
