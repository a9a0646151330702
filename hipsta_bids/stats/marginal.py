"""Weights of the columns of a design for contrasts of levels, terms and slopes.

Levels stand for estimated marginal means, by the rules of R's emmeans (Lenth 2016,
doi:10.18637/jss.v069.i01; Searle et al. 1980, doi:10.1080/00031305.1980.10483031): a reference grid
has all levels of factors and the means of numbers, or both values of a number that has two; levels
that a contrast does not name have equal weights.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pandas as pd
from formulaic import ModelMatrix
from scipy.linalg import null_space

from hipsta_bids.errors import ModelError, did_you_mean
from hipsta_bids.stats.contrasts import Contrast, ContrastSpec, split_name
from hipsta_bids.stats.formula import INTERCEPT, in_order, level_name, listed
from hipsta_bids.stats.grammar import CONTEXT, closed_formula, term_text
from hipsta_bids.types import Float

#: How a contrast asks whether a variable bends.
NONLINEAR = "nonlinear"
#: A line is in the span of columns if it is off by less, in standard deviations.
_EXACT = 1e-6
#: Slopes are differences over this share of the range, as in emmeans' ``emtrends``.
_STEP = 1e-3
#: Rows of the largest reference grid.
_LARGEST_GRID = 200_000


def _is_code(level: str) -> bool:
    """Check for a number, which says nothing without its factor."""
    return in_order(level)[0] < np.inf


class Terms:
    """What contrasts can name, as rows of weights of the columns."""

    def __init__(
        self,
        matrix: ModelMatrix,
        table: pd.DataFrame,
        levels: Mapping[str, Sequence[str]],
        added: Sequence[str] = (),
    ) -> None:
        self.matrix: Float = np.asarray(matrix, dtype=np.float64)
        self.columns = tuple(str(column) for column in matrix.columns)
        #: Columns of the design, and covariates of each hemisphere.
        self.names = (*self.columns, *added)
        self.spec, self.table, self.levels = matrix.model_spec, table, levels
        self._grids: dict[tuple[tuple[str, object], ...], Float] = {}

    def contrast(self, spec: ContrastSpec) -> Contrast:
        """Return a contrast with its weights; ModelError lists unknown names."""
        return Contrast(spec.name, self._weights(spec), spec.side, spec.margin)

    def dummies(self, test: str) -> tuple[ContrastSpec, ...]:
        """Return a contrast per column: reference minus level of factors, else the column."""
        named: dict[str, tuple[str, ...]] = {}
        for variables, columns in self._structures():
            factors, slopes = variables & set(self.levels), sorted(variables - set(self.levels))
            factor, *further = factors or [""]
            first, *remaining = self.levels.get(factor, [""])
            # Else these are the means of levels, a bent variable, or several factors.
            is_difference = not further and len(slopes) < 2 and len(columns) == len(remaining)  # noqa: PLR2004
            ending = "".join(f":{name}" for name in slopes)
            for level in remaining if is_difference else ():
                name = f"{first}-{level}{ending}"
                name = f"{factor} {name}" if name in named or _is_code(level) else name
                named[name] = f"{factor}[{first}]{ending}", f"{factor}[{level}]{ending}"
            named |= {} if is_difference else {name: (name,) for name in columns}
        named |= {name: (name,) for name in self.names[len(self.columns) :]}
        return tuple(
            ContrastSpec(name, parts, ((1.0, -1.0)[: len(parts)],), test)
            for name, parts in named.items()
            if name != INTERCEPT
        )

    def _weights(self, spec: ContrastSpec) -> Float:
        variable = re.fullmatch(rf"{NONLINEAR}\(`?([^`]+)`?\)", spec.conditions[0])
        if variable and len(spec.conditions) == 1:
            return self._nonlinear(variable[1], spec.name)
        parts = [self._rows(name, spec.name) for name in spec.conditions]
        width = max(part.shape[1] for part in parts)
        parts = [np.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts]
        if len(parts) == len(spec.weights) == 1:
            return parts[0] * spec.weights[0][0]
        if wide := [name for name, p in zip(spec.conditions, parts, strict=True) if len(p) > 1]:
            raise ModelError(
                f"contrast {spec.name!r}: {listed(wide)} has several rows; test it by itself"
            )
        return np.asarray(np.array(spec.weights) @ np.concatenate(parts))

    def _structures(self) -> Iterator[tuple[frozenset[str], list[str]]]:
        """List the terms of the formula: their variables, and their columns."""
        for structure in self.spec.structure:
            names = closed_formula(term_text(structure.term)).names
            yield frozenset(names), list(structure.columns)

    def _columns_of(self, variables: frozenset[str]) -> list[int]:
        """Return places of the columns of terms with exactly these variables."""
        names = {name for s, columns in self._structures() if s == variables for name in columns}
        return [place for place, name in enumerate(self.columns) if name in names]

    def _free_and_fixed(self, name: str, contrast: str) -> tuple[list[str], dict[str, str]]:
        """Return the variables that a name compares, and those that it fixes, with their levels."""
        atoms, conditions = split_name(name)
        fixed = {self._variable(key, contrast): value for key, value in conditions.items()}
        free: list[str] = []
        for atom in atoms:
            factor, level = self._split(atom)
            if factor is None:
                free.append(self._variable(atom, contrast))
            elif fixed.setdefault(factor, level) != level:
                raise ModelError(f"contrast {contrast!r}: {name} fixes {factor} twice")
        if compared := sorted(set(free) & set(fixed)):
            raise ModelError(f"contrast {contrast!r}: {name} compares and fixes {listed(compared)}")
        return free, fixed

    def _rows(self, name: str, contrast: str) -> Float:
        """Return (rows, columns) weights of a column, level, slope, term or product of these."""
        if name in self.names:
            size = len(self.columns) if name in self.columns else len(self.names)
            return np.eye(size)[[self.names.index(name)]]
        free, fixed = self._free_and_fixed(name, contrast)
        variables = frozenset(free)
        if variables and not any(variables <= structure for structure, _ in self._structures()):
            raise ModelError(
                f"contrast {contrast!r}: the formula has no {':'.join(free)}; add the term, or"
                " contrast something else"
            )
        places = self._columns_of(variables)
        sizes = [len(self.levels[name]) - 1 for name in free if name in self.levels]
        if variables - set(self.levels) and len(places) > math.prod(sizes):
            if fixed:
                raise ModelError(
                    f"contrast {contrast!r}: {':'.join(free)} is no line, so that it has no slope"
                    f" to compare; test {':'.join(free)} by itself"
                )
            return np.eye(len(self.columns))[places]
        return self._marginal(free, fixed, contrast)

    def _variable(self, name: str, contrast: str) -> str:
        """Return a variable of the formula; ModelError suggests what is known."""
        if name in self.table:
            return name
        levels = [f"{f}[{level}]" for f, levels in self.levels.items() for level in levels]
        names = [*self.names, *levels, *map(str, self.table.columns)]
        hint = did_you_mean([name], names) or f"; known are {listed(dict.fromkeys(names))}"
        if complete := [level for level in levels if level.endswith(f"[{name}]")]:
            hint = f"; write {' or '.join(complete)}"
        raise ModelError(f"contrast {contrast!r}: nothing is called {name!r}{hint}")

    def _split(self, name: str) -> tuple[str | None, str]:
        """Return factor and level of ``factor[level]`` or ``factor.level``."""
        for factor, levels in self.levels.items():
            for level in levels:
                if name in {f"{factor}[{level}]", f"{factor}.{level}"}:
                    return factor, level
        return None, ""

    def _marginal(self, free: Sequence[str], fixed: Mapping[str, str], contrast: str) -> Float:
        """Reduce a reference grid: slopes of numbers, and reference minus level of factors."""
        axes: dict[str, Sequence[object]] = {}
        reductions = []
        for name in map(str, self.table.columns):
            size = len(self.levels.get(name, ()))
            if name in fixed:
                axes[name] = [self._value(name, fixed[name], contrast)]
            elif name in self.levels:
                axes[name] = list(self.levels[name])
            else:
                values = self.table[name].to_numpy(dtype=np.float64)
                distinct = np.unique(values)
                step = _STEP * float(np.ptp(values)) * (name in free)
                is_pair = len(distinct) == 2 and not step  # noqa: PLR2004 -- as in emmeans
                middle = float(values.mean())
                axes[name] = distinct.tolist() if is_pair else [middle - step, middle + step]
                if step:
                    reductions.append(np.array([[-0.5, 0.5]]) / step)
                    continue
                axes[name] = axes[name] if is_pair else [middle]
            n = len(axes[name])
            if name in free:
                reductions.append(np.hstack([np.ones((size - 1, 1)), -np.eye(size - 1)]))
            else:
                reductions.append(np.full((1, n), 1 / n))
        rows = self._evaluate(axes, contrast)
        # The first axis of each factor is reduced, and becomes the last one of the effects.
        for reduction in reductions:
            rows = np.moveaxis(np.tensordot(reduction, rows, axes=(1, 0)), 0, -2)
        return np.asarray(rows.reshape(-1, len(self.columns)))

    def _value(self, name: str, text: str, contrast: str) -> object:
        """Return the level or number at which a variable is fixed."""
        if name in self.levels:
            if (level := level_name(text)) in self.levels[name]:
                return level
            raise ModelError(
                f"contrast {contrast!r}: {name} has no level {text!r}, only"
                f" {listed(self.levels[name])}"
            )
        try:
            number = float(text)
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            raise ModelError(f"contrast {contrast!r}: {name} is a number, not {text!r}")
        return number

    def _evaluate(self, axes: Mapping[str, Sequence[object]], contrast: str) -> Float:
        """Return rows of the design over a grid: (size of each axis..., columns)."""
        shape = [len(values) for values in axes.values()]
        if math.prod(shape) > _LARGEST_GRID:
            raise ModelError(
                f"contrast {contrast!r}: a grid of {math.prod(shape)} combinations of levels is too"
                " large; name columns of the design instead"
            )
        key = tuple((name, value) for name, values in axes.items() for value in values)
        if key not in self._grids:
            grid = pd.DataFrame(itertools.product(*axes.values()), columns=[*axes])
            for name, levels in self.levels.items():
                grid[name] = pd.Categorical(grid[name], categories=list(levels))
            with np.errstate(invalid="ignore", divide="ignore"):
                matrix = self.spec.get_model_matrix(grid, na_action="ignore", context=dict(CONTEXT))
            self._grids[key] = np.asarray(matrix, dtype=np.float64)
        if not np.isfinite(self._grids[key]).all():
            raise ModelError(
                f"contrast {contrast!r}: the formula has no value there; fix other values"
            )
        return self._grids[key].reshape(*shape, len(self.columns))

    def _nonlinear(self, variable: str, contrast: str) -> Float:
        """Weights that are zero where the columns of a variable make a line of it.

        If ``line`` are the coefficients that give the variable itself, these are the directions of
        its coefficients at right angles to ``line``. A single one is scaled to the coefficient of
        the square.
        """
        places = self._columns_of(frozenset([variable]))
        if variable not in {*self.table} - {*self.levels} or len(places) < 2:  # noqa: PLR2004
            raise ModelError(
                f"contrast {contrast!r}: {variable!r} is in the formula as a line at most; write it"
                f" as poly({variable}, 2) or cr({variable}, df=3)"
            )
        values = self.table[variable].to_numpy(dtype=np.float64)
        spread = float(values.std())
        values = (values - values.mean()) / spread
        powers = np.column_stack([values, values**2])
        shares = np.linalg.lstsq(self.matrix, powers, rcond=None)[0]
        if np.abs(self.matrix @ shares[:, 0] - values).max() > _EXACT:
            raise ModelError(
                f"contrast {contrast!r}: no line of {variable!r} is in the formula to compare with"
            )
        line, square = shares[places].T
        across = null_space(line[None]).T
        if len(across) == 1:
            across = across / float(across[0] @ square) / spread**2
        weights = np.zeros((len(across), len(self.columns)))
        weights[:, places] = across
        return weights
