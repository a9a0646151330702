"""Tests of conjunctions: at each point, all one-sided alternatives have to hold.

The p-value is the largest of the parts (Berger 1982, Technometrics 24:295-300): of several
contrasts the minimum statistic against the conjunction null (Nichols et al. 2005), of two
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
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import PointTest, PointwiseFit

#: Fields of a test that are of the part with the largest p-value.
_PICKED = (
    *("p", "df", "estimate", "se", "statistic"),
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
    def is_equivalence(self) -> bool:
        """Whether the parts are two bounds of one contrast, at the same distance from zero."""
        low, high = self.parts[0], self.parts[-1]
        is_pair = [part.side for part in self.parts] == ["greater", "less"]
        is_symmetric = low.margin == -high.margin < 0
        return is_pair and is_symmetric and np.array_equal(low.weights, high.weights)

    @property
    def hypothesis(self) -> str:
        """What the test shows."""
        if self.is_equivalence:
            return f"equivalent within {self.parts[-1].margin:g}"
        texts = [part.hypothesis for part in self.parts]
        if len(set(texts)) == 1:
            return f"{texts[0]} in each of {len(texts)} contrasts"
        return " and ".join(texts)

    def evidence(self, statistic: Float) -> Float:
        """Return the statistic, which is positive in the direction of the alternative."""
        return statistic


def combine(analysis: Analysis, planned: Plan) -> Analysis:
    """Replace parts by conjunctions, in the design and wherever all parts are tested."""
    plan, plain = planned
    level = analysis.request.settings.multiplicity.alpha

    def joined_parts(by_name: Mapping[str, Any], join: Callable[..., Any]) -> tuple[Any, ...]:
        """Join the parts of conjunctions, and drop parts that are no results by themselves."""
        conjunctions = {
            name: join(name, [by_name[part] for part in parts])
            for name, parts in plan.items()
            if by_name.keys() >= set(parts)
        }
        hidden = {part for parts in plan.values() for part in parts}.difference(plain)
        remaining = {name: value for name, value in by_name.items() if name not in hidden}
        return tuple((remaining | conjunctions).values())

    def of_fit(fit: PointwiseFit) -> PointwiseFit:
        tests = {test.contrast.name: test for test in fit.tests}
        return replace(fit, tests=joined_parts(tests, partial(combine_tests, level=level)))

    contrasts = {contrast.name: contrast for contrast in analysis.design.contrasts}
    fitted = {
        hemi: replace(side, fits={name: of_fit(fit) for name, fit in side.fits.items()})
        for hemi, side in analysis.fitted.items()
    }
    measures = {key: (names, of_fit(fit), n) for key, (names, fit, n) in analysis.measures.items()}
    design = replace(analysis.design, contrasts=joined_parts(contrasts, conjoin))
    return replace(analysis, design=design, fitted=fitted, measures=measures)


def conjoin(name: str, parts: Sequence[Contrast]) -> Conjunction:
    """Make a contrast of one-sided contrasts; of equivalence, it has one row."""
    first = Conjunction(name, parts[0].weights, "all", parts=tuple(parts))
    weights = np.concatenate([part.weights for part in parts])
    return first if first.is_equivalence else replace(first, weights=weights)


def combine_tests(name: str, tests: Sequence[PointTest], level: float) -> PointTest:
    """Test at each point that all one-sided alternatives hold.

    Statistic (positive in the direction of the alternative), estimate and effect size are of the
    part with the largest p-value. Of equivalence, limits of the estimate hold at 1 - 2 ``level``.
    """
    signs = {"greater": 1.0, "less": -1.0}
    tests = [replace(t, statistic=signs[t.contrast.side] * t.statistic) for t in tests]
    weakest = np.argmax([test.p for test in tests], axis=0)  # of a missing test, NaN
    picked = {}
    for field in _PICKED:
        stacked = np.stack([getattr(test, field) for test in tests])
        places = np.expand_dims(weakest, tuple(range(stacked.ndim - 1)))
        picked[field] = np.take_along_axis(stacked, places, axis=0)[0]
    contrast, further = conjoin(name, [test.contrast for test in tests]), {}
    if contrast.is_equivalence:
        estimate, reach = picked["estimate"][0], special.stdtrit(picked["df"], 1 - level)
        reach = reach * picked["se"][0]
        further = {"limit_low": estimate - reach, "limit_high": estimate + reach}
    return replace(tests[0], contrast=contrast, further=further, **picked)


def meaning(planned: Plan) -> Iterator[Mapping[str, str]]:  # noqa: ARG001  (as of all steps)
    """Return the meaning of the columns."""
    yield read_columns(__package__)


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how conjunctions and equivalence were tested."""
    contrasts = [c for c in analysis.design.contrasts if isinstance(c, Conjunction)]
    if joint := [c for c in contrasts if not c.is_equivalence]:
        parts = [f"{c.name} ({joined([part.name for part in c.parts])})" for c in joint]
        yield (
            f"Conjunctions were tested by the minimum statistic {cite('conjunction')}:"
            f" {escaped('; '.join(parts))}. The p-value of a conjunction is the largest of its"
            " one-sided p-values, so that all its contrasts have to hold. Estimates and effect"
            " sizes are of the contrast with the largest p-value."
        )
    if within := [c.name for c in contrasts if c.is_equivalence]:
        level = 1 - 2 * analysis.request.settings.multiplicity.alpha
        yield (
            f"Equivalence ({escaped(joined(within))}) was tested by two one-sided tests"
            f" {cite('tost')} {cite('equivalence')}, with {level:.0%} limits of the difference."
            " Without significance, equivalence is not shown, which is no evidence of a difference."
        )
