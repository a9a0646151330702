"""Results as tables."""

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.group.cohort.data import Cohort, hemispheres, participants_with, summary_values
from hipsta_bids.group.output import columns, results
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.reports import cells
from hipsta_bids.reports.group_tables import opposite_changes
from hipsta_bids.stats.arrays import Float, describe_known
from hipsta_bids.stats.classify import ClassifierResult
from hipsta_bids.stats.clusters import edges_of
from hipsta_bids.stats.formula import file_label
from hipsta_bids.stats.inference import Discoveries, MapKey, control_fdr
from hipsta_bids.stats.registration import Registration
from hipsta_bids.types import PARTICIPANT, REGION, SESSION

Named = tuple[str, pd.DataFrame]
"""File name without extension, and table."""
Columns = Mapping[str, Any]
Averages = Mapping[str, Float]
"""(points, 3) of average surfaces in RAS mm, by hemisphere."""
CurveOf = Callable[[ClassifierResult], Columns]

_MEANINGS = tomllib.loads((files("hipsta_bids.group.output") / "columns.toml").read_text("utf-8"))
#: Meaning of every column; the unit is that of the measure unless said.
COLUMNS: Mapping[str, str] = _MEANINGS["group"]
#: The same of participants by group.
DEMOGRAPHIC_COLUMNS: Mapping[str, str] = COLUMNS | _MEANINGS["demographics"]


@cache
def read_columns(package: str) -> Mapping[str, str]:
    """Read the meaning of the columns of an extension, beside the columns of all analyses."""
    return {**COLUMNS, **tomllib.loads((files(package) / "columns.toml").read_text("utf-8"))}


def result_tables(
    surface: str,
    cohort: Cohort,
    analysis: results.Analysis,
    settings: GroupSettings,
    averages: Averages,
) -> Iterator[Named]:
    """Make all tables of one model of the maps of one surface."""
    prefix = f"{surface}_" if surface else ""
    if analysis.fitted:
        yield f"{prefix}peaks", _stacked(_peaks(cohort, analysis, settings, averages))
        yield f"{prefix}means", _stacked(_means(cohort, analysis))
    if analysis.registrations:
        yield from _registration_tables(cohort, analysis)
    if analysis.measures:
        yield "measures", summary_tests(cohort, analysis, settings)
        if analysis.groups is not None:
            yield "descriptives", _stacked(_descriptives(analysis))
    if analysis.pairs:
        yield "classification", _classification(analysis, settings)
        yield "roc", _stacked(_curves(analysis, _roc))
        if any(models.full.calibration.judged for *_, models in analysis.pairs):
            yield "calibration", _stacked(_curves(analysis, _calibration))
    yield from _statistics(cohort, analysis)


def design_table(analysis: results.Analysis) -> pd.DataFrame:
    """Return the design matrix with participants and sessions."""
    names = analysis.compared.table.iloc[analysis.design.rows][[PARTICIPANT, SESSION]]
    matrix = pd.DataFrame(
        analysis.design.matrix, columns=list(analysis.design.columns), index=names.index
    )
    return pd.concat([names, matrix], axis=1)


def map_name(hemi: str, measure: str, contrast: str) -> str:
    """Name the files of one map of statistics, without suffix and extension."""
    label = file_label(contrast) or "contrast"
    # BIDS knows L and R only: what is made of both has no hemisphere in its name.
    side = f"hemi-{hemi}_" if hemi in {"L", "R"} else ""
    return f"{side}contrast-{label}_desc-{entity_label(measure)}_statmap"


def entity_label(measure: str) -> str:
    """Write a measure as the value of an entity: ``mean_x`` as ``meanX``."""
    return measure[:1] + file_label(measure)[1:]


def _stacked(blocks: Iterable[Columns]) -> pd.DataFrame:
    """Put blocks of rows under each other; single values hold for all rows of a block."""
    return pd.concat([pd.DataFrame(block) for block in blocks], ignore_index=True)


def _statistics(cohort: Cohort, analysis: results.Analysis) -> Iterator[Named]:
    for key, test, discoveries in results.tested_maps(analysis):
        fitted = analysis.fitted[key.hemi]
        values = columns.point_columns(
            test, discoveries, columns.frame_of(cohort, fitted), fitted.fits[key.measure].n
        )
        if (before := analysis.unregistered.get(key)) is not None:
            values["statistic_unregistered"] = before[0]
            values["significant_unregistered"] = before[1].rejected
        yield map_name(key.hemi, key.measure, key.contrast), pd.DataFrame(values)


def _peaks(
    cohort: Cohort, analysis: results.Analysis, settings: GroupSettings, averages: Averages
) -> Iterator[Columns]:
    for key, test, discoveries in results.tested_maps(analysis):
        fitted = analysis.fitted[key.hemi]
        edges = edges_of(fitted.maps, settings.multiplicity.neighbors)
        frame = columns.frame_of(cohort, fitted, averages.get(key.hemi))
        peaks = columns.peak_table(test, discoveries, frame, edges)
        yield {"measure": key.measure, "hemi": key.hemi, **peaks}


