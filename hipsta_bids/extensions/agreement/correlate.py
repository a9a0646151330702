"""Correlation of two maps of the group level, from files or arrays to a table, figure and text."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from hipsta_bids.errors import InputError, UsageError, did_you_mean, in_python
from hipsta_bids.extensions.agreement.columns import CORRELATION_COLUMNS
from hipsta_bids.extensions.agreement.correlation import correlate_maps
from hipsta_bids.group.output import style, write
from hipsta_bids.group.output.citations import Citations, escaped
from hipsta_bids.io import files, gifti
from hipsta_bids.stats.arrays import Float
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import Mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TABLE = "correlation"
_MOST_SMOOTH = 0.5  # FWHM over the root of the area


@in_python()
def correlate(
    first: ArrayLike | str | Path,
    second: ArrayLike | str | Path,
    surface: tuple[ArrayLike, ArrayLike] | str | Path,
    *,
    permutations: int = 10_000,
    seed: int = 0,
    out: str | Path | None = None,
) -> pd.Series:
    """Correlate two maps, with p-values that allow for their smoothness.

    Parameters
    ----------
    first, second
        Value of each vertex, y fastest, NaN for missing; or a file as of ``hipsta-bids correlate``.
    surface
        Points and triangles, or a file (.surf.gii), as the average surface of an analysis.
    permutations : int
        Surrogates of the first map, this map included.
    seed : int
        Of the surrogates.
    out : str or Path, optional
        New folder for table, figure and text.

    Returns
    -------
    Series
        Pearson's and Spearman's r with p, number of points, and smoothness (FWHM) of both maps.

    Raises
    ------
    ModelError
        If maps and surface do not fit, or a map has one value everywhere.
    InputError
        If a file cannot be read.

    Examples
    --------
    ::

        hb.correlate("means.tsv:mean:measure=thickness:hemi=L:group=CN", "pet.shape.gii",
                     "hemi-L_desc-average_midthickness.surf.gii")
    """
    mesh, side = _surface(surface)
    names = [str(one) if isinstance(one, str | Path) else "array" for one in (first, second)]
    maps = [
        _read(str(one), side)
        if isinstance(one, str | Path)
        else np.asarray(one, np.float64).ravel()
        for one in (first, second)
    ]
    columns = correlate_maps(maps[0], maps[1], mesh, permutations, seed)
    content = dict(zip(("first", "second"), names, strict=True)) | columns
    row = pd.Series({**content, "permutations": permutations, "seed": seed}, dtype=object)
    if out is not None:
        _write(Path(out), row, partial(_drawn, row, maps, mesh))
    return row


def _surface(surface: tuple[ArrayLike, ArrayLike] | str | Path) -> tuple[Mesh, str]:
    """Return a surface and its hemisphere; L where arrays and files name none."""
    if isinstance(surface, tuple):
        points, triangles = np.asarray(surface[0], np.float64), np.asarray(surface[1], np.int64)
        return Mesh(points=points, triangles=triangles), "L"
    path = Path(surface)
    return gifti.read_mesh(path), gifti.structure_side(path) or "L"


def _read(text: str, hemi: str) -> Float:
    """Read a map: a GIFTI or CIFTI file, or ``FILE.tsv:COLUMN``, perhaps with ``:KEY=VALUE``."""
    name, extension, choice = text.partition(".tsv:")
    if not extension:
        points = gifti.read_map(Path(text), "", hemi)
        return points.values  # noqa: PD011  (no table)
    path, (column, *conditions) = Path(f"{name}.tsv"), choice.split(":")
    rows = files.read_tsv(path)
    pairs = [condition.partition("=")[::2] for condition in conditions]
    columns = tuple(rows[0]) if rows else ()
    if unknown := {column, *dict(pairs)} - set(columns):
        raise InputError(
            f"{path}: no column {min(unknown)!r}{did_you_mean([min(unknown)], columns)}"
        )
    for number, (key, value) in enumerate(pairs, start=1):
        levels = sorted({row[key] for row in rows})
        if value not in levels:
            raise InputError(
                f"{path}: no row has {' and '.join(conditions[:number])}; {key} is {listed(levels)}"
            )
        rows = [row for row in rows if row[key] == value]
    cells = [row[column] for row in rows]
    try:
        return np.array([np.nan if files.is_missing(cell) else float(cell) for cell in cells])
    except ValueError as error:
        raise InputError(f"{path}: column {column} has other cells than numbers: {error}") from None


def _write(out: Path, row: pd.Series, drawing: style.Drawing) -> None:
    """Write table, figure and text, into a new folder or over an earlier correlation."""
    if out.exists() and not (out / f"{_TABLE}.tsv").exists():
        raise UsageError(f"{out}: exists and is no correlation; choose a new folder")
    cite = Citations()
    text = (
        f"Two maps ({escaped(row['first'])}; {escaped(row['second'])}) were correlated over"
        f" {row['n']} points of the surface. P-values were two-sided, of {row['permutations']}"
        f" surrogates of the first map (seed {row['seed']}). Surrogates had random signs of the"
        f" map's coefficients in the eigenmodes of a covariance {cite('moran')}. The covariance was"
        f" of a Whittle-Matern field {cite('matern')} with Robin boundary conditions"
        f" {cite('robin')}, by linear finite elements {cite('shapedna')}. It had the smoothness of"
        f" the maps (FWHM {row['fwhm_first']:.1f} and {row['fwhm_second']:.1f} mm). Pearson's r"
        f" was {row['pearson']:.2f} (p = {row['pearson_p']:.3g}), Spearman's"
        f" {row['spearman']:.2f} (p = {row['spearman_p']:.3g})."
    )
    if row["smooth_share"] > _MOST_SMOOTH:
        text += " The maps are so smooth, relative to the surface, that p-values are too small."
    with write.whole_folder(out) as folder:
        write.write_table(folder, _TABLE, row.to_frame().T, meaning=CORRELATION_COLUMNS)
        files.write_text(folder / "methods.md", cite.page([text]))
        write.write_figures(folder, [(_TABLE, drawing)])


def _drawn(row: pd.Series, maps: Sequence[Float], mesh: Mesh) -> "list[Figure]":
    """Draw both maps, seen along the shortest axis of the surface, and their values."""
    figure, axes = style.new_panels(1, 3, (style.TWO_COLUMNS, 60.0))
    centered = mesh.points - mesh.points.mean(axis=0)
    across = (centered @ np.linalg.svd(centered, full_matrices=False)[2].T)[:, :2]
    for axis, title, values in zip(axes[0], ("first map", "second map"), maps, strict=False):
        triangles = mesh.triangles[np.isfinite(values)[mesh.triangles].all(axis=1)]
        filled = np.where(np.isfinite(values), values, np.nanmean(values))
        shades = axis.tripcolor(*across.T, triangles, filled, shading="gouraud", rasterized=True)
        figure.colorbar(shades, ax=axis, shrink=0.7)
        axis.set(title=title, aspect="equal")
        axis.set_axis_off()
    axes[0, 2].plot(*maps, ".", markersize=2)
    axes[0, 2].set(xlabel="first map", ylabel="second map")
    axes[0, 2].set_title(f"r = {row['pearson']:.2f}, p = {row['pearson_p']:.2g}")
    style.letter_panels(axes[0])
    return [figure]
