"""One figure per group of measures: where its number comes from, on a phantom that was measured."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from measure_example import Example, spell

from hipsta_bids.geometry.sheet import equal_volume_layers
from hipsta_bids.types import Float

#: Colors that people with any kind of color vision tell apart (Okabe & Ito 2008).
INTERIOR, MID, EXTERIOR, ACCENT = "#0072B2", "#000000", "#D55E00", "#009E73"
VIOLET = "#CC79A7"
SUBFIELDS = ("#56B4E9", "#E69F00", ACCENT, VIOLET)
PALE = "#DDDDDD"

#: Measures of a cross-section, and the color of what they are of.
SECTION_COLORS = {
    "length_interior": INTERIOR,
    "length_mid": MID,
    "length_exterior": EXTERIOR,
    "circumference": ACCENT,
    "interior_exterior_ratio": MID,
    "section_area": "#666666",
    "shape_index": MID,
}


def draw_thickness(figure: Figure, example: Example) -> None:
    """Draw columns of a cross-section, two of them with their lengths."""
    words, axis = figure.subplots(1, 2, width_ratios=(1, 2))
    points = example.section(example.maps.sheet)
    _walls(axis, example.section(example.whole))
    axis.plot(*np.moveaxis(points[::2], -1, 0).swapaxes(1, 2), color=PALE, lw=1.5, zorder=1)
    lines = [("thickness: length of a z line", MID), ("from wall to wall", MID)]
    for x, color in ((10, ACCENT), (30, VIOLET)):
        axis.plot(*points[x].T, color=color, lw=3, marker=".", ms=5, zorder=4)
        lines += [(f"column {x + 1}", color), (f"  {example.at('thickness', x)}", color)]
    for name in ("thickness_mean", "thickness_nodes", "extent_z"):
        lines += [(name, MID), (f"  {example.of_summary(name)}", MID)]
    lines += [("thickness of this section, mean", MID)]
    lines += [(f"  {example.of_section('thickness')}", MID)]
    _write(words, lines)
    _plane(axis)


def draw_extents(figure: Figure, example: Example) -> None:
    """Draw lines of the mid-surface along x and y."""
    words = figure.add_subplot(1, 2, 1)
    axis = figure.add_subplot(1, 2, 2, projection="3d")
    mid = example.upright(example.whole.points[:, :, example.whole.middle])
    axis.plot_surface(*np.moveaxis(mid, -1, 0), color="#EEEEEE", alpha=0.5, lw=0.3, edgecolor=PALE)
    half, x = example.half, 20
    axis.plot(*mid[:, half].T, color=INTERIOR, lw=3, zorder=5)
    axis.plot(*mid[x].T, color=EXTERIOR, lw=3, zorder=5)
    axis.view_init(elev=28, azim=-62)
    axis.set_xlabel("lateral, mm", fontsize=8)
    axis.set_ylabel("superior, mm", fontsize=8)
    axis.set_zlabel("anterior, mm", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.set_yticks([-2, 2])
    axis.set_box_aspect(np.ptp(mid, axis=(0, 1)), zoom=0.85)
    lines = []
    for name, color, way in (
        ("extent_x", INTERIOR, "along x, from rim to rim"),
        ("extent_y", EXTERIOR, "along y, from end to end"),
    ):
        lines += [(f"{name}: length of the line", color), (way, color)]
        lines += [(f"  this line: {example.at(name, x)}", color)]
        lines += [(f"  mean: {example.of_summary(name)}", color)]
    _write(words, lines)


def draw_sections(figure: Figure, example: Example) -> None:
    """Draw one cross-section with its walls and area, and all along the axis."""
    figure.set_layout_engine("constrained")  # the panels differ in height
    words, section, along = figure.subplots(1, 3, width_ratios=(0.95, 1.1, 1.2))
    outline = example.section(example.whole)
    ring = np.concatenate([outline[:, 0], outline[::-1, -1]])
    section.fill(*ring.T, color=PALE, zorder=0)
    _walls(section, outline, legend=False)
    _plane(section)
    lines = []
    for name, color in SECTION_COLORS.items():
        digits = 3 if name in ("interior_exterior_ratio", "shape_index") else 1
        lines += [(name, color), (f"  {example.of_section(name, digits)}", color)]
    _write(words, lines)
    position = example.measured["sections"]["position"].found
    for name in ("circumference", "section_area", "length_exterior", "length_interior"):
        one = example.measured["sections"][name]
        along.plot(position, one.true, color=SECTION_COLORS[name], lw=1, ls=":")
        along.plot(position, one.found, ".", color=SECTION_COLORS[name], label=name)
    along.set(xlabel="position along the axis, mm", ylabel="lengths, mm; area, mm²", ylim=(0, 45))
    along.legend(fontsize=7, loc="lower center")
    along.set_title("dots: measured, lines: analytic", fontsize="small")


def draw_curvature(figure: Figure, example: Example) -> None:
    """Draw circles that touch the three surfaces at a column."""
    words, axis = figure.subplots(1, 2, width_ratios=(1, 2))
    points = example.section(example.maps.sheet)
    _walls(axis, example.section(example.whole))
    x, sheet = 28, example.measured["sheet"]
    outward = points[x, -1] - points[x, 0]
    outward /= np.linalg.norm(outward)
    turn = np.linspace(0, 2 * np.pi, 200)
    lines = [
        ("mean curvature: half of the sum of", MID),
        ("1/radius across and along the axis", MID),
    ]
    for ending, level, color in (
        ("_interior", 0, INTERIOR),
        ("", 4, MID),
        ("_exterior", 8, EXTERIOR),
    ):
        mean = sheet[f"curvature{ending}"].found[x, example.half]
        gauss = sheet[f"gaussian_curvature{ending}"].found[x, example.half]
        radius = 1 / (mean + np.sqrt(max(mean**2 - gauss, 0)))
        center = points[x, level] - radius * outward
        circle = center + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        axis.plot(*circle.T, color=color, lw=1.2, ls="--")
        axis.plot(*points[x, level], color=color, marker="o", ms=6)
        name = f"curvature{ending}"
        lines += [(name, color), (f"  at the dot: {example.at(name, x, 3)}", color)]
        lines += [(f"  circle of radius {radius:.1f} mm", color)]
        lines += [(f"  mean: {example.of_summary(f'{name}_mean', 3)}", color)]
    _write(words, lines)
    _plane(axis)


def draw_gaussian(figure: Figure, example: Example) -> None:
    """Draw measured and true Gaussian curvature of the three surfaces."""
    rows = figure.subplots(2, 3, sharex=True, sharey=True)
    names = [f"gaussian_curvature{ending}" for ending in ("_interior", "", "_exterior")]
    limit = 0.008
    for column, name in enumerate(names):
        one = example.measured["sheet"][name]
        keep = np.where(one.weights > 0, 1.0, np.nan)
        for row, values in zip(rows[:, column], (one.found, one.true), strict=True):
            image = row.imshow(
                (values * keep).T,
                origin="lower",
                aspect="auto",
                cmap="PuOr_r",
                vmin=-limit,
                vmax=limit,
                extent=(0.5, len(values) + 0.5, 0.5, values.shape[1] + 0.5),
            )
        found, true = example.measured["summary"][f"{name}_mean"].means
        words = f"{name}\nmean {found:.4f}, analytic {true:.4f}"
        rows[0, column].set_title(words, fontsize=8)
        rows[1, column].set_xlabel("x node, medial to lateral", fontsize=8)
    for axis, words in zip(rows[:, 0], ("measured", "analytic"), strict=True):
        axis.set_ylabel(f"{words}\ny node, post. to ant.", fontsize=8)
    figure.colorbar(image, ax=rows, label="1/mm²; positive on domes")


def draw_surfaces(figure: Figure, example: Example) -> None:
    """Draw the three surfaces with their areas, and what lies between the walls."""
    kinds = (("interior", 0, INTERIOR), ("mid", 2, "#888888"), ("exterior", 4, EXTERIOR))
    for column, (name, level, color) in enumerate(kinds):
        axis = figure.add_subplot(1, 3, column + 1, projection="3d")
        for other in (0, 2, 4):
            surface = example.upright(example.whole.points[::2, ::2, other])
            solid = other == level
            axis.plot_surface(
                *np.moveaxis(surface, -1, 0),
                color=color if solid else PALE,
                alpha=0.9 if solid else 0.12,
                lw=0,
                rcount=20,
                ccount=12,
            )
        axis.set_box_aspect(np.ptp(surface, axis=(0, 1)), zoom=1.15)
        axis.view_init(elev=25, azim=-60)
        axis.set(xticks=[], yticks=[], zticks=[])
        axis.set_title(
            f"area_{name}\n{example.of_summary(f'area_{name}', 1)}", fontsize=8, color=color
        )
    rest = (
        f"volume between the walls: {example.of_summary('volume', 1)}\n"
        f"area_ratio: {example.of_summary('area_ratio', 3)};  "
        f"surface_volume_ratio: {example.of_summary('surface_volume_ratio', 3)}"
    )
    figure.text(0.5, 0.02, rest, ha="center", fontsize=8)


def draw_profiles(figure: Figure, example: Example) -> None:
    """Draw a map and its averages along either axis."""
    (top, corner), (middle, right) = figure.subplots(
        2, 2, width_ratios=(3, 1), height_ratios=(1, 2), sharex="col"
    )
    corner.set_axis_off()
    one = example.measured["sheet"]["thickness"]
    nx, ny = one.found.shape
    nodes = np.arange(1, nx + 1), np.arange(1, ny + 1)
    image = middle.imshow(
        one.found.T, origin="lower", aspect="auto", extent=(0.5, nx + 0.5, 0.5, ny + 0.5)
    )
    figure.colorbar(image, ax=middle, label="thickness, mm", location="bottom")
    for axis, along, other in ((top, 0, 1), (right, 1, 0)):
        found = example.maps.profiles["xy"[along]]["thickness"]
        true = np.average(one.true, axis=other, weights=one.weights)
        for values, style in ((found, "."), (true, ":")):
            pair = (nodes[along], values) if along == 0 else (values, nodes[along])
            axis.plot(*pair, style, color=INTERIOR if style == "." else MID)
    top.set_ylabel("mean over y,\nmm", fontsize=8)
    right.set_xlabel("mean over x, mm", fontsize=8)
    right.set_xlim(1.5, 2.5)
    right.tick_params(labelleft=False)
    middle.set_xlabel("x node, medial to lateral", fontsize=8)
    middle.set_ylabel("y node, post. to ant.", fontsize=8)
    top.set_title("profiles: dots measured, dotted line analytic", fontsize="small")


def draw_layers(figure: Figure, example: Example) -> None:
    """Draw layers at equal distances and of equal volume at a bend."""
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    near = slice(26, 38)
    sheets = (
        ("distance", example.maps.sheet),
        ("volume", equal_volume_layers(example.maps.sheet)[0]),
    )
    for axis, (name, sheet) in zip(axes, sheets, strict=True):
        points = example.section(sheet)[near]
        for level in range(points.shape[1]):
            edge = level in (0, points.shape[1] - 1)
            axis.plot(*points[:, level].T, color=MID if edge else INTERIOR, lw=2 if edge else 1)
        axis.plot(*np.moveaxis(points, -1, 0).swapaxes(1, 2), color=PALE, lw=0.8, zorder=0)
        axis.plot(*points[:, 4].T, color=EXTERIOR, lw=2.5, label="middle layer")
        found, true = _off_middle(example, sheet.points[near, 4:-4, 4], name)
        axis.set_title(
            f'sheet.depths = "{name}"\nmiddle layer off the middle: {spell(found, true, "mm", 2)}',
            fontsize=8,
        )
        _plane(axis)
    axes[0].legend(fontsize=8)


def _off_middle(example: Example, points: Float, depths: str) -> tuple[float, float]:
    """How far the middle layer lies to the exterior of the middle, found and true, mm.

    On a bend of radius R, half of the volume lies within sqrt(R^2 + T^2 / 4) of its center.
    """
    body = example.phantom.body
    u, v, n = body.locate(points.reshape(-1, 3)).T
    if depths == "distance":
        return float(n.mean()), 0.0
    bend = body.curve.curvature(u * body.spec.width)
    true = (np.sqrt(1 + (bend * body.thickness(u, v) / 2) ** 2) - 1) / bend
    return float(n.mean()), float(true.mean())


def draw_subfields(figure: Figure, example: Example) -> None:
    """Draw the sheet by subfield, and the numbers of each."""
    sheet, text = figure.subplots(1, 2, width_ratios=(1.1, 1))
    tissues = list(example.phantom.subfield_summary(example.protocol))
    colors = ListedColormap(SUBFIELDS[: len(tissues)])
    norm = BoundaryNorm(np.arange(len(tissues) + 1) - 0.5, colors.N)
    index = np.searchsorted(tissues, example.maps.subfield)
    nx, ny = index.shape
    sheet.imshow(
        index.T,
        origin="lower",
        aspect="auto",
        cmap=colors,
        norm=norm,
        extent=(0.5, nx + 0.5, 0.5, ny + 0.5),
    )
    sheet.set(xlabel="x node, medial to lateral", ylabel="y node, posterior to anterior")
    text.set_axis_off()
    for row, tissue in enumerate(tissues):
        name = tissue.name
        lines = "\n".join(
            f"{kind}: {example.of_summary(f'{kind}_{name}', digits, 'subfields')}"
            for kind, digits in (("thickness_mean", 2), ("area", 1), ("volume", 1))
        )
        y = 0.98 - 0.25 * row
        text.text(
            0,
            y,
            name,
            color="black",
            fontsize=8,
            va="top",
            fontweight="bold",
            bbox={"facecolor": SUBFIELDS[row], "edgecolor": "none", "pad": 1.5},
        )
        text.text(0, y - 0.06, lines, fontsize=8, va="top")


#: What draws each figure of the page.
DRAWINGS: Mapping[str, Callable[[Figure, Example], None]] = {
    "thickness": draw_thickness,
    "extents": draw_extents,
    "sections": draw_sections,
    "curvature": draw_curvature,
    "gaussian": draw_gaussian,
    "surfaces": draw_surfaces,
    "subfields": draw_subfields,
    "profiles": draw_profiles,
    "layers": draw_layers,
}


def _walls(axis: Axes, outline: Float, *, legend: bool = True) -> None:
    """Draw both walls and the mid-line of a section (Nx, Nz, 2)."""
    middle = outline.shape[1] // 2
    for level, color, name in (
        (0, INTERIOR, "interior wall"),
        (middle, MID, "mid-surface"),
        (-1, EXTERIOR, "exterior wall"),
    ):
        style = "-" if level != middle else "--"
        axis.plot(*outline[:, level].T, style, color=color, lw=1.8, label=name, zorder=3)
    if legend:
        axis.legend(loc="upper left", fontsize=7)


def _plane(axis: Axes) -> None:
    """Label the axes of a cross-section."""
    axis.set_aspect("equal", adjustable="box")
    axis.set(xlabel="lateral, mm", ylabel="superior, mm")


def _write(axis: Axes, lines: Sequence[tuple[str, str]]) -> None:
    """Write lines of text, each with its color, from the top of an empty panel."""
    axis.set_axis_off()
    step = min(0.07, 1 / len(lines))
    for row, (words, color) in enumerate(lines):
        axis.text(0, 1 - step * row, words, color=color, fontsize=8, va="top")
