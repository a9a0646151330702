"""Kinds of segmentation in one analysis: a mix is refused, or named with what it goes with."""

import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.derivatives.dataset import PROVENANCE, counts_text
from hipsta_bids.errors import InputError
from hipsta_bids.group.cohort.quality import exact_p
from hipsta_bids.group.cohort.read import visit_name
from hipsta_bids.group.questions.study import Study
from hipsta_bids.stats.formula import typed
from hipsta_bids.types import PARTICIPANT, SESSION, p_text

#: Largest difference of two edges of voxels, as a share: fields of view differ so within a
#: protocol, while 0.75 and 0.8 mm are two. Level of tests, for a clause only.
_SAME_EDGE, _LEVEL = 0.05, 0.05
#: What labels may have or lack with any program; a mix is named, and not refused.
_ENDS = "ends of the body"


def with_mixes(
    study: Study,
    rows: pd.DataFrame,
    terms: Iterable[str],
    *,
    source: tuple[object, Mapping[str, Sequence[str]]] = ("", {}),
) -> Study:
    """Find in what the hemispheres of a model differ; InputError unless the settings allow it.

    ``rows`` are visits or, of pairs of sessions, participants; without ``terms`` they do not count.
    ``source`` names a file of norms or effects of sites, and the segmentations that it rests on.
    """
    frame, is_change = _origins(study), bool(study.options.comparison.sessions.later)
    key = PARTICIPANT if is_change else "visit"
    is_used = frame.duplicated([PARTICIPANT, "side"], keep=False) | (not is_change)
    complete = pd.DataFrame({t: typed(rows[t]) for t in terms if t in rows}, rows.index).dropna()
    frame = frame[is_used & frame[key].isin(complete.index)]
    frame = frame.assign(voxel_size=frame["voxel_size"].map(_sizes(Counter(frame["voxel_size"]))))
    mixed, labels = _mixed(frame, *source)
    if refused := [field for field in mixed if field not in study.settings.design.mixed]:
        raise InputError(
            f"hemispheres of one analysis differ in {'; '.join(map(mixed.__getitem__, refused))};"
            f" segment all alike, exclude some, or allow it by --mixed {' '.join(refused)}"
        )
    if len(ends := Counter(frame[_ENDS])) > 1:
        mixed[_ENDS] = f"{_ENDS}: {counts_text(ends)}"
    values = {str(term): frame[key].map(complete[term]) for term in complete}
    values |= {"session": frame[SESSION], "side": frame["side"]}
    lines = (
        f"hemispheres differ in {text}{_associations(frame, field, values)}"
        for field, text in mixed.items()
    )
    return replace(study, mixes=tuple(lines), labels=labels)


def _origins(study: Study) -> pd.DataFrame:
    """Return the origin of the labels of each hemisphere of a cohort."""
    table, sides = study.cohort.table, study.cohort.sides
    records = ((r.result.name, (*r.provenance, r.ends)) for r in study.collection.records)
    origins = {(visit_name(n.subject, n.session), n.hemi): origin for n, origin in records}
    places = [(visit, hemi) for hemi, side in sides.items() for visit in table.index[side.rows]]
    entries = [(*place, *origins[place]) for place in places if place in origins]
    frame = pd.DataFrame(entries, columns=["visit", "side", *PROVENANCE, _ENDS])
    return frame.join(table[[PARTICIPANT, SESSION]], on="visit")


def _mixed(
    frame: pd.DataFrame, source: object, expected_of: Mapping[str, Sequence[str]]
) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Describe the fields in which hemispheres differ, and list the values of all fields."""
    mixed = {f: f"{f}: {counts_text(n)}" for f in PROVENANCE if len(n := Counter(frame[f])) > 1}
    labels = {field: sorted(set(frame[field])) for field in PROVENANCE}
    for field, expected in expected_of.items():
        present = labels.get(field, [])
        sizes = _sizes(Counter({**dict.fromkeys(present, 1), **dict.fromkeys(expected, 2)}))
        if set(map(sizes.get, present) if field == "voxel_size" else present) - set(expected):
            text = mixed.get(field, f"{field}: {', '.join(present)}")
            mixed[field] = f"{text}, but {', '.join(expected)} in {source}"
        labels[field] = sorted({*present, *expected})
    return mixed, labels


def _associations(frame: pd.DataFrame, field: str, values: Mapping[str, pd.Series]) -> str:
    """Describe tests of a field with the variables of a model."""
    tests = [(name, *_association(frame, field, column)) for name, column in values.items()]
    parts = ", ".join(f"with {name} p {p_text(p)} ({test})" for name, test, p in tests if test)
    names = ", ".join(name for name, _, p in tests if p < _LEVEL)
    ending = f"; association {parts}" if parts else ""
    return ending + (f"; effects of {names} may be effects of {field}" if names else "")


def _sizes(counts: Counter[str]) -> dict[str, str]:
    """Return the most frequent size of voxels that is like each, whatever the order of axes."""
    edges = {s: np.sort(pd.to_numeric((s.split(" x ") * 3)[:3], "coerce")) for s in counts}
    sizes: dict[str, str] = {}
    for size in sorted(counts, key=lambda size: (-counts[size], size)):
        similar = (s for s in sizes.values() if np.allclose(edges[s], edges[size], _SAME_EDGE, 0.0))
        sizes[size] = next(similar, size)
    return sizes


def _association(frame: pd.DataFrame, field: str, values: pd.Series) -> tuple[str, float]:
    """Test whether kinds go with values: the name of the test, and p; no name if nothing varies."""
    frame = pd.DataFrame({"kind": frame[field], "value": values, "person": frame[PARTICIPANT]})
    frame = frame.dropna().drop_duplicates()
    # Participants are units or, if kinds differ in some of them, the values of each participant.
    is_between = frame.drop_duplicates(["person", "kind"])["person"].is_unique
    units = frame.groupby(["person"] if is_between else ["person", "value"])
    value, kind = units["value"].first(), units["kind"].agg(lambda kinds: " + ".join(sorted(kinds)))
    table = pd.crosstab(value, kind).to_numpy()
    if min(table.shape) < 2:  # noqa: PLR2004 -- nothing varies
        return "", np.nan
    if pd.api.types.is_numeric_dtype(value):
        with warnings.catch_warnings(action="ignore"):  # of kinds without spread
            samples = (value[kind == name] for name in kind.unique())
            return "F test", float(stats.f_oneway(*samples).pvalue)
    return "Fisher's exact test", exact_p(table)
