"""Tables of a group page: participants, model, summary measures, classification, w-scores."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.reports.group_findings import (
    effect_name,
    place_words,
    point_of,
    summary_side,
)
from hipsta_bids.reports.group_results import (
    SIDES,
    GroupResults,
    number_text,
    p_text,
    records,
    spelled,
    statistic_text,
    unit_of,
)

_MOST_ROWS = 200  # of lists, so that pages stay small
_IDS = ("participant_id", "session_id")
_APART = 2.0  # w-scores beyond are listed: about one in twenty of the reference


def peaks(results: GroupResults) -> Mapping[str, Any] | None:
    """List clusters with their peaks, and the strongest point of maps without."""
    table = results.everywhere("peaks")
    if not len(table):
        return None
    files = results.table("maps").set_index(["measure", "contrast", "hemi"])["file"]
    numbers = table.groupby(["measure", "contrast", "hemi"]).cumcount() + 1
    rows = []
    for number, row in zip(numbers, records(table), strict=True):
        points = results.table(files[row["measure"], row["contrast"], row["hemi"]])
        here = point_of(row, points)
        rows.append(
            {
                "number": int(number) if row["extent"] > 0 else "",
                "measure": spelled(row["measure"]),
                "contrast": row["contrast"],
                "side": SIDES.get(row["hemi"], row["hemi"]),
                "place": place_words(row),
                "extent": int(row["extent"]),
                "shares": row["shares"] if isinstance(row["shares"], str) else "",
                "estimate": number_text(np.nan if here is None else here["estimate"]),
                "statistic": statistic_text(row),
                "p": p_text(row["p"]),
                "adjusted": p_text(row["p_corrected"]),
                "effect": effect_text(row),
            }
        )
    return {"rows": rows[:_MOST_ROWS], "more": max(0, len(rows) - _MOST_ROWS)}


def effect_text(row: Any) -> str:  # noqa: ANN401  (a row of pandas)
    """Spell an effect size with its limits."""
    limits = f"{number_text(row['effect_low'])} to {number_text(row['effect_high'])}"
    return f"{effect_name(row['effect'])} {number_text(row['effect_size'])} ({limits})"


def participants(results: GroupResults) -> Mapping[str, Any]:
    """Say who is in the model, by group, and who is not, with reasons."""
    people = results.table("covariates")
    groups = results.record.get("groups") or {}
    visits = len(people)
    if len(people):
        people = people[~people[_IDS[0]].duplicated()]
    column = groups.get("column")
    levels = [level for level in results.levels if column in people]
    members = [people[people[column].astype(str) == level] for level in levels] or [people]
    excluded = results.table("excluded")
    reasons = excluded["reason"].value_counts().items() if len(excluded) else ()
    return {
        "n": len(people),
        "visits": visits,
        "hemispheres": [
            (SIDES.get(hemi, hemi), n)
            for hemi, n in (results.record.get("hemispheres") or {}).items()
        ],
        "levels": levels or ["all"],
        "counts": [len(part) for part in members],
        "rows": [
            {"title": name, "cells": [_described(part[name], people[name]) for part in members]}
            for name in _variables(results, people, column)
        ],
        "reasons": [(str(reason).replace("-", " "), n) for reason, n in reasons],
        "excluded": records(excluded.fillna("").head(_MOST_ROWS)),
        "more": max(0, len(excluded) - _MOST_ROWS),
    }


def _variables(results: GroupResults, people: pd.DataFrame, column: str | None) -> list[str]:
    """Columns that the formula names, but for the groups."""
    formula = str(results.record.get("formula", ""))
    words = set(re.findall(r"[^\W\d]\w*", formula)) | set(re.findall("`([^`]+)`", formula))
    own = [name for name in people.columns if name in words and name not in {*_IDS, column}]
    return [str(name) for name in own]


def _described(values: pd.Series, everyone: pd.Series) -> str:
    """Mean and standard deviation of numbers, counts of words."""
    if pd.api.types.is_numeric_dtype(everyone) and not pd.api.types.is_bool_dtype(everyone):
        return f"{number_text(values.mean())} ({number_text(values.std())})"
    counts = values.dropna().astype(str).value_counts().sort_index()
    return ", ".join(f"{level} {n}" for level, n in counts.items())


def summaries(results: GroupResults) -> Mapping[str, Any] | None:
    """Set tests of summary measures beside the means of the groups."""
    table = results.table("measures")
    if not len(table):
        return None
    means = results.table("descriptives")
    groups = list(means["group"].unique()) if len(means) else []
    by_group = {(r["measure"], r["hemi"], r["group"]): r for r in records(means)} if groups else {}
    rows = []
    for row in records(table.sort_values("measure", kind="stable")):
        known = [by_group.get((row["measure"], row["hemi"], group)) for group in groups]
        if not np.isfinite(row["statistic"]):
            continue
        rows.append(
            {
                "measure": spelled(row["measure"]),
                "unit": unit_of(row["unit"]),
                "side": summary_side(row["hemi"], row["measure"]),
                "contrast": row["contrast"],
                "model": row["model"],
                "n": int(row["n"]),
                "means": [
                    f"{number_text(one['mean'])} ({number_text(one['sd'])})" if one else ""
                    for one in known
                ],
                "estimate": number_text(row["estimate"]),
                "statistic": statistic_text(row),
                "p": p_text(row["p"]),
                "low": bool(row["p"] < 0.05),  # noqa: PLR2004  (emphasis only)
                "effect": effect_text(row),
            }
        )
    models = list(dict.fromkeys(row["model"] for row in rows))
    return {"groups": groups, "rows": rows, "models": models if len(models) > 1 else []}


def classification(results: GroupResults) -> Sequence[dict[str, Any]]:
    """List pairs of groups with both models."""
    table = results.table("classification")
    return [
        {
            "pair": f"{row['control']} against {row['case']}",
            "side": summary_side(row["hemi"], row["added"]),
            "base": " + ".join(spelled(name) for name in row["base"].split(" + ")),
            "added": spelled(row["added"]),
            "n": f"{row['n']} ({row['n_cases']} {row['case']})",
            "areas": [
                f"{row[f'auc_{m}']:.2f} ({row[f'auc_{m}_low']:.2f} to {row[f'auc_{m}_high']:.2f})"
                for m in ("base", "full")
            ],
            "validated": [f"{row[f'auc_{model}_cv']:.2f}" for model in ("base", "full")],
            "slope": number_text(row["calibration_slope"]),
            "brier": f"{row['brier']:.3f}",
            "ratio": f"{row['likelihood_ratio']:.2f}",
            "p": p_text(row["p"]),
            "separated": bool(row["separated"]),
        }
        for row in (records(table) if len(table) else ())
    ]


def scores(results: GroupResults) -> Mapping[str, Any] | None:
    """Say how groups stand to the reference, and who stands apart."""
    table = results.everywhere("wscores")
    if not len(table):
        return None
    level = (results.record.get("comparison") or {}).get("normative") or []
    whole = table[table["region"].isna() | (table["region"] == "all")]
    return {
        "reference": "=".join(str(part) for part in level),
        "rows": list(_score_rows(whole)),
        "apart": list(_apart(whole)),
        "limit": _APART,
    }


def _score_rows(table: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for (measure, hemi), rows in table.groupby(["measure", "hemi"], sort=False):
        kinds = (("reference", rows["reference"]), ("others", ~rows["reference"].astype(bool)))
        cells = []
        for _, own in kinds:
            w = rows.loc[own.astype(bool), "w"].dropna()
            beyond = f"{(w < -_APART).sum()} low, {(w > _APART).sum()} high"
            spread = f"{number_text(w.mean())} ({number_text(w.std())})"
            cells.append(f"{spread}; {beyond} of {len(w)}" if len(w) else "")
        yield {
            "measure": spelled(str(measure)),
            "side": summary_side(str(hemi), str(measure)),
            "cells": cells,
        }


def _apart(table: pd.DataFrame) -> Iterator[dict[str, str]]:
    far = table[table["w"].abs() > _APART]
    far = far.reindex(far["w"].abs().sort_values(ascending=False, kind="stable").index)
    for row in records(far.head(_MOST_ROWS)):
        session = row["session_id"] if isinstance(row["session_id"], str) else ""
        yield {
            "who": f"{row['participant_id']} {session}".strip(),
            "measure": spelled(row["measure"]),
            "side": summary_side(row["hemi"], row["measure"]),
            "w": number_text(row["w"]),
        }
