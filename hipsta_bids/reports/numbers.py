"""Tables of a participant's page: key numbers and quality."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.reports.cohort import MEASURES, SMALLEST_COHORT, Measure
from hipsta_bids.reports.series import Series
from hipsta_bids.reports.words import number, usual_ranges


def key_numbers(series: Series) -> Mapping[str, Any] | None:
    """Set the numbers of both hemispheres beside those of the cohort."""
    measured = series.measured
    if not measured:
        return None
    first = measured[0].place.name
    rows = [_number_row(measure, series) for measure in (*MEASURES, *_subfield_measures(series))]
    counts = [len(series.cohort.values(h.place.name, MEASURES[0].name)) for h in measured]
    return {
        "sides": [h.side for h in measured],
        "rows": rows,
        "others": min(counts) if min(counts) >= SMALLEST_COHORT else 0,
        "seg": first.seg,
        "smallest": SMALLEST_COHORT,
    }


def _subfield_measures(series: Series) -> list[Measure]:
    """Mean thickness of each subfield that one of the hemispheres has."""
    prefix = "thickness_mean_"
    names = dict.fromkeys(
        name
        for hemisphere in series.measured
        for name, value in hemisphere.summary.items()
        if name.startswith(prefix) and np.isfinite(value)
    )
    return [
        Measure(
            name=name,
            title=f"Mean thickness, {_subfield_title(name.removeprefix(prefix))}",
            unit="mm",
            digits=2,
        )
        for name in names
    ]


def _subfield_title(name: str) -> str:
    return name.replace("_", "/") if name.startswith(("CA", "BA")) else name.lower()


def _number_row(measure: Measure, series: Series) -> Mapping[str, Any]:
    """One number of both hemispheres, with its place in the range of the cohort."""
    values = [h.summary.get(measure.name, np.nan) for h in series.measured]
    cohort = [series.cohort.values(h.place.name, measure.name) for h in series.measured]
    return {
        "title": measure.title,
        "unit": measure.unit,
        "cells": ["n/a" if np.isnan(v) else f"{v:.{measure.digits}f}" for v in values],
        "strips": [
            _strip(value, others, measure)
            for value, others in zip(values, cohort, strict=True)
            if len(others) >= SMALLEST_COHORT and np.isfinite(value)
        ],
    }


def _strip(value: float, others: Float, measure: Measure) -> Mapping[str, Any]:
    """Places of one value and all of the cohort between 0 and 100."""
    low, high = float(others.min()), float(others.max())
    span = max(high - low, 1e-9)
    median = float(np.median(others))
    digits = measure.digits
    share = float(np.mean(others <= value))
    return {
        "dots": [round(100 * (float(v) - low) / span, 1) for v in others],
        "value": round(100 * (value - low) / span, 1),
        "median": round(100 * (median - low) / span, 1),
        "words": f"{value:.{digits}f}; cohort of {len(others)}: {low:.{digits}f} to"
        f" {high:.{digits}f}, median {median:.{digits}f}; {share:.0%} are not larger",
    }


def quality_numbers(series: Series) -> Mapping[str, Any] | None:
    """Set the quality numbers of both hemispheres beside their usual ranges."""
    measured = series.measured
    if not measured:
        return None
    thickness = float(np.nanmean([h.summary.get("thickness_mean", np.nan) for h in measured]))
    rows = []
    for usual in usual_ranges(thickness, series.cohort.settings):
        values = [number(h.metrics, usual.name) for h in measured]
        if np.isnan(values).all():
            continue
        rows.append(
            {
                "title": usual.title,
                "meaning": usual.meaning,
                "range": usual.range,
                "cells": [
                    {
                        "text": "n/a" if np.isnan(v) else usual.text(v),
                        "unusual": not (np.isnan(v) or usual.low <= v <= usual.high),
                    }
                    for v in values
                ],
            }
        )
    words = [
        ("End planes", "posterior_end_rule", "anterior_end_rule"),
        ("Boundaries found by", "boundary_rule"),
        ("Interior side found by", "side_rule"),
    ]
    facts = [
        (title, [", ".join(str(h.metrics.get(key, "n/a")) for key in keys) for h in measured])
        for title, *keys in words
    ]
    return {"sides": [h.side for h in measured], "rows": rows, "facts": facts}
