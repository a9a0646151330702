"""Tests of conjunctions: at each point, all one-sided alternatives have to hold.

The p-value is the largest of the parts (Berger 1982, Technometrics 24:295-300): of
several contrasts the minimum statistic against the conjunction null (Nichols et al. 2005), of two
bounds of one contrast the two one-sided tests of equivalence (Schuirmann 1987).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from hipsta_bids.extensions.conjunctions.texts import Plan
from hipsta_bids.group.output.citations import escaped, joined
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.reports.cells import with_unit
from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import PointTest, PointwiseFit

#: Fields of a test that are of the part with the largest p-value.
_PICKED = (
    *("p", "df", "estimate", "se"),
    *("cohen_d", "cohen_d_limits", "eta_squared", "eta_squared_limits"),
)


@dataclass(frozen=True)
class Conjunction(Contrast):
    """Contrasts that all have to hold, each in its direction."""

    parts: tuple[Contrast, ...] = ()

    def __post_init__(self) -> None:
        """Accept rows that depend on each other, because each is tested by itself."""

    @property
    def n_rows(self) -> int:
        """One, because each row is tested by t."""
        return 1

    @property
    def margin_within(self) -> float | None:
        """Margin of equivalence; ``None`` if the parts are no bounds of one contrast."""
        low, high = self.parts[0], self.parts[-1]
        is_pair = [part.side for part in self.parts] == ["greater", "less"]
        if is_pair and low.margin == -high.margin < 0 and (low.weights == high.weights).all():
            return high.margin
        return None

    @property
    def hypothesis(self) -> str:
        """What the test shows."""
        if self.margin_within is not None:
            return f"equivalent within {self.margin_within:g}"
        texts = [part.hypothesis for part in self.parts]
        if len(set(texts)) == 1:
            return f"{texts[0]} in each of {len(texts)} contrasts"
        return " and ".join(texts)


def combine(analysis: Analysis, planned: tuple[Plan, frozenset[str]]) -> Analysis:
    """Replace parts by conjunctions, in the design and wherever all parts are tested."""
    plan, hidden = planned
    level = analysis.request.settings.multiplicity.alpha

    def joined_parts(by_name: Mapping[str, Any], join: Callable[..., Any]) -> tuple[Any, ...]:
        """Join the parts of conjunctions, and drop hidden parts."""
        conjunctions = {
            name: join(name, [by_name[part] for part in parts])
            for name, parts in plan.items()
            if by_name.keys() >= set(parts)
        }
        remaining = {name: value for name, value in by_name.items() if name not in hidden}
        return tuple((remaining | conjunctions).values())

    def of_fit(fit: PointwiseFit) -> PointwiseFit:
        tests = {test.contrast.name: test for test in fit.tests}
        return replace(fit, tests=joined_parts(tests, partial(combine_tests, level=level)))

    contrasts = {contrast.name: contrast for contrast in analysis.design.contrasts}
    return replace(
        analysis,
        design=replace(analysis.design, contrasts=joined_parts(contrasts, conjoin)),
        fitted={
            hemi: replace(side, fits={name: of_fit(fit) for name, fit in side.fits.items()})
            for hemi, side in analysis.fitted.items()
        },
        measures={
            key: (names, of_fit(fit), n) for key, (names, fit, n) in analysis.measures.items()
        },
    )


def conjoin(name: str, parts: Sequence[Contrast]) -> Conjunction:
    """Make a contrast of one-sided contrasts."""
    conjunction = Conjunction(name, parts[0].weights, "all", parts=tuple(parts))
    if conjunction.margin_within is not None:
        return conjunction
    return replace(conjunction, weights=np.concatenate([part.weights for part in parts]))


def combine_tests(name: str, tests: Sequence[PointTest], level: float) -> PointTest:
    """Test at each point that all one-sided alternatives hold.

    Statistic (positive in the direction of the alternative), estimate and effect size are of the
    part with the largest p-value. Of equivalence, limits of the estimate hold at 1 - 2 ``level``.
    """
    weakest = np.argmax([test.p for test in tests], axis=0)  # of a missing test, NaN

    def pick(values: Sequence[Float]) -> Float:
        stacked = np.stack(values)
        places = np.expand_dims(weakest, tuple(range(stacked.ndim - 1)))
        return np.asarray(np.take_along_axis(stacked, places, axis=0)[0], dtype=np.float64)

    picked = {field: pick([getattr(test, field) for test in tests]) for field in _PICKED}
    signs = [1.0 if test.contrast.side == "greater" else -1.0 for test in tests]
    directed = [sign * test.statistic for sign, test in zip(signs, tests, strict=True)]
    reach = special.stdtrit(picked["df"], 1 - level) * picked["se"][0]
    limits = np.stack([picked["estimate"][0] - reach, picked["estimate"][0] + reach])
    contrast = conjoin(name, [test.contrast for test in tests])
    return replace(
        tests[0],
        contrast=contrast,
        statistic=pick(directed),
        limits=None if contrast.margin_within is None else limits,
        **picked,
    )


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how conjunctions and equivalence were tested."""
    contrasts = [c for c in analysis.design.contrasts if isinstance(c, Conjunction)]
    names = [
        *analysis.measured.maps,
        *(n for names, *_ in analysis.measures.values() for n in names),
    ]
    unit = analysis.cohort.units.get(names[0], "1")
    within = [
        f"{escaped(c.name)}: {with_unit(f'{c.margin_within:g}', unit)}"
        for c in contrasts
        if c.margin_within is not None
    ]
    joint = [
        f"{escaped(c.name)} ({escaped(joined([part.name for part in c.parts]))})"
        for c in contrasts
        if c.margin_within is None
    ]
    level = 1 - 2 * analysis.request.settings.multiplicity.alpha
    text = ""
    if joint:
        text += (
            f"Conjunctions were tested by the minimum statistic {cite('conjunction')}:"
            f" {'; '.join(joint)}. The p-value of a conjunction is the largest of its one-sided"
            " p-values, so that all its contrasts have to hold. Estimates and effect sizes are"
            " of the contrast with the largest p-value. "
        )
    if within:
        text += (
            f"Equivalence was tested by two one-sided tests {cite('tost')} {cite('equivalence')},"
            f" with {level:.0%} limits of the difference and these margins: {'; '.join(within)}."
            " Without significance, equivalence is not shown, which is no evidence of a"
            " difference. "
        )
    yield text.strip()


def record(analysis: Analysis) -> Iterator[tuple[str, Any]]:
    """Record the parts of conjunctions."""
    plan, _ = analysis.request.plans["conjunctions"]
    yield "conjunctions", plan
