"""Which model is fitted: the user's, or the paper's default."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.arrays import Bool, SideMaps
from hipsta_bids.stats.design import AGES, VISIT, Design
from hipsta_bids.stats.formula import declared_levels, folder_name
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.marginal import NONLINEAR
from hipsta_bids.stats.references import choose_reference
from hipsta_bids.types import PARTICIPANT, SESSION

#: Cites a reference by its key.
Cite = Callable[[str], str]
#: Both sides of a participant, in names of hemispheres.
BOTH = "LR"


@dataclass(frozen=True)
class Groups:
    """The column of the groups, and their order."""

    column: str
    levels: tuple[str, ...]
    """The reference first, the other levels in the order of the alphabet."""

    @property
    def reference(self) -> str:
        """The level that the other levels are compared with."""
        return self.levels[0]

    def contrasts(self) -> list[str]:
        """Each other level against the reference: positive where the reference has more."""
        first = f"{self.column}[{self.reference}]"
        return [
            f"{self.reference}-{level} = {first} - {self.column}[{level}]"
            for level in self.levels[1:]
        ]


def find_groups(
    table: pd.DataFrame,
    settings: GroupSettings,
    reference: str | None = None,
    *,
    preferred: Sequence[str] = (),
) -> Groups | None:
    """Find the column of groups and their reference level; ``preferred`` names are first."""
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    for name in sorted(
        settings.model.group_columns, key=lambda name: name.casefold() not in preferred
    ):
        column = by_name.get(name.casefold())
        values = formulas.typed(table[column]).dropna() if column else None
        if column is None or values is None or values.nunique() < 2:  # noqa: PLR2004 -- two groups
            continue
        counts = Counter(formulas.level_name(value) for value in values)
        formulas.check_spelling(counts, column)
        ordered = sorted(counts, key=formulas.in_order)
        words, declared = settings.design.reference_levels, declared_levels(table[column])
        first = choose_reference(ordered, words, requested=reference, declared=declared).level
        if first not in counts:
            available = ", ".join(sorted(counts))
            raise ModelError(
                f"model: no participant has {column!r} {first!r}; there are {available}"
            )
        return Groups(column, (first, *(level for level in ordered if level != first)))
    return None


def default_formula(
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    covariates: Sequence[str] | None = None,
    time: str | None = None,
) -> str:
    """Spell the right-hand side: the groups, and each covariate that varies."""
    first = " * ".join(name for name in (groups.column if groups else None, time) if name)
    names = settings.model.covariates if covariates is None else covariates
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    terms = [first or "1"]
    for name in (by_name[name.casefold()] for name in names if name.casefold() in by_name):
        if len(formulas.typed(table[name]).dropna().unique()) > 1:
            shape = settings.model.age if name.casefold() in AGES else "linear"
            bent = {"quadratic": f"poly({name}, 2)"}
            bent["spline"] = f'cr({name}, df=3, constraints="center")'
            terms.append(bent.get(shape, name))
    return " + ".join(terms)


def empty_covariates(table: pd.DataFrame, settings: GroupSettings) -> list[str]:
    """Name covariates of the default model whose column holds nothing."""
    names = {name.casefold() for name in settings.model.covariates}
    named = [str(name) for name in table.columns if str(name).casefold() in names]
    return [name for name in named if formulas.typed(table[name]).isna().all()]


@dataclass(frozen=True)
class VisitTime:
    """Visits with their time, for longitudinal models."""

    table: pd.DataFrame
    column: str | None
    """Column of the time; None if it is not known."""
    covariates: tuple[str, ...]
    """Names of covariates of the default model, with age at the first visit."""
    labels: tuple[str, ...] = ()
    """Visits in their order, if they are categories."""


@dataclass(frozen=True)
class Sessions:
    """Which sessions are compared: the first of each participant. Extensions have others."""

    is_repeated: ClassVar[bool] = False
    """Whether rows are visits, of which a participant may have several."""
    has_changes: ClassVar[bool] = False
    """Whether the default model tests changes, also without groups."""
    is_classified: ClassVar[bool] = True
    """Whether groups are classified, by the first rows of participants."""
    group_columns: ClassVar[tuple[str, ...]] = ()
    """Columns of groups that come before the others of the settings."""
    reason: ClassVar[str] = "later-session"
    """Of sessions that are not compared."""
    sd: ClassVar[str] = "the residual standard deviation"
    """Divisor of Cohen's d."""

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        return ""

    @property
    def later(self) -> str:
        """The session from which the first one is subtracted; empty without differences."""
        return ""

    @property
    def subject(self) -> str:
        """To what models are fitted, if not to the maps as they are."""
        return ""

    def record(self) -> dict[str, Any]:
        """Return the entries of the record."""
        return {"longitudinal": self.is_repeated, "endpoint": (), "pair": None}

    def excludes(self) -> Mapping[str, Sequence[str]]:
        """Return flags, and the flags beside which they are refused."""
        return {}

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        """Choose rows of a table of visits, and return why each is excluded if it is."""
        message = "the first session of each participant is analyzed"
        return ~table[PARTICIPANT].duplicated().to_numpy(), pd.Series(message, index=table.index)

    def with_visits(self, time: VisitTime, settings: GroupSettings) -> VisitTime:
        """Add visits as categories."""
        return time

    def rows(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the rows of the model from the visits that were chosen."""
        return table

    def compare(
        self, table: pd.DataFrame, sides: Mapping[str, SideMaps], covariates: Sequence[str]
    ) -> Mapping[str, SideMaps]:
        """Return maps of the rows of the model; some of them are covariates."""
        if not covariates:
            return sides
        return {
            hemi: replace(side, covariates={name: side.covariate(name) for name in covariates})
            for hemi, side in sides.items()
        }

    def described(self, rows: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
        """Return visits, of which the first of each participant is described."""
        return rows

    def row_models(
        self, table: pd.DataFrame, time: str | None, groups: Groups | None, settings: GroupSettings
    ) -> Callable[[Design], RowModel]:
        """Return what makes the model of the rows of a design."""
        return partial(RowModel, settings=settings.glm)

    def check_default(self, table: pd.DataFrame, time: str | None, settings: GroupSettings) -> None:
        """Refuse visits that the default model cannot have."""

    def contrasts(
        self, groups: Groups | None, visits: VisitTime | None, bends: Sequence[str]
    ) -> list[str]:
        """Return contrasts of the default model: groups, and whether covariates bend."""
        return [*(groups.contrasts() if groups else ()), *bends]

    def of_visits(self, groups: Sequence[str], labels: Sequence[str]) -> list[str]:
        """Return contrasts of visits as categories, from contrasts of groups."""
        return [*groups]

    def methods(
        self, model: RowModel, fits: Sequence[PointwiseFit], settings: GroupSettings, cite: Cite
    ) -> str:
        """Return sentences of the methods on models of visits; contrasts follow."""
        return ""

    def findings(self, fits: Sequence[PointwiseFit], cite: Cite) -> str:
        """Return sentences on how participants differ in their changes, after the contrasts."""
        return ""


class AllSessions(Sessions):
    """All sessions, each a row."""

    is_repeated = True

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        """Choose all visits."""
        return np.ones(len(table), dtype=np.bool_), pd.Series("", index=table.index)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Which sessions and sides of a participant are compared; by default the first session."""

    sessions: Sessions = Sessions()
    asymmetry: bool = False
    """Also left minus right."""


@dataclass(frozen=True, kw_only=True)
class ModelRequest:
    """Which model; all empty is the default."""

    file: Path | None = None
    """BIDS Stats Model."""
    formula: str | None = None
    contrasts: tuple[str, ...] = ()
    references: tuple[tuple[str, str], ...] = ()
    """Reference level by factor."""
    name: str | None = None
    """Folder of the results; else made from the formula."""


def wanted_measures(request: ModelRequest, options: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the measures that are asked for, by option or on the left of a formula."""
    if request.file is not None:
        left = formulas.parse_model(files.read_json(request.file)).measures
    else:
        left = formulas.left_side(request.formula or "")
    if options and left and set(options) != set(left):
        raise UsageError(
            f"--measures {' '.join(options)} and {' + '.join(left)} ~ in the formula differ; give"
            " one"
        )
    return options or left


def covariate_maps(request: ModelRequest) -> tuple[str, ...]:
    """Names of maps that are covariates at each point."""
    if request.file is not None:
        return formulas.parse_model(files.read_json(request.file)).maps
    return formulas.split_maps(request.formula or "")[1]


def choose_model(
    request: ModelRequest,
    table: pd.DataFrame,
    settings: GroupSettings,
    *,
    comparison: Comparison | None = None,
    visits: VisitTime | None = None,
    summaries: Collection[str] = (),
) -> tuple[Mapping[str, Any], formulas.ModelSpec, Groups | None, dict[str, str]]:
    """Return the model as a BIDS Stats Model and read, the groups, and reference levels.

    Terms that are no columns of the table may be summary measures of each hemisphere.
    The request names reference levels; the design chooses the others by the rule of
    ``find_groups``.
    """
    references = _requested_references(request)
    # The groups of tables and figures are those of the formula, if it has any.
    in_formula = {name.casefold() for name in closed_formula(_requested_formula(request)).names}
    in_formula.intersection_update(map(str.casefold, settings.model.group_columns))
    preferred = list(in_formula) or (comparison or Comparison()).sessions.group_columns
    groups = find_groups(table, settings, preferred=preferred)
    if groups is not None and groups.column in references:
        groups = find_groups(table, settings, references[groups.column], preferred=preferred)
    document = model_document(
        request, table, groups, settings, comparison=comparison, visits=visits
    )
    columns = set(map(str, table.columns))
    model = formulas.parse_model(document, set(summaries) - columns)
    if visits is not None and visits.labels and VISIT in closed_formula(model.formula).names:
        references[VISIT] = visits.labels[0]
    return document, model, groups, references


def _requested_references(request: ModelRequest) -> dict[str, str]:
    """Return reference levels of options and of codings in the formula; they must not differ."""
    references = dict(request.references)
    for factor, level in closed_formula(_requested_formula(request)).references:
        if references.setdefault(factor, level) != level:
            problem = f"--reference {factor}={references[factor]}, but the formula has"
            raise UsageError(f"{problem} contr.treatment({level!r}); give one")
    return references


def _requested_formula(request: ModelRequest) -> str:
    """Return the right-hand side of the formula of a request; ``1`` without any."""
    if request.file is not None:
        return formulas.parse_model(files.read_json(request.file)).formula
    return formulas.split_maps(request.formula or "1")[0]


def model_document(
    request: ModelRequest,
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    comparison: Comparison | None = None,
    visits: VisitTime | None = None,
) -> Mapping[str, Any]:
    """Give the model as a BIDS Stats Model."""
    comparison = comparison or Comparison()
    if request.file is not None:
        if request.formula or request.contrasts:
            raise UsageError("give --model or --formula, not both")
        return files.read_json(request.file)
    if request.formula is not None:
        if not request.formula.rpartition("~")[2].strip():
            raise UsageError("--formula is empty; write it as group + age")
        formula = request.formula
        contrasts = list(request.contrasts) or _formula_contrasts(
            formula, groups, comparison.sessions, visits
        )
        return formulas.model_from_shortcut(
            formula, contrasts, request.name or folder_name(formula)
        )
    formula, contrasts = _default_model(
        table, groups, settings, comparison=comparison, visits=visits
    )
    contrasts = list(request.contrasts) or contrasts
    return formulas.model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


def _default_model(
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    comparison: Comparison,
    visits: VisitTime | None,
) -> tuple[str, list[str]]:
    """Return formula and contrasts; ModelError without groups or changes to test."""
    sessions = comparison.sessions
    if groups is None and not (sessions.has_changes or comparison.asymmetry):
        raise _no_groups(table, settings.model.group_columns)
    time = visits.column if visits else None
    sessions.check_default(table, time, settings)
    covariates = visits.covariates if visits else settings.model.covariates
    formula = default_formula(table, groups, settings, covariates=covariates, time=time)
    bent = [name for name in closed_formula(formula).names if name.casefold() in AGES]
    bent = [] if settings.model.age == "linear" else bent
    bends = [f"{name} nonlinear = {NONLINEAR}({name})" for name in bent]
    return formula, sessions.contrasts(groups, visits, bends)


def _no_groups(table: pd.DataFrame, group_columns: Sequence[str]) -> ModelError:
    """Say why no groups can be compared."""
    columns = [str(name) for name in table.columns if name not in {PARTICIPANT, SESSION}]
    available = (
        f"there are {formulas.listed(columns)}; give another question, such as"
        ' --formula "age + sex" --contrast age'
        if columns
        else "BIDS_DIR/participants.tsv is missing or has no further columns; add one, or"
        " --covariates"
    )
    spelled = {*map(str.casefold, group_columns)}
    for name in columns:
        if name.casefold() in spelled and table[name].nunique() == 1:  # noqa: PD101 (missing are none)
            level = table[name].dropna().iloc[0]
            available = f"{name} is {level} for all in the analysis; see --seg and --exclude"
    return ModelError(f"no column has two groups ({', '.join(group_columns)}); {available}")


def _formula_contrasts(
    formula: str, groups: Groups | None, sessions: Sessions, visits: VisitTime | None
) -> list[str]:
    """Contrasts of a formula that a user wrote without any."""
    plain, maps = formulas.split_maps(formula)
    if groups is not None and groups.column not in plain:
        groups = None
    if visits is not None and visits.labels and VISIT in closed_formula(plain).names:
        return sessions.of_visits(groups.contrasts() if groups else [], visits.labels)
    if groups is None:
        return []
    terms = (f"map({name})" for name in maps)
    return [*groups.contrasts(), *formulas.interactions(plain), *terms]


def asymmetry_name(measure: str) -> str:
    """Name of the map of left minus right."""
    return f"{measure}_asymmetry"
