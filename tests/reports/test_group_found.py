"""What a group page says about its tests: counts, margins and models that cannot be estimated."""

import math
import re

import pandas as pd
import pytest
from extension_marks import needs

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.reports.cells import MINUS
from hipsta_bids.reports.group_tables import findings, slope_of, slope_unit, summaries
from hipsta_bids.reports.page import render

MISSING = float("nan")
SPELLED = {
    "settings": {"multiplicity": {"method": "bh", "alpha": 0.05, "scope": "map"}},
    "contrasts": {"A-B": [1.0]},
}


def results_of(folder, *, record=None, **tables):
    frames = {name: pd.DataFrame(rows) for name, rows in tables.items()}
    return GroupResults(folder=folder, record=SPELLED | (record or {}), _tables=frames)


def test_row(measure, p, **changed):
    estimable = not math.isnan(p)
    return {
        "hemi": "L",
        "measure": measure,
        "unit": "mm",
        "model": "arm * visit",
        "contrast": "A-B",
        "test": "t",
        "n": 16,
        "visits": 48,
        "estimate": -0.2 if estimable else MISSING,
        "se": 0.1 if estimable else MISSING,
        "statistic": -2.0 if estimable else MISSING,
        "df": 40.0 if estimable else MISSING,
        "p": p,
        "p_fdr": p,
        "effect": "cohen_d",
        "effect_size": -0.5 if estimable else MISSING,
        "effect_low": -1.0 if estimable else MISSING,
        "effect_high": -0.1 if estimable else MISSING,
    } | changed


test_row.__test__ = False


def map_tables(n_significant, n_tests, contrast="A-B"):
    names = {"measure": "thickness", "contrast": contrast, "hemi": "L"}
    peak = names | {
        "statistic": 4.0, "p_corrected": 0.01, "subfield": "CA1", "x": 0.0, "y": 0.0, "extent": 9,
        "effect": "cohen_d", "effect_size": 1.1, "shares": "CA1 100%",
    }  # fmt: skip
    point = {
        "x": 0.0, "y": 0.0, "cohen_d": 1.1, "statistic": 4.0, "significant": True, "estimate": 0.3,
    }  # fmt: skip
    counts = {"file": "points", "n_significant": n_significant, "n_tests": n_tests}
    return {"maps": [names | counts], "peaks": [peak], "points": [point]}


def page_of(results):
    text = render("group/found.html", values=findings(results))
    return " ".join(text.split())


@pytest.mark.parametrize("lenient", [True, False])
def test_uncorrected_p_above_the_level_is_written_beside_the_count(tmp_path, lenient):
    """Two-stage corrections allow it where most points differ; readers should know."""
    tables = map_tables(858, 861)
    tables["maps"][0] |= {"lenient": lenient, "p_cutoff": 0.5612}
    page = page_of(results_of(tmp_path, **tables))
    assert "858 of 861 points survive" in page
    assert (
        "uncorrected p up to 0.56 since the effect is widespread, or all values are shifted" in page
    ) == lenient


@pytest.mark.parametrize(
    ("endpoint", "reason"),
    [
        pytest.param(
            ["clda", "ses-1", "ses-2"], "the covariance of visits", marks=needs("repeated")
        ),
        ([], "the model"),
    ],
)
def test_models_that_cannot_be_estimated_are_noted_and_not_counted(tmp_path, endpoint, reason):
    rows = [test_row("thickness_mean", MISSING, contrast=name) for name in ("A-B", "B-A")]
    record = {"comparison": {"endpoint": endpoint}}
    singular = results_of(tmp_path, measures=rows, record=record)
    assert summaries(singular) is None
    note = f"thickness mean, left: {reason} cannot be estimated"
    assert note in page_of(singular)
    assert "corrected p below 0.05" not in page_of(singular)
    measures = [*rows, test_row("volume", 0.3)]
    mixed = results_of(tmp_path, measures=measures, record=record, **map_tables(0, 861))
    page = page_of(mixed)
    assert note in page
    assert "Summary measures: 1 test in 1 family, by contrast." in page
    assert "No summary measure has a corrected p below 0.05." in page
    section = render("group/summaries.html", values=summaries(mixed))
    assert "1 test, by corrected p; 0 are below 0.05." in section
    assert "There is 1 such family." in section
    assert "<summary>1 test with a corrected p" in section


