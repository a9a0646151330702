"""Surrogate thickness in single slices by group: means, limits, figure."""

import numpy as np
import pandas as pd
import pytest
from page_outline import Outline
from scipy import stats
from small_cohorts import FAST, GROUPS, PLAN, place_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.dataset import TABLES

FRACTIONS = np.linspace(0, 1, 5)
SLICES = (0.25, 0.5, 0.75)
#: Who has no table, and whose axis has a point without thickness.
WITHOUT, GAP = ("02", "L"), ("03", "R")
SIZES = dict(zip(GROUPS, PLAN.sizes, strict=True))


def thickness(subject, hemi, at):
    """Thickness along the medial axis: a slope to lateral and to anterior; patients lose .2 mm."""
    random = np.random.default_rng([int(subject), hemi == "R", round(100 * at)])
    loss = 0.2 * (int(subject) > PLAN.sizes[0])
    return 1.5 + 0.2 * FRACTIONS + 0.4 * at - loss + random.normal(0, 0.05, len(FRACTIONS))


def write_surrogate(place, subject, hemi):
    rows = []
    for at in SLICES:
        values = thickness(subject, hemi, at)
        for number, (fraction, value) in enumerate(zip(FRACTIONS, values, strict=True), start=1):
            text = "n/a" if (subject, hemi) == GAP and number == 1 else f"{value:.4f}"
            common = (f"{fraction:.4f}", "0", "0", "0", "0")
            mesh = f"{value + 0.1:.4f}"
            rows.append([f"{at:g}", "proportional", str(number), *common, text, mesh])
            rows.append([f"{at:g}", "equidistant", str(number), *common, "9", "9"])
    frame = pd.DataFrame(rows, columns=list(TABLES["surrogate"]))
    frame.to_csv(place.path("surrogate"), sep="\t", index=False)


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Make the page of the analysis."""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slices")
    data, out = write_dataset(folder)
    for i in range(sum(PLAN.sizes)):
        for hemi in "LR":
            subject = f"{i + 1:02d}"
            if (subject, hemi) != WITHOUT:
                write_surrogate(place_of(out, subject, hemi), subject, hemi)
    options = [option for option in FAST if option != "--no-reports"]
    assert main([str(data), str(out), "group", *options, "--name", "slices"]) == 0
    return out / "group" / "slices"


def members(group, hemi, *, gap=False):
    first = 1 if group == "CN" else PLAN.sizes[0] + 1
    names = [f"{i:02d}" for i in range(first, first + SIZES[group])]
    left_out = [WITHOUT, GAP] if gap else [WITHOUT]
    return [name for name in names if (name, hemi) not in left_out]


def test_means_and_limits_of_groups_at_each_point(results):
    rows = table(results / "surrogate.tsv")
    points = rows[rows["fraction"].notna()]
    assert len(points) == 2 * len(GROUPS) * len(SLICES) * len(FRACTIONS)
    for row in points.to_dict("records"):
        number = int(np.argmin(np.abs(FRACTIONS - row["fraction"])))
        people = members(row["group"], row["hemi"], gap=number == 0)
        values = [thickness(one, row["hemi"], row["slice"])[number] for one in people]
        assert row["n"] == len(people)
        assert row["mean"] == pytest.approx(np.mean(values), abs=1e-4)  # four digits in the files
        low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
        assert (row["mean_low"], row["mean_high"]) == pytest.approx((low, high), abs=1e-4)
        if row["hemi"] == "L":  # nobody lacks a point there
            assert row["sheet_mean"] == pytest.approx(np.mean(values) + 0.1, abs=1e-4)


def test_mean_of_a_slice_counts_participants_not_points(results):
    rows = table(results / "surrogate.tsv")
    means = rows[rows["fraction"].isna()]
    assert len(means) == 2 * len(GROUPS) * len(SLICES)
    for row in means.to_dict("records"):
        people = members(row["group"], row["hemi"])
        values = []
        for one in people:
            along = thickness(one, row["hemi"], row["slice"])
            values.append(along[1:].mean() if (one, row["hemi"]) == GAP else along.mean())
        assert row["n"] == len(people)
        low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
        found = row["mean"], row["mean_low"], row["mean_high"]
        assert found == pytest.approx((np.mean(values), low, high), abs=1e-4)


def test_figure_and_page_show_slices_by_group(results):
    figure = (results / "figures" / "surrogate.svg").read_text()
    for text in ("left, slice 25%", "slice 75%", "right, all slices", "95% limits", "CN (n = 15)"):
        assert text in figure
    text = results.with_name("slices.html").read_text()
    page = Outline(text)
    assert not page.open
    assert not page.unlabeled
    assert "group-surrogate" in page.ids
    assert "<code>hipsta-bids surrogate</code>" in text


@pytest.mark.usefixtures("without_figures")
def test_one_participant_has_no_limits_and_no_tables_give_none(tmp_path):
    data, out = write_dataset(tmp_path)
    write_surrogate(place_of(out, "01", "L"), "01", "L")
    assert main([str(data), str(out), "group", *FAST, "--name", "one"]) == 0
    rows = table(out / "group" / "one" / "surrogate.tsv")
    assert rows.query("group == 'CN'")["mean"].notna().all()
    assert rows["mean_low"].isna().all()
    assert (rows.query("group == 'AD'")["n"] == 0).all()
    place_of(out, "01", "L").path("surrogate").unlink()
    assert main([str(data), str(out), "group", *FAST, "--name", "none"]) == 0
    assert not (out / "group" / "none" / "surrogate.tsv").exists()
