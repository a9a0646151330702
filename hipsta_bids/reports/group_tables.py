"""What a group page says: findings in sentences, and tables of all else that an analysis left."""

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.io import files
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.reports.display import subfield_title

#: Names of the sides in tables of maps; in those of summary measures LR may be a mean.
SIDES = {"L": "left", "R": "right", "LR": "left minus right", "both": "both sides"}
BOTH, BOTH_SIDES = "LR", "both"

#: Name of the map that tests several measures together, among those of measures.
JOINT = "joint"

MINUS = "\N{MINUS SIGN}"

_THIRD = 1 / 3
_ALPHA = 0.05  # of tests of summary measures and of models, for a word only
_MOST_ROWS = 200  # of lists, so that pages stay small
_IDS = ("participant_id", "session_id")
_CHANCE = 0.5  # area under the curve of guesses
_FAR = 2.0  # w-scores beyond are listed: about one in twenty of the reference

#: Names of tissues inside names of measures; ``CA2_3`` before ``CA2``.
_SUBFIELD = re.compile(
    f"_({'|'.join(sorted((tissue.name for tissue in Tissue), key=len, reverse=True))})(?=_|$)"
)

#: Columns that are never numbers.
_TEXT = (
    *("measure", "unit", "contrast", "hemi", "group", "subfield", "shares", "test", "effect"),
    *("file", "model", "control", "case", "base", "added", "classifier", "region"),
    *("participant_id", "session_id", "reason", "message", "site", "kind", "version", "template"),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupResults:
    """The folder of one analysis."""

    folder: Path
    record: Mapping[str, Any]
    """What was run, from ``analysis.json``."""
    _tables: dict[str, pd.DataFrame] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.folder.name

    @property
    def levels(self) -> tuple[str, ...]:
        """Groups that are compared, from least to most affected; may be empty."""
        return tuple(str(level) for level in (self.record.get("groups") or {}).get("levels", ()))

    def table(self, name: str) -> pd.DataFrame:
        """Read a table; empty if there is none."""
        if name not in self._tables:
            path = self.folder / f"{name}.tsv"
            self._tables[name] = (
                pd.read_csv(
                    path,
                    sep="\t",
                    na_values=[files.MISSING],
                    keep_default_na=False,
                    dtype=dict.fromkeys(_TEXT, str),
                    quoting=csv.QUOTE_NONE,
                )
                if path.exists()
                else pd.DataFrame()
            )
        return self._tables[name]

    def everywhere(self, name: str) -> pd.DataFrame:
        """Join a table of the sheets and those of other programs' maps."""
        others = [*((self.record.get("inputs") or {}).get("maps") or {}), JOINT]
        parts = [self.table(name), *(self.table(f"{other}_{name}") for other in others)]
        return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def read_group(folder: Path) -> GroupResults:
    """Read the record of an analysis."""
    return GroupResults(folder=folder, record=files.read_json(folder / "analysis.json"))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the rows of a table by column."""
    return [dict(zip(map(str, table.columns), row, strict=True)) for row in table.to_numpy(object)]


def display_name(measure: str) -> str:
    """Write a measure in words, with its subfield after a comma."""
    words = _SUBFIELD.sub(lambda found: f", {subfield_title(found[1])}", measure)
    return words.replace("_", " ")


def measure_title(measure: object) -> str:
    """Name a measure at the beginning of a line."""
    name = display_name(str(measure))
    return name[:1].upper() + name[1:]


def unit_of(unit: str) -> str:
    """Write a unit with superscripts; nothing for pure numbers."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def with_brackets(title: str, unit: str) -> str:
    """Append a unit to the title of a column or row."""
    return f"{title} [{unit_of(unit)}]" if unit_of(unit) else title


def with_unit(text: str, unit: str) -> str:
    """Append a unit to a number."""
    return f"{text} {unit_of(unit)}".rstrip()


def statistic_text(row: Mapping[str, Any]) -> str:
    """Write a statistic with its degrees of freedom; of F, those of the error."""
    value = number_text(row["statistic"])
    if row["test"] == "z":
        return f"z {value}"
    if row["test"] == "t":
        return f"t({row['df']:.0f}) {value}" if np.isfinite(row["df"]) else f"z {value}"
    return f"{row['test']} {value}, error df {row['df']:.0f}"


def number_text(value: float) -> str:
    """Write a number with three digits."""
    if not np.isfinite(value):
        return files.MISSING
    text = f"{value:.3g}"
    text = f"{value:.0f}" if "e+" in text else text
    return text.replace("-", MINUS)


def p_text(p: float) -> str:
    """Write a p-value."""
    if not np.isfinite(p):
        return files.MISSING
    return "< 0.001" if p < 0.001 else f"{p:.3f}"  # noqa: PLR2004  (as papers have it)


def direction(results: GroupResults, contrast: str, hemi: str, sign: float) -> str:
    """Describe what a contrast above or below zero means."""
    comparison = results.record.get("comparison") or {}
    if contrast == "mean" and hemi == BOTH:
        return "larger on the left" if sign > 0 else "larger on the right"
    if contrast == "mean" and comparison.get("pair"):
        return "with an increase" if sign > 0 else "with a decrease"
    # Contrasts as users write them, and as the default model names them: of change in time, too.
    short = re.sub(r" \((fixed|random) effects?\)$", "", contrast)
    short = re.sub(r"\w+\[([^\]]*)\]", r"\1", short).replace(" - ", "-")
    for first in results.levels:
        for second in results.levels:
            if re.fullmatch(rf"(?:.* in )?{re.escape(first)}-{re.escape(second)}", short):
                return f"larger in {first if sign > 0 else second}"
    return "positive" if sign > 0 else "negative"


def findings(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe what survived, by measure and contrast."""
    maps = results.table("maps")
    if "contrasts" not in results.record:
        return None  # nothing was compared
    cards = []
    if len(maps):
        for (measure, contrast), rows in maps.groupby(["measure", "contrast"], sort=False):
            sides = [_side(results, row) for row in records(rows)]
            cards.append(
                {
                    "title": f"{measure_title(measure)}, {contrast}",
                    "found": any(side["found"] for side in sides),
                    "sides": sides,
                }
            )
    cards.sort(key=lambda card: not card["found"])
    settings = results.record.get("settings") or {}
    multiplicity = settings.get("multiplicity") or {}
    return {
        "cards": cards,
        "tested": len(results.table("measures")) > 0,
        "summaries": list(_summaries(results)),
        "classification": list(_classification(results)),
        "method": multiplicity.get("method"),
        "alpha": multiplicity.get("alpha"),
        "joint": _joint(settings),
    }


def _joint(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Say what was tested together."""
    joint = settings.get("joint") or {}
    if not joint.get("measures"):
        return None
    names = [display_name(str(name)) for name in joint["measures"]]
    sides = ["on the left", "on the right"] if joint.get("sides") else []
    what = " and ".join(names) + (f", {' and '.join(sides)}," if sides else "")
    return {**joint, "what": what, "permutations": settings["multiplicity"]["permutations"]}


def _side(results: GroupResults, row: Mapping[str, Any]) -> dict[str, Any]:
    points = results.table(str(row["file"]))
    peaks = results.everywhere("peaks")
    same = (peaks["measure"] == row["measure"]) & (peaks["contrast"] == row["contrast"])
    own = peaks[same & (peaks["hemi"] == row["hemi"])]
    n, total = int(row["n_significant"]), int(row["n_tests"])
    title = SIDES[row["hemi"]].capitalize()
    if not len(own):
        return {"title": title, "found": False, "text": "nothing could be tested.", "peak": ""}
    if n:
        where = _where(results, row, points)
        text = f"{n} of {total} points survive ({_percent(n / total)} of the map): {where}."
        first = records(own)[int(np.argmax(own["statistic"].abs()))]
    else:
        text = f"none of {total} points survives."
        first = records(own)[0]
    return {
        "title": title,
        "found": n > 0,
        "text": text,
        "peak": f"Strongest at {_peak(results, first, points)}.",
    }


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else "less than 1%"  # noqa: PLR2004


def _where(results: GroupResults, row: Mapping[str, Any], points: pd.DataFrame) -> str:
    """Count the points in each subfield, by direction."""
    found = points[points["significant"] == True]  # noqa: E712  (may hold missing values)
    signed = "cohen_d" in points and points["cohen_d"].notna().any()
    parts = []
    for sign in (1, -1):
        own = found[np.sign(found["statistic"]) == sign]
        if not len(own):
            continue
        shares = own["subfield"].fillna("n/a").value_counts(normalize=True)
        fields = [f"{name} {share:.0%}" for name, share in shares.items() if name != "n/a"]
        words = [f"{len(own)} points"]
        if signed:
            words.append(direction(results, str(row["contrast"]), str(row["hemi"]), sign))
        parts.append(" ".join(words) + (f" ({', '.join(fields)})" if fields else ""))
    return "; ".join(parts)


def _peak(results: GroupResults, peak: Mapping[str, Any], points: pd.DataFrame) -> str:
    if peak["measure"] == JOINT:
        together = f"together corrected p {p_text(peak['p_corrected'])}"
        return f"{position_text(peak)}: {peak['measures']}; {together}"
    here = point_of(peak, points)
    what = [f"{effect_name(peak['effect'])} {number_text(peak['effect_size'])}"]
    if here is not None and np.isfinite(here["estimate"]):
        unit = map_unit(results, str(peak["measure"]))
        what.insert(0, f"estimate {with_unit(number_text(here['estimate']), unit)}")
    return f"{position_text(peak)}: {', '.join(what)}, corrected p {p_text(peak['p_corrected'])}"


def map_unit(results: GroupResults, measure: str) -> str:
    """Look up the unit of a map, by the means of groups or in forest plots."""
    means = results.everywhere("means")
    means = means if len(means) else results.table("forest")
    if not len(means):
        return "1"
    own = means.loc[means["measure"] == measure, "unit"]
    return str(own.iloc[0]) if len(own) else "1"


def point_of(peak: Mapping[str, Any], points: pd.DataFrame) -> pd.Series | None:
    """Find the point of a map that a peak is."""
    names = ("vertex",) if "vertex" in points else ("x", "y")
    same = np.all([points[name] == peak[name] for name in names], axis=0)
    return points[same].iloc[0] if same.any() else None


def position_text(peak: Mapping[str, Any]) -> str:
    """Describe the position of a peak."""
    inside = f"{peak['subfield']}, " if isinstance(peak["subfield"], str) else ""
    if np.isfinite(peak.get("x", np.nan)):
        words = [
            ends.split()[1 if abs(peak[axis]) < _THIRD else 0 if peak[axis] < 0 else 2]
            for axis, ends in (("x", "medial middle lateral"), ("y", "posterior midway anterior"))
        ]
        if isinstance(part := peak.get("part"), str):
            words[1:] = [part] if part != "body" else ["body", words[1]]
        x, y = (f"{peak[axis]:.2f}".replace("-", MINUS) for axis in "xy")
        return f"{inside}{', '.join(words)} (x {x}, y {y})"
    return f"{inside}vertex {int(peak['vertex'])}"


def effect_name(effect: str) -> str:
    """Write the kind of an effect size."""
    return {"cohen_d": "d", "partial_eta_squared": "partial η²"}.get(effect, effect)


def _summaries(results: GroupResults) -> Iterator[str]:
    """List summary measures that differ, corrected for their number."""
    table = results.table("measures")
    if not len(table):
        return
    several = len(table["model"].unique()) > 1
    by = ["contrast", "measure", "model"]
    for (contrast, measure, model), rows in table.groupby(by, sort=False):
        own = rows[rows["p_fdr"] < _ALPHA]
        if len(own):
            said = f", model {model}" if several else ""
            yield f"{display_name(str(measure))}, {contrast}{said}: " + "; ".join(
                f"{summary_side(row['hemi'], str(measure))} {effect_name(row['effect'])}"
                f" {number_text(row['effect_size'])}, p {p_text(row['p_fdr'])}"
                for row in records(own)
            )


def summary_side(hemi: str, measure: str) -> str:
    """Write the side of a summary measure."""
    if hemi == "LR" and not measure.endswith("_asymmetry"):
        return "mean of both sides"
    return SIDES[hemi]


def _classification(results: GroupResults) -> Iterator[str]:
    """List the pairs in which a measure adds to the base model."""
    table = results.table("classification")
    for row in records(table):
        if row["p"] < _ALPHA:
            yield (
                f"{row['control']} against {row['case']},"
                f" {summary_side(row['hemi'], row['added'])}:"
                f" {display_name(row['added'])} adds to {row['base']} (p {p_text(row['p'])});"
                f" cross-validated area {row['auc_base_cv']:.2f} to {row['auc_full_cv']:.2f}"
            )


def peaks(results: GroupResults) -> Mapping[str, Any] | None:
    """List clusters with their peaks, and the strongest point of maps without."""
    table = results.everywhere("peaks")
    if not len(table):
        return None
    file_of = results.table("maps").set_index(["measure", "contrast", "hemi"])["file"]
    numbers = table.groupby(["measure", "contrast", "hemi"]).cumcount() + 1
    rows = []
    for number, row in zip(numbers, records(table), strict=True):
        points = results.table(file_of[row["measure"], row["contrast"], row["hemi"]])
        joint = row["measure"] == JOINT
        here = None if joint else point_of(row, points)
        rows.append(
            {
                "number": int(number) if row["extent"] > 0 else "",
                "measure": display_name(row["measure"]),
                "contrast": row["contrast"],
                "side": SIDES[row["hemi"]],
                "position": position_text(row),
                "extent": int(row["extent"]),
                "shares": row["shares"] if isinstance(row["shares"], str) else "",
                "estimate": number_text(np.nan if here is None else here["estimate"]),
                "statistic": statistic_text(row),
                "p": p_text(row["p"]),
                "adjusted": p_text(row["p_corrected"]),
                "effect": row["measures"] if joint else effect_text(row),
            }
        )
    return {"rows": rows[:_MOST_ROWS], "more": max(0, len(rows) - _MOST_ROWS)}


def effect_text(row: Any) -> str:  # noqa: ANN401  (a row of pandas)
    """Write an effect size with its limits."""
    limits = f"{number_text(row['effect_low'])} to {number_text(row['effect_high'])}"
    return f"{effect_name(row['effect'])} {number_text(row['effect_size'])} ({limits})"


def participants(results: GroupResults) -> Mapping[str, Any]:
    """Describe who is in the model, by group, and list who is not, with reasons."""
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
            (SIDES[hemi], n) for hemi, n in (results.record.get("hemispheres") or {}).items()
        ],
        "levels": levels or ["all"],
        "counts": [len(part) for part in members],
        "rows": [
            {"title": name, "cells": [_described(part[name], people[name]) for part in members]}
            for name in _variables(results, people, column)
        ],
        "ratings": list((results.record.get("ratings") or {}).items()),
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
    """List tests of summary measures with the means of the groups."""
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
                "measure": with_brackets(display_name(row["measure"]), row["unit"]),
                "side": summary_side(row["hemi"], row["measure"]),
                "contrast": row["contrast"],
                "model": row["model"],
                "n": int(row["n"]),
                "visits": int(row["visits"]),
                "means": [
                    f"{number_text(one['mean'])} ({number_text(one['sd'])})" if one else ""
                    for one in known
                ],
                "estimate": number_text(row["estimate"]),
                "statistic": statistic_text(row),
                "p": p_text(row["p"]),
                "adjusted": p_text(row["p_fdr"]),
                "low": bool(row["p_fdr"] < _ALPHA),
                "effect": effect_text(row),
            }
        )
    letters = dict(zip(dict.fromkeys(row["model"] for row in rows), ascii_uppercase, strict=False))
    for row in rows:
        row["letter"] = letters[row["model"]]
    models = [(letter, model) for model, letter in letters.items()]
    return {
        "groups": groups,
        "rows": rows,
        "models": models if len(models) > 1 else [],
        "repeated": any(row["visits"] > row["n"] for row in rows),
    }


