"""Figures for papers, from the files of a participant or of an analysis; no model is fitted."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.api.variables import attributes, check_choice, node_axes
from hipsta_bids.derivatives.analyses import GroupResults, read_group
from hipsta_bids.errors import ArgumentError, NothingToDoError, did_you_mean
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.cohort.collect import grid_of
from hipsta_bids.group.output import figures, maps, panels, style
from hipsta_bids.group.output.ground import Ground, read_grounds
from hipsta_bids.io import files, gifti
from hipsta_bids.reports import display
from hipsta_bids.reports.cells import display_name, with_brackets
from hipsta_bids.reports.group import group_models
from hipsta_bids.reports.group_maps import measures_of
from hipsta_bids.reports.results import Hemisphere, find_results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hipsta_bids.types import Float

#: What a figure can show.
FIGURES = ("participant", "group", "contrast", "registration", "roc")
WIDTHS = {1: style.ONE_COLUMN, 2: style.TWO_COLUMNS}
_DEFAULT = ("thickness", "curvature")
_MOST_DPI = 2400  # a page has 0.4 gigapixels


def _curves(results: GroupResults, what: str, width: float | None) -> "Figure":
    """Draw registration or receiver operating characteristics, if the analysis has them."""
    if what == "registration" and not (results.folder / "template.json").exists():
        raise NothingToDoError(f"{results.folder}: no registration in this analysis")
    if what == "roc" and not len(results.table("roc")):
        raise NothingToDoError(f"{results.folder}: no classification in this analysis")
    draw = figures.draw_roc if what == "roc" else figures.draw_registration
    return draw(results, width)[0]


def figure(
    what: str,
    out_dir: str | Path,
    *,
    name: str | None = None,
    participant: str | None = None,
    session: str | None = None,
    measures: Sequence[str] = (),
    contrasts: Sequence[str] = (),
    columns: int | None = None,
    limits: tuple[float, float] | None = None,
    dpi: float = style.DOTS_PER_INCH,
    file: str | Path | None = None,
) -> "Figure":
    """Draw a figure for a paper from files, and write it if asked.

    Parameters
    ----------
    what : {"participant", "group", "contrast", "registration", "roc"}
        Maps of a participant; mean maps of the groups and effects of the contrasts; effect and
        significance of one contrast; registration; receiver operating characteristics.
    out_dir : str or Path
        The output folder of ``hipsta-bids``.
    name : str, optional
        Name of an analysis of the group level; not needed where there is one.
    participant, session : str, optional
        Labels, with or without prefix; for ``participant``.
    measures : sequence of str, optional
        Maps of a participant (default: thickness and curvature), or the map of the group level
        (default: the first).
    contrasts : sequence of str, optional
        Contrasts for ``group`` (default: all) and ``contrast`` (default: the first).
    columns : {1, 2}, optional
        Width in columns of a page: 85 or 180 mm. One column shows both sides unfolded only.
    limits : tuple of float, optional
        Values at both ends of the colors of the maps of a participant, the mean maps of
        ``group`` and the effects of ``contrast``; else percentiles of the values that are shown.
    dpi : float
        Dots per inch of pictures, from 1 to 2400.
    file : str or Path, optional
        Where to write the figure, as PDF, SVG or PNG by its extension.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        If an argument lacks, or has a value that the files do not allow; the attribute
        ``argument`` of the error names this argument.
    NothingToDoError
        If the folder lacks the participant or the analysis.

    Examples
    --------
    ::

        hb.figure("contrast", "out", contrasts=["CN-AD"], columns=1, file="figure2.pdf")
    """
    check_choice("what", what, dict.fromkeys(FIGURES))
    check_choice("columns", columns or 2, dict.fromkeys(WIDTHS))
    if limits and not (np.isfinite(limits).all() and limits[0] < limits[1]):
        raise ArgumentError("limits", f"is {limits}; give two numbers, the smaller one first")
    if not 1 <= dpi <= _MOST_DPI:
        raise ArgumentError("dpi", f"is {dpi}; give 1 to {_MOST_DPI}, such as 300 for print")
    root = Path(out_dir)
    kind = _format_of(Path(file)) if file is not None else None
    width = None if columns is None else WIDTHS[columns]
    with style.style():
        if what == "participant":
            sides = _hemispheres(root, participant, session)
            grounds = {side.result.name.hemi: _ground(root, side) for side in sides}
            rows = list(_participant_rows(sides, measures or _DEFAULT, limits))
        else:
            results = _analysis(root, name)
            if what in {"registration", "roc"}:
                return _written(_curves(results, what, width), file, kind, dpi)
            measure = _measure(results, measures)
            grounds = read_grounds(results, measure)
            rows = list(_group_rows(results, measure, what, contrasts, limits))
        (drawing,) = panels.draw_pages(grounds, [rows], width=width, dpi=dpi)
        return _written(drawing, file, kind, dpi)


def _format_of(path: Path) -> str:
    """Return the format of a figure by its file's name; ArgumentError for other formats."""
    kind = path.suffix.removeprefix(".").lower()
    if kind not in style.KINDS:
        raise ArgumentError("file", f"is {path}, no format of figures; use .pdf, .svg or .png")
    return kind


def _written(drawing: "Figure", file: str | Path | None, kind: str | None, dpi: float) -> "Figure":
    """Write a figure if there is a file for it."""
    if file is not None and kind is not None:
        ((_, content),) = style.encode("", lambda: [drawing], [kind], dpi)
        files.write_bytes(Path(file), content)
    return drawing


