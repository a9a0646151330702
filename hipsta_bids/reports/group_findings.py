"""What an analysis found, and where, in sentences."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.reports.group_results import (
    MINUS,
    SIDES,
    GroupResults,
    direction,
    number_text,
    p_text,
    records,
    spelled,
    with_unit,
)

_THIRD = 1 / 3
_ALPHA = 0.05  # of tests that are not corrected, for a word only


def findings(results: GroupResults) -> Mapping[str, Any] | None:
    """Say per measure and contrast what survived.

    Parameters
    ----------
    results : GroupResults

    Returns
    -------
    mapping or None
        For the template.
    """
    maps = results.table("maps")
    cards = []
    if len(maps):
        for (measure, contrast), rows in maps.groupby(["measure", "contrast"], sort=False):
            sides = [_side(results, row) for row in records(rows)]
            cards.append(
                {
                    "title": f"{spelled(str(measure)).capitalize()}, {contrast}",
                    "found": any(side["found"] for side in sides),
                    "sides": sides,
                }
            )
    cards.sort(key=lambda card: not card["found"])
    settings = results.record.get("settings") or {}
    multiplicity = settings.get("multiplicity") or {}
    return {
        "cards": cards,
        "n_found": sum(card["found"] for card in cards),
        "summaries": list(_summaries(results)),
        "classification": list(_classification(results)),
        "method": multiplicity.get("method"),
        "alpha": multiplicity.get("alpha"),
    }


def _side(results: GroupResults, row: Mapping[str, Any]) -> dict[str, Any]:
    points = results.table(str(row["file"]))
    peaks = results.everywhere("peaks")
    same = (peaks["measure"] == row["measure"]) & (peaks["contrast"] == row["contrast"])
    own = peaks[same & (peaks["hemi"] == row["hemi"])]
    n, total = int(row["n_significant"]), int(row["n_tests"])
    title = SIDES.get(str(row["hemi"]), str(row["hemi"])).capitalize()
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
    """Say how many points lie in which subfield, by direction."""
    found = points[points["significant"] == True]  # noqa: E712  (may hold missing values)
    signed = points["cohen_d"].notna().any()
    parts = []
    for sign in (1, -1):
        own = found[np.sign(found["statistic"]) == sign]
        if not len(own):
            continue
        shares = own["subfield"].fillna("n/a").value_counts(normalize=True)
        places = [f"{name} {share:.0%}" for name, share in shares.items() if name != "n/a"]
        words = [f"{len(own)} points"]
        if signed:
            words.append(direction(results, str(row["contrast"]), str(row["hemi"]), sign))
        parts.append(" ".join(words) + (f" ({', '.join(places)})" if places else ""))
    return "; ".join(parts)


def _peak(results: GroupResults, peak: Mapping[str, Any], points: pd.DataFrame) -> str:
    here = point_of(peak, points)
    what = [f"{effect_name(peak['effect'])} {number_text(peak['effect_size'])}"]
    if here is not None and np.isfinite(here["estimate"]):
        unit = _unit(results, str(peak["measure"]))
        what.insert(0, f"estimate {with_unit(number_text(here['estimate']), unit)}")
    place = place_words(peak)
    return f"{place}: {', '.join(what)}, corrected p {p_text(peak['p_corrected'])}"


def _unit(results: GroupResults, measure: str) -> str:
    means = results.everywhere("means")
    if not len(means):
        return "1"
    own = means.loc[means["measure"] == measure, "unit"]
    return str(own.iloc[0]) if len(own) else "1"


def point_of(peak: Mapping[str, Any], points: pd.DataFrame) -> pd.Series | None:
    """Find the point of a map that a peak is."""
    names = ("vertex",) if "vertex" in points else ("x", "y")
    same = np.all([points[name] == peak[name] for name in names], axis=0)
    return points[same].iloc[0] if same.any() else None


def place_words(peak: Mapping[str, Any]) -> str:
    """Say where a peak lies."""
    field = peak["subfield"] if isinstance(peak["subfield"], str) else ""
    if np.isfinite(peak.get("x", np.nan)):
        words = [
            ends[1] if abs(peak[axis]) < _THIRD else ends[0 if peak[axis] < 0 else 2]
            for axis, ends in (
                ("x", ("medial", "middle", "lateral")),
                ("y", ("posterior", "midway", "anterior")),
            )
        ]
        x, y = (f"{peak[axis]:.2f}".replace("-", MINUS) for axis in "xy")
        inside = f"{field}, " if field else ""
        return f"{inside}{', '.join(words)} (x {x}, y {y})"
    inside = f"{field}, " if field else ""
    return f"{inside}vertex {int(peak['vertex'])}"


def effect_name(effect: str) -> str:
    """Spell the kind of an effect size."""
    return {"cohen_d": "d", "partial_eta_squared": "partial η²"}.get(effect, effect)


def _summaries(results: GroupResults) -> Iterator[str]:
    """Summary measures that differ, uncorrected."""
    table = results.table("measures")
    if not len(table):
        return
    for (contrast, measure), rows in table.groupby(["contrast", "measure"], sort=False):
        own = rows[rows["p"] < _ALPHA]
        if len(own):
            yield f"{spelled(str(measure))}, {contrast}: " + "; ".join(
                f"{summary_side(row['hemi'], str(measure))} {effect_name(row['effect'])}"
                f" {number_text(row['effect_size'])}, p {p_text(row['p'])}"
                for row in records(own)
            )


def summary_side(hemi: str, measure: str) -> str:
    """Spell the side of a summary measure."""
    if hemi == "LR" and not measure.endswith("_asymmetry"):
        return "mean of both sides"
    return SIDES.get(hemi, hemi)


def _classification(results: GroupResults) -> Iterator[str]:
    """Name the pairs in which a measure adds to the base model."""
    table = results.table("classification")
    for row in records(table):
        if row["p"] < _ALPHA:
            yield (
                f"{row['control']} against {row['case']},"
                f" {summary_side(row['hemi'], row['added'])}:"
                f" {spelled(row['added'])} adds to {row['base']} (p {p_text(row['p'])});"
                f" cross-validated area {row['auc_base_cv']:.2f} to {row['auc_full_cv']:.2f}"
            )
