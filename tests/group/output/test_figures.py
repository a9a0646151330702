"""Where figures put what they show, and that letters, lines and colors are those of the values."""

import contextlib
import io
import re
import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.contour import ContourSet
from matplotlib.image import BboxImage
from matplotlib.text import Text
from PIL import Image
from scipy.spatial.transform import Rotation

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group.output.figures import draw_calibration, draw_roc, draw_sections
from hipsta_bids.group.output.maps import draw_measure
from hipsta_bids.group.output.panels import draw_view
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.output.style import encode, style
from hipsta_bids.group.output.views import across, draw_mesh, flat_layout, look
from hipsta_bids.io.gifti import sheet_triangles, surface_bytes
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.stats.classify import Area, calibrate, roc_curve
from hipsta_bids.stats.settings import ClassificationSettings
from hipsta_bids.types import Mesh

GRID = (21, 7)
GRAY = {"cmap": "gray", "vmin": 0.0, "vmax": 1.0}
ABOVE = np.eye(3)


def surface(length, width, height, grid=(11, 6)):
    """A grid bent upward along its length; heights of its points are the second answer."""
    u, v = np.meshgrid(*(np.linspace(-1, 1, n) for n in grid), indexing="ij")
    points = np.stack([length * u, width * v, height * u**2], axis=-1).reshape(-1, 3) / 2
    return Mesh(points=points, triangles=sheet_triangles(*grid).astype(np.int64)), points[:, 2]


def no_lines(view):
    return np.zeros(view.triangle.shape, dtype=bool)


def test_half_of_a_flat_sheet_has_the_color_of_its_values():
    """Seen from above, right is right, up is up, and both sides of a surface are as bright."""
    mesh, _ = surface(20.0, 10.0, 0.0)
    for triangles in (mesh.triangles, mesh.triangles[:, ::-1]):
        view = look(Mesh(points=mesh.points, triangles=triangles), ABOVE, 4.0, (60, 100))
        right_and_up = (mesh.points[:, 0] > 0) & (mesh.points[:, 1] > 0)
        shown = draw_view(view, no_lines(view), right_and_up.astype(float), GRAY, None)
        assert shown.shape == (60, 100, 4)
        assert (shown[..., 3] == 255).mean() == pytest.approx(80 * 40 / 6000, rel=0.03)
        bright = (shown[..., 0] > 150) & (shown[..., 0] < 255)
        rows, columns = np.nonzero(bright)
        # 80 by 40 pixels are in the middle: a quarter of them is bright, the last nodes aside.
        assert (rows.min(), columns.max()) == (11, 88)
        assert rows.max() < 32
        assert columns.min() > 48
        assert view.triangle[::2, ::2][10:50, 10:90].min() >= 0
        assert (view.triangle >= 0).mean() == pytest.approx(80 * 40 / 6000, rel=0.03)
        assert len(np.unique(view.light.round(6))) == 1


def test_what_is_nearer_hides_what_is_farther():
    """In any order of triangles, also where two sheets pass through each other."""
    low, _ = surface(10.0, 10.0, 0.0)
    tilt = Rotation.from_euler("y", 30, degrees=True).apply(low.points)
    points = np.concatenate([low.points, tilt])
    triangles = np.concatenate([low.triangles, low.triangles + len(low.points)])
    order = np.random.default_rng(0).permutation(len(triangles))
    view = look(Mesh(points=points, triangles=triangles[order]), ABOVE, 5.0, (60, 60))
    tilted = triangles[order][view.triangle[30]][:, 0] >= len(low.points)
    inside = np.flatnonzero(view.triangle[30] >= 0)
    half = (inside[0] + inside[-1]) / 2
    # Turned about y, its left half rises toward the viewer, and its right half sinks.
    heights = tilt[tilt[:, 0] < 0, 2].mean()
    nearer = inside < half - 2 if heights > 0 else inside > half + 2
    farther = inside > half + 2 if heights > 0 else inside < half - 2
    overlap = np.abs(inside - half) < 0.8 * np.cos(np.radians(30)) * (inside[-1] - half)
    assert tilted[inside[nearer & overlap]].all()
    assert not tilted[inside[farther & overlap]].any()


