"""What the figures show, as tables, so that pages and other programs can draw it anew."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.members import mean_of_known, members_of, rows_of, spread_of_known
from hipsta_bids.group.peaks import frame_of
from hipsta_bids.group.roc import roc_curve
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort, Float, ResultTable


def figure_tables(cohort: Cohort, analysis: Analysis) -> Iterator[ResultTable]:
    """Give the tables behind the figures of one model.

    Parameters
    ----------
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.

    Yields
    ------
    ResultTable
    """
    if analysis.fitted:
        yield ResultTable(name="means", rows=mean_table(cohort, analysis))
    if analysis.sides:
        yield ResultTable(name="profiles", rows=_profiles(cohort, analysis))
    if analysis.pairs:
        yield ResultTable(name="roc", rows=_roc(analysis))
        yield ResultTable(name="calibration", rows=_calibration(analysis))


def mean_table(cohort: Cohort, analysis: Analysis) -> pd.DataFrame:
    """Means and standard deviations of groups at each point of the maps that were fitted.

    Parameters
    ----------
    cohort : Cohort
        Gives coordinates and units.
    analysis : Analysis
        Results.

    Returns
    -------
    DataFrame
        One row per measure, hemisphere, group and point.
    """
    parts = []
    for hemi, one in analysis.fitted.items():
        frame = frame_of(cohort, one)
        points = np.arange(frame.shape[0] * frame.shape[1])
        place = {**frame.number(points), **frame.place(points)}
        members = members_of(analysis, rows_of(analysis, one))
        for measure in one.fits:
            values = one.values(measure)
            for group, own in members.items():
                what = {
                    "measure": measure,
                    "unit": cohort.units.get(measure, "1"),
                    "hemi": hemi,
                    "group": group,
                }
                parts.append(
                    pd.DataFrame(
                        {
                            **what,
                            **place,
                            "n": np.isfinite(values[own]).sum(axis=0),
                            "mean": mean_of_known(values[own], 0),
                            "sd": spread_of_known(values[own]),
                        }
                    )
                )
    return pd.concat(parts, ignore_index=True)


def design_table(analysis: Analysis) -> pd.DataFrame:
    """Give the design matrix, a row per row of the model."""
    names = analysis.compared.table.iloc[analysis.design.rows][[PARTICIPANT, SESSION]]
    matrix = pd.DataFrame(
        analysis.design.matrix, columns=list(analysis.design.columns), index=names.index
    )
    return pd.concat([names, matrix], axis=1)


def _profiles(cohort: Cohort, analysis: Analysis) -> pd.DataFrame:
    parts = []
    for hemi, side in analysis.sides.items():
        for registered, source in ((False, cohort.sides[hemi]), (True, side.registered)):
            members = members_of(analysis, cohort.table.iloc[source.rows])
            for measure, maps in source.maps.items():
                values = mean_of_known(maps, 2)
                for group, own in members.items():
                    count = np.isfinite(values[own]).sum(axis=0)
                    error = spread_of_known(values[own]) / np.sqrt(np.maximum(count, 1))
                    parts.append(
                        pd.DataFrame(
                            {
                                "measure": measure,
                                "unit": cohort.units.get(measure, "1"),
                                "hemi": hemi,
                                "registered": registered,
                                "group": group,
                                "node_x": np.arange(len(cohort.x)) + 1,
                                "n": count,
                                "mean": mean_of_known(values[own], 0),
                                "mean_se": error,
                            }
                        )
                    )
    return pd.concat(parts, ignore_index=True)


def _curves(
    analysis: Analysis, curves: Mapping[tuple[int, str], Mapping[str, Float]]
) -> pd.DataFrame:
    """Put curves, by number of the comparison and model, under each other."""
    parts = []
    for (i, classifier), columns in curves.items():
        hemi, measure, pair = analysis.pairs[i]
        what = {"hemi": hemi, "control": pair.control, "case": pair.case, "added": measure}
        parts.append(pd.DataFrame({**what, "classifier": classifier, **columns}))
    return pd.concat(parts, ignore_index=True)


def _roc(analysis: Analysis) -> pd.DataFrame:
    curves = {}
    for i, (_, _, pair) in enumerate(analysis.pairs):
        for classifier, result in (("base", pair.comparison.base), ("full", pair.comparison.full)):
            wrong, right = roc_curve(result.score, pair.is_case)
            curves[i, classifier] = {"false_positives": wrong, "true_positives": right}
    return _curves(analysis, curves)


def _calibration(analysis: Analysis) -> pd.DataFrame:
    curves = {}
    for i, (_, _, pair) in enumerate(analysis.pairs):
        for classifier, result in (("base", pair.comparison.base), ("full", pair.comparison.full)):
            found = result.calibration
            curves[i, classifier] = {"predicted": found.predicted, "observed": found.observed}
    return _curves(analysis, curves)
