"""Measures labels in memory, and reads an output dataset, as labeled arrays."""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from hipsta_bids.derivatives.hemisphere import POSITION, STATE, read_sheet, sheet_labels, verdict
from hipsta_bids.derivatives.measures import identify, origin
from hipsta_bids.errors import InputError, NothingToDoError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sheet import is_left_handed, layer_depth
from hipsta_bids.group.cohort.collect import grid_of
from hipsta_bids.group.cohort.read import node_coordinates
from hipsta_bids.inputs.labels import MARGIN, label_volume
from hipsta_bids.io import files
from hipsta_bids.io.gifti import sheet_triangles, write_surface
from hipsta_bids.io.volumes import LabelImage, read_labels
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.protocols import body_ends
from hipsta_bids.protocols.load import for_region, load_protocol
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.reports.results import SIDES, Hemisphere, SheetTable, find_results
from hipsta_bids.settings import Settings, SheetSettings, load_settings
from hipsta_bids.types import Flag, Float, HemisphereMaps, LabelVolume, Mesh

if TYPE_CHECKING:
    import xarray as xr

    from hipsta_bids.io.xarrays import Variable

#: Surfaces of the sheet, by their position among its layers.
_LEVELS = {"interior": 0.0, "midthickness": 0.5, "exterior": 1.0}
#: What is no column of the sheet's table: definition and unit.
_EXTRA_VARIABLES = {
    "position": ["position, scanner RAS", "mm"],
    "depth": ["distance from the interior wall along the column", "mm"],
}
_NODES = {
    "x": {"long_name": "medial to lateral", "units": "1"},
    "y": {"long_name": "posterior to anterior", "units": "1"},
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """One measured hemisphere."""

    side: str
    """``L`` or ``R``."""
    protocol: Protocol
    """With the sheet of what was measured."""
    settings: Settings
    hemisphere: HemisphereMaps
    """All that was measured, as the stages of the method hand it on."""

    @property
    def maps(self) -> Mapping[str, Float]:
        """Maps (x, y) by name, read-only; NaN is missing. Units are in :attr:`units`."""
        return self.hemisphere.maps

    @property
    def units(self) -> Mapping[str, str]:
        """Units of the maps, by name."""
        return {row.name: row.unit for row in MAPS}

    @property
    def decision(self) -> str:
        """``use``, or ``look``: a person should look before use."""
        return self.hemisphere.decision.value

    @property
    def flags(self) -> tuple[Flag, ...]:
        """What to look at before use; empty unless the decision is ``look``."""
        return self.hemisphere.flags

    @property
    def message(self) -> str:
        """Why a person should look; empty if nobody need."""
        return verdict(self.hemisphere)[2] or ""

    @cached_property
    def summary(self) -> pd.Series:
        """One number per summary measure, named as the columns of the summary table."""
        return pd.Series(dict(self.hemisphere.summary), name=self.side, dtype=np.float64)

    @cached_property
    def subfield(self) -> NDArray[np.str_]:
        """(x, y) abbreviations of subfields; empty where there is none."""
        labels = sheet_labels(self.protocol)
        names = {int(tissue): label.abbreviation for tissue, label in labels.items()}
        codes = self.hemisphere.subfield
        return np.array([names.get(c, "") for c in codes.ravel().tolist()]).reshape(codes.shape)

    def surface(self, level: str = "midthickness", file: str | Path | None = None) -> Mesh:
        """Return one surface of the sheet, and write it if a file is named.

        Parameters
        ----------
        level : {"interior", "midthickness", "exterior"}
        file : path, optional
            Where to write it: ``.vtk`` and ``.ply`` with all maps, ``.obj`` without.

        Returns
        -------
        Mesh
            Points (x * y, 3), RAS mm, in the order of ``maps[name].ravel()``, and triangles whose
            normals point to the exterior; NaN where a column has no position.

        Raises
        ------
        ValueError
            If no surface has this name.
        UsageError
            If the name of the file has another ending.
        """
        check_choice("level", level, _LEVELS)
        points = self.hemisphere.sheet.points
        nx, ny, nz = points.shape[:3]
        triangles = sheet_triangles(nx, ny, flip=is_left_handed(points))
        at = round(_LEVELS[level] * (nz - 1))
        mesh = Mesh(points=points[:, :, at].reshape(-1, 3), triangles=triangles.astype(np.int64))
        if file is not None:
            write_surface(Path(file), mesh, self.maps)
        return mesh

    @cached_property
    def table(self) -> SheetTable:
        """The sheet as the pages draw it."""
        sheet = self.hemisphere.sheet
        return SheetTable(
            columns=self.maps,
            subfield=self.subfield,
            valid=sheet.valid,
            repaired=self.hemisphere.repaired,
            points={"midthickness": sheet.points[:, :, sheet.middle]},
            ends=body_ends(self.settings.body.region, sheet.valid.shape[1]),
        )

    @cached_property
    def dataset(self) -> "xr.Dataset":
        """The maps as a dataset of xarray.

        Coordinates are ``x`` (medial to lateral) and ``y`` (posterior to anterior), from -1 to 1,
        and ``layer``, the share of the column from the interior (0) to the exterior wall (1).
        Each map has dimensions (x, y), ``position`` (x, y, layer, ras) in scanner RAS mm, and
        ``depth`` (x, y, layer) in mm from the interior wall. Attributes hold units, definitions
        and sources of maps.
        """
        from hipsta_bids.io.xarrays import make_dataset  # noqa: PLC0415  (an optional extra)

        sheet, layers = self.hemisphere.sheet, self.hemisphere.layers
        nz = sheet.points.shape[2]
        grid = ("x", "y")
        state = {"subfield": self.subfield, "valid": sheet.valid, "repaired": self.table.repaired}
        variables: dict[str, Variable] = {
            row.name: (grid, self.maps[row.name], attributes(row.name)) for row in MAPS
        }
        variables |= {name: (grid, values, attributes(name)) for name, values in state.items()}
        layered = ("x", "y", "layer")
        variables["position"] = (*layered, "ras"), layers.points, attributes("position")
        variables["depth"] = layered, layer_depth(layers), attributes("depth")
        coordinates = {
            **node_axes(self.settings.sheet, self.settings.body.region),
            "layer": (["layer"], np.linspace(0, 1, nz), {"long_name": "interior to exterior"}),
            "ras": (["ras"], list(POSITION), {}),
        }
        about = {"side": self.side, "protocol": self.protocol.name, "decision": self.decision}
        return make_dataset(variables, coordinates, about)


def attributes(name: str) -> dict[str, str]:
    """Describe a variable: unit, definition and source."""
    for row in MAPS:
        if row.name == name:
            return {"units": row.unit, "long_name": row.definition, "source": row.source}
    return dict(zip(("long_name", "units"), (_EXTRA_VARIABLES | STATE)[name], strict=False))


def node_axes(grid: SheetSettings, region: str) -> dict[str, Any]:
    """Coordinates of the nodes, by the settings of the sheet."""
    axis_values = zip("xy", node_coordinates(grid, region), strict=True)
    return {axis: ([axis], values, _NODES[axis]) for axis, values in axis_values}


def check_choice(name: str, value: object, choices: Mapping[str, object]) -> None:
    """Refuse a value that is not among the choices."""
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; choose {' or '.join(map(repr, choices))}")


def measure(
    labels: Any,  # noqa: ANN401  (nibabel's images have no types)
    side: str = "L",
    protocol: str | Path | Protocol | None = None,
    *,
    affine: ArrayLike | None = None,
    region: str = "body",
    settings: Settings | str | Path | None = None,
) -> Measurement:
    """Measure thickness, curvature and shape of one hippocampus; writes no file.

    Parameters
    ----------
    labels
        Path of an image, an image of nibabel, or an array (I, J, K) of the protocol's codes; or a
        :class:`~hipsta_bids.types.LabelVolume`, which needs no protocol.
    side : {"L", "R"}
        Hemisphere. Of an image with codes of both, in a protocol that shifts those of one side,
        the other is left out.
    protocol : str, Path or Protocol
        What the codes mean: a name of ``hipsta-bids protocols``, as ``"freesurfer"`` or
        ``"hippunfold"``, or a TOML file. A wrong one may give a plausible, wrong map.
    affine : array, optional
        (4, 4), voxel index to RAS mm; for arrays only.
    region : {"body", "extended", "entorhinal", "headbody", "whole"}
        What to measure; the second and third need labels of the cortex beside it, the last two,
        which are experimental, those of subfields in the head.
    settings : Settings, str or Path, optional
        Settings of the participant level, or a TOML file with some.

    Returns
    -------
    Measurement
        ``maps`` as arrays, ``dataset`` with coordinates and units, ``summary``, ``status``.

    Raises
    ------
    ValueError
        If side, protocol or affine are missing or wrong.
    InputError, ProtocolError
        If the labels cannot be read, or do not fit the protocol.
    GeometryError
        With the reason why this hemisphere cannot be measured.

    Examples
    --------
    A synthetic body with a wall of 2 mm everywhere, in voxels of 0.5 mm:

    >>> import hipsta_bids as hb
    >>> from hipsta_bids.phantom import Phantom, PhantomSpec, encode
    >>> from hipsta_bids.protocols.load import load_protocol
    >>> phantom = Phantom(PhantomSpec(kind="arc", thickness=2.0, length=10.0))
    >>> volume = phantom.label_volume(load_protocol("freesurfer"), voxel_size=(0.5, 0.5, 0.5))
    >>> codes = encode(volume)
    >>> left = hb.measure(codes, side="L", protocol="freesurfer", affine=volume.affine)
    >>> left.decision
    'use'
    >>> left.maps["thickness"].shape
    (41, 21)
    >>> print(f"{left.summary['thickness_mean']:.1f} {left.units['thickness']}")
    2.0 mm

    With xarray, values are found by their coordinates:

    >>> middle = left.dataset.sel(y=0.0)
    >>> dict(middle.sizes)
    {'x': 41, 'layer': 9, 'ras': 3}
    >>> print(f"{float(middle.thickness.mean()):.1f} {middle.thickness.units}")
    2.0 mm
    """
    check_choice("side", side, SIDES)
    if isinstance(settings, str | Path) or settings is None:
        settings = load_settings(None if settings is None else Path(settings))
    settings = settings.changed(body={"region": region})
    volume = (
        labels
        if isinstance(labels, LabelVolume)
        else _read_volume(labels, side, _as_protocol(protocol), affine, region)
    )
    return Measurement(
        side=side,
        protocol=for_region(volume.protocol, region),
        settings=settings,
        hemisphere=measure_hemisphere(volume, side, settings, lambda _: nullcontext()),
    )


def _as_protocol(protocol: str | Path | Protocol | None) -> Protocol:
    if protocol is None:
        raise ValueError("name the protocol of the codes, such as protocol='freesurfer'")
    return protocol if isinstance(protocol, Protocol) else load_protocol(protocol)


def _read_volume(
    labels: Any,  # noqa: ANN401  (as above)
    side: str,
    protocol: Protocol,
    affine: ArrayLike | None,
    region: str,
) -> LabelVolume:
    image_affine = getattr(labels, "affine", None)
    if isinstance(labels, str | Path) or image_affine is not None:
        if affine is not None:
            raise ValueError("an image has an affine of its own; give affine with arrays only")
    elif affine is None:
        raise ValueError("an array needs affine, (4, 4), from voxel indices to RAS mm")
    if isinstance(labels, str | Path):
        path = Path(labels)
        image = read_labels(path, MARGIN)
        if not image.data.size:
            raise InputError(f"{path}: all labels are zero", reason="empty-labels")
        return label_volume(image, protocol, side, region, path=path)
    data = np.asanyarray(labels if image_affine is None else labels.dataobj)
    if data.ndim != 3:  # noqa: PLR2004  (a volume)
        raise InputError(f"labels of shape {data.shape}; a volume has 3 axes", reason="not-3d")
    matrix = np.asarray(affine if image_affine is None else image_affine, dtype=np.float64)
    if matrix.shape != (4, 4) or not abs(np.linalg.det(matrix[:3, :3])) > 0:
        raise ValueError("affine has to be an invertible matrix (4, 4), voxel indices to RAS mm")
    image = LabelImage(data=data, start=(0, 0, 0), shape=data.shape, affine=matrix)
    return label_volume(image, protocol, side, region)


class Results(NamedTuple):
    """An output dataset."""

    maps: "xr.Dataset"
    """(participant, session, side, x, y), read when values are used."""
    measures: pd.DataFrame
    """One row per hemisphere, as in ``measures.tsv``: who, decision, reason, message, where the
    labels come from (``labels_tool``, ``labels_version`` and so on), and the summary measures."""


def load(out_dir: str | Path, *, protocol: str | None = None, region: str = "body") -> Results:
    """Load an output dataset as a table of measures and one lazy dataset of xarray.

    Nothing but the small records and summaries is read at once. Maps are read when their values
    are used, and only those of the participants, sides and measures that are used: select first,
    then compute. ``.load()`` reads all that is left.

    Parameters
    ----------
    out_dir : str or Path
        The output folder of ``hipsta-bids ... participant``.
    protocol : str, optional
        Name of the segmentation protocol, if the folder has results of several.
    region : {"body", "extended", "entorhinal", "headbody", "whole"}
        What was measured.

    Returns
    -------
    Results
        ``maps``: every map of the sheet, ``subfield``, ``valid``, ``repaired`` and ``position``
        (RAS mm of the mid-surface); where they were made, SDs of ``--uncertainty``
        (``thickness_sd``) and what ``--map`` sampled, by its name; by participant
        (``sub-01``), session (``ses-1``; ``n/a`` in datasets without), side (``L``, ``R``), x and
        y (-1 to 1 in the body), with units; NaN where there is no map. ``decision`` has
        no x and y. ``measures``: one row per hemisphere, failed ones included, whose
        ``participant_id`` is that of ``participants.tsv``.

    Raises
    ------
    NothingToDoError
        ``no-hemisphere``: no results are there, or none of this protocol and region.
    InputError
        ``several-protocols``: choose one.

    Examples
    --------
    ::

        maps, measures = hb.load("out")
        thickness = maps.thickness.sel(side="L").mean(("participant", "session"))
        hb.plot_sheet(maps.sel(participant="sub-01", side="L").squeeze("session"))
    """
    root = Path(out_dir)
    hemispheres = list(find_results(root))
    seg = _one_protocol(root, hemispheres, protocol, region)
    selected = [
        side
        for side in hemispheres
        if (side.result.name.seg, side.result.name.region) == (seg, region)
    ]
    table = pd.DataFrame([_row(side) for side in selected])
    return Results(maps=_lazy_dataset(root, selected, table), measures=table)


def _one_protocol(
    root: Path, hemispheres: list[Hemisphere], protocol: str | None, region: str
) -> str:
    pairs = sorted({(side.result.name.seg, side.result.name.region) for side in hemispheres})
    names = [seg for seg, pair_region in pairs if pair_region == region]
    if not names or protocol not in {None, *names}:
        available = ", ".join(f"{seg} (region {pair_region})" for seg, pair_region in pairs)
        available = f"there is {available}" if available else "run the participant level first"
        raise NothingToDoError(f"{root}: no such hemisphere; {available}")
    if protocol is None and len(names) > 1:
        raise InputError(
            f"{root}: hemispheres of several protocols, {', '.join(names)}; choose one by protocol"
        )
    return protocol or names[0]


def _row(side: Hemisphere) -> dict[str, object]:
    return {
        **identify(side.result.name),
        "decision": side.decision.value,
        "reason": side.record.get("reason") or "",
        "message": side.message,
        **origin(side.record),
        **side.summary,
    }


def _lazy_dataset(root: Path, hemispheres: list[Hemisphere], table: pd.DataFrame) -> "xr.Dataset":
    from hipsta_bids.io.xarrays import make_dataset, read_later  # noqa: PLC0415  (optional)

    axes_of_nodes = node_axes(grid_of(root), table["region"].iloc[0])
    nx, ny = (len(values) for _, values, _ in axes_of_nodes.values())
    shape = nx, ny
    labels = [sorted(table[column].unique()) for column in ("participant_id", "session_id", "hemi")]
    outer = tuple(len(names) for names in labels)
    axes = ("participant", "session", "side")
    index = [
        tuple(names.index(cell) for names, cell in zip(labels, cells, strict=True))
        for cells in table[["participant_id", "session_id", "hemi"]].itertuples(index=False)
    ]
    decision = np.full(outer, "", dtype="<U8")
    for at, word in zip(index, table["decision"], strict=True):
        decision[at] = word
    measured = {at: side for at, side in zip(index, hemispheres, strict=True) if side.measured}

    extras = _beside_sheets(list(measured.values()))

    def read(name: str, at: tuple[int, ...]) -> NDArray[Any] | None:
        key, _ = extras.get(name, (("sheet",), {}))
        if at not in measured or not (path := measured[at].result.path(*key)).is_file():
            return None
        if name == "position":
            columns = read_sheet(path, tuple(POSITION), shape=shape)
            return np.stack([columns[axis] for axis in POSITION], axis=-1)
        if name in STATE:
            words = read_sheet(path, (), (name,), shape)[name]
            return words if name == "subfield" else words == "true"
        return read_sheet(path, (name,), shape=shape)[name]

    def variable(name: str) -> tuple[tuple[str, ...], Any, Mapping[str, str]]:
        kind = {"subfield": np.object_, "valid": np.bool_, "repaired": np.bool_}
        last = ("ras",) if name == "position" else ()
        inner = (*shape, *(len(POSITION) for _ in last))
        values = read_later(outer, inner, kind.get(name, np.float64), partial(read, name))
        about = extras[name][1] if name in extras else attributes(name)
        return (*axes, "x", "y", *last), values, about

    names = (*(row.name for row in MAPS), *STATE, "position", *extras)
    variables: dict[str, Any] = {name: variable(name) for name in names}
    variables["decision"] = (axes, decision, {"long_name": "use, look or failed; empty: none"})
    coordinates = {
        **{name: ([name], values, {}) for name, values in zip(axes, labels, strict=True)},
        **axes_of_nodes,
        "ras": (["ras"], list(POSITION), {}),
    }
    about = {"protocol": table["protocol"].iloc[0], "region": table["region"].iloc[0]}
    return make_dataset(variables, coordinates, about)


def _beside_sheets(measured: list[Hemisphere]) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
    """Columns of tables of SDs and of sampled maps: their table, and what they are."""
    maps = {entry["name"] for one in measured for entry in one.record.get("maps") or ()}
    variables = {}
    for key in (("uncertainty",), *(("map_table", name) for name in sorted(maps))):
        paths = (one.result.path(*key).with_suffix(".json") for one in measured)
        path = next((path for path in paths if path.is_file()), None)
        for name, about in files.read_json(path).items() if path else ():
            if name.endswith("_sd") if key == ("uncertainty",) else name.partition("_")[0] in maps:
                unit = {"units": about["Units"]} if "Units" in about else {}
                variables[name] = key, {"long_name": about["Description"], **unit}
    return variables