@pytest.mark.parametrize("below", [False, True])
def test_views_face_the_viewer_with_anterior_up(below):
    along = np.array([0.1, 0.9, -0.4])
    axes = across(along, np.array([1.0, 0, 0]), below=below)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)  # nothing is mirrored
    assert axes[1] @ along > 0.99 * np.linalg.norm(along)
    assert np.sign(axes[2, 2]) == (-1 if below else 1)
    assert np.sign(axes[0, 0]) == (-1 if below else 1)
    assert axes[2, 0] > 0  # the lateral wall is seen
    assert np.isfinite(across(np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), below=below)).all()


def test_lines_enclose_regions_and_not_the_silhouette():
    mesh, _ = surface(20.0, 10.0, 0.0, grid=(41, 21))
    view = look(mesh, ABOVE, 4.0, (60, 100))
    region = (np.abs(mesh.points[:, 0]) < 3.9).astype(int)
    line = view.border(view.region(region, 1), 1.0)
    columns = np.flatnonzero(line[60])
    at = (columns / 2 - 50) / 4  # mm
    assert set(np.sign(at)) == {-1, 1}
    np.testing.assert_allclose(np.abs(at), 3.75, atol=0.4)  # half a cell from the last node
    assert not view.border(view.seen, 1.0).any()


@pytest.mark.parametrize(("size", "words"), [((20.0, 8.0), "yx"), ((8.0, 20.0), "xy")])
def test_a_flat_surface_is_drawn_upright_in_its_own_coordinates(size, words):
    mesh, _ = surface(*size, 0.0)
    axis = new_figure((3.0, 3.0), None).subplots()
    draw_mesh(axis, mesh, np.zeros(len(mesh.points)), GRAY)
    assert flat_layout(mesh)[1] == (f"{words[0]} of the surface", "")
    assert axis.get_ylabel() == f"{words[1]} of the surface"
    assert axis.get_xlim() == (-4.0, 4.0)
    assert axis.get_ylim() == (-10.0, 10.0)


@pytest.mark.parametrize("version", [1, 2])
def test_unfolded_surfaces_of_hippunfold_lie_as_sheets_do(version):
    """Of both versions the posterior end is at the bottom and the subiculum on the left."""
    mesh, _ = surface(40.0, 20.0, 0.0)
    points = mesh.points + np.array([-20.0, -190.0, 1.0])  # version 1: x is posterior to anterior
    mesh = replace(mesh, points=points if version == 1 else points[:, [1, 0, 2]])
    plane, ends, name = flat_layout(mesh)
    np.testing.assert_array_equal(plane, points[:, [1, 0]])
    assert ends == ("medial", "lateral")
    assert name == "posterior to anterior"
    axis = new_figure((3.0, 3.0), None).subplots()
    draw_mesh(axis, mesh, np.zeros(len(points)), GRAY)
    assert axis.get_ylim() == (-40.0, 0.0)


def test_triangles_without_a_value_are_left_out():
    mesh, _ = surface(20.0, 8.0, 0.0)
    values = np.full(len(mesh.points), 0.5)
    values[0] = np.nan
    axis = new_figure((3.0, 3.0), None).subplots()
    draw_mesh(axis, mesh, values, GRAY)
    (colors,) = axis.collections
    assert len(colors.get_array()) == len(mesh.triangles) - (mesh.triangles == 0).any(axis=1).sum()


