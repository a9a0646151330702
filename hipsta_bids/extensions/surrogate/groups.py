"""Surrogate thickness by group, from the tables of ``hipsta-bids surrogate``, without a mesh."""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group.cohort.collect import SheetRecord
from hipsta_bids.group.cohort.read import visit_name
from hipsta_bids.group.output import style
from hipsta_bids.group.output.results import Analysis, members_of
from hipsta_bids.group.output.tables import COLUMNS
from hipsta_bids.group.output.write import write_table
from hipsta_bids.group.questions.study import Study
from hipsta_bids.io import files
from hipsta_bids.joints import Writer, read_texts
from hipsta_bids.reports.display import COLORS, X_ENDS, Y_ENDS
from hipsta_bids.stats.arrays import describe_known
from hipsta_bids.types import SIDES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Numbers that are compared: of single slices, and of the whole sheet.
_NUMBERS = ("thickness", "thickness_mesh")


def surrogate_table(
    records: Sequence[SheetRecord], analysis: Analysis, confidence: float
) -> pd.DataFrame:
    """Describe groups at each point of the medial axis, and the means of slices.

    Participants weigh the same; a slice's mean is over the points of its axis. Empty where there
    are no tables, or where rows of the model are no single visits.
    """
    people = analysis.compared.table.iloc[analysis.design.rows]
    sessions = analysis.comparison.sessions
    if sessions.later or sessions.is_repeated:
        return pd.DataFrame()
    parts = list[pd.DataFrame]()
    for record in records:
        name, path = record.result.name, record.result.path("surrogate")
        visit = visit_name(name.subject, name.session)
        if visit in people.index and path.exists():
            table = pd.read_csv(path, sep="\t", na_values=[files.MISSING])
            table = table[table["sampling"] == "proportional"]
            parts.append(table.assign(visit=visit, hemi=name.hemi))
    if not parts:
        return pd.DataFrame()
    points = pd.concat(parts, ignore_index=True)
    means = points.groupby(["visit", "hemi", "slice"], as_index=False)[[*_NUMBERS]].mean()
    points = pd.concat([points, means.assign(fraction=np.nan)], ignore_index=True)
    return pd.DataFrame(_rows(points, analysis, people, confidence))


def _rows(
    points: pd.DataFrame, analysis: Analysis, people: pd.DataFrame, confidence: float
) -> Iterator[dict[str, Any]]:
    members = members_of(analysis, people)
    keys = ["hemi", "slice", "fraction"]
    for (hemi, at, fraction), rows in points.groupby(keys, dropna=False):
        for group, is_member in members.items():
            values = rows[rows["visit"].isin(people.index[is_member])]
            numbers = values[[*_NUMBERS]].to_numpy(np.float64)
            finite, (mean, sheet_mean), (sd, _) = describe_known([numbers])
            n = int(finite[:, 0].sum())
            reach = stats.t.ppf((1 + confidence) / 2, n - 1) * sd / np.sqrt(max(n, 1))
            yield {
                "hemi": hemi,
                "group": group,
                "slice": at,
                "fraction": fraction,
                "unit": "mm",
                "n": n,
                "mean": mean,
                "mean_low": mean - reach,
                "mean_high": mean + reach,
                "sheet_mean": sheet_mean,
            }


def describe_groups(study: Study, analysis: Analysis) -> tuple[Writer, list[str]]:
    """Prepare the table of groups, if there are tables of single slices."""
    confidence = study.settings.glm.confidence
    table = surrogate_table(study.collection.records, analysis, confidence)

    def write(folder: Path) -> None:
        if len(table):
            meaning = COLUMNS | read_texts("hipsta_bids.extensions.surrogate")["groups"]
            write_table(folder, "surrogate", table, meaning=meaning)

    return write, []


def list_figures(results: GroupResults) -> Iterator[tuple[str, style.Drawing]]:
    """List the figure, if there is a table of groups."""
    if len(results.table("surrogate")):
        yield "surrogate", partial(draw_surrogate, results)


def draw_surrogate(results: GroupResults) -> "list[Figure]":
    """Draw means of groups with limits along the medial axis, and along the body if possible."""
    table = results.table("surrogate")
    positions = sorted(table["slice"].unique())  # the first, the middle and the last are drawn
    places = [positions[i] for i in sorted({0, len(positions) // 2, len(positions) - 1})]
    parts = [(f"slice {at:.0%}", "fraction", table["slice"] == at) for at in places]
    slices = table["fraction"].isna()
    if len(positions) > 1:
        parts.append(("all slices", "slice", slices))
    sides = [str(hemi) for hemi in table["hemi"].unique()]
    shape = (len(sides), len(parts)) if len(parts) > 1 else (1, len(sides))
    size = style.TWO_COLUMNS, 55.0 * shape[0]
    figure, axes = style.new_panels(*shape, size)
    pairs = [(hemi, part) for hemi in sides for part in parts]
    for axis, (hemi, (title, along, of_part)) in zip(axes.flat, pairs, strict=True):
        rows = table[of_part & (table["hemi"] == hemi) & (slices == (along == "slice"))]
        for color, (group, curve) in zip(
            cycle(COLORS), rows.groupby("group", sort=False), strict=False
        ):
            name = f"{group} (n = {curve['n'].max()})"
            axis.plot(curve[along], curve["mean"], color=color, label=name, linewidth=1.2)
            band = curve["mean_low"], curve["mean_high"]
            axis.fill_between(curve[along], *band, color=color, alpha=0.25, linewidth=0)
        ends = X_ENDS if along == "fraction" else Y_ENDS
        low, high = rows[along].min(), rows[along].max()
        axis.set_xticks([low, high], ends)
        for label, side in zip(axis.get_xticklabels(), ("left", "right"), strict=True):
            label.set_horizontalalignment(side)
        axis.set_title(f"{SIDES[hemi]}, {title}", loc="right")
    for axis in axes[:, 0]:
        axis.set_ylabel("surrogate thickness [mm]")
    style.share_limits(axes.ravel())
    confidence = ((results.record.get("settings") or {}).get("glm") or {}).get("confidence", 0.95)
    style.explain(figure, axes[0, 0], f"mean, {confidence:.0%} limits")
    style.letter_panels(axes.flat)
    return [figure]
