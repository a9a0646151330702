"""Results as tables, and the meaning of their columns."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.classification import ClassifierResult
from hipsta_bids.group.figure_tables import figure_tables, mean_table
from hipsta_bids.group.glm import PointTest
from hipsta_bids.group.multiplicity import Discoveries, MapKey
from hipsta_bids.group.peaks import Frame, frame_of, peak_table
from hipsta_bids.group.summaries import hemispheres, summary_values
from hipsta_bids.group_data import Cohort, ResultTable
from hipsta_bids.group_settings import GroupSettings


def result_tables(
    cohort: Cohort, analysis: Analysis, settings: GroupSettings
) -> Iterator[ResultTable]:
    """Give all tables of one model.

    Parameters
    ----------
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.
    settings : GroupSettings
        Level of the false discovery rate, neighbors, base model.

    Yields
    ------
    ResultTable
    """
    if analysis.fitted:
        yield ResultTable(name="peaks", rows=_peaks(cohort, analysis, settings))
    if analysis.found:
        yield ResultTable(name="maps", rows=_overview(analysis))
    if analysis.sides:
        yield ResultTable(name="registration", rows=_registration(analysis))
        yield ResultTable(name="warps", rows=_warps(cohort, analysis))
    if analysis.measures:
        yield ResultTable(name="measures", rows=_measures(cohort, analysis))
    if analysis.groups is not None and analysis.measures:
        yield ResultTable(name="descriptives", rows=_descriptives(analysis))
    if analysis.groups is not None and analysis.sides:
        yield ResultTable(name="shifts", rows=_shifts(analysis))
    if analysis.scores is not None and len(analysis.scores.table):
        yield ResultTable(name="wscores", rows=analysis.scores.table)
    if analysis.pairs:
        yield ResultTable(name="classification", rows=_classification(analysis, settings))
    yield from figure_tables(cohort, analysis)
    yield from _statistics(cohort, analysis)


def point_tables(
    name: str, cohort: Cohort, analysis: Analysis, settings: GroupSettings
) -> Iterator[ResultTable]:
    """Give the tables of maps that lie on a surface of their own.

    Parameters
    ----------
    name : str
        Of the maps.
    cohort, analysis, settings
        As for :func:`result_tables`.

    Yields
    ------
    ResultTable
    """
    yield ResultTable(name=f"{name}_peaks", rows=_peaks(cohort, analysis, settings))
    if analysis.scores is not None:
        yield ResultTable(name=f"{name}_wscores", rows=analysis.scores.table)
    yield ResultTable(name=f"{name}_means", rows=mean_table(cohort, analysis))
    yield from _statistics(cohort, analysis)


def _statistics(cohort: Cohort, analysis: Analysis) -> Iterator[ResultTable]:
    for hemi, one in analysis.fitted.items():
        for measure, fit in one.fits.items():
            for test in fit.tests:
                found = analysis.found[MapKey(measure, test.contrast.name, hemi)]
                rows = _map(frame_of(cohort, one), fit.n, test, found)
                yield ResultTable(name=map_name(hemi, measure, test.contrast.name), rows=rows)


def map_name(hemi: str, measure: str, contrast: str) -> str:
    """Name of the files of one map of statistics, without suffix and extension."""
    label = _label(contrast) or "contrast"
    # BIDS knows L and R only: what is made of both has no hemisphere in its name.
    side = f"hemi-{hemi}_" if hemi in {"L", "R"} else ""
    return f"{side}contrast-{label}_desc-{entity_label(measure)}_statmap"


def entity_label(measure: str) -> str:
    """Spell a measure as the value of an entity: ``mean_x`` as ``meanX``."""
    return measure[:1] + _label(measure)[1:]


def _label(text: str) -> str:
    """Spell a name with letters and digits only, as entities want it."""
    words = "".join(c if c.isalnum() else " " for c in text).split()
    return "".join(word[:1].upper() + word[1:] for word in words)


def _map(
    frame: Frame,
    n: np.ndarray,
    test: PointTest,
    found: Discoveries,
) -> pd.DataFrame:
    points = np.arange(frame.shape[0] * frame.shape[1])
    single = test.kind == "t"
    blank = np.full(len(points), np.nan)
    return pd.DataFrame(
        {
            **frame.number(points),
            **frame.place(points),
            "subfield": frame.subfield.ravel(),
            "n": n,
            "estimate": test.estimate[0] if single else blank,
            "se": test.se[0] if single else blank,
            "statistic": test.statistic,
            "df": test.df,
            "p": test.p,
            "p_corrected": found.adjusted,
            "significant": found.rejected,
            "cohen_d": test.cohen_d,
            "cohen_d_low": test.cohen_d_limits[0],
            "cohen_d_high": test.cohen_d_limits[1],
            "eta_squared": test.eta_squared,
            "eta_squared_low": test.eta_squared_limits[0],
            "eta_squared_high": test.eta_squared_limits[1],
        }
    )


def _peaks(cohort: Cohort, analysis: Analysis, settings: GroupSettings) -> pd.DataFrame:
    parts = []
    for hemi, one in analysis.fitted.items():
        frame = frame_of(cohort, one)
        for measure, fit in one.fits.items():
            for test in fit.tests:
                found = analysis.found[MapKey(measure, test.contrast.name, hemi)]
                part = peak_table(test, found, frame, settings.multiplicity.neighbors)
                part.insert(0, "hemi", hemi)
                part.insert(0, "measure", measure)
                parts.append(part)
    return pd.concat(parts, ignore_index=True)


def _overview(analysis: Analysis) -> pd.DataFrame:
    """One row per map: how many points survive, and at which p."""
    return pd.DataFrame(
        [
            {
                "measure": key.measure,
                "contrast": key.contrast,
                "hemi": key.hemi,
                "file": map_name(key.hemi, key.measure, key.contrast),
                "n_tests": found.n_tests,
                "n_significant": int(found.rejected.sum()),
                "p_cutoff": found.cutoff,
                "lenient": found.lenient,
            }
            for key, found in analysis.found.items()
        ]
    )


def _measures(cohort: Cohort, analysis: Analysis) -> pd.DataFrame:
    parts = []
    for one in analysis.measures:
        for test in one.fit.tests:
            single = test.kind == "t"
            limits = test.cohen_d_limits if single else test.eta_squared_limits
            blank = np.full(len(one.measures), np.nan)
            parts.append(
                pd.DataFrame(
                    {
                        "hemi": one.hemi,
                        "measure": one.measures,
                        "unit": [cohort.units.get(name, "1") for name in one.measures],
                        "model": one.formula,
                        "contrast": test.contrast.name,
                        "test": test.kind,
                        "n": one.fit.n,
                        "estimate": test.estimate[0] if single else blank,
                        "se": test.se[0] if single else blank,
                        "statistic": test.statistic,
                        "df": test.df,
                        "p": test.p,
                        "effect": "cohen_d" if single else "partial_eta_squared",
                        "effect_size": test.cohen_d if single else test.eta_squared,
                        "effect_low": limits[0],
                        "effect_high": limits[1],
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def _descriptives(analysis: Analysis) -> pd.DataFrame:
    groups, cohort = analysis.groups, analysis.compared
    if groups is None:
        return pd.DataFrame()
    members = cohort.table[groups.column].iloc[analysis.design.rows]
    parts = []
    for hemi in hemispheres(cohort):
        only = analysis.measured.summaries
        values = summary_values(cohort, hemi, only).iloc[analysis.design.rows]
        for level in groups.levels:
            own = values[(members == level).to_numpy()]
            parts.append(
                pd.DataFrame(
                    {
                        "hemi": hemi,
                        "group": level,
                        "measure": own.columns,
                        "unit": [cohort.units.get(str(name), "1") for name in own.columns],
                        "n": own.notna().sum().to_numpy(),
                        "mean": own.mean().to_numpy(),
                        "sd": own.std().to_numpy(),
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def _registration(analysis: Analysis) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "hemi": hemi,
                "n": len(side.registration.warps),
                "explained_before": side.registration.explained_before,
                "explained_after": side.registration.explained_after,
                "iterations": side.registration.iterations,
                "converged": side.registration.converged,
            }
            for hemi, side in analysis.sides.items()
        ]
    )


def _warps(cohort: Cohort, analysis: Analysis) -> pd.DataFrame:
    parts = []
    for hemi, side in analysis.sides.items():
        visits = cohort.table.iloc[side.registered.rows]
        nodes = side.registration.warps.shape[1]
        parts.append(
            pd.DataFrame(
                {
                    "participant_id": visits["participant_id"].to_numpy(),
                    "session_id": visits["session_id"].to_numpy(),
                    "hemi": hemi,
                    "displacement": side.registration.displacement,
                    "extreme": side.registration.extreme,
                    **{f"node_{i + 1}": side.registration.warps[:, i] for i in range(nodes)},
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def _shifts(analysis: Analysis) -> pd.DataFrame:
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "hemi": hemi,
                    "group": group,
                    "node_x": np.arange(len(shift.mean)) + 1,
                    "n": shift.n,
                    "shift": shift.mean,
                    "shift_se": shift.se,
                }
            )
            for hemi, side in analysis.sides.items()
            for group, shift in side.shifts.items()
        ],
        ignore_index=True,
    )


def _classification(analysis: Analysis, settings: GroupSettings) -> pd.DataFrame:
    rows: list[dict[str, object]] = []
    for hemi, measure, pair in analysis.pairs:
        found = pair.comparison
        rows.append(
            {
                "hemi": hemi,
                "control": pair.control,
                "case": pair.case,
                "base": " + ".join(settings.classification.base),
                "added": measure,
                "n": found.n,
                "n_cases": found.n_cases,
                "n_incomplete": pair.n_incomplete,
                **_areas("base", found.base),
                **_areas("full", found.full),
                "calibration_intercept": found.full.calibration.intercept,
                "calibration_slope": found.full.calibration.slope,
                "brier": found.full.calibration.brier,
                "likelihood_ratio": found.likelihood_ratio,
                "lr_df": found.df,
                "p": found.p,
                "separated": found.separated,
            }
        )
    return pd.DataFrame(rows)


def _areas(which: str, result: ClassifierResult) -> dict[str, float]:
    return {
        f"auc_{which}": result.auc.area,
        f"auc_{which}_low": result.auc.low,
        f"auc_{which}_high": result.auc.high,
        f"auc_{which}_cv": result.cross_validation.auc,
        f"auc_{which}_cv_sd": result.cross_validation.auc_sd,
    }