def _analysis(root: Path, name: str | None) -> GroupResults:
    """Read the record of an analysis, by its name where there are several."""
    models = group_models(root)
    if not models:
        raise NothingToDoError(f"{root}: no analysis; run the group level first")
    if name is None and len(models) > 1:
        raise ArgumentError("name", f"is missing; {root} has the analyses {', '.join(models)}")
    if name is not None and name not in models:
        near = did_you_mean([name], models)
        raise NothingToDoError(f"{root}: no analysis {name}{near}; see the folder group")
    return read_group(root / "group" / (name or models[0]))


def _measure(results: GroupResults, measures: Sequence[str]) -> str:
    """Choose the map to show."""
    known_maps = measures_of(results)
    if not known_maps:
        raise NothingToDoError(f"{results.folder}: no maps in this analysis")
    if len(measures) > 1:
        raise ArgumentError("measures", "has several maps; a figure of an analysis shows one")
    measure = measures[0] if measures else known_maps[0]
    check_choice("measures", measure, dict.fromkeys(known_maps))
    return measure


def _group_rows(
    results: GroupResults,
    measure: str,
    what: str,
    contrasts: Sequence[str],
    limits: tuple[float, float] | None,
) -> Iterator[panels.Row]:
    """Yield the rows of the figure of an analysis."""
    pairs = dict(
        zip(_contrasts(results, measure), maps.contrast_rows(results, measure), strict=True)
    )
    for contrast in contrasts:
        check_choice("contrasts", contrast, pairs)
    chosen_names = list(contrasts or pairs)
    if what == "contrast":
        if len(contrasts) > 1:
            raise ArgumentError("contrasts", "has several names; give one for this figure")
        effect, significance = pairs[chosen_names[0]]
        yield _with_limits(effect, limits)
        yield significance
        return
    means = [row for row in maps.mean_rows(results, measure) if row.kind == "mean"]
    n_rows = len(means) + len(chosen_names)
    if n_rows > panels.MOST_ROWS:
        raise ArgumentError(
            "contrasts",
            f"gives {n_rows} rows, more than the {panels.MOST_ROWS} of a page; name fewer",
        )
    yield from (_with_limits(row, limits) for row in means)
    yield from (pairs[contrast][0] for contrast in chosen_names)


def _contrasts(results: GroupResults, measure: str) -> list[str]:
    """List the contrasts of a map in their order."""
    table = results.table("maps")
    return [str(name) for name in table[table["measure"] == measure]["contrast"].unique()]


def _with_limits(row: panels.Row, limits: tuple[float, float] | None) -> panels.Row:
    if limits is None:
        return row
    return replace(row, scale={**row.scale, "vmin": limits[0], "vmax": limits[1]})


def _hemispheres(root: Path, participant: str | None, session: str | None) -> list[Hemisphere]:
    """Find the measured hemispheres of one participant and session, left first."""
    if participant is None:
        raise ArgumentError("participant", "is missing; name the participant of this figure")
    label = participant.removeprefix("sub-")
    folders = sorted(path.name for path in root.glob(f"sub-{label}/ses-*"))
    names = [None, *folders] if session is None else [session]
    sides = [
        side
        for name in names
        for side in find_results(root, label, name and name.removeprefix("ses-"))
        if side.measured
    ]
    visits = sorted({str(side.result.name.session) for side in sides})
    if not sides:
        raise NothingToDoError(f"{root}: no map of sub-{label}; run the participant level first")
    if len(visits) > 1:
        raise ArgumentError(
            "session", f"is missing; sub-{label} has the sessions {', '.join(visits)}"
        )
    first = sides[0].result.name
    sides = [
        side
        for side in sides
        if (side.result.name.seg, side.result.name.region) == (first.seg, first.region)
    ]
    return sorted(sides, key=lambda side: side.result.name.hemi)


def _ground(root: Path, side: Hemisphere) -> Ground:
    """Return what the maps of a hemisphere lie on."""
    axes = node_axes(grid_of(root), side.result.name.region)
    words = side.sheet.subfield
    names = tuple(name for name in dict.fromkeys(words.ravel().tolist()) if name not in {"", "n/a"})
    subfield = np.full(words.shape, -1, dtype=np.int64)
    for number, name in enumerate(names):
        subfield[words == name] = number
    surface = gifti.read_mesh(side.result.path("midthickness_surface"))
    return Ground(x=axes["x"][1], y=axes["y"][1], subfield=subfield, names=names, surface=surface)


def _participant_rows(
    sides: Sequence[Hemisphere], measures: Sequence[str], limits: tuple[float, float] | None
) -> Iterator[panels.Row]:
    """Show maps of a participant, of both sides on one scale."""
    units = {row.name: row.unit for row in MAPS}
    label = f"sub-{sides[0].result.name.subject}"
    if session := sides[0].result.name.session:
        label += f", ses-{session}"
    for number, measure in enumerate(measures):
        values: dict[str, Float] = {}
        for side in sides:
            check_choice(
                "measures", measure, dict.fromkeys(sorted(set(side.sheet.columns) & units.keys()))
            )
            values[side.result.name.hemi] = side.sheet.columns[measure].ravel()
        kind = display.kind_of(measure)
        low, high = limits or display.span_of(kind, list(values.values()))
        title = display_name(measure)
        yield panels.Row(
            kind="mean",
            index=number,
            title=f"{title.capitalize()}, {label}",
            label=with_brackets(title, str(attributes(measure)["units"])),
            scale={"cmap": kind.colors, "vmin": low, "vmax": high},
            values=values,
        )
