"""Maps between the whole sheet and HippUnfold's unfolded surfaces, and between these surfaces.

All cover the hippocampus from its posterior to its anterior end and from the subiculum to the end
of the sheet at CA3. What has the same share of both ways is taken for the same place.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import cKDTree

from hipsta_bids.derivatives.hemisphere import write_nodes
from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sheet import sheet_levels
from hipsta_bids.io import files, gifti
from hipsta_bids.io.gifti import DENSE_SCALARS, PointMap
from hipsta_bids.io.hippunfold import SHEET_SIZE, unfolded_shares
from hipsta_bids.settings import SheetSettings
from hipsta_bids.types import Float

TABLE, METRICS = ".tsv", (".shape.gii", ".func.gii")
"""Endings of outputs, beside `DENSE_SCALARS`."""
Unfolded = tuple[str, Float]
"""Label of an unfolded surface, and shares of its vertices."""
_LARGEST = 1 + 1e-4
"""Of a proximal-distal coordinate, with room for rounding."""
_REACH = 1.75
"""mm of HippUnfold's sheet: by proximal-distal x the grid ends up to 1.5 mm before its edges."""


class Correspondence:
    """Where HippUnfold's vertices lie on the whole sheet."""

    def __init__(
        self, shares: Float, settings: SheetSettings, proximodistal: Float | None = None
    ) -> None:
        """Place vertices by their shares (V, 2) of both ways (``unfolded_shares``).

        ``proximodistal`` (Nx, Ny) of the sheet takes the place of x, if it is given.
        """
        x, y, _ = sheet_levels(settings, "whole")
        anterior, lateral = shares.T
        #: mm of HippUnfold's sheet per unit of x and y.
        self.scale: Float = SHEET_SIZE[::-1] / [2, y[-1] - y[0]]
        #: (V, 2) from -1 to 1 between the edges, and y between the ends of the sheet.
        self.places: Float = np.column_stack([2 * lateral - 1, y[0] + anterior * (y[-1] - y[0])])
        along = np.broadcast_to(y, (len(x), len(y)))
        across = (
            np.broadcast_to(x[:, None], along.shape) if proximodistal is None else proximodistal
        )
        #: (Nx, Ny, 2) the same of the nodes; NaN where the sheet has none.
        self.nodes: Float = np.stack([across, np.where(np.isnan(across), np.nan, along)], axis=-1)

    def to_vertices(self, values: Float) -> tuple[Float, Float]:
        """Interpolate a map (Nx, Ny) at the vertices (V,), NaN beside NaN.

        Vertices beyond the nodes take the value of the nearest node, up to `_REACH`. Also returns
        how far (V,) that node is, mm of HippUnfold's sheet; 0 where the map was interpolated.
        """
        finite = np.isfinite(self.nodes).all(axis=-1)
        nodes, sources = self.nodes[finite], values[finite]
        # A second column without gaps distinguishes vertices beyond the nodes from missing values.
        sample = LinearNDInterpolator(nodes, np.column_stack([sources, np.zeros(len(sources))]))
        moved, beyond = sample(self.places).T
        distance, nearest = cKDTree(nodes * self.scale).query(self.places * self.scale)
        is_near = np.isnan(beyond) & (distance <= _REACH)
        moved = np.where(is_near, sources[nearest], moved)
        return moved, np.where(is_near & np.isfinite(moved), distance, 0.0)

    def to_nodes(self, values: Float) -> Float:
        """Interpolate numbers (V, ...) at the nodes (Nx, Ny, ...), NaN beside NaN and beyond."""
        return np.asarray(LinearNDInterpolator(self.places, values)(self.nodes), dtype=np.float64)


