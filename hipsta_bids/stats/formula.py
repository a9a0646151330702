"""What is fitted and tested, by BIDS Stats Models 1.0.0 or a formula, and the variables of it."""

import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError, did_you_mean
from hipsta_bids.stats import contrasts as texts
from hipsta_bids.stats.contrasts import ContrastSpec, contrast_json, refusal
from hipsta_bids.stats.grammar import CONTEXT, closed_formula, split_random, term_text
from hipsta_bids.stats.references import Reference, choose_reference
from hipsta_bids.stats.settings import DefaultModelSettings, DesignSettings
from hipsta_bids.types import MISSING, Float, Int64

#: A column with text is taken for a damaged number if more of it than this is numbers.
NUMERIC_SHARE = 0.5
#: A note names other columns of three to this many different numbers, fitted as a line.
FEW_VALUES = 5


#: A map as a covariate, with the sign before it.
_MAP = re.compile(r"\+\s*map\(\s*(\w+)\s*\)(?=\s*(?:\+|$))")

#: Numbers from here on overflow when they are squared and summed.
_LARGEST = 1e100
#: Name of the constant.
INTERCEPT = "Intercept"
#: Rows that a message names.
_NAMED = 8
#: Codes for missing values that may be values.
_SMALL_CODES = (-4.0, -1.0)
#: Two values are the same on a line and as a factor.
_LEAST_LINE = 3

#: Whole numbers as spreadsheets may write them, and dates.
_WHOLE = re.compile(r"(-?\d+)\.0+")
_DATE = re.compile(r"\d{4}-\d{1,2}-\d{1,2}\b.*|\d{1,2}[./]\d{1,2}[./]\d{2,4}")


@dataclass(frozen=True)
class ModelSpec:
    """One linear model."""

    name: str
    formula: str
    """Right-hand side, in formulaic's grammar."""
    contrasts: tuple[ContrastSpec, ...]
    dummy: str | None
    """Also test each column by itself, with this test."""
    measures: tuple[str, ...] = ()
    """Left-hand side: what the model is fitted to; empty for the default."""
    maps: tuple[str, ...] = ()
    """Maps that are covariates at each point, as ``map(curvature)`` in the formula."""
    summaries: tuple[str, ...] = ()
    """Summary measures that are covariates of each hemisphere, as ``volume`` in the formula."""
    random: str = ""
    """Column whose levels have random intercepts, as ``(1|site)`` in the formula."""

    @property
    def added(self) -> tuple[str, ...]:
        """Names of covariates that are measures of each hemisphere."""
        return (*self.maps, *self.summaries)

    @property
    def added_terms(self) -> tuple[str, ...]:
        """The terms of these covariates, which contrasts can name."""
        return (*(f"map({name})" for name in self.maps), *self.summaries)

    @property
    def random_term(self) -> str:
        """``(1|site)``, or empty."""
        name = self.random if self.random.isidentifier() else f"`{self.random}`"
        return f"(1|{name})" if self.random else ""

    @property
    def text(self) -> str:
        """Right-hand side with covariates of each hemisphere and the random intercept."""
        return " + ".join(filter(None, [self.formula, *self.added_terms, self.random_term]))


def model_from_shortcut(formula: str, contrasts: Sequence[str], name: str) -> dict[str, Any]:
    """Write the BIDS Stats Model of a formula and contrasts."""
    node: dict[str, Any] = {
        "Level": "Dataset",
        "Name": name,
        "GroupBy": ["contrast"],
        "Model": {"Type": "glm", "X": [1], "Formula": formula},
    }
    if contrasts:
        node["Contrasts"] = [contrast_json(text) for text in contrasts]
    else:
        node["DummyContrasts"] = {"Test": "t"}
    return {"Name": name, "BIDSModelVersion": texts.VERSION, "Nodes": [node]}


