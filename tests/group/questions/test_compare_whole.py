"""The group level on sheets with head and tail: more rows, and nodes without values."""

import re

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from small_cohorts import NODES
from whole_cohorts import QUICK, REGION, SHAPE, TAIL, N, write_whole

from hipsta_bids.cli.main import main
from hipsta_bids.geometry.sheet import sheet_levels
from hipsta_bids.group.output import figures, write
from hipsta_bids.protocols import body_ends
from hipsta_bids.reports.group import group_page
from hipsta_bids.settings import SheetSettings
from hipsta_bids.types import parts_of

pytestmark = needs("regions")


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here."""


def only_maps(*given):
    return ((name, draw) for name, draw in figures.draw_figures(*given) if name.endswith("_maps"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    data, out = write_whole(tmp_path_factory.mktemp("whole"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", only_maps)
        assert main([str(data), str(out), "group", "--region", REGION, *QUICK]) == 0
    return out / "group" / f"thickness_group_{REGION}"


@pytest.fixture(scope="module")
def points(folder):
    return {
        hemi: pd.read_csv(path, sep="\t")
        for hemi in "LR"
        for path in folder.glob(f"hemi-{hemi}_*statmap.tsv")
    }


@pytest.mark.parametrize("region", ["headbody", "whole"])
@pytest.mark.parametrize("nodes", [9, 12, 21])
def test_rows_are_of_the_part_that_the_participant_level_says(region, nodes):
    _, y, _ = sheet_levels(SheetSettings(y_nodes=nodes), region)
    parts = parts_of(y)
    assert parts is not None
    body = np.flatnonzero(parts == "body")
    assert (body[0], body[-1]) == body_ends(region, len(y))


def test_difference_in_the_head_is_found_and_named(folder, points):
    head = TAIL + NODES[1] + 2
    for table in points.values():
        found = (table.significant == True).to_numpy()  # noqa: E712  (may be missing)
        assert found.reshape(SHAPE)[11:14, head - 1 : head + 2].all()
        assert found[table.part != "head"].mean() < 0.05
        assert set(table.part) == {"tail", "body", "head"}
        assert ((table.y > 1) == (table.part == "head")).all()
    peaks = pd.read_csv(folder / "peaks.tsv", sep="\t")
    assert (peaks.groupby("hemi").first().part == "head").all()  # the largest clusters
    assert "head (x" in (folder.parent / f"{folder.name}.html").read_text()


def test_no_value_is_made_where_there_was_none(points):
    for table in points.values():
        n = table.n.to_numpy().reshape(SHAPE)
        assert (n[[0, -1]] == 0).all()
        assert n[:, -1].max() == N // 2
        assert (n[5, TAIL + 1 : TAIL + 4] == 0).all()  # fewer than half have a value
        assert ((n == 0) | (n >= N / 2)).all()
        # A group may have fewer than three participants left, who are not tested.
        assert (np.isfinite(table.p) <= (table.n > 0)).all()
        assert np.isfinite(table.p)[table.n > 0.75 * N].all()


def test_what_is_experimental_is_said(folder):
    page = (folder.parent / f"{folder.name}.html").read_text()
    assert "Region whole is experimental." in page
    text = (folder / "methods.md").read_text()
    assert "the whole hippocampus on one sheet (experimental)" in text
    assert "Missing values were not imputed" in text


def test_figures_show_how_many_have_a_value(folder):
    text = (folder / "figures" / "thickness_maps.svg").read_text()
    assert "Sheets with a value at each point" in text
    for word in ("tail", "body", "head"):
        assert f">{word}<" in text


@needs("trials")
def test_trials_say_what_was_measured(folder):
    out = folder.parents[1]
    power = [*QUICK[:2], "--power", "thinning=5%", "--name", "power"]
    assert main([str(out.parent / "bids"), str(out), "group", "--region", REGION, *power]) == 0
    text = (out / "group/power/methods.md").read_text()
    assert "Measures of the whole hippocampus on one sheet (experimental) [1]" in text
    points = pd.read_csv(out / "group/power/power_points.tsv", sep="\t")
    assert set(points.part) == {"tail", "body", "head"}
    known = int((points[points.hemi == "L"].n > 0).sum())
    page = group_page(out / "group/power")
    assert re.search(rf"<td>left</td>\s*<td[^>]*>{known}</td>", page)
