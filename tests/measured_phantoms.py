"""Phantoms that are measured: drawn, cut up, written to files, and compared with their truth."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.dataset import identity, read_status, row_key
from hipsta_bids.derivatives.names import HemisphereName, output_path
from hipsta_bids.io import files
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import HemisphereMaps, LabelVolume

#: Long enough for two end planes with a body between them, short enough for quick tests.
LENGTH = 10.0


def measure(volume, hemi="L", settings=None):
    """Measure without a clock."""
    return measure_hemisphere(volume, hemi, settings or Settings(), lambda _: nullcontext())


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A drawn phantom and its maps."""

    phantom: Phantom
    volume: LabelVolume
    maps: HemisphereMaps
    hemi: str = "L"

    @property
    def truth(self):
        """One number per summary column, as a perfect method would measure."""
        return self.phantom.truth(0.5, 0.5).summary


@cache
def measured(spec, *, protocol="freesurfer", hemi="L", settings=None, voxel=0.4):
    """Draw and measure once for all tests (specifications and settings are hashable)."""
    phantom = Phantom(spec)
    volume = phantom.label_volume(load_protocol(protocol), hemi=hemi, voxel_size=(voxel,) * 3)
    maps = measure(volume, hemi, settings)
    return Case(phantom=phantom, volume=volume, maps=maps, hemi=hemi)


def spiral(**changes):
    """Specify the phantom that most tests use."""
    return replace(PhantomSpec(kind="spiral", thickness=2.0, length=LENGTH), **changes)


def middle(values):
    """Columns 5 to 37 of 41: away from the rims, which phantoms have sharp and hippocampi not."""
    return values[4:-4]


def sheet_coordinates(case):
    """Find true (u, v, n) of every mid-surface point, (Nx, Ny, 3)."""
    points = case.maps.sheet.points[:, :, case.maps.sheet.middle]
    return case.phantom.body.locate(points.reshape(-1, 3)).reshape(points.shape)


class Damage:
    """Changes the labels of a drawn phantom at places that are given in sheet coordinates."""

    def __init__(self, case):
        self.body, self.volume = case.phantom.body, case.volume
        affine = self.volume.affine
        index = np.indices(self.volume.tissue.shape).reshape(3, -1).T
        points = index @ affine[:3, :3].T + affine[:3, 3]
        shape = (*self.volume.tissue.shape, 3)
        self.points = points.reshape(shape)
        self.u, self.v, self.n = np.moveaxis(
            self.body.locate(points, reach=6.0).reshape(shape), -1, 0
        )
        self.sheet = np.isin(self.volume.tissue, self.volume.protocol.sheet)

    def ball(self, place, radius):
        """Voxels within a radius (mm) of a place (u, v, n)."""
        return np.linalg.norm(self.points - self.body.place(*place), axis=-1) < radius

    def shaft(self, u, v, radius):
        """Voxels of the wall within a radius (mm) of a line straight through it."""
        spec = self.body.spec
        across = np.hypot((self.u - u) * spec.width, (self.v - v) * spec.length)
        return self.sheet & (across < radius)

    def bar(self, start, end, radius):
        """Voxels outside the wall within a radius (mm) of the line between two places."""
        first, last = self.body.place(*start), self.body.place(*end)
        length = np.linalg.norm(last - first)
        along = (self.points - first) @ ((last - first) / length)
        off = self.points - first - along[..., None] * ((last - first) / length)
        near = np.linalg.norm(off, axis=-1) < radius
        return near & (along > 0) & (along < length) & ~self.sheet

    def erase(self, where):
        """Turn voxels into background."""
        return self._set(where, Tissue.BACKGROUND, Part.UNKNOWN)

    def relabel(self, where, tissue, part=Part.BODY):
        """Give voxels another label."""
        return self._set(where, tissue, part)

    def _set(self, where, tissue, part):
        return replace(
            self.volume,
            tissue=np.where(where, np.uint8(tissue), self.volume.tissue),
            part=np.where(where, np.uint8(part), self.volume.part),
        )


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a run wrote about one hemisphere."""

    out: Path
    name: HemisphereName

    def path(self, key):
        return self.out / output_path(self.name, key)

    @property
    def row(self):
        """The row of ``status.tsv``."""
        rows = {row_key(row): row for row in read_status(self.out)}
        return rows[row_key(identity(self.name))]

    @property
    def summary(self):
        (values,) = files.read_tsv(self.path("summary"))
        return values

    @property
    def sheet(self):
        return pd.read_csv(self.path("sheet"), sep="\t")

    @property
    def metrics(self):
        return files.read_json(self.path("qc"))


def results(out, subject, hemi, seg):
    """Address the results of a hemisphere without sessions."""
    name = HemisphereName(subject=subject, session=None, hemi=hemi, seg=seg)
    return Results(out=out, name=name)