def measured(folder, survive, sides="LR", *, kind="t", mesh=None, groups=("CN", "AD"),
             contrasts=1, surface=True):  # fmt: skip
    """The files of an analysis of thickness in which some points survive on the left side."""
    nx, ny = GRID
    random = np.random.default_rng(0)
    if mesh is None:
        points = nx * ny
        i, j = np.indices(GRID).reshape(2, -1)
        x, y = np.linspace(-0.9, 0.9, nx), np.linspace(-0.9, 0.9, ny)
        place = {"node_x": i + 1, "node_y": j + 1, "x": x[i], "y": y[j]}
        names = np.where(i < 7, "Sub", "CA1")
    else:
        points = len(mesh.points)
        place = {"vertex": np.arange(points)}
        place |= {f"surface_{axis}": mesh.points[:, n] for n, axis in enumerate("xyz")}
        names = np.full(points, np.nan)
    tables, maps = {}, []
    for hemi in sides:
        for n in range(contrasts):
            flags = np.asarray(survive) if hemi == "L" else np.zeros(points, dtype=bool)
            name = f"hemi-{hemi}_{n}"
            effect = random.uniform(0, 0.5, points)
            tables[name] = pd.DataFrame(
                {
                    **place,
                    "subfield": names,
                    "n": 4,
                    "statistic": np.abs(random.normal(0, 1, points)),
                    "df": 20.0,
                    "p_corrected": np.where(flags, 0.001, 0.5),
                    "significant": flags,
                    "cohen_d": effect if kind == "t" else np.nan,
                    "eta_squared": effect,
                }
            )
            contrast = f"{groups[0]}-{groups[-1]} {n}" if n else "CN-AD"
            maps.append({"measure": "thickness", "contrast": contrast, "hemi": hemi, "file": name})
    tables["maps"] = pd.DataFrame(maps)
    tables["means"] = pd.concat(
        pd.DataFrame({"measure": "thickness", "unit": "mm", "hemi": hemi, "group": group,
                      **place, "n": 2, "mean": random.normal(2, 0.1, points)})
        for hemi in sides for group in groups
    )  # fmt: skip
    for hemi, own in shapes_of(sides).items() if surface and mesh is None else ():
        write_mesh(folder / f"hemi-{hemi}_desc-average_midthickness.surf.gii", own)
    if mesh is not None:
        for hemi in sides:
            write_mesh(folder / f"hemi-{hemi}_space-thickness_midthickness.surf.gii", mesh)
    return GroupResults(folder=folder, record={"comparison": {"pair": None}}, _tables=tables)


def write_mesh(path, mesh):
    triangles = mesh.triangles.astype(np.int32)
    path.write_bytes(
        surface_bytes(mesh.points, triangles, hemi=path.name[5], secondary=None, unfolded=False)
    )


def shapes_of(sides="LR"):
    """The middle of a bent wall on each side."""
    u, y = np.meshgrid(np.linspace(0, np.pi, GRID[0]), np.linspace(-15, 15, GRID[1]), indexing="ij")
    triangles = sheet_triangles(*GRID).astype(np.int64)
    return {
        hemi: Mesh(
            points=np.stack([lateral * 5 * np.sin(u), y, -5 * np.cos(u)], axis=-1).reshape(-1, 3),
            triangles=triangles,
        )
        for hemi in sides
        for lateral in [1 if hemi == "R" else -1]
    }


def draw(results):
    return draw_measure(results, "thickness", {})


def drawn(results):
    return dict(encode("maps", lambda: draw(results)))


def maps_of(figure):
    """Unfolded maps by their identifiers."""
    return {axes.get_gid(): axes for axes in figure.axes if axes.get_gid()}


def bold_lines(axes):
    return [c for c in axes.collections if isinstance(c, ContourSet) and c.get_linewidths()[0] > 1]


NONE = np.zeros(GRID[0] * GRID[1], dtype=bool)
SOME = np.arange(GRID[0] * GRID[1]) < 40


