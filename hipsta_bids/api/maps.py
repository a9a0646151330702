"""Measures labels in memory: one hemisphere as arrays, labeled arrays, surfaces and files."""

from base64 import b64encode
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from hipsta_bids import __version__
from hipsta_bids.api.variables import attributes, check_choice, node_axes
from hipsta_bids.derivatives import dataset as folders
from hipsta_bids.derivatives import hemisphere as outputs
from hipsta_bids.derivatives.measures import write_measures
from hipsta_bids.derivatives.names import HemisphereName, output_name, write_shared
from hipsta_bids.derivatives.results import POSITION, ResultPlace
from hipsta_bids.errors import ArgumentError, InputError, in_python
from hipsta_bids.geometry.catalog import MAPS, SUMMARY
from hipsta_bids.geometry.label_checks import naming_causes
from hipsta_bids.geometry.sheet import is_left_handed, layer_depth
from hipsta_bids.inputs.labels import MARGIN, label_volume
from hipsta_bids.inputs.shares import Layer, add_shares, read_layers
from hipsta_bids.io import files
from hipsta_bids.io.gifti import sheet_triangles, write_surface
from hipsta_bids.io.volumes import LabelImage, moved, read_labels, without_nan
from hipsta_bids.io.xarrays import Variable, make_dataset
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.protocols import body_ends
from hipsta_bids.protocols.load import for_region, load_protocol
from hipsta_bids.protocols.protocol import Protocol, Tissue
from hipsta_bids.reports.cells import card, with_unit, wrapped
from hipsta_bids.reports.results import SIDES, SheetTable
from hipsta_bids.settings import Settings, load_settings
from hipsta_bids.types import Flag, Float, HemisphereMaps, LabelVolume, Mesh

