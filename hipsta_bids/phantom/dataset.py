"""Synthetic BIDS datasets: segmentations of phantoms, arranged as other tools do, and the truth."""

import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import filterfalse
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import nibabel as nib
import numpy as np
from nibabel.affines import from_matvec
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hipsta_bids import __version__
from hipsta_bids.errors import UsageError, did_you_mean
from hipsta_bids.io import files
from hipsta_bids.phantom.head import HeadPhantom, HeadSpec
from hipsta_bids.phantom.labels import encode
from hipsta_bids.phantom.phantom import Phantom
from hipsta_bids.phantom.shape import PhantomSpec, bad
from hipsta_bids.protocols.load import load_protocol, plain_name
from hipsta_bids.protocols.protocol import Part, Protocol, Tissue
from hipsta_bids.types import Float, LabelVolume

#: Name of the table of true values, at the top of the dataset.
TRUTH_TABLE = "phantom_truth.tsv"

#: Where bodies of phantoms with a head end, for ``--ends``.
ENDS_TABLE = "phantom_ends.tsv"

#: Points per axis of a voxel, by which shares are measured.
_POINTS = 4

BIDS_VERSION = "1.11.0"

#: Columns of the truth table: definition and unit.
TRUTH_COLUMNS: Mapping[str, tuple[str, str | None]] = MappingProxyType(
    {
        "subject": ("subject, with its sub- prefix", None),
        "hemi": ("L or R", None),
        "region": (
            "body; with cortex also extended and entorhinal, with a head headbody and whole",
            None,
        ),
        "kind": ("shape of the cross-section", None),
        "thickness_mean": ("mean thickness over the area of the mid-surface", "mm"),
        "extent_x": ("arc length of the mid-curve, medial to lateral", "mm"),
        "extent_y": ("mean length of the mid-surface, posterior to anterior", "mm"),
        "extent_z": ("mean thickness, interior to exterior", "mm"),
        "volume": ("volume of the sheet", "mm^3"),
        "area_interior": ("area of the interior surface", "mm^2"),
        "area_mid": ("area of the mid-surface", "mm^2"),
        "area_exterior": ("area of the exterior surface", "mm^2"),
    }
)


class Layout(NamedTuple):
    """How a tool names and encodes its segmentations."""

    protocol: str
    """Bundled protocol."""
    path: str
    """Of one hemisphere, below the tool's folder."""
    sides: tuple[str, str]
    """How the tool names L and R."""


_ASHS = "{subject}/final/{subject}_{side}_lfseg_corr_usegray.nii.gz"
_HIPPUNFOLD = "{subject}/anat/{subject}_hemi-{side}_space-cropT1w_desc-subfields_"