def test_the_threshold_is_drawn_exactly_where_something_survives(tmp_path):
    (figure,) = draw(measured(tmp_path, SOME))
    maps = maps_of(figure)
    assert set(maps) == {
        f"map-{kind}-{n}-{hemi}"
        for hemi in "LR"
        for kind, n in (("mean", 0), ("mean", 1), ("effect", 0), ("significance", 0))
    }
    enclosed = {name for name, axes in maps.items() if bold_lines(axes)}
    assert enclosed == {"map-effect-0-L", "map-significance-0-L"}
    (line,) = bold_lines(maps["map-effect-0-L"])
    inside = [path.contains_points(nodes()) for path in line.get_paths()]
    np.testing.assert_array_equal(np.any(inside, axis=0), SOME)
    titles = [text.get_text() for text in figure.texts]
    assert "Significant: 40 left, 0 right of 147 points" in titles
    words = {"Left", "Right", "unfolded", "superior", "inferior", "a", "b", "c", "d"}
    assert words | {"medial", "lateral", "med.", "lat.", "anterior", "posterior"} <= set(titles)
    assert titles.count("Sub") == titles.count("CA1") == 2  # below each side
    (borders,) = [c for c in maps["map-mean-0-R"].collections if isinstance(c, LineCollection)]
    between = np.concatenate(borders.get_segments())
    np.testing.assert_allclose(between[:, 0], -0.9 + 6.5 / 20 * 1.8)  # nodes 7 and 8
    (figure,) = draw(measured(tmp_path, NONE))
    assert not any(bold_lines(axes) for axes in maps_of(figure).values())


def nodes():
    x, y = (np.linspace(-0.9, 0.9, n) for n in GRID)
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def test_colors_of_means_span_what_is_shown(tmp_path):
    results = measured(tmp_path, SOME)
    (figure,) = draw(results)
    (image,) = maps_of(figure)["map-mean-1-L"].images
    means = results.table("means")["mean"]
    assert image.get_clim() == pytest.approx(np.percentile(means, (1, 99)))