def parse_model(document: Mapping[str, Any], summaries: Collection[str] = ()) -> ModelSpec:
    """Read a BIDS Stats Model: one node at dataset level, with ``Model.X`` or ``Model.Formula``.

    Terms that are names of ``summaries`` are covariates of each hemisphere.
    """
    node, model = _node(document)
    dummy = node.get("DummyContrasts")
    formula, maps = split_maps(_formula(model))
    formula, of_hemispheres = _split_summaries(formula, summaries)
    return ModelSpec(
        name=str(node.get("Name") or document.get("Name") or "model"),
        formula=formula,
        maps=maps,
        summaries=of_hemispheres,
        random=split_random(_formula(model))[1],
        measures=left_side(str(model.get("Formula") or "")),
        contrasts=_contrasts(node.get("Contrasts", [])),
        dummy=str(dummy.get("Test", "t")) if isinstance(dummy, Mapping) else None,
    )


def _node(document: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the only node and its model."""
    nodes = document.get("Nodes")
    if not isinstance(nodes, list) or len(nodes) != 1 or not isinstance(nodes[0], Mapping):
        raise refusal("needs exactly one node, at dataset level")
    node = nodes[0]
    if str(node.get("Level", "")).lower() != "dataset":
        raise refusal(f"has a node at level {node.get('Level')!r}; only Dataset is supported")
    if node.get("Transformations"):
        raise refusal("has transformations; write them into the formula instead, as log(age)")
    model = node.get("Model")
    if not isinstance(model, Mapping) or str(model.get("Type", "glm")).lower() != "glm":
        raise refusal("needs a Model of Type glm")
    return node, model


def _contrasts(contrasts: object) -> tuple[texts.ContrastSpec, ...]:
    """Read contrasts; their names and the labels of their files have to differ."""
    if not isinstance(contrasts, list):
        raise refusal("has Contrasts that are no list")
    specs = tuple(map(texts.parse_contrast, contrasts))
    check_labels([spec.name for spec in specs])
    return specs


def check_labels(names: Sequence[str]) -> None:
    """Refuse contrasts of one name, or whose files would have one name."""
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise refusal(f"has contrasts of the same name: {', '.join(repeated)}")
    labels = list(map(file_label, names))
    if alike := [name for name in names if labels.count(file_label(name)) > 1]:
        raise refusal(
            f"has contrasts whose files would have one name: {listed(alike)}; give one"
            " a name, as other=group[A]:age"
        )


def split_maps(formula: str) -> tuple[str, tuple[str, ...]]:
    """Take the terms ``map(NAME)`` out of the right-hand side of a formula, and list the maps.

    A random intercept is taken out, too.
    """
    right = split_random(formula)[0].rpartition("~")[2]
    names = tuple(dict.fromkeys(_MAP.findall(f"+{right}")))
    plain = _MAP.sub(" ", f"+{right}")
    if re.search(r"(?<![\w.])map\s*\(", plain):
        raise ModelError(
            f"formula {right.strip()!r}: add map(NAME) to other terms, as group + map(curvature)"
        )
    return re.sub(r"^[\s+]+", "", plain).strip() or "1", names


def _split_summaries(formula: str, summaries: Collection[str]) -> tuple[str, tuple[str, ...]]:
    """Take the terms that are summary measures out of a right-hand side, and list them."""
    names = tuple(name for name in closed_formula(formula).names if name in summaries)
    plain = f"+{formula}"
    for name in names:
        plain = re.sub(rf"\+\s*{re.escape(name)}\s*(?=\+|$)", " ", plain)
    plain = re.sub(r"^[\s+]+", "", plain).strip() or "1"
    if inside := [name for name in closed_formula(plain).names if name in summaries]:
        raise ModelError(
            f"formula {formula!r}: {inside[0]} is a summary measure; add it to other terms, as"
            f" group + {inside[0]}"
        )
    return plain, names


def left_side(formula: str) -> tuple[str, ...]:
    """Names on the left of the tilde, as in ``thickness + curvature ~ group``."""
    left, tilde, right = formula.partition("~")
    if not tilde or not left.strip():
        return ()
    names = tuple(dict.fromkeys(name.strip() for name in left.split("+")))
    if "~" in right or not all(name.isidentifier() for name in names):
        raise ModelError(
            f"formula {formula!r}: on the left of ~ stand names of measures, joined by +, as"
            " thickness + curvature"
        )
    return names


def _formula(model: Mapping[str, Any]) -> str:
    if text := model.get("Formula"):
        return str(text).rpartition("~")[2].strip()
    terms = model.get("X")
    if not isinstance(terms, list) or not terms:
        raise refusal("needs Model.X or Model.Formula")
    names = [str(term) for term in terms if str(term) != "1"]
    if bad := [name for name in names if not re.fullmatch(r"[\w.*: ]+", name)]:
        raise refusal(f"has {bad[0]!r} in X; use names of columns, or a Formula")
    return " + ".join(["1" if len(names) < len(terms) else "0", *names])


#: Sign of a one-sided test in the name of a contrast, and the sign of its margin.
_MARGIN = re.compile(r"\s([<>])\s(-?)(?=[\d.]+(?:e[-+]?\d+)?(?:\s\||$))")


def file_label(text: str) -> str:
    """Write a name in ASCII letters and digits, as BIDS has it; other scripts as ``u5973``."""
    words = {">": "above", "<": "below", "-": "minus", "": ""}
    text = _MARGIN.sub(lambda side: f" {words[side[1]]} {words[side[2]]} ", text)
    words_of_name = ascii_letters(text.replace("+", " plus ")).split()
    return "".join(word[:1].upper() + word[1:] for word in words_of_name)


def ascii_letters(text: str, filler: str = " ") -> str:
    """Write a text in ASCII letters and digits, other scripts as ``u5973``; signs are filled."""
    letters = unicodedata.normalize("NFKD", text)
    plain = "".join(c if c.isascii() else f"u{ord(c):x}" * c.isalpha() for c in letters)
    return re.sub(r"[^A-Za-z0-9]", filler, plain)


def folder_name(formula: str, measures: tuple[str, ...] = ()) -> str:
    """Spell measures and a formula as the name of a folder; products must not look like sums."""
    right = formula.rpartition("~")[2].replace("*", " x ").replace(":", " by ")
    right = right.replace(" - ", " without ")
    words = "-".join(ascii_letters(right).split()) or "model"
    return "_".join(part for part in ("-".join(measures), words) if part)


def check_names(names: Iterable[str], columns: pd.Index) -> None:
    """Refuse names that the table does not have."""
    available = [str(column) for column in columns]
    for name in names:
        if name not in available:
            hint = did_you_mean([name], available) or f"; the table has {listed(available)}"
            raise ModelError(f"model: the table has no column {name!r}{hint}")


def with_factors(
    table: pd.DataFrame, design: DesignSettings, model: DefaultModelSettings
) -> pd.DataFrame:
    """Make factors, of pandas' type, of the columns that are some by their name."""
    factor_names = (*design.factors, *model.group_columns)
    names = {name.casefold() for name in factor_names}
    factors = [
        column
        for column in table.columns
        if str(column).casefold() in names
        and not isinstance(table[column].dtype, pd.CategoricalDtype)
    ]
    return table.assign(**{str(column): as_factor(table[column]) for column in factors})


def as_factor(values: pd.Series) -> pd.Series:
    """Take values for names, whatever they look like; ``1.0`` is ``1``."""
    if pd.api.types.is_bool_dtype(values):
        return values.map({True: "yes", False: "no"}).astype("category")
    text = values.astype(object).where(values.notna(), None)
    text = text.map(lambda value: None if value is None else level_name(value))
    return text.astype("category")


def level_name(value: object) -> str:
    """Write a level of a factor."""
    text = str(value).strip()
    whole = _WHOLE.fullmatch(text)
    return whole[1] if whole else text


def typed(values: pd.Series) -> pd.Series:
    """Return numbers as floats, text and factors as text, and missing cells as missing."""
    if isinstance(values.dtype, pd.CategoricalDtype):
        return values.astype(object).where(values.notna(), None)
    if pd.api.types.is_bool_dtype(values):
        return values.map({True: "yes", False: "no"}).astype(object)
    if pd.api.types.is_numeric_dtype(values):
        numbers = values.astype(np.float64)
        return numbers.where(np.isfinite(numbers))
    text = values.astype(object).where(values.notna(), None)
    text = text.map(lambda value: None if value is None else str(value).strip())
    text = text.where(~text.isin([MISSING, ""]), None)
    present = text.notna()
    ascii_text = text.replace("^\u2212", "-", regex=True)  # minus of print
    numbers = pd.to_numeric(ascii_text, errors="coerce").astype(np.float64)
    if present.any() and numbers[present].notna().all():
        too_large = present & ~(numbers.abs() < _LARGEST)
        if too_large.any():
            raise ModelError(
                f"model: column {values.name!r} holds numbers that are too large for rows"
                f" {listed(values.index[too_large])}; correct them, or mark them n/a"
            )
        return numbers
    if numbers[present].notna().mean() > NUMERIC_SHARE:
        bad = present & numbers.isna()
        raise ModelError(
            f"model: column {values.name!r} holds numbers but for rows {cells(text[bad])};"
            " correct them, or mark them n/a"
        )
    _refuse_spellings(text[present])
    return text


def level_labels(values: pd.Series) -> pd.Series:
    """Names of levels, whatever they look like; ``None`` where missing."""
    names = typed(values).astype(object)
    texts = names.map(lambda value: f"{value:g}" if isinstance(value, float) else str(value))
    return texts.where(names.notna(), None)


def columns_of(
    table: pd.DataFrame, formula: str, levels: Mapping[str, Sequence[str]], source: str
) -> tuple[Float, tuple[str, ...], Int64]:
    """Make columns of a formula with given levels, without intercept; and rows that have all."""
    closed = closed_formula(formula)
    names = sorted(closed.names)
    if not names:
        return np.empty((len(table), 0)), (), np.arange(len(table))
    check_names(names, table.columns)
    variables = pd.DataFrame(
        {n: level_labels(table[n]) if n in levels else typed(table[n]) for n in names}
    )
    complete = variables.notna().all(axis=1).to_numpy()
    variables = variables[complete].copy()
    for name, levels_of in levels.items():
        if unknown := sorted(set(variables[name]) - set(levels_of)):
            raise ModelError(
                f"{source}has no {name!r} {listed(unknown)}, only {listed(levels_of)}; "
                "exclude these participants, or harmonize anew"
            )
        variables[name] = pd.Categorical(variables[name], categories=list(levels_of))
    if text := sorted({*names} - {*levels, *variables.select_dtypes("number")}):
        raise ModelError(f"{source}{listed(text)} should be numbers, as where it was made")
    matrix = Formula(closed.text).get_model_matrix(
        variables, na_action="raise", context=dict(CONTEXT)
    )
    inside = [str(name) for name in matrix.columns if str(name) != INTERCEPT]
    return matrix[inside].to_numpy(np.float64), tuple(inside), np.flatnonzero(complete)


def _refuse_spellings(text: pd.Series) -> None:
    """Refuse what is meant for numbers but is not written so: decimal commas, and dates."""
    points = pd.to_numeric(text.str.replace(",", ".", n=1, regex=False), errors="coerce")
    for written, problem, remedy in (
        (points.notna(), "decimal commas", "write 70.5 for 70,5"),
        (text.str.fullmatch(_DATE), "dates", "give years or days, as numbers"),
    ):
        if len(text) and written.mean() > NUMERIC_SHARE:
            raise ModelError(
                f"model: column {text.name!r} holds {problem}, as {cells(text[written][:1])};"
                f" {remedy}"
            )


def check_numbers(values: pd.Series, settings: DesignSettings) -> None:
    """Refuse codes for missing values, far from all other values, and impossible values."""
    present = values[values.notna()]
    codes = present.isin(settings.missing_codes)
    values_left = present[~codes]
    if codes.any() and len(values_left):
        low, high = float(values_left.min()), float(values_left.max())
        gap = np.maximum(low - present, present - high)
        far = codes & (gap > high - low)
        if far.any():
            raise ModelError(
                f"model: {values.name!r} has {cells(present[far])}, other values are {low:g} "
                f"to {high:g}; mark missing codes n/a (or design.missing_codes)"
            )
    if not len(present):
        return
    _refuse_small_codes(values.name, present)
    quartiles = np.quantile(present, [0.25, 0.5, 0.75])
    reach = settings.farthest * (quartiles[2] - quartiles[0])
    far = (present - quartiles[1]).abs() > reach
    if reach > 0 and far.any():
        raise ModelError(
            f"model: {values.name!r} has {cells(present[far])}, half of the others "
            f"{quartiles[0]:.4g} to {quartiles[2]:.4g}; correct them, or mark them n/a"
        )


def _refuse_small_codes(name: object, present: pd.Series) -> None:
    """Refuse -1 and -4, which ADNI has for missing values, where other values are far above zero.

    Far is more than the range of the middle half of the values, so that changes may be -1.
    """
    coded = present[present.isin(_SMALL_CODES)]
    values_left = present[~present.isin(_SMALL_CODES)]
    if not len(coded) or not len(values_left) or values_left.min() <= 0:
        return
    first, last = np.quantile(values_left, [0.25, 0.75])
    if float(values_left.min()) - float(coded.max()) > last - first:
        counts = ", ".join(
            f"{code:g} ({n})" for code, n in coded.value_counts().sort_index().items()
        )
        raise ModelError(
            f"model: {name!r} has {counts}, other values are from {values_left.min():g}; missing?"
            f' write "MissingValues" of {name} in participants.json, or n/a'
        )


def cells(values: pd.Series) -> str:
    """List rows with what stands in them."""
    texts = [f"{value:g}" if isinstance(value, float) else repr(value) for value in values]
    return listed(f"{row} ({cell})" for row, cell in zip(values.index, texts, strict=True))


#: Columns whose levels begin with other letters.
_SEXES = {"sex", "gender"}


def check_spelling(levels: Mapping[str, int], name: str) -> None:
    """Refuse levels of a factor that differ in case or blanks only.

    The user has to choose between them: merged silently, a typing error would pass.
    """
    spellings: dict[str, list[str]] = {}
    size = 1 if name.casefold() in _SEXES else None  # F and Female
    for level in levels:
        spellings.setdefault("".join(level.split()).casefold()[:size], []).append(level)
    for variants in spellings.values():
        if len(variants) > 1:
            words = ", ".join(f"{level!r} ({levels[level]})" for level in sorted(variants))
            fault = "are several spellings" if size else "differ in capitals or blanks only"
            raise ModelError(f"model: levels of {name!r} {fault}: {words}; write them alike")


def coding_note(values: pd.Series) -> str | None:
    """Note that few different numbers are fitted as a line, as perhaps they should not."""
    codes = sorted(values.unique())
    if not _LEAST_LINE <= len(codes) <= FEW_VALUES:
        return None
    return (
        f"{values.name} has {len(codes)} values ({', '.join(f'{x:g}' for x in codes)}), "
        f"fitted as a line; for codes write C({values.name}), or Levels in participants.json"
    )


def rows_by_lack(
    variables: pd.DataFrame, complete: NDArray[np.bool_]
) -> dict[str, tuple[str, ...]]:
    """Group incomplete rows by the first variable that they lack."""
    result: dict[str, list[str]] = {}
    lacking = variables.isna().to_numpy()
    for row in np.flatnonzero(~complete).tolist():
        name = str(variables.columns[int(np.argmax(lacking[row]))])
        result.setdefault(name, []).append(str(variables.index[row]))
    return {name: tuple(rows) for name, rows in result.items()}


def check_left(variables: pd.DataFrame, dropped: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse a model that leaves no row, with the missing variables."""
    if not len(variables):
        lack = ", ".join(f"{name} ({len(rows)})" for name, rows in dropped.items())
        reason = f"; missing are {lack}" if lack else ""
        raise ModelError(f"model: no row has all variables{reason}")


def set_levels(
    variables: pd.DataFrame,
    references: Mapping[str, str],
    settings: DesignSettings,
    declared: Mapping[str, Sequence[str]],
) -> tuple[dict[str, list[str]], dict[str, Reference]]:
    """Make factors of text columns in place; also return why each has its reference."""
    levels, choices = {}, {}
    for column in variables.columns:
        name = str(column)
        if pd.api.types.is_numeric_dtype(variables[name]):
            check_numbers(variables[name], settings)
            numbers = variables[name].to_numpy(dtype=np.float64)
            if numbers.min() == numbers.max():
                raise ModelError(
                    f"model: {name!r} is {numbers[0]:g} in all {len(numbers)} complete rows; "
                    "remove it"
                )
        else:
            levels[name] = _levels(variables[name], name, settings)
            choices[name] = choose_reference(
                levels[name],
                settings.reference_levels,
                requested=references.get(name),
                declared=declared.get(name, ()),
            )
            first = choices[name].level
            if first not in levels[name]:
                raise ModelError(
                    f"model: {name!r} has no level {first!r} in the complete rows, only"
                    f" {listed(levels[name])}"
                )
            levels[name].remove(first)
            levels[name].insert(0, first)
            variables[name] = pd.Categorical(variables[name], categories=levels[name])
    if unknown := sorted(set(references) - set(levels)):
        raise ModelError(
            f"model: reference level given for {listed(unknown)}, which is no factor of the model;"
            f" its factors: {listed(levels) or 'none'}{did_you_mean(unknown, levels)}"
        )
    return levels, choices


def _levels(values: pd.Series, name: str, settings: DesignSettings) -> list[str]:
    """Return the levels of a factor in their order, or refuse them."""
    counts = {str(level): int(count) for level, count in values.value_counts().items()}
    check_spelling(counts, name)
    levels = sorted(counts, key=in_order)
    numbers = pd.to_numeric(pd.Series(levels), errors="coerce")
    codes = [level for level, n in zip(levels, numbers, strict=True) if n in settings.missing_codes]
    if codes and numbers.isna().any():
        raise ModelError(
            f"model: column {name!r} has {', '.join(f'{code} ({counts[code]})' for code in codes)}"
            " among words: a code for missing values? mark them n/a (or change the setting"
            " design.missing_codes)"
        )
    if len(levels) == 1:
        raise ModelError(
            f"model: all {len(values)} complete rows have {name!r} {levels[0]}; remove it"
        )
    small = [f"{level} ({counts[level]})" for level in levels if counts[level] < settings.min_level]
    if small:
        raise ModelError(
            f"model: too few complete rows in {name!r}: {listed(small)}; at least"
            f" {settings.min_level} are needed; merge levels or remove {name}"
        )
    return levels


def declared_levels(values: pd.Series) -> list[str]:
    """Return the levels of a factor in the order of its description; empty without one."""
    kind = values.dtype
    is_declared = isinstance(kind, pd.CategoricalDtype) and kind.ordered
    return [str(level) for level in values.cat.categories] if is_declared else []


def in_order(level: str) -> tuple[float, str]:
    """Sort levels as numbers where they are some, before names."""
    try:
        return float(level), level
    except ValueError:
        return np.inf, level


def listed(items: Iterable[object], limit: int = _NAMED) -> str:
    """Join names for a message, not too many."""
    texts = [str(item) for item in items]
    ending = f" and {len(texts) - limit} more" if len(texts) > limit else ""
    return ", ".join(texts[:limit]) + ending


def interactions(formula: str) -> list[str]:
    """List the interactions of a formula by their variables, as contrasts."""
    closed = closed_formula(formula.rpartition("~")[2])
    try:
        terms = list(Formula(closed.text))
    except Exception:  # noqa: BLE001  (formulaic raises all kinds; the design refuses it, with words)
        return []
    variables = (closed_formula(term_text(term)).names for term in terms)
    sets = {frozenset(names): names for names in variables if len(names) > 1}
    plain = (":".join(names) for names in sets.values())
    quoted = (":".join(f"`{name}`" for name in names) for names in sets.values())
    return [
        name if all(map(str.isidentifier, name.split(":"))) else f"{name} = {text}"
        for name, text in zip(plain, quoted, strict=True)
    ]
