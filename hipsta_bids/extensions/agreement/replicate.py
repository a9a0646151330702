"""The published numbers of Diers et al. (2023) with the numbers of a finished analysis."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records, short_contrast
from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.agreement.columns import REPLICATE_COLUMNS
from hipsta_bids.extensions.agreement.several import open_analysis
from hipsta_bids.group.output.citations import joined
from hipsta_bids.group.output.write import write_table
from hipsta_bids.io.files import MISSING, read_tsv
from hipsta_bids.types import p_text

#: Published numbers as they are printed: one row per test, pair of classifiers, or group.
PUBLISHED = Path(__file__).with_name("replicate.tsv")
#: Groups of the paper, controls first.
GROUPS = ("CU", "MCI", "DAT")
#: Why a row has no counterpart, by the first part of its key that no measured row has.
_REASONS = (
    "no {0}.tsv: run the group command of the guide",
    "{0}.tsv has no {1}: add it to --measures or classification.added, if the labels have it",
    "{0}.tsv has no {1} of {2}: measure both hemispheres",
    "{0}.tsv has no {3}: check --contrast and --groups",
    "{0}.tsv has no model {4} ICV: check icv in participants.tsv, and --formula",
)
_TEXTS = (
    *("t {t}", "AUC {auc_base} -> {auc_full}", "p {p}", "node {node_x} {node_y}"),
    *("age {age_mean} ({age_sd})", "female {female}", "n {n}"),
)
_Numbers = dict[tuple[str, ...], dict[str, Any]]
"""By file, measure, hemisphere, contrast or group of the paper, and with or without ICV."""


def replicate(folder: Path, out: Path, groups: Sequence[str] | None = None) -> list[dict[str, str]]:
    """Write ``replicate.tsv`` of published and measured numbers, and return its rows for print.

    ``groups`` are the measured names of ``GROUPS``. Own t has the sign of the published contrast.

    Raises
    ------
    HipstaError
        If the folder has no analysis, or the analysis no published contrast.
    """
    results, own_groups = open_analysis(folder), groups or GROUPS
    numbers = _of_tests(results, _signs(results, own_groups))
    numbers |= _of_groups(results, dict(zip(own_groups, GROUPS, strict=True)))
    rows, printed = list[dict[str, Any]](), list[dict[str, str]]()
    for row in read_tsv(PUBLISHED):
        values, reason = _counterpart(row, numbers)
        rows.append(row | {f"own_{name}": v for name, v in values.items()} | {"reason": reason})
        paper = " ".join(row[name] for name in ("item", "dataset", "segmentation"))
        contrast = f"{row['contrast']} {row['hemi']}".removesuffix(" LR")
        titles = {"paper": paper, "quantity": row["quantity"], "contrast": contrast}
        titles = {name: text.removesuffix(f" {MISSING}") for name, text in titles.items()}
        printed.append({**titles, "published": _words(row), "measured": reason or _words(values)})
    content = pd.DataFrame(rows, columns=[*REPLICATE_COLUMNS])
    write_table(out, "replicate", content, meaning=REPLICATE_COLUMNS)
    return printed


def _signs(results: GroupResults, own_groups: Sequence[str]) -> dict[str, tuple[str, int]]:
    """Return the published contrast, and the sign that turns to it, by the measured contrast."""
    contrasts, signs = [*(results.record.get("contrasts") or ())], dict[str, tuple[str, int]]()
    for name, title in zip(own_groups[1:], GROUPS[1:], strict=True):
        signs[f"{own_groups[0]}-{name}"] = f"{GROUPS[0]}-{title}", 1
        signs[f"{name}-{own_groups[0]}"] = f"{GROUPS[0]}-{title}", -1
    if signs.keys().isdisjoint(map(short_contrast, contrasts)):
        raise ModelError(
            f"{results.folder}: no contrast {' or '.join([*signs][::2])}; there is"
            f" {joined(contrasts) or 'none'}; check --contrast and --groups"
        )
    return signs


def _counterpart(row: Mapping[str, str], numbers: _Numbers) -> tuple[dict[str, Any], str]:
    """Return the measured numbers of a published row, or the reason why none are there."""
    model = "with" if row["file"] == "measures" and "icv" in row["model"] else "without"
    key = row["file"], row["measure"], row["hemi"], row["contrast"], model
    lengths = range(1, len(key) + 1)
    lacking = [n for n in lengths if all(other[:n] != key[:n] for other in numbers)]
    if lacking:
        return {}, _REASONS[lacking[0] - 1].format(*key)
    return numbers[key], ""


def _of_tests(results: GroupResults, signs: Mapping[str, tuple[str, int]]) -> _Numbers:
    """Collect numbers of tests and of pairs of classifiers; of maps, of the peak of a loss."""
    numbers, record = _Numbers(), results.record
    columns = "|".join(record["settings"]["model"]["icv_columns"])
    icv = re.compile(rf"\b({columns})\b", re.IGNORECASE)
    for file in ("measures", "peaks", "classification"):
        for row in records(results.table(file)):
            if isinstance(row.get("alternative"), str):
                continue  # one-sided
            values = {"n": record["hemispheres"].get(row["hemi"]), "statistic": math.nan, **row}
            if file == "classification":
                values |= {"measure": row["added"], "model": row["base"]}
                values["contrast"] = f"{row['control']}-{row['case']}"
            contrast, sign = signs.get(short_contrast(values["contrast"]), ("", 1))
            model = "with" if file == "measures" and icv.search(row["model"]) else "without"
            key = file, values["measure"], values["hemi"], contrast, model
            values["t"] = sign * values["statistic"]
            if key not in numbers or values["t"] > numbers[key]["t"]:
                numbers[key] = values
    return numbers


def _of_groups(results: GroupResults, titles: Mapping[str, str]) -> _Numbers:
    """Collect size, age and share of women of each group."""
    numbers = _Numbers()
    for row in records(results.table("demographics")):
        key = "demographics", MISSING, MISSING, titles.get(row["group"], ""), "without"
        values, name = numbers.setdefault(key, {}), row["variable"].casefold()
        if name == "participants":
            values["n"] = row["n"]
        elif name == "age":
            values |= {"age_mean": row["mean"], "age_sd": row["sd"]}
        elif name == "sex" and str(row["level"]).casefold().startswith(("f", "w")):
            values["female"] = row["percent"] / 100
    return numbers


def _words(numbers: Mapping[str, Any]) -> str:
    """Write the numbers of a row as a paper prints them."""
    texts = []
    for text in _TEXTS:
        spelled = {name: _spelled(name, numbers.get(name)) for name in re.findall(r"{(\w+)}", text)}
        if MISSING not in spelled.values():
            texts.append(text.format_map(spelled))
    return ", ".join(texts)


def _spelled(name: str, value: str | float | None) -> str:
    if isinstance(value, str):
        return value
    if value is None or math.isnan(value):
        return MISSING
    return p_text(value).replace(" ", "") if name == "p" else f"{round(value, 2):g}"
