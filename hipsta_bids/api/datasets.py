"""Reads an output dataset as labeled arrays and a table, and makes an example of one."""

import atexit
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import nibabel as nib
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from hipsta_bids.api.maps import measure
from hipsta_bids.api.variables import attributes, node_axes
from hipsta_bids.derivatives.dataset import counts_text
from hipsta_bids.derivatives.measures import identify, origin
from hipsta_bids.derivatives.names import NAMED_TABLES
from hipsta_bids.derivatives.results import NODES, POSITION, STATE, list_results, read_sheet
from hipsta_bids.errors import MissingFileError, NothingToDoError, in_python
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.cohort.collect import grid_of
from hipsta_bids.io import files
from hipsta_bids.io.xarrays import make_dataset, read_later
from hipsta_bids.joints import find_measurements
from hipsta_bids.phantom import Phantom, PhantomSpec, encode
from hipsta_bids.phantom.cohort import CohortPlan, make_cohort
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.reports.cells import card, wrapped
from hipsta_bids.reports.results import Hemisphere, find_results
from hipsta_bids.types import PARTICIPANT, LabelVolume

#: Axes of an output dataset, and the columns of its table that name places on them.
_AXES = {
    "protocol": "protocol",
    "participant": "participant_id",
    "session": "session_id",
    "side": "hemi",
}
_VOXEL = (0.5, 0.5, 0.5)  # mm, of the example


class Results(NamedTuple):
    """An output dataset."""

    maps: xr.Dataset
    """(protocol, participant, session, side, x, y), read when values are used."""
    measures: pd.DataFrame
    """One row per hemisphere, as in ``measures.tsv``: who, decision, reason, message, where the
    labels come from (``labels_tool``, ``labels_version`` and so on), and the summary measures."""

    def __repr__(self) -> str:
        places = ", ".join(f"{axis} {len(self.maps[axis])}" for axis in _AXES)
        decisions = counts_text(Counter(self.measures["decision"]))
        return (
            f"Output dataset of {len(self.measures)} hemispheres: {decisions}\n"
            f"{wrapped(f'maps ({places})', self.maps.data_vars)}\n"
            f"  measures: {' x '.join(map(str, self.measures.shape))}"
        )

    def _repr_html_(self) -> str:
        columns = [*_AXES.values(), "decision", "reason", "thickness_mean"]
        columns = [name for name in columns if name in self.measures]
        return card(repr(self), self.measures[columns].head().to_html(index=False, border=0))


@in_python()
def load(out_dir: str | Path, *, protocol: str | None = None, region: str = "body") -> Results:
    """Load an output dataset as a table of measures and one lazy dataset of xarray.

    Nothing but the small records and summaries is read at once. Maps are read when their values
    are used, and only of the participants, sides and measures that are used: select first, then
    compute. ``.load()`` reads all others.

    Parameters
    ----------
    out_dir : str or Path
        The output folder of ``hipsta-bids ... participant``.
    protocol : str, optional
        Name of one segmentation protocol; else all that the folder has results of.
    region : {"body", "extended", "entorhinal", "headbody", "whole"}
        The region measured.

    Returns
    -------
    Results
        ``maps``: every map of the sheet, ``subfield``, ``valid``, ``repaired``, ``doubtful`` and
        ``position`` (RAS mm of the mid-surface); where they were made, SDs of perturbed copies
        (``thickness_sd``) and maps of other volumes, by their names; by protocol, participant
        (``sub-01``), session (``ses-1``; ``n/a`` in datasets without), side (``L``, ``R``), x and
        y (-1 to 1 in the body), with units; NaN where there is no map. ``decision`` has
        no x and y. ``measures``: one row per hemisphere, failed ones included, with the
        ``participant_id`` of ``participants.tsv``.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    NothingToDoError
        If no results are there, or none of this protocol and region.

    Examples
    --------
    >>> import hipsta_bids as hb
    >>> maps, measures = hb.load(hb.example().out_dir)
    >>> dict(maps.thickness.sizes)
    {'protocol': 1, 'participant': 10, 'session': 1, 'side': 1, 'x': 41, 'y': 21}
    >>> thickness = maps.thickness.sel(side="L").mean("participant").squeeze()
    >>> print(f"{thickness.mean().item():.2f} {maps.thickness.units}")
    1.74 mm
    """
    root = Path(out_dir)
    if not root.is_dir():
        raise MissingFileError(f"{root}: folder not found; check its name")
    hemispheres = list(find_results(root))
    selected = [
        side
        for side in hemispheres
        if side.result.name.region == region and protocol in {None, side.result.name.seg}
    ]
    if not selected:
        names = {(side.result.name.seg, side.result.name.region) for side in hemispheres}
        available = ", ".join(f"{seg} (region {measured})" for seg, measured in sorted(names))
        available = f"there is {available}" if available else "run the participant level first"
        raise NothingToDoError(f"{root}: hemisphere not found; {available}")
    table = pd.DataFrame([_row(side) for side in selected])
    return Results(maps=_lazy_dataset(root, selected, table), measures=table)