#: Surfaces of the sheet, by their position among its layers.
_LEVELS = {"interior": 0.0, "midthickness": 0.5, "exterior": 1.0}
_TEXT_ROWS = 8  # summary measures in the text of a measurement


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
    notes: tuple[str, ...] = ()
    """What is doubtful about the image of the labels."""
    soft: bool = False
    """Whether probabilities of the labels placed the walls."""

    def __repr__(self) -> str:
        name = f"{SIDES[self.side]}, {self.protocol.name}, {self.settings.body.region}"
        nx, ny = self.maps["thickness"].shape
        numbers = [
            f"  {row.name:<15} {with_unit(f'{self.summary[row.name]:.2f}', row.unit)}"
            for row in SUMMARY[:_TEXT_ROWS]
        ]
        words = [self.decision, *([outputs.headline(self.message)] if self.message else [])]
        title = f"Measurement of a hemisphere ({name}): {': '.join(words)}"
        return "\n".join([title, *numbers, wrapped(f"maps ({nx}, {ny})", self.maps)])

    def _repr_html_(self) -> str:
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to load)

        from hipsta_bids.api.drawing import draw_map  # noqa: PLC0415  (as above)

        figure, content = Figure(figsize=(3.4, 2.6), layout="constrained"), BytesIO()
        draw_map(figure.subplots(), self.table, "thickness", self.side)
        figure.savefig(content, format="png", dpi=80)
        code = b64encode(content.getvalue()).decode()
        picture = f'<img alt="Thickness on the sheet" src="data:image/png;base64,{code}">'
        return card(repr(self), picture)

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
        """``use``, or ``look``: look at the map before use."""
        return self.hemisphere.decision.value

    @property
    def flags(self) -> tuple[Flag, ...]:
        """What to look at before use; empty unless the decision is ``look``."""
        return self.hemisphere.flags

    @property
    def message(self) -> str:
        """Why to look at the map; empty if there is no need."""
        return outputs.verdict(self.hemisphere)[2] or ""

    @cached_property
    def summary(self) -> pd.Series:
        """One number per summary measure, named as the columns of the summary table."""
        return pd.Series(dict(self.hemisphere.summary), name=self.side, dtype=np.float64)

    @cached_property
    def subfield(self) -> NDArray[np.str_]:
        """(x, y) abbreviations of subfields; empty where there is none."""
        labels = outputs.sheet_labels(self.protocol)
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

    def to_gifti(self, folder: str | Path, participant: str, session: str | None = None) -> Path:
        """Write surfaces (RAS mm), maps and subfields as GIFTI; labels as of :meth:`save`.

        Values are in the order of ``maps[name].ravel()``, NaN where missing.
        """
        name = self._name(participant, session)
        files.check_writable(Path(folder))
        for key, content in outputs.gifti_files(self.hemisphere, self.protocol, self.side):
            files.write_bytes(Path(folder) / output_name(name, key), content)
        return Path(folder)

    def save(self, out_dir: str | Path, participant: str, session: str | None = None) -> Path:
        """Write all files into an output dataset, as the participant level does.

        Parameters
        ----------
        out_dir : str or Path
            Made if need be; :func:`hipsta_bids.load` and ``hipsta-bids ... group`` read it.
        participant, session : str
            Labels, such as ``"sub-01"`` and ``"ses-1"``; earlier files of these are replaced.

        Returns
        -------
        Path
            The output dataset.

        Raises
        ------
        ValueError
            If a label has other characters than letters and digits.
        UsageError, OutputError
            If the folder has results with other settings or of other software, or is not writable.
        """
        root, name = Path(out_dir), self._name(participant, session)
        folders.check_own_dataset(root)
        files.check_writable(root)
        with files.locked(root, files.DATASET):
            digest = folders.settle_settings(root, self.settings)
            folders.write_description(root, {})
            folders.write_sidecar(root)
            write_shared(root)
        common = {"version": __version__, "settings_hash": digest, "region": name.region}
        about = {"scheme": name.seg, "scheme_title": self.protocol.title, "input_hash": None}
        record: dict[str, Any] = common | about
        record |= {"inputs": [], "edited": [], "notes": ["measured in Python", *self.notes]}
        record |= {"provenance": {"probabilities": "memory"}} if self.soft else {}
        place = ResultPlace(root=root, name=name)
        outputs.write_results(place, self.hemisphere, self.protocol, record, write_meshes=False)
        _, reason, message = outputs.verdict(self.hemisphere)
        row = {"decision": self.decision, "repairs": str(len(self.hemisphere.repairs))}
        row |= (
            {"reason": reason, "message": outputs.headline(message)} if reason and message else {}
        )
        folders.update_status(root, [common | row | folders.identity(name)])
        write_measures(root)
        return root

    def _name(self, participant: str, session: str | None) -> HemisphereName:
        subject = participant.removeprefix("sub-")
        visit = session.removeprefix("ses-") if session else None
        if not all(label.isascii() and label.isalnum() for label in (subject, visit or subject)):
            raise ValueError("labels of participant and session have letters and digits only")
        region = self.settings.body.region
        return HemisphereName(
            subject=subject, session=visit, hemi=self.side, seg=self.protocol.name, region=region
        )

    @cached_property
    def table(self) -> SheetTable:
        """The sheet as the pages draw it."""
        sheet = self.hemisphere.sheet
        return SheetTable(
            columns=self.maps,
            subfield=self.subfield,
            valid=sheet.valid,
            repaired=self.hemisphere.repaired,
            doubtful=self.hemisphere.doubtful,
            points={"midthickness": sheet.points[:, :, sheet.middle]},
            ends=body_ends(self.settings.body.region, sheet.valid.shape[1]),
        )

    @cached_property
    def dataset(self) -> xr.Dataset:
        """The maps as a dataset of xarray.

        Coordinates are ``x`` (medial to lateral) and ``y`` (posterior to anterior), from -1 to 1,
        and ``layer``, the share of the column from the interior (0) to the exterior wall (1).
        Each map has dimensions (x, y), ``position`` (x, y, layer, ras) in scanner RAS mm, and
        ``depth`` (x, y, layer) in mm from the interior wall. Attributes hold units, definitions
        and sources of maps.
        """
        sheet, layers = self.hemisphere.sheet, self.hemisphere.layers
        nz = sheet.points.shape[2]
        grid = ("x", "y")
        state = {"subfield": self.subfield, "valid": sheet.valid}
        state |= {name: getattr(self.table, name) for name in ("repaired", "doubtful")}
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