def classification(results: GroupResults) -> list[dict[str, Any]]:
    """List pairs of groups with both models."""
    table = results.table("classification")
    return [
        {
            "pair": f"{row['control']} against {row['case']}",
            "side": summary_side(row["hemi"], row["added"]),
            "base": " + ".join(display_name(name) for name in row["base"].split(" + ")),
            "added": display_name(row["added"]),
            "n": f"{row['n'] - row['n_cases']} and {row['n_cases']}",
            "areas": [
                f"{row[f'auc_{m}']:.2f} ({row[f'auc_{m}_low']:.2f} to {row[f'auc_{m}_high']:.2f})"
                for m in ("base", "full")
            ],
            "validated": [f"{row[f'auc_{model}_cv']:.2f}" for model in ("base", "full")],
            "slope": number_text(row["calibration_slope"])
            if np.isfinite(row["calibration_slope"])
            else "",
            "chance": bool(min(row["auc_base_cv"], row["auc_full_cv"]) < _CHANCE),
            "brier": f"{row['brier']:.3f}",
            "ratio": f"{row['likelihood_ratio']:.2f}",
            "p": p_text(row["p"]),
            "separated": bool(row["separated"]),
        }
        for row in records(table)
    ]


def visit_of(row: Mapping[str, Any]) -> str:
    """Name a participant, and the session if there is one."""
    return " ".join(row[name] for name in _IDS if isinstance(row[name], str))


