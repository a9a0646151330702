"""No text of a figure lies on another or leaves the page, whatever it shows."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.lines import Line2D
from matplotlib.text import Text

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group.output import color_bar
from hipsta_bids.group.output.color_bar import spanned
from hipsta_bids.group.output.figures import draw_registration, draw_roc
from hipsta_bids.group.output.ground import Ground
from hipsta_bids.group.output.maps import ContrastMap, contrasts
from hipsta_bids.group.output.panels import Row, draw_pages
from hipsta_bids.group.output.style import ONE_COLUMN, TWO_COLUMNS, style
from hipsta_bids.io.gifti import sheet_triangles
from hipsta_bids.reports.cells import MINUS
from hipsta_bids.types import Mesh

GRID = (41, 21)
LONG = "CN-AD in the slope of thickness over years since the first visit, by a spline of age"
FIVE = ("PrS", "Sub", "CA1", "CA2/3", "DG")
NINE = ("ParaSub", "PreSub", "ProS", "Sub", "CA1", "CA2", "CA3", "CA4", "DG")
ROUNDING = 1.0  # pixel: glyphs are put on whole ones


def tube(lateral):
    """A bent wall, 30 mm long."""
    u, y = np.meshgrid(np.linspace(0, 4, GRID[0]), np.linspace(-15, 15, GRID[1]), indexing="ij")
    points = np.stack([lateral * 5 * np.sin(u), y, -5 * np.cos(u)], axis=-1).reshape(-1, 3)
    return Mesh(points=points, triangles=sheet_triangles(*GRID).astype(np.int64))


def ground(hemi, names=FIVE, *, surface=True, mesh=None, whole=False):
    if mesh is not None:
        none = np.full((len(mesh.points), 1), -1)
        ends = np.array([-1.0, 1.0])
        return Ground(x=ends, y=ends, subfield=none, names=(), mesh=mesh)
    fields = np.repeat(np.arange(GRID[0]) * len(names) // GRID[0], GRID[1]).reshape(GRID)
    return Ground(
        x=np.linspace(-0.9, 0.9, GRID[0]),
        y=np.linspace(-1.6, 1.9, GRID[1]) if whole else np.linspace(-1, 1, GRID[1]),
        subfield=fields,
        names=names,
        surface=tube(1 if hemi == "R" else -1) if surface else None,
    )


def rows_of(grounds, n_groups, n_contrasts, *, kind="t", name="CN-AD", scale=1.0, smallest=1e-6):
    """Means of groups, and effects and significance of contrasts."""
    random = np.random.default_rng(0)
    n = {hemi: one.subfield.size for hemi, one in grounds.items()}
    for index in range(n_groups):
        values = {hemi: scale * random.normal(2, 0.2, size) for hemi, size in n.items()}
        label = "mean,\nlongitudinal curvature of the exterior wall [1/mm]"
        title = f"Mean, group {index} (n = 12 left, 11 right)"
        colors = spanned("viridis", values)
        yield [Row(kind="mean", index=index, title=title, label=label, scale=colors, values=values)]
    tests = {
        hemi: {
            "thickness": {
                f"{name} {index}": ContrastMap(
                    kind=kind,
                    effect=np.abs(random.normal(0, 1, size)),
                    statistic=np.abs(random.normal(0, 3, size)),
                    df=np.full(size, 30.0),
                    adjusted=10 ** random.uniform(np.log10(smallest), 0, size),
                    rejected=np.arange(size) < 90,
                    alpha=0.05,
                )
                for index in range(n_contrasts)
            }
        }
        for hemi, size in n.items()
    }
    yield from contrasts(tests, "thickness")


def titled():
    """A row with the subfields of one protocol in its title."""
    (row,) = next(rows_of({"L": ground("L", surface=False)}, 1, 0))
    return [replace(row, title=f"control-patient: freesurfer (n = 14); {', '.join(NINE)}")] * 2


def maps(sides="LR", n_groups=2, n_contrasts=1, *, width=None, widest=None, like=None, kind="t",
         name="CN-AD", scale=1.0, smallest=1e-6):  # fmt: skip
    names = {"D": "LR", "B": "both"}
    grounds = {names.get(hemi, hemi): ground(hemi, **(like or {})) for hemi in sides}
    options = {"kind": kind, "name": name, "scale": scale, "smallest": smallest}
    blocks = list(rows_of(grounds, n_groups, n_contrasts, **options))
    return draw_pages(grounds, blocks, width=width, widest=widest)


def test_maps_that_the_page_limits_in_height_have_no_space_beside_them():
    """Six rows of flat maps fill a page before they fill two columns; the label is at their bar."""
    (tall,) = maps(n_groups=6, n_contrasts=0, widest=TWO_COLUMNS, like={"surface": False})
    (flat,) = maps(n_groups=1, n_contrasts=0, widest=TWO_COLUMNS, like={"surface": False})
    assert flat.get_figwidth() * 25.4 == pytest.approx(TWO_COLUMNS, abs=0.1)
    beyond = [
        (1 - max(axes.get_position().x1 for axes in figure.axes)) * figure.get_figwidth()
        for figure in (tall, flat)
    ]
    assert beyond[0] == pytest.approx(beyond[1], abs=0.02)  # inches
    assert tall.get_figwidth() < 0.8 * flat.get_figwidth()


def results(groups=("CN", "AD"), sides="LR", measure="thickness_mean"):
    """Tables of registration and classification."""
    random, nodes = np.random.default_rng(0), np.arange(1, 42)
    profiles = [
        {"measure": "curvature", "unit": "1/mm", "hemi": hemi, "registered": state, "group": group,
         "node_x": nodes, "n": 14, "mean": random.normal(0, 1, 41), "mean_se": np.full(41, 0.1)}
        for hemi in sides for state in (False, True) for group in groups
    ]  # fmt: skip
    warps = pd.DataFrame(np.linspace(0, 1, 41) + random.normal(0, 0.02, (20 * len(sides), 41)))
    warps.columns = [f"node_{node}" for node in nodes]
    people = [f"sub-{n:02d}" for n in range(20)]
    warps.insert(0, "participant_id", people * len(sides))
    warps.insert(1, "hemi", np.repeat(list(sides), 20))
    areas = {f"auc_{name}{end}": 0.61 for name in ("base", "full")
             for end in ("", "_low", "_high", "_cv")}  # fmt: skip
    keys = [
        {"hemi": hemi, "control": control, "case": case, "added": measure}
        for control, case in combinations(groups, 2)
        for hemi in (*sides, "LR")
    ]
    line = np.linspace(0, 1, 9)
    curves = [
        {**key, "classifier": name, "false_positives": line, "true_positives": line**0.5}
        for key in keys
        for name in ("base", "full")
    ]
    tables = {
        "profiles": pd.concat(map(pd.DataFrame, profiles)),
        "warps": warps,
        "covariates": pd.DataFrame({"participant_id": people, "group": np.resize(groups, 20)}),
        "classification": pd.DataFrame([{**key, **areas, "separated": True} for key in keys]),
        "roc": pd.concat(map(pd.DataFrame, curves)),
    }
    return GroupResults(folder=Path(), record={"groups": {"column": "group"}}, _tables=tables)


FLAT = Mesh(
    points=np.stack([*np.meshgrid(np.arange(9.0), np.arange(21.0), indexing="ij"),
                     np.zeros((9, 21))], axis=-1).reshape(-1, 3),
    triangles=sheet_triangles(9, 21).astype(np.int64),
)  # fmt: skip
FOUR = ("cognitively normal", "subjective decline", "mild impairment", "dementia of any type")
LAYOUTS = {
    "both sides": maps,
    "one side": lambda: maps("R"),
    "no surfaces": lambda: maps(like={"surface": False}),
    "one column": lambda: maps(width=ONE_COLUMN),
    "one side in one column": lambda: maps("L", width=ONE_COLUMN),
    "one side in two columns": lambda: maps("L", 1, 0, width=TWO_COLUMNS),
    "three sides": lambda: maps("LRD"),
    "three sides in one column": lambda: maps("LRD", width=ONE_COLUMN),
    "four sides": lambda: maps("LRDB", 0, 2, kind="z"),
    "many contrasts": lambda: maps("LR", 3, 5),
    "one side with small p": lambda: maps("L", 0, 2, kind="t", smallest=1e-12),
    "subfields of several protocols": lambda: draw_pages(
        {"L": ground("L", (), surface=False)}, [titled()]
    ),
    "six rows": lambda: maps("LR", 6, 0),
    "long names": lambda: maps("LR", 2, 2, name=LONG),
    "long names in one column": lambda: maps("L", 1, 1, name=LONG, width=ONE_COLUMN),
    "many subfields": lambda: maps(like={"names": NINE}),
    "many subfields in one column": lambda: maps(like={"names": NINE}, width=ONE_COLUMN),
    "head and tail": lambda: maps(like={"whole": True}),
    "F tests": lambda: maps("LR", 1, 1, kind="F"),
    "small values": lambda: maps("LR", 1, 0, scale=1e-3),
    "large values": lambda: maps("LR", 1, 0, scale=1e4),
    "flat surfaces of other programs": lambda: maps(like={"mesh": FLAT}),
    "folded surfaces of other programs": lambda: maps(like={"mesh": tube(-1)}),
    "registration": lambda: draw_registration(results()),
    "registration of four groups": lambda: draw_registration(results(FOUR)),
    "registration in one column": lambda: draw_registration(results(FOUR), ONE_COLUMN),
    "ROC": lambda: draw_roc(results(("CN", "MCI", "AD"))),
    "ROC of long names": lambda: draw_roc(results(FOUR[2:], measure="long_curvature_ext_CA2_3")),
    "ROC of one side": lambda: draw_roc(results(sides="L")),
    "ROC in one column": lambda: draw_roc(results(), ONE_COLUMN),
}


def texts_of(figure):
    """Texts that are drawn, with their boxes."""
    unseen = set()
    for axes in figure.axes:
        for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            if not axes.axison:
                unseen |= set(axis.findobj(Text))
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not min(ends) - 1e-9 <= tick.get_loc() <= max(ends) + 1e-9:
                    unseen |= set(tick.findobj(Text))
    return [
        (text.get_text(), text.get_window_extent())
        for text in figure.findobj(Text)
        if text not in unseen and text.get_visible() and text.get_text().strip()
    ]


def overlap(first, second):
    """Whether boxes share more than rounding."""
    width = min(first.x1, second.x1) - max(first.x0, second.x0)
    height = min(first.y1, second.y1) - max(first.y0, second.y0)
    return width > ROUNDING and height > ROUNDING


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_texts_overlap_or_leave_the_figure(layout):
    with style():
        for figure in LAYOUTS[layout]():
            figure.draw_without_rendering()
            texts = texts_of(figure)
            assert len(texts) > 10
            pairs = [(a, b) for (a, one), (b, two) in combinations(texts, 2) if overlap(one, two)]
            assert pairs == []
            box = figure.bbox
            outside = [
                text
                for text, at in texts
                if at.x0 < -ROUNDING or at.y0 < -ROUNDING
                or at.x1 > box.x1 + ROUNDING or at.y1 > box.y1 + ROUNDING
            ]  # fmt: skip
            assert outside == []


def test_titles_of_two_lines_are_whole():
    with style():
        (figure,) = LAYOUTS["subfields of several protocols"]()
        figure.draw_without_rendering()
    texts = [text for text, _ in texts_of(figure)]
    assert texts.count(", ".join(NINE)) == 2
    assert texts.count("control-patient: freesurfer (n = 14)") == 2


@pytest.mark.parametrize(
    ("number", "tick"),
    [("0.0001", "10⁻⁴"), ("1e-12", "10⁻¹²"), ("0.00015", "0.00015"), ("5e-05", f"5e{MINUS}05"),
     ("-2.5", f"{MINUS}2.5"), ("10,000", "10,000")],
)  # fmt: skip
def test_ticks_are_short(number, tick):
    assert color_bar._tick_text(number) == tick


def test_small_p_are_powers_of_ten_on_the_color_bar():
    with style():
        (figure,) = LAYOUTS["one side with small p"]()
        figure.draw_without_rendering()
    texts = {text for text, _ in texts_of(figure)}
    assert {"10⁻⁴", "10⁻⁸", "0.05"} <= texts
    assert not any(text.startswith(("1e", "0.000")) for text in texts)


def test_what_is_written_is_beside_maps_and_the_ruler_is_clear_of_the_color_bar():
    with style():
        (figure,) = maps()
        figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in figure.axes]
    for text, place in texts_of(figure):
        assert not any(overlap(place, box) for box in boxes), text
    (ruler,) = (line for line in figure.artists if isinstance(line, Line2D))
    ends = ruler.get_window_extent()
    assert ends.y1 < min(box.y0 for box in boxes)
    bars = [axes.get_window_extent() for axes in figure.axes if axes.get_gid() is None]
    assert len(bars) == 4
    assert ends.x1 < min(bar.x0 for bar in bars)


def test_sides_have_the_same_ticks():
    (figure,) = draw_registration(results())
    figure.draw_without_rendering()
    rows = np.reshape(figure.axes, (2, 4))
    for left, right in rows.T:
        assert left.get_ylim() == right.get_ylim()
        assert left.get_yticks().tolist() == right.get_yticks().tolist()
    for shifts in rows[:, 2]:  # nothing is cut off
        low, high = shifts.get_ylim()
        lines = np.concatenate([np.concatenate(c.get_segments()) for c in shifts.collections
                                if hasattr(c, "get_segments")])  # fmt: skip
        assert low < lines[:, 1].min()
        assert lines[:, 1].max() < high