#: Tools whose folders can be imitated; the name is that of the folder in ``derivatives``.
LAYOUTS: Mapping[str, Layout] = MappingProxyType(
    {
        "freesurfer": Layout(
            "freesurfer", "{subject}/mri/{side}.hippoAmygLabels-T1.v22.mgz", ("lh", "rh")
        ),
        "ashs": Layout("ashsABC3T", _ASHS, ("left", "right")),
        "ashsPMC": Layout("ashsPMC", _ASHS, ("left", "right")),
        "hippunfold": Layout(
            "hippunfold", f"{_HIPPUNFOLD}atlas-multihist7_dseg.nii.gz", ("L", "R")
        ),
    }
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Hemisphere:
    """One phantom of a dataset."""

    subject: str
    """Label without ``sub-``."""
    hemi: str
    """``L`` or ``R``."""
    spec: PhantomSpec | HeadSpec
    pose: Float | None = None
    """(4, 4) rigid motion in RAS mm."""


def write_dataset(
    out: Path,
    hemispheres: Sequence[Hemisphere],
    *,
    layouts: Sequence[str] = ("freesurfer",),
    voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
    axes: str = "LIA",
    probabilities: bool = False,
    columns: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
    rows: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> None:
    """Write phantoms as a BIDS dataset with derivatives and a table of the truth.

    ``probabilities`` writes the share of each voxel that a tissue fills next to the labels.
    ``columns`` describes the columns of ``participants.tsv`` next to the labels, as a BIDS sidecar
    does; ``rows`` has their values in this order, by subject label without ``sub-``. The same input
    gives the same bytes. Existing files of the same name are replaced.
    """
    if unknown := list(filterfalse(LAYOUTS.__contains__, layouts)):
        raise bad(
            f"layout {unknown[0]!r} is unknown; choose from {', '.join(LAYOUTS)}"
            f"{did_you_mean(unknown, LAYOUTS)}"
        )
    if any(item.spec.cortex for item in hemispheres):
        _refuse(layouts, "labels for cortex", lambda protocol: protocol.neighbors != ())
    if any(isinstance(item.spec, HeadSpec) for item in hemispheres):
        _refuse(layouts, "subfields in the head", _has_head)
    points: dict[str, Any] = {"supersample": _POINTS} if probabilities else {}
    truth: list[dict[str, str]] = []
    ends: list[list[str]] = []
    for item in hemispheres:
        spec = item.spec
        phantom = HeadPhantom(spec) if isinstance(spec, HeadSpec) else Phantom(spec)
        truth += _truth_rows(item, phantom)
        if isinstance(phantom, HeadPhantom):
            for end, plane in phantom.ends(item.hemi, item.pose).items():
                ends.append([f"sub-{item.subject}", item.hemi, end, *(f"{x:.4f}" for x in plane)])
        for name in layouts:
            layout = LAYOUTS[name]
            volume = phantom.label_volume(
                load_protocol(layout.protocol),
                hemi=item.hemi,
                pose=item.pose,
                voxel_size=voxel_size,
                axes=axes,
                **points,
            )
            path = layout.path.format(
                subject=f"sub-{item.subject}", side=layout.sides["LR".index(item.hemi)]
            )
            _write_labels(out / "derivatives" / name / path, item, volume)
    if ends:
        header = ["participant_id", "hemi", "end", "r", "a", "s", "nr", "na", "ns"]
        files.write_tsv(out / ENDS_TABLE, header, ends)
    _write_truth(out, hemispheres, truth)
    _write_participants(out, hemispheres, columns, rows)
    _write_descriptions(out, layouts)


def write_demo_dataset(out: Path) -> None:
    """Write a dataset of two subjects in FreeSurfer's layout: four shapes, 1.6 to 2.2 mm thick."""
    shapes = {
        ("demo1", "L"): PhantomSpec(kind="spiral", thickness=1.6),
        ("demo1", "R"): PhantomSpec(kind="spiral", thickness=2.0, variation=0.2),
        ("demo2", "L"): PhantomSpec(kind="arc", thickness=2.2, width=18.85, bend=0.01),
        ("demo2", "R"): PhantomSpec(kind="tight", thickness=1.8, layer_thickness=0.5),
    }
    poses = {
        "demo1": rigid_motion((4.0, -3.0, 2.0), (1.3, -2.1, 0.7)),
        "demo2": rigid_motion((-5.0, 2.0, -4.0), (-0.6, 3.4, 5.2)),
    }
    write_dataset(
        out,
        [
            Hemisphere(subject=subject, hemi=hemi, spec=spec, pose=poses[subject])
            for (subject, hemi), spec in shapes.items()
        ],
    )


def refuse_taken(out: Path, content: str = "phantoms") -> None:
    """Refuse a folder that holds something other than phantoms."""
    try:
        is_occupied = out.exists() and any(out.iterdir())
    except OSError as error:
        raise files.output_error(out, error) from error
    if is_occupied and not (out / TRUTH_TABLE).exists():
        raise UsageError(f"{out}: holds something other than {content}; choose a new folder")
    files.check_writable(out)


def rigid_motion(degrees: tuple[float, float, float], shift: tuple[float, float, float]) -> Float:
    """Make a (4, 4) rigid motion: rotations about R, A and S in this order, then a shift, mm."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return np.asarray(from_matvec(turn, shift))


def _refuse(layouts: Sequence[str], feature: str, able: Callable[[Protocol], bool]) -> None:
    """Refuse a layout whose protocol lacks something, and name those that have it."""
    have = [key for key, row in LAYOUTS.items() if able(load_protocol(row.protocol))]
    for name in layouts:
        if name not in have:
            raise bad(
                f"the protocol of layout {name} has no {feature}; choose from {', '.join(have)}"
            )


def _has_head(protocol: Protocol) -> bool:
    whole = (label.part for label in protocol.labels if label.tissue is Tissue.HIPPOCAMPUS)
    return Part.HEAD not in whole


def _truth_rows(item: Hemisphere, phantom: Phantom | HeadPhantom) -> list[dict[str, str]]:
    """One row per region."""
    row = {"subject": f"sub-{item.subject}", "hemi": item.hemi, "kind": item.spec.kind}
    return [
        row
        | {"region": region}
        | {name: f"{value:.4f}" for name, value in phantom.region_summary(region).items()}
        for region in phantom.regions
    ]


def _write_labels(path: Path, item: Hemisphere, volume: LabelVolume) -> None:
    """Write labels, and the shares of tissues next to them if the volume has some."""
    _write_image(path, encode(volume), volume.affine)
    names = {int(row.tissue): plain_name(row.abbreviation) for row in volume.protocol.labels}
    for tissue in names.keys() & volume.shares.keys():
        name = f"sub-{item.subject}_hemi-{item.hemi}_label-{names[tissue]}_probseg.nii.gz"
        _write_image(path.with_name(name), volume.shares[tissue], volume.affine)


def _write_image(path: Path, values: NDArray[Any], affine: Float) -> None:
    """Write codes or shares as a compressed MGH or NIfTI image, by the suffix."""
    image: Any
    if path.suffix == ".mgz":
        image = nib.MGHImage(values, affine)
    else:
        kind = np.int16 if np.issubdtype(values.dtype, np.integer) else np.float32
        image = nib.Nifti1Image(values.astype(kind), affine)
        image.header.set_xyzt_units("mm")
    # Without a time stamp, so that writing the same phantom again does not look like new input.
    files.write_bytes(path, gzip.compress(image.to_bytes(), compresslevel=6, mtime=0))


def _write_truth(
    out: Path, hemispheres: Sequence[Hemisphere], truth: Sequence[Mapping[str, str]]
) -> None:
    files.write_tsv(
        out / TRUTH_TABLE, list(TRUTH_COLUMNS), [[row[c] for c in TRUTH_COLUMNS] for row in truth]
    )
    specs = {f"sub-{item.subject}_hemi-{item.hemi}": asdict(item.spec) for item in hemispheres}
    write_sidecar(out / TRUTH_TABLE, TRUTH_COLUMNS, Specifications=specs)


def write_sidecar(
    table: Path, columns: Mapping[str, tuple[str, str | None]], **extras: Mapping[str, Any]
) -> None:
    """Write definitions and units of a table's columns next to it."""
    described = {
        name: {"Description": text} | ({"Units": unit} if unit else {})
        for name, (text, unit) in columns.items()
    }
    files.write_json(table.with_suffix(".json"), described | extras)


def _write_participants(
    out: Path,
    hemispheres: Sequence[Hemisphere],
    columns: Mapping[str, Mapping[str, Any]],
    rows: Mapping[str, Sequence[str]],
) -> None:
    subjects = dict.fromkeys(item.subject for item in hemispheres)
    files.write_tsv(
        out / "participants.tsv",
        ["participant_id", *columns],
        [[f"sub-{name}", *rows.get(name, ())] for name in subjects],
    )
    for name in subjects:
        # A subject's folder has to be there, and folders without files are lost by archives.
        files.write_tsv(out / f"sub-{name}" / f"sub-{name}_scans.tsv", ["filename"], [])
    about = {"Description": "synthetic subject; there is no image behind it"}
    files.write_json(out / "participants.json", {"participant_id": about, **columns})


def _write_descriptions(out: Path, layouts: Sequence[str]) -> None:
    files.write_text(out / "README", _README)
    files.write_text(out / ".bidsignore", _IGNORED)
    files.write_json(
        out / "dataset_description.json",
        {
            "Name": "Synthetic hippocampi with known thickness",
            "BIDSVersion": BIDS_VERSION,
            "DatasetType": "raw",
        },
    )
    for name in layouts:
        # Not made by us as far as finding inputs goes, which passes over its outputs.
        folder = out / "derivatives" / name
        maker = {
            "Name": f"phantom ({name})",
            "Version": __version__,
            "Description": f"Analytic shapes in the labels and folders of {name}",
        }
        readme = f"Segmentations of the phantoms in the dataset above, in the layout of {name}.\n"
        files.write_text(folder / "README", readme)
        inner = Path(LAYOUTS[name].path).parts[1]
        ignored = f"# Folders and names follow {name}, not BIDS.\n/sub-*/{inner}\n"
        files.write_text(folder / ".bidsignore", ignored)
        files.write_json(
            folder / "dataset_description.json",
            {
                "Name": f"Synthetic segmentations in the layout of {name}",
                "BIDSVersion": BIDS_VERSION,
                "DatasetType": "derivative",
                "GeneratedBy": [maker],
            },
        )


_IGNORED = """\
# The truth behind the phantoms, as tables and maps: BIDS has no names for it.
/phantom_*
"""

_README = """\
Synthetic hippocampi: analytic shapes drawn as segmentations, of no participant.
The exact thickness, extents, areas and volume of each are in phantom_truth.tsv.
The segmentations are in derivatives/. There are no images: the subjects' scans.tsv list none.
"""