def scores(results: GroupResults) -> Mapping[str, Any] | None:
    """Compare the groups with the reference, and list participants far from it."""
    table = results.everywhere("wscores")
    if not len(table):
        return None
    level = (results.record.get("comparison") or {}).get("normative") or []
    whole = table[table["region"].isna() | (table["region"] == "all")]
    return {
        "reference": "=".join(str(part) for part in level),
        "rows": list(score_rows(whole)),
        "far": list(far_scores(whole)),
        "limit": _FAR,
    }


def score_rows(table: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Describe scores ``w`` of each measure, of the ``reference`` and of the others."""
    for (measure, hemi), rows in table.groupby(["measure", "hemi"], sort=False):
        reference = rows["reference"].astype(bool)
        cells = []
        for own in (reference, ~reference):
            w = rows.loc[own, "w"].dropna()
            beyond = f"{(w < -_FAR).sum()} low, {(w > _FAR).sum()} high"
            spread = f"{number_text(w.mean())} ({number_text(w.std())})"
            cells.append(f"{spread}; {beyond} of {len(w)}" if len(w) else "")
        yield {
            "measure": display_name(str(measure)),
            "side": summary_side(str(hemi), str(measure)),
            "cells": cells,
        }


def far_scores(table: pd.DataFrame) -> Iterator[dict[str, str]]:
    """List scores ``w`` far from zero, the farthest first."""
    far = table[table["w"].abs() > _FAR]
    far = far.reindex(far["w"].abs().sort_values(ascending=False, kind="stable").index)
    for row in records(far.head(_MOST_ROWS)):
        yield {
            "who": visit_of(row),
            "measure": display_name(row["measure"]),
            "side": summary_side(row["hemi"], row["measure"]),
            "w": number_text(row["w"]),
        }