def resample(
    paths: Sequence[Path],
    out: Path,
    surfaces: Sequence[Path],
    settings: SheetSettings,
    *,
    column: str = "thickness",
    sheets: Sequence[Path] = (),
    targets: Sequence[Path] = (),
) -> str:
    """Move maps of one or both sides to HippUnfold's vertices, or from there to the whole sheet.

    Maps are tables (``column`` holds the map) or GIFTI files of the whole sheet, or GIFTI or CIFTI
    files of HippUnfold; ``out`` is GIFTI, CIFTI or, of one side of the sheet, a table, by its
    ending. ``surfaces`` are HippUnfold's unfolded ones, one for both sides or one for each;
    ``settings`` are the settings of the sheets; ``sheets`` their ``desc-proximodistal`` maps, one
    for each side. ``targets`` are unfolded surfaces of another density or version, to which maps
    of HippUnfold are moved instead of to the sheet. Returns one line about the result.
    """
    _check_name(out, (*paths, *surfaces, *targets))
    if targets and sheets:
        raise UsageError("--sheet: has no use between two surfaces of HippUnfold; omit it")
    surface_of, target_of = _by_side(surfaces), _by_side(targets)
    positions_of = {hemi: side.values for path in sheets for hemi, side in _read(path, column)}
    moved: dict[str, PointMap] = {}
    path_of: dict[str, Path] = {}
    distances: list[Float] = []
    to_vertices = bool(targets)
    sides = ((path, *pair) for path in paths for pair in _read(path, column))
    for path, hemi, side in sides:
        if hemi in moved:
            raise _several(f"{path_of[hemi]} and {path}: both are of side {hemi}")
        surface = _of_side(surface_of, hemi, path, "--surface")
        if targets:
            target = _of_side(target_of, hemi, path, "--to-surface")
            values = _to_surface(path, side, surface, target)
        else:
            on_nodes, values, distance = _to_other(
                path, side, surface, settings, positions_of.get(hemi)
            )
            distances.append(distance[distance > 0])
            if moved and on_nodes != to_vertices:
                raise _several(f"{path}: is not on the same points as {paths[0]}")
            to_vertices = on_nodes
        moved[hemi], path_of[hemi] = replace(side, values=values), path
    filled = np.concatenate([np.zeros(0), *distances])
    note = f"{filled.size} have the nearest value, up to {filled.max(initial=0):.2f} mm away"
    _write(out, moved, to_nodes=not to_vertices, note=note if filled.size else "")
    points = "vertices of HippUnfold" if to_vertices else "nodes of the whole sheet"
    return f"{out}: {_described(moved, points)}" + f"; {note}" * bool(filled.size)


def _check_name(out: Path, inputs: Sequence[Path]) -> None:
    """Refuse a name of results of another format, or of an input."""
    if not out.name.endswith((TABLE, *METRICS, DENSE_SCALARS)):
        ends = ", ".join((*METRICS, DENSE_SCALARS))
        raise UsageError(f"{out}: results end with {ends} or {TABLE}")
    if out.resolve() in {path.resolve() for path in inputs}:
        raise UsageError(f"{out}: is an input; choose another name")


def _described(sides: Mapping[str, PointMap], points: str) -> str:
    """Count points by side, and the share without a value."""
    missing = np.mean(np.isnan(np.concatenate([side.values.ravel() for side in sides.values()])))
    counts = ", ".join(f"{side.values.size} {hemi}" for hemi, side in sides.items())
    return f"{counts} {points}, {missing:.0%} without a value"


def _to_other(
    path: Path, side: PointMap, surface: Unfolded, settings: SheetSettings, places: Float | None
) -> tuple[bool, Float, Float]:
    """Move a map from the nodes of the sheet to vertices, or from there; return whether the former.

    Also returns how far each vertex beyond the nodes is from the node whose value it has.
    ``places`` are the sheet's proximal-distal coordinates, if they were given.
    """
    label, shares = surface
    if label != "hipp":
        raise InputError(f"{path}: the sheet has no {label}; give label-hipp, or --to-surface")
    x, y, _ = sheet_levels(settings, "whole")
    nodes = len(x), len(y)
    if places is not None:
        if places.size != nodes[0] * nodes[1] or np.nanmax(np.abs(places)) > _LARGEST:
            raise InputError(
                f"--sheet: {nodes[0]} x {nodes[1]} points are needed; give the sheet's "
                "desc-proximodistal map, or the results' --settings"
            )
        places = places.reshape(nodes)
    between = Correspondence(shares, settings, places)
    if len(side.values) == nodes[0] * nodes[1] and side.nodes in (None, nodes):
        return True, *between.to_vertices(side.values.reshape(nodes))
    if len(side.values) != len(shares):
        raise InputError(
            f"{path}: {len(side.values)} points fit neither the sheet ({nodes[0]} x "
            f"{nodes[1]}) nor the surface ({len(shares)}); give its surface, or "
            "--settings"
        )
    return False, between.to_nodes(side.values), np.zeros(0)


def _to_surface(path: Path, side: PointMap, surface: Unfolded, target: Unfolded) -> Float:
    """Move a map to the vertices of another unfolded surface."""
    (label, shares), (target_label, goal) = surface, target
    if target_label != label or len(side.values) != len(shares):
        raise InputError(
            f"{path}: {len(side.values)} values, --surface is {label} with {len(shares)}"
            f" vertices, --to-surface is {target_label}; give surfaces of one label"
        )
    return between_surfaces(shares, goal, side.values)