@in_python()
def measure(
    labels: Any,  # noqa: ANN401  (nibabel's images have no types)
    side: str = "L",
    protocol: str | Path | Protocol | None = None,
    *,
    affine: ArrayLike | None = None,
    probabilities: Any = None,  # noqa: ANN401  (as above)
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
        Hemisphere. Of an image with codes of both, in a protocol that shifts the codes of one side,
        the other is excluded.
    protocol : str, Path or Protocol
        What the codes mean: a name of ``hipsta-bids protocols``, as ``"freesurfer"`` or
        ``"hippunfold"``, or a TOML file. A wrong one may give a plausible, wrong map.
    affine : array, optional
        (4, 4), voxel index to RAS mm; for arrays only.
    probabilities : optional
        Probability, 0 to 1, of the sheet with its molecular layer, which places the walls: an array
        (I, J, K) on the grid of the labels, a path or an image of nibabel. Or a mapping from codes,
        among them each code of the sheet and its layer, to these.
    region : {"body", "extended", "entorhinal", "headbody", "whole"}
        What to measure; the second and third need labels of the cortex next to it, the last two,
        which are experimental, labels of subfields in the head.
    settings : Settings, str or Path, optional
        Settings of the participant level, or a TOML file with some.

    Returns
    -------
    Measurement
        ``maps`` as arrays, ``dataset`` with coordinates and units, ``summary``, ``decision``.

    Raises
    ------
    ValueError
        If side, protocol or affine are missing or wrong.
    FileNotFoundError
        If a file of labels, protocol or settings does not exist.
    InputError, ProtocolError
        If labels or probabilities cannot be read, or do not match the protocol or each other.
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

    With xarray, values are selected by their coordinates:

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
    if probabilities is not None:
        volume = _with_probabilities(volume, probabilities)
    with naming_causes(volume):
        hemisphere = measure_hemisphere(volume, side, settings, lambda _: nullcontext())
    return Measurement(
        side=side,
        protocol=for_region(volume.protocol, region),
        settings=settings,
        hemisphere=hemisphere,
        notes=volume.notes,
        soft=bool(volume.shares),
    )


def _check_complete(volume: LabelVolume, tissues: AbstractSet[Tissue]) -> None:
    sheet = (*volume.protocol.sheet, *volume.protocol.layer)
    present = {tissue for tissue in sheet if (volume.tissue == tissue).any()}
    if lacking := present - tissues:
        names = ", ".join(sorted(tissue.name for tissue in lacking))
        raise InputError(f"no probabilities of {names}; add them", reason="bad-probabilities")


def _with_probabilities(volume: LabelVolume, source: Any) -> LabelVolume:  # noqa: ANN401  (as above)
    """Add probabilities of the sheet, or of codes, to labels."""
    sheet = (*volume.protocol.sheet, *volume.protocol.layer)
    tissues = {0: Tissue.BACKGROUND} | {x.code: x.tissue for x in volume.protocol.labels}
    if isinstance(source, Mapping):
        for code in source:
            check_choice("probabilities: code", code, tissues)
        _check_complete(volume, {tissues[code] for code in source})
        by_tissue = [(tissues[code], f" of code {code}", values) for code, values in source.items()]
    else:
        # All of the sheet, whichever of its tissues has the name.
        by_tissue = [(sheet[0], "", source)]
        by_tissue += [(tissue, "", np.zeros(_shape(volume))) for tissue in sheet[1:]]
    layers: list[Layer] = []
    for tissue, name, values in by_tissue:
        if isinstance(values, str | Path):
            layers += read_layers(Path(values), [tissue], volume)
            continue
        data = np.asanyarray(getattr(values, "dataobj", values), dtype=np.float32)
        affine = getattr(values, "affine", None)
        if affine is None and data.shape != _shape(volume):
            problem = f"{name} have shape {data.shape}, the labels {_shape(volume)}"
            raise ArgumentError("probabilities", problem.strip())
        start = -volume.start[0], -volume.start[1], -volume.start[2]
        affine = moved(volume.affine, start) if affine is None else affine
        layers.append(Layer(f"probabilities{name}", tissue, data, affine))
    return add_shares(volume, layers, "probabilities")


def _shape(volume: LabelVolume) -> tuple[int, ...]:
    return volume.file_shape or volume.tissue.shape


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
    data, has_nan = without_nan(data)
    image = LabelImage(data, (0, 0, 0), data.shape, matrix, has_nan)
    return label_volume(image, protocol, side, region)
