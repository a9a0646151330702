"""Which model the group level fits: the user's, or the paper's."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.bids import files
from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.comparison import Comparison
from hipsta_bids.group.default_model import (
    Groups,
    default_contrasts,
    default_formula,
    find_groups,
)
from hipsta_bids.group.model_spec import left_side, model_from_shortcut, parse_model
from hipsta_bids.group.visit_time import VisitTime
from hipsta_bids.group_settings import GroupSettings


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


def wanted_measures(request: ModelRequest, listed: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the measures that are asked for, by option or on the left of a formula.

    Parameters
    ----------
    request : ModelRequest
    listed : tuple of str
        Those of the option.

    Returns
    -------
    tuple of str
        Empty for the default.

    Raises
    ------
    UsageError
        If both ask for different ones.
    ModelError
        If the left-hand side cannot be read.
    """
    if request.file is not None:
        left = parse_model(files.read_json(request.file)).measures
    else:
        left = left_side(request.formula or "")
    if listed and left and set(listed) != set(left):
        raise UsageError(
            f"--measures {' '.join(listed)} and {' + '.join(left)} ~ in the formula differ; give"
            " one",
            reason="usage",
        )
    return listed or left


def choose_references(
    request: ModelRequest, table: pd.DataFrame, settings: GroupSettings
) -> tuple[dict[str, str], Groups | None]:
    """Take reference levels that the user gave; that of the groups reorders them.

    Raises
    ------
    ModelError
        If nobody has the reference level of the groups.
    """
    references = dict(request.references)
    groups = find_groups(table, settings)
    if groups is not None and groups.column in references:
        groups = find_groups(table, settings, references[groups.column])
    return references, groups


def model_document(
    request: ModelRequest,
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    comparison: Comparison | None = None,
    visits: VisitTime | None = None,
) -> Mapping[str, Any]:
    """Give the model as a BIDS Stats Model.

    Parameters
    ----------
    request : ModelRequest
    table : DataFrame
        Covariates.
    groups : Groups or None
        From :func:`choose_references`.
    settings : GroupSettings
    comparison : Comparison, optional
        Changes and asymmetries can be tested without groups.
    visits : VisitTime, optional
        Of a longitudinal model: its default has time, and its products with groups.

    Raises
    ------
    UsageError
        If two models are asked for.
    ModelError
        If none is, and the table does not allow for the default one.
    """
    if request.file is not None:
        if request.formula or request.contrasts:
            raise UsageError("give --model or --formula, not both", reason="usage")
        return files.read_json(request.file)
    if request.formula is not None:
        if not request.formula.rpartition("~")[2].strip():
            raise UsageError("--formula is empty; write it as group + age", reason="usage")
        formula = request.formula
        contrasts = list(request.contrasts)
        if not contrasts and groups is not None and groups.column in formula:
            contrasts = groups.contrasts()
        return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))
    comparison = comparison or Comparison()
    within = comparison.longitudinal or comparison.pair or comparison.asymmetry
    if groups is None and not within:
        raise ModelError(
            "participants.tsv has no column that tells groups"
            f" ({', '.join(settings.model.group_columns)}) with two levels; give a model by"
            ' --formula "age + sex" --contrast age',
            reason="no-groups",
        )
    time = visits.column if visits else None
    if comparison.longitudinal and time is None:
        raise ModelError(
            "the default longitudinal model needs the time of each session: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv",
            reason="no-time",
        )
    covariates = visits.covariates if visits else settings.model.covariates
    formula = default_formula(table, groups, settings, covariates=covariates, time=time)
    contrasts = list(request.contrasts) or default_contrasts(groups, time)
    return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


def folder_name(formula: str, measures: tuple[str, ...] = ()) -> str:
    """Spell measures and a formula as the name of a folder; products must not look like sums."""
    right = formula.rpartition("~")[2].replace("*", " x ").replace(":", " by ")
    right = right.replace(" - ", " without ")
    words = "".join(c if c.isalnum() else " " for c in right).split()
    return "_".join(part for part in ("-".join(measures), "-".join(words) or "model") if part)