def _means(cohort: Cohort, analysis: results.Analysis) -> Iterator[Columns]:
    """Means and standard deviations of groups at each point of the maps that were fitted."""
    for hemi, fitted in analysis.fitted.items():
        frame = columns.frame_of(cohort, fitted)
        rows = results.rows_of(analysis, fitted)
        people = rows[PARTICIPANT].to_numpy()
        members = results.members_of(analysis, rows)
        for measure in fitted.fits:
            for group, member in members.items():
                finite, mean, sd = describe_known(fitted.parts(measure, member))
                yield {
                    "measure": measure,
                    "unit": cohort.units.get(measure, "1"),
                    "hemi": hemi,
                    "group": group,
                    **frame.number,
                    **frame.position,
                    "n": participants_with(finite, people[member]),
                    "mean": mean,
                    "sd": sd,
                }


def _profiles(cohort: Cohort, analysis: results.Analysis) -> Iterator[Columns]:
    for hemi, side in analysis.registered.items():
        for registered, source in ((False, cohort.sides[hemi]), (True, side)):
            members = results.members_of(analysis, cohort.table.iloc[source.rows])
            for measure in source.maps:
                for group, member in members.items():
                    values = results.profiles_of(source.maps, measure, member)
                    finite, mean, sd = describe_known([values])
                    count = finite.sum(axis=0)
                    yield {
                        "measure": measure,
                        "unit": cohort.units.get(measure, "1"),
                        "hemi": hemi,
                        "registered": registered,
                        "group": group,
                        "node_x": np.arange(len(cohort.x)) + 1,
                        "n": count,
                        "mean": mean,
                        "mean_se": sd / np.sqrt(np.maximum(count, 1)),
                    }


def summary_tests(
    cohort: Cohort, analysis: results.Analysis, settings: GroupSettings
) -> pd.DataFrame:
    """Return one row per test of a summary measure; empty without any."""
    blocks = list(_measures(cohort, analysis))
    return with_fdr(_stacked(blocks), settings) if blocks else pd.DataFrame()


def opposite_notes(
    cohort: Cohort, analysis: results.Analysis, settings: GroupSettings
) -> list[str]:
    """Return notes on volume and mean thickness that change in opposite directions."""
    return opposite_changes(summary_tests(cohort, analysis, settings))


def notebook_table(title: str, table: pd.DataFrame, rows: int) -> str:
    """Show a table of at most as many rows in a notebook, below a title."""
    return cells.card(title, table.to_html(index=False, max_rows=rows, border=0))


def with_references(table: pd.DataFrame, analysis: results.Analysis) -> pd.DataFrame:
    """Add the reference levels of the model to a table of contrasts."""
    levels = analysis.design.references.items()
    if "contrast" not in table or not levels:
        return table
    return table.assign(references="; ".join(f"{factor}={level}" for factor, level in levels))


def overview_table(discoveries: Mapping[MapKey, Discoveries]) -> pd.DataFrame:
    """Return one row per map: how many points survive, and at which p."""
    return pd.DataFrame(
        [
            columns.overview_row(map_name(key.hemi, key.measure, key.contrast), key, result)
            for key, result in discoveries.items()
        ]
    )


def _measures(cohort: Cohort, analysis: results.Analysis) -> Iterator[Columns]:
    for (hemi, formula), (names, fit, participants) in analysis.measures.items():
        for test in fit.tests:
            yield {
                "hemi": hemi,
                "measure": names,
                "unit": [cohort.units.get(name, "1") for name in names],
                "model": replace(analysis.model, formula=formula).text,
                "contrast": test.contrast.name,
                "test": test.kind,
                "n": participants,
                "visits": fit.n,
                **columns.test_columns(test),
                "p_fdr": np.nan,
                **columns.effect_columns(test),
            }


def with_fdr(table: pd.DataFrame, settings: GroupSettings) -> pd.DataFrame:
    """Correct the tests of one contrast for the number of measures, sides and models.

    Means of one map over regions are a separate family. The two-stage procedure can adjust a p to
    less than it was; it stays where it was, so that no measure is listed for the others' effects.
    """
    rules = settings.multiplicity
    method = "bh" if rules.method == "bh" else "fdr2"
    parts = [str(name).partition(REGION) for name in table["measure"]]
    maps = np.array([name if of_region else "" for name, of_region, _ in parts], dtype=object)
    for _, rows in table.groupby(["contrast", maps], sort=False):
        discoveries = control_fdr(rows["p"].to_numpy(dtype=np.float64), rules.alpha, method)
        table.loc[rows.index, "p_fdr"] = np.maximum(discoveries.adjusted, rows["p"])
    return table