def _row(side: Hemisphere) -> dict[str, object]:
    return {
        **identify(side.result.name),
        "decision": side.decision.value,
        "reason": side.record.get("reason") or "",
        "message": side.message,
        **origin(side.record),
        **side.summary,
    }


def _lazy_dataset(root: Path, hemispheres: list[Hemisphere], table: pd.DataFrame) -> xr.Dataset:
    axes_of_nodes = node_axes(grid_of(root), table["region"].iloc[0])
    nx, ny = (len(values) for _, values, _ in axes_of_nodes.values())
    shape = nx, ny
    axes, places = tuple(_AXES), table[list(_AXES.values())]
    labels = [sorted(places[column].unique()) for column in places]
    outer = tuple(len(names) for names in labels)
    index = [
        tuple(names.index(cell) for names, cell in zip(labels, cells, strict=True))
        for cells in places.itertuples(index=False)
    ]
    decision = np.full(outer, "", dtype="<U8")
    for at, word in zip(index, table["decision"], strict=True):
        decision[at] = word
    measured = {at: side for at, side in zip(index, hemispheres, strict=True) if side.measured}

    extras = _further_maps(list(measured.values()))

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
        kind = {
            "subfield": np.object_,
            "valid": np.bool_,
            "repaired": np.bool_,
            "doubtful": np.bool_,
        }
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
    return make_dataset(variables, coordinates, {"region": table["region"].iloc[0]})


def _further_maps(measured: list[Hemisphere]) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
    """Columns of tables of SDs and of sampled maps: their table, and what they are."""
    maps = {entry["name"] for h in measured for entry in h.record.get("maps") or ()}
    added = [(key,) for measurement in find_measurements() for key in measurement.tables]
    variables = {}
    for key in (*added, *((key, name) for key in NAMED_TABLES for name in sorted(maps))):
        for name, about in _read_sidecar(measured, key).items():
            is_map = name not in NODES if key in added else name.partition("_")[0] in maps
            if is_map and isinstance(about, dict):
                unit = {"units": about["Units"]} if "Units" in about else {}
                variables[name] = key, {"long_name": about["Description"], **unit}
    return variables


def _read_sidecar(measured: list[Hemisphere], key: tuple[str, ...]) -> dict[str, Any]:
    """Read the sidecar of a table of the first hemisphere that has it; empty without one."""
    paths = (hemisphere.result.path(*key).with_suffix(".json") for hemisphere in measured)
    path = next((path for path in paths if path.is_file()), None)
    return files.read_json(path) if path else {}


class Example(NamedTuple):
    """A small synthetic study."""

    labels: nib.Nifti1Image
    """Segmentation of the left hippocampus of the first participant; protocol ``freesurfer``."""
    out_dir: Path
    """Output dataset: all left hemispheres, measured."""
    participants: pd.DataFrame
    """``participant_id``, ``group`` (CN, AD), ``age`` (years), ``sex`` and ``icv`` (mL)."""


@cache
def _temporary_folder() -> str:
    folder = tempfile.mkdtemp(prefix="hipsta_bids-example-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def example(folder: str | Path | None = None) -> Example:
    """Make and measure a small synthetic study, without network; this takes some 20 seconds.

    Five of ten participants are patients, whose wall is 0.3 mm thinner in the anterior CA1. It is
    measured once.

    Parameters
    ----------
    folder : str or Path, optional
        Where to write it, and from where later sessions take it; else a temporary folder that is
        removed when Python ends.

    Returns
    -------
    Example
        ``labels`` for :func:`measure`, ``out_dir`` for :func:`load`, ``participants`` for
        :func:`group`.

    Raises
    ------
    UsageError, OutputError
        If the folder has results of other software, or is not writable.

    Examples
    --------
    >>> import hipsta_bids as hb
    >>> study = hb.example()
    >>> study.participants["group"].value_counts().to_dict()
    {'CN': 5, 'AD': 5}
    >>> left = hb.measure(study.labels, side="L", protocol="freesurfer")
    >>> print(f"{left.summary['thickness_mean']:.1f} {left.units['thickness']}")
    1.8 mm
    """
    root, protocol = Path(folder or _temporary_folder()), load_protocol("freesurfer")
    subjects = make_cohort(CohortPlan(n_subjects=10, groups=("CN", "AD")))
    present = {result.name.subject for result in list_results(root)}
    volumes: list[LabelVolume] = []
    for subject in subjects:
        left = subject.hemispheres[0]
        if not volumes or subject.label not in present:
            phantom = Phantom(cast("PhantomSpec", left.spec))  # the plan has no heads
            volumes.append(phantom.label_volume(protocol, voxel_size=_VOXEL, pose=left.pose))
        if subject.label not in present:
            measure(volumes[-1], "L").save(root, subject.label)
    codes = encode(volumes[0]).astype(np.int16)
    rows = [(f"sub-{s.label}", s.group, s.age, s.sex, s.icv) for s in subjects]
    columns = [PARTICIPANT, "group", "age", "sex", "icv"]
    return Example(
        labels=nib.Nifti1Image(codes, volumes[0].affine),
        out_dir=root,
        participants=pd.DataFrame(rows, columns=columns),
    )