def between_surfaces(shares: Float, goal: Float, values: Float) -> Float:
    """Interpolate a map from vertices (V,) to the vertices (W,) of another surface.

    Both positions are shares of the way. Outer vertices of the other surface may lie up to a
    spacing outside: the map is continued there by point reflection at the edge. NaN beside NaN.
    """
    linear, nearest = (
        make(shares, values) for make in (LinearNDInterpolator, NearestNDInterpolator)
    )
    covers = LinearNDInterpolator(shares, np.zeros(len(shares)))

    def interpolate(places: Float) -> Float:
        covered = np.isfinite(covers(places))
        return np.asarray(np.where(covered, linear(places), nearest(places)), dtype=np.float64)

    edge = np.clip(goal, shares.min(axis=0), shares.max(axis=0))
    inside = (edge == goal).all(axis=1)
    continued = 2 * interpolate(edge) - interpolate(2 * edge - goal)
    return np.where(inside, interpolate(goal), continued)


def _by_side(paths: Sequence[Path]) -> dict[str | None, Unfolded]:
    """Read unfolded surfaces; a single one without a side in its name is for both sides.

    HippUnfold 2 has one template for both sides, which calls itself right.
    """
    if len(paths) > 1:
        return {_hemi(path): _unfolded(path) for path in paths}
    return {files.entities(path.name).get("hemi"): _unfolded(path) for path in paths}


def _of_side(
    surface_of: Mapping[str | None, Unfolded], hemi: str, path: Path, option: str
) -> Unfolded:
    """Choose the surface of a side, or the one of both."""
    surface = surface_of.get(hemi, surface_of.get(None))
    if surface is None:
        raise InputError(f"{path}: there is no unfolded surface of side {hemi}; add it to {option}")
    return surface


def _write(out: Path, maps: Mapping[str, PointMap], *, to_nodes: bool, note: str) -> None:
    (hemi, first), *further_maps = maps.items()
    if out.name.endswith(DENSE_SCALARS):
        sides = {hemi: maps[hemi].values.ravel()[None] for hemi in sorted(maps)}
        files.write_bytes(out, gifti.cifti_bytes(sides, [first.name], note))
        return
    if further_maps:
        raise UsageError(f"{out}: holds one side; name a {DENSE_SCALARS} file for both")
    if out.suffix != TABLE:
        values = first.values.ravel()
        content = gifti.shape_bytes(values, hemi=hemi, name=first.name, unit=first.unit, note=note)
        files.write_bytes(out, content)
        return
    if not to_nodes:
        raise UsageError(f"{out}: tables are of sheets; name a {METRICS[0]} file for vertices")
    write_nodes(out, [first.name], first.values[..., None])


def _read(path: Path, column: str) -> Iterator[tuple[str, PointMap]]:
    """Read the maps of one file by their sides: one side, or those that a CIFTI file has."""
    pairs = files.entities(path.name)
    region = pairs.get("label", "body")
    if "seg" in pairs and region != "whole":  # HippUnfold's names have no seg
        raise InputError(
            f"{path}: is of region {region}, which does not reach both ends of HippUnfold's"
            " surface; measure with --region whole"
        )
    if path.name.endswith(DENSE_SCALARS):
        hemis = gifti.cifti_sides(path)
    else:
        hemis = [hemi] if (hemi := _hemi(path)) else []
    if not hemis:
        raise InputError(
            f"{path}: its side is unknown; put hemi-L or hemi-R in its name",
            reason="unknown-hemisphere",
        )
    units = {row.name: row.unit for row in MAPS}
    for hemi in hemis:
        side = gifti.read_map(path, column, hemi)
        unit, name = units.get(side.name, side.unit), side.name or pairs["suffix"]
        yield hemi, replace(side, unit=unit, name=name)


def _hemi(path: Path) -> str | None:
    """Side by a file's name and its structure, if they say it."""
    named = files.entities(path.name).get("hemi")
    inside = gifti.structure_side(path) if path.suffix == ".gii" else None
    if named and inside and named != inside:
        raise InputError(
            f"{path}: side {named} in its name, {inside} in its structure; correct one of them",
            reason="unknown-hemisphere",
        )
    return named or inside


def _unfolded(path: Path) -> Unfolded:
    """Read an unfolded surface of HippUnfold: its label, and shares of its vertices."""
    surface = unfolded_shares(gifti.read_mesh(path))
    if surface is None:
        raise InputError(
            f"{path}: is no unfolded surface of HippUnfold; give its space-unfold_..."
            "_midthickness.surf.gii"
        )
    return surface


def _several(problem: str) -> InputError:
    return InputError(f"{problem}; give one map of each side")