def _descriptives(analysis: results.Analysis) -> Iterator[Columns]:
    """Describe the first visit of each participant in the model."""
    cohort = analysis.compared
    in_model = analysis.design.rows
    first = in_model[~cohort.table[PARTICIPANT].iloc[in_model].duplicated().to_numpy()]
    members = results.members_of(analysis, cohort.table.iloc[first])
    for hemi in hemispheres(cohort):
        values = summary_values(cohort, hemi, analysis.measured.summaries)
        values = values.iloc[first]
        for group, rows in members.items():
            values_here = values[rows]
            yield {
                "hemi": hemi,
                "group": group,
                "measure": values_here.columns,
                "unit": [cohort.units.get(str(name), "1") for name in values_here.columns],
                "n": values_here.notna().sum().to_numpy(),
                "mean": values_here.mean().to_numpy(),
                "sd": values_here.std().to_numpy(),
            }


def _registration_tables(cohort: Cohort, analysis: results.Analysis) -> Iterator[Named]:
    yield from registration_tables(cohort, analysis.registrations)
    if analysis.unregistered:
        yield "alignment", _alignment(analysis)
    yield "profiles", _stacked(_profiles(cohort, analysis))
    if analysis.groups is not None:
        shifts = (
            {"hemi": hemi, "group": group, **shift}
            for hemi, registration in analysis.registrations.items()
            for group, shift in registration.by_group.items()
        )
        yield "shifts", _stacked(shifts)


def registration_tables(
    cohort: Cohort, registrations: Mapping[str, Registration]
) -> Iterator[Named]:
    """Make the tables of registration and of its warps."""
    rows = [
        {
            "hemi": hemi,
            "n": len(registration.warps),
            "explained_before": registration.explained_before,
            "explained_after": registration.explained_after,
            "iterations": registration.iterations,
            "converged": registration.converged,
            **registration.difference,
        }
        for hemi, registration in registrations.items()
    ]
    yield "registration", pd.DataFrame(rows)
    yield "warps", _stacked(_warps(cohort, registrations))


def _alignment(analysis: results.Analysis) -> pd.DataFrame:
    """One row per map: what survives with and without registration, and how alike both are."""
    rows = []
    for key, test, discoveries in results.tested_maps(analysis):
        if key in analysis.unregistered:
            statistic, before = analysis.unregistered[key]
            n_significant, n_unregistered, n_both = (
                int(points.sum())
                for points in (
                    discoveries.rejected,
                    before.rejected,
                    discoveries.rejected & before.rejected,
                )
            )
            survive = n_significant + n_unregistered
            rows.append(
                {
                    "measure": key.measure,
                    "contrast": key.contrast,
                    "hemi": key.hemi,
                    "n_tests": discoveries.n_tests,
                    "n_significant": n_significant,
                    "n_unregistered": n_unregistered,
                    "n_both": n_both,
                    "dice": 2 * n_both / survive if survive else np.nan,
                    "statistic_r": pd.Series(test.statistic).corr(pd.Series(statistic)),
                }
            )
    return pd.DataFrame(rows)


def _warps(cohort: Cohort, registrations: Mapping[str, Registration]) -> Iterator[Columns]:
    for hemi, result in registrations.items():
        visits = cohort.table.iloc[cohort.sides[hemi].rows]
        yield {
            PARTICIPANT: visits[PARTICIPANT].to_numpy(),
            SESSION: visits[SESSION].to_numpy(),
            "hemi": hemi,
            "displacement": result.displacement,
            "extreme": result.extreme,
            **{f"node_{i}": column for i, column in enumerate(result.warps.T, start=1)},
        }


def _curves(analysis: results.Analysis, curve: CurveOf) -> Iterator[Columns]:
    """Curves of both models of each comparison."""
    for hemi, measure, (control, case), comparison in analysis.pairs:
        labels = {"hemi": hemi, "control": control, "case": case, "added": measure}
        for classifier, result in (("base", comparison.base), ("full", comparison.full)):
            yield {**labels, "classifier": classifier, **curve(result)}


def _roc(result: ClassifierResult) -> Columns:
    return dict(zip(("false_positives", "true_positives"), result.curve, strict=True))


def _calibration(result: ClassifierResult) -> Columns:
    calibration = result.calibration
    return {"predicted": calibration.predicted, "observed": calibration.observed}


def _classification(analysis: results.Analysis, settings: GroupSettings) -> pd.DataFrame:
    base = " + ".join(settings.classification.base)
    return pd.DataFrame(
        [
            {
                "hemi": hemi,
                "control": control,
                "case": case,
                "base": base,
                "added": measure,
                **comparison.columns,
            }
            for hemi, measure, (control, case), comparison in analysis.pairs
        ]
    )