def test_sizes_and_type_are_those_of_journals(tmp_path):
    """Both sides with surfaces take two columns of a page, all else takes one."""
    for number, (sides, surface, width) in enumerate(
        (("LR", True, 180), ("LR", False, 85), ("L", True, 85))
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        (figure,) = draw(measured(folder, SOME, sides, surface=surface))
        inches = figure.get_size_inches()
        assert inches[0] * 25.4 == pytest.approx(width, abs=0.05)
        assert inches[1] * 25.4 <= 235.5
        letters = [text for text in figure.texts if text.get_text() in "abcd"]
        assert {text.get_weight() for text in letters} == {"bold"}
        figure.draw_without_rendering()
        texts = [text for text in figure.findobj(Text) if text.get_text()]
        assert {text.get_fontsize() for text in texts} == {7.0, 8.0, 9.0}


def test_files_are_the_same_each_time_and_small(tmp_path, monkeypatch):
    first = drawn(measured(tmp_path, SOME, "L"))
    assert [name.rpartition(".")[2] for name in first] == ["png", "svg", "pdf"]
    monkeypatch.setattr("time.time", lambda: 1e9)
    assert drawn(measured(tmp_path, SOME, "L")) == first
    picture = Image.open(io.BytesIO(first["maps.png"]))
    assert picture.width == 1004  # 85 mm
    assert max(map(len, first.values())) < 1e6
    svg = first["maps.svg"].decode()
    assert ">Mean, CN (n = 2)<" in svg
    assert {"Sub", "CA1", "Left"} <= words_of(first["maps.pdf"])
    assert b"/FontFile2" in first["maps.pdf"]
    assert b"/Type3" not in first["maps.pdf"]


def words_of(printed):
    """Texts of a PDF whose fonts keep the letters' codes, as its tables of letters say."""
    streams = []
    for found in re.finditer(rb">>\s*stream\r?\n", printed):
        with contextlib.suppress(zlib.error):
            streams.append(zlib.decompressobj().decompress(printed[found.end() :]))
    assert any(b"begincmap" in stream for stream in streams)
    (page,) = (stream for stream in streams if b" Tf" in stream)
    lines = re.findall(rb"\[(.*?)\] TJ", page)
    return {b"".join(re.findall(rb"\x00([^\x00()])", line)).decode() for line in lines}


def pictures_of(figure):
    return [image.get_array() for image in figure.findobj(BboxImage)]


def test_both_sides_and_both_views_are_seen(tmp_path):
    """Each view is a picture of its own, colored, and not clipped by its box."""
    (figure,) = draw(measured(tmp_path, SOME))
    pictures = pictures_of(figure)
    assert len(pictures) == 4 * 4
    for picture in pictures:
        inked = picture[..., 3] > 0  # all around is clear
        assert 0.2 < inked.mean() < 0.95
        edges = [inked[0], inked[-1], inked[:, 0], inked[:, -1]]
        assert not np.concatenate(edges).any()
    assert len({picture.tobytes() for picture in pictures[:4]}) == 4


def test_many_contrasts_are_split_into_pages(tmp_path):
    figures = draw(measured(tmp_path, SOME, groups=("CN", "MCI", "AD"), contrasts=3, surface=False))
    kinds = [[name.split("-")[1] for name in maps_of(f) if name.endswith("L")] for f in figures]
    assert kinds == [["mean"] * 3 + ["effect", "significance"], ["effect", "significance"] * 2]
    assert all(figure.get_figheight() * 25.4 < 236 for figure in figures)


def test_effects_without_sign_begin_at_zero(tmp_path):
    (figure,) = draw(measured(tmp_path, SOME, kind="F", surface=False))
    words = [text.get_text() for text in figure.texts]
    assert {"partial eta squared", "corrected p"} <= set(words)
    bars = [axes.get_ylim() for axes in figure.axes if axes.get_gid() is None]
    assert [bar[0] for bar in bars[2:]] == [0.0, 0.0]  # after those of the means


def test_the_threshold_is_drawn_on_other_programs_flat_surfaces(tmp_path):
    flat, _ = surface(20.0, 8.0, 0.0)
    (figure,) = draw(measured(tmp_path, flat.points[:, 0] > 2, "L", mesh=flat))
    enclosed = {name for name, axes in maps_of(figure).items() if bold_lines(axes)}
    assert enclosed == {"map-effect-0-L", "map-significance-0-L"}


def test_a_folded_surface_of_other_programs_is_seen_from_above_and_below(tmp_path):
    shape = shapes_of("L")["L"]
    survive = np.arange(len(shape.points)) < 40
    (figure,) = draw(measured(tmp_path, survive, "L", mesh=shape))
    assert maps_of(figure) == {}
    assert len(pictures_of(figure)) == 4 * 2


def test_pictures_keep_their_size_at_other_resolutions(tmp_path):
    results = measured(tmp_path, SOME, "L")
    shown = []
    for dpi in (150, 300):
        files = dict(encode("maps", lambda: draw(results), ["png"], dpi))
        picture = Image.open(io.BytesIO(files["maps.png"])).convert("L")
        shown.append(np.asarray(picture.resize((50, 120)), dtype=float))
    assert np.abs(shown[0] - shown[1]).mean() < 4  # of 255: lines and letters differ a little


def test_legends_of_curves_are_beside_them_and_small_groups_have_no_calibration():
    score = np.linspace(-1, 1, 12)
    calibration = calibrate(score, score > 0, ClassificationSettings(least_calibrated=2))
    one = SimpleNamespace(
        auc=Area(0.6, 0.1, 0.4, 0.8),
        validated=(0.07, 0.01),
        curve=roc_curve(score, score > 0),
        calibration=calibration,
    )
    small = SimpleNamespace(calibration=calibrate(score, score > 0, ClassificationSettings()))
    cases = []
    for hemi, full in (("L", one), ("R", one), ("LR", small)):
        model = SimpleNamespace(base=one, full=full, columns={"separated": False})
        cases.append((hemi, "thickness_mean", ("CN", "AD"), model))
    fields = dict.fromkeys(Analysis.__dataclass_fields__)
    analysis = Analysis(**{**fields, "pairs": cases[:2]})
    keys = {"control": "CN", "case": "AD", "added": "thickness_mean"}
    areas = {f"auc_{name}{end}": 0.6 for name in ("base", "full")
             for end in ("", "_low", "_high", "_cv")}  # fmt: skip
    points = dict(zip(("false_positives", "true_positives"), one.curve, strict=True))
    tables = {
        "classification": pd.DataFrame(
            [{"hemi": hemi, **keys, **areas, "separated": False} for hemi in "LR"]
        ),
        "roc": pd.concat(
            pd.DataFrame({"hemi": hemi, **keys, "classifier": name, **points})
            for hemi in "LR"
            for name in ("base", "full")
        ),
    }
    saved = GroupResults(folder=Path(), record={}, _tables=tables)
    for figures in (partial(draw_roc, saved), partial(draw_calibration, analysis)):
        with style():
            (figure,) = figures()
            figure.draw_without_rendering()
        first, second, beside = figure.axes
        legend = beside.get_legend().get_window_extent()
        assert not legend.overlaps(first.get_window_extent())
        assert not legend.overlaps(second.get_window_extent())
        assert legend.y0 >= 0  # not cut off
        assert legend.x1 <= figure.bbox.width
    (figure,) = draw_roc(saved)
    np.testing.assert_allclose(figure.axes[0].lines[2].get_xydata(), np.transpose(one.curve))
    (figure,) = draw_calibration(Analysis(**{**fields, "pairs": cases}))
    assert [axis.get_title() for axis in figure.axes] == ["left", "right", ""]


def test_subfields_are_named_inside_them_and_end_at_lines_across_the_wall():
    x, y, z = np.meshgrid(np.arange(9.0), np.arange(7.0), np.arange(3.0), indexing="ij")
    wall = np.moveaxis(np.stack([x, y, z], axis=-1), 2, 0)  # mm; (3, x, y, 3)
    shape = AverageShape(mean=wall, by_group={"CN": wall}, counts={"CN": 3})
    fields = np.repeat([-1, 0, 0, 0, 1, 1, 1, 1, 1], 7).reshape(9, 7)
    left = SimpleNamespace(subfield=fields, maps=SimpleNamespace(names=("Sub", "CA1", "CA2")))
    cohort = SimpleNamespace(y=0.3 * np.arange(-3, 4))
    (figure,) = draw_sections(cohort, SimpleNamespace(fitted={"L": left}), {"L": shape, "R": shape})
    axes = np.reshape(figure.axes, (2, 3))
    for axis in axes[0]:
        # The left side's lateral is against x; the center is at 4 and 1 mm.
        texts = {text.get_text(): text.get_position() for text in axis.texts}
        assert texts == {"Sub": (2.0, 0.0), "CA1": (-2.0, 0.0)}
        borders = [line.get_xydata().tolist() for line in axis.lines if line.get_color() == "0.3"]
        assert borders == [[[3.5, -1], [3.5, 1]], [[0.5, -1], [0.5, 1]]]
    for sign, row in zip((-1, 1), axes, strict=True):
        middle = row[0].lines[1].get_xydata()
        np.testing.assert_allclose(middle, np.stack([sign * (x[:, 0, 0] - 4), 0 * x[:, 0, 0]], 1))
    assert not any(axis.texts for axis in axes[1])  # nothing was fitted there
    places = [axis.get_title().partition(", ")[2] for axis in axes[0]]
    assert places == ["posterior (y = -0.6)", "middle (y = 0)", "anterior (y = 0.6)"]