def test_a_margin_is_named_and_its_points_are_counted(tmp_path):
    record = {"one_sided": {"A-B": "> -0.05"}}
    page = page_of(results_of(tmp_path, record=record, **map_tables(860, 861)))
    assert f"Significant points of <i>A-B</i> are above {MINUS}0.05." in page
    assert f"860 above {MINUS}0.05, 1 not shown (100% of 861 points); peak CA1, " in page
    assert "is positive where A has more" not in page
    page = page_of(results_of(tmp_path, record=record, **map_tables(0, 861)))
    assert f"none of 861 points is shown to be above {MINUS}0.05" in page
    record = {"one_sided": {"A-B": "equivalent within 0.1"}}
    page = page_of(results_of(tmp_path, record=record, **map_tables(0, 861)))
    assert "none of 861 points is shown to be equivalent within 0.1" in page
    two_sided = page_of(results_of(tmp_path, record={}, **map_tables(860, 861)))
    assert "is positive where A has more" in two_sided
    assert "860 of 861 points survive" in two_sided
    mixed = record | {"contrasts": {"A-B": [1.0], "B": [1.0]}}
    assert "is positive where A has more" in page_of(
        results_of(tmp_path, record=mixed, **map_tables(860, 861))
    )


@pytest.mark.parametrize(
    ("contrasts", "words"),
    [
        (["A-B"], "1 of 1 contrast of maps has points that survive"),
        (["A-B", "B-C"], "2 of 2 contrasts of maps have points that survive"),
    ],
)
def test_one_and_several_have_their_forms(tmp_path, contrasts, words):
    tables = [map_tables(500, 861, name) for name in contrasts]
    joined = {name: [row for one in tables for row in one[name]] for name in tables[0]}
    page = page_of(results_of(tmp_path, **joined))
    assert words in page
    n = len(contrasts)
    assert f"Maps: {n} {'family' if n == 1 else 'families'} of points, each map" in page


def test_families_of_a_meta_analysis_are_of_contrasts_and_models(tmp_path):
    rows = [
        test_row("volume", 0.3, contrast=f"A-B ({kind})")
        for kind in ("fixed effect", "random effects")
    ]
    tables = map_tables(0, 861)
    page = page_of(results_of(tmp_path, measures=rows, record={"sites": ["a"]}, **tables))
    assert "Summary measures: 2 tests in 2 families, by contrast and model." in page
    assert "<summary>1 contrast of maps has no point that survives</summary>" in page


def longitudinal(folder, rows):
    """A model of visits: slopes over months, and a difference at the mean of months."""
    record = {
        "columns": ["Intercept", "arm[T.b]", "months", "arm[T.b]:months"],
        "contrasts": {"a-b": [[0, -1, 0, -6]], "slope": [[0, 0, 1, 1]], "all": [[1, 0, 0, 0]]},
    }
    return results_of(folder, record=record, measures=rows)


@pytest.mark.parametrize(("contrast", "variable"), [("slope", "months"), ("a-b", ""), ("all", "")])
def test_slopes_are_known_by_their_columns(tmp_path, contrast, variable):
    results = longitudinal(tmp_path, [])
    assert slope_of(results, contrast) == variable
    assert slope_unit(results, "mm", contrast) == ("mm per unit of months" if variable else "mm")
    assert slope_unit(results, "1", contrast) == ("per unit of months" if variable else "1")


def test_measures_that_differ_are_a_table_of_twelve_rows_and_the_rest(tmp_path):
    names = [f"measure{k}" for k in range(20)]
    rows = [test_row(name, 0.001 * (20 - k), contrast="slope") for k, name in enumerate(names)]
    rows.append(test_row("other", 0.3, contrast="a-b"))
    text = render("group/found.html", values=findings(longitudinal(tmp_path, rows)))
    shown, _, folded = text.partition("<summary>8 more tests</summary>")
    measures = [re.findall(r'<th scope="row">(\w+) \[mm\]', part) for part in (shown, folded)]
    assert measures == [names[::-1][:12], names[::-1][12:]]
    # The quantile .975 of t with 40 degrees of freedom, from tables: 2.0211.
    assert "<td>-0.2 (-0.402 to 0.00211) per unit of months</td>" in shown.replace(MINUS, "-")
    assert '<td class="n">d ' in shown
    assert "other" not in text.replace("another", "")
    section = render("group/summaries.html", values=summaries(longitudinal(tmp_path, rows)))
    assert "Estimates of <i>slope</i> are per unit of months." in section
    assert "Estimates of <i>a-b</i>" not in section
