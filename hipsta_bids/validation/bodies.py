"""Bodies that suites damage or reslice: phantoms, and segmentations of a dataset."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import HemisphereMaps, LabelVolume
from hipsta_bids.bids.dataset import HemisphereInput, InputRequest, find_hemispheres
from hipsta_bids.bids.images import read_label_volume
from hipsta_bids.participant import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.schemes import load_scheme
from hipsta_bids.settings import Settings

ValidationBody = PhantomSpec | HemisphereInput


def fine_segmentations(labels: Path, largest: float) -> list[HemisphereInput]:
    """Find the usable segmentations of a dataset with voxels of at most ``largest`` mm."""
    return [
        item
        for item in find_hemispheres(InputRequest(bids_dir=labels))
        if item.problem is None
        and np.linalg.norm(read_label_volume(item).affine[:3, :3], axis=0).max() <= largest
    ]


def load_body(body: ValidationBody, voxel: float) -> tuple[LabelVolume, str]:
    """Labels of a body and its hemisphere; phantoms are drawn in voxels of ``voxel`` mm."""
    if isinstance(body, PhantomSpec):
        volume = Phantom(body).label_volume(load_scheme("freesurfer"), voxel_size=(voxel,) * 3)
        return volume, "L"
    return read_label_volume(body), body.hemi


def name_body(body: ValidationBody) -> str:
    """Name a body for people."""
    if isinstance(body, PhantomSpec):
        return body.kind
    return f"labels {body.subject} {body.hemi}"


def measure_body(volume: LabelVolume, hemi: str) -> HemisphereMaps:
    """Measure with default settings, without a clock."""
    return measure_hemisphere(volume, hemi, Settings(), lambda _: nullcontext())
