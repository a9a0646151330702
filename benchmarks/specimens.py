"""Hemispheres that several programs measure: phantoms, and labels of a dataset, as files.

Every program reads the same file, in the codes of FreeSurfer's full hierarchy.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import nibabel as nib
import numpy as np

from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import find_hemispheres
from hipsta_bids.io import files
from hipsta_bids.phantom import Phantom, PhantomSpec, encode, rigid_motion
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.types import Float, LabelVolume

#: Files of one hemisphere, as FreeSurfer names them.
LABELS = "derivatives/freesurfer/sub-{subject}/mri/{side}.hippoAmygLabels-T1.v22.mgz"
SIDES = {"L": "lh", "R": "rh"}
SEED = 20243
ROUGH_PARTS = 3
"""Finer voxels per voxel and axis, from which rough labels are drawn."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A phantom, and how it is drawn."""

    spec: PhantomSpec
    hemi: str = "L"
    voxel: float = 0.4
    """mm, edge."""
    rough: float = 0.0
    """mm, SD along each axis of how far from its center a voxel takes its label."""
    degrees: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """mm."""

    @property
    def pose(self) -> Float:
        """Rigid motion (4, 4), RAS mm."""
        return rigid_motion(self.degrees, self.shift)


#: By subject label: thickness, curvature, size of voxels and noise of labels differ.
PHANTOMS: Mapping[str, Drawing] = {
    "spiral": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=2.0), degrees=(4, -3, 2), shift=(1.3, -2.1, 0.7)
    ),
    "thin": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=1.4),
        hemi="R",
        degrees=(-5, 2, -4),
        shift=(-0.6, 3.4, 5.2),
    ),
    "uneven": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
        degrees=(2, 6, -3),
        shift=(0.4, 1.1, -0.8),
    ),
    "tight": Drawing(
        spec=PhantomSpec(kind="tight", thickness=1.8),
        hemi="R",
        degrees=(-3, -4, 5),
        shift=(-1.2, 0.5, 2.3),
    ),
    "bent": Drawing(
        spec=PhantomSpec(kind="arc", thickness=2.2, width=18.85, bend=0.01),
        degrees=(6, 1, 3),
        shift=(0.9, -0.7, 1.6),
    ),
    "rough": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=2.0),
        hemi="R",
        rough=0.1,
        degrees=(1, -5, -2),
        shift=(-0.3, 2.2, -1.9),
    ),
    "coarse": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=2.0),
        voxel=0.5,
        degrees=(-2, 3, 4),
        shift=(1.7, 0.2, -1.1),
    ),
    "fine": Drawing(
        spec=PhantomSpec(kind="spiral", thickness=2.0),
        hemi="R",
        voxel=1 / 3,
        degrees=(3, 4, -5),
        shift=(-2.4, -1.3, 0.6),
    ),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Specimen:
    """One hemisphere that all programs measure."""

    subject: str
    hemi: str
    dataset: Path
    """BIDS dataset with these labels alone."""
    drawing: Drawing | None = None
    """None for labels of a dataset."""

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{'phantom' if self.drawing else 'sub'}-{self.subject}_hemi-{self.hemi}"

    @property
    def labels(self) -> Path:
        """File of the labels."""
        return self.dataset / LABELS.format(subject=self.subject, side=SIDES[self.hemi])


def draw(drawing: Drawing) -> LabelVolume:
    """Draw a phantom in FreeSurfer's labels, with rough borders if it has noise."""
    volume, *finer = (
        Phantom(drawing.spec).label_volume(
            load_protocol("freesurfer"),
            hemi=drawing.hemi,
            pose=drawing.pose,
            voxel_size=(drawing.voxel / parts,) * 3,
            axes="LIA",
        )
        for parts in ((1, ROUGH_PARTS) if drawing.rough else (1,))
    )
    return roughen(volume, finer[0], drawing.rough) if finer else volume


def roughen(volume: LabelVolume, finer: LabelVolume, sd: float) -> LabelVolume:
    """Take the label of each voxel from a point that lies off its center by noise of SD mm."""
    generator = np.random.default_rng(SEED)
    index = np.indices(volume.tissue.shape).reshape(3, -1).T
    points = nib.affines.apply_affine(volume.affine, index)
    points += generator.normal(0.0, sd, points.shape)
    nearest = np.rint(nib.affines.apply_affine(np.linalg.inv(finer.affine), points)).astype(int)
    at = tuple(np.clip(nearest, 0, np.array(finer.tissue.shape) - 1).T)
    shape = volume.tissue.shape
    return LabelVolume(
        tissue=finer.tissue[at].reshape(shape),
        part=finer.part[at].reshape(shape),
        affine=volume.affine,
        protocol=volume.protocol,
    )


def write_labels(specimen: Specimen, volume: LabelVolume) -> None:
    """Write labels in FreeSurfer's full hierarchy, which Hipsta needs, as a BIDS dataset."""
    about = {"Name": specimen.name, "BIDSVersion": "1.11.0", "DatasetType": "raw"}
    files.write_json(specimen.dataset / "dataset_description.json", about)
    folder = specimen.dataset / LABELS.partition("/sub-")[0]
    about = {"Name": "labels", "BIDSVersion": "1.11.0", "DatasetType": "derivative"}
    files.write_json(folder / "dataset_description.json", about)
    protocol = load_protocol("freesurfer")
    known = {(label.tissue, label.part) for label in protocol.labels}
    pairs = np.stack([volume.tissue, volume.part], axis=-1)
    other = np.ones(volume.tissue.shape, dtype=bool)
    for pair in known:
        other &= (pairs != pair).any(axis=-1)
    volume = LabelVolume(
        tissue=np.where(other, 0, volume.tissue).astype(np.uint8),
        part=np.where(other, 0, volume.part).astype(np.uint8),
        affine=volume.affine,
        protocol=protocol,
    )
    specimen.labels.parent.mkdir(parents=True, exist_ok=True)
    nib.save(nib.MGHImage(encode(volume), volume.affine), specimen.labels)


def specimens(bids_dir: Path | None, work: Path) -> Iterator[Specimen]:
    """Write the labels of phantoms and of FreeSurfer's hemispheres in a dataset."""
    for name, drawing in PHANTOMS.items():
        dataset = work / f"phantom-{name}"
        item = Specimen(subject=name, hemi=drawing.hemi, dataset=dataset, drawing=drawing)
        if not item.labels.exists():
            write_labels(item, draw(drawing))
        yield item
    if bids_dir is None:
        return
    for found in find_hemispheres(InputRequest(bids_dir=bids_dir)):
        if found.problem is None and found.protocol.tool == "freesurfer":
            dataset = work / f"sub-{found.subject}-{found.hemi}"
            item = Specimen(subject=found.subject, hemi=found.hemi, dataset=dataset)
            if not item.labels.exists():
                write_labels(item, read_label_volume(found))
            yield item
