"""Small results and inputs for tests of what writes, runs and reports; no geometry is computed."""

import json
import os
import signal
import sys
import time
import types
from pathlib import Path

import numpy as np

from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.errors import GeometryError, InputError
from hipsta_bids.geometry.catalog import MAPS, SECTIONS, average_profiles
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.participant.job import run_alone
from hipsta_bids.protocols.protocol import Label, Part, Protocol, Tissue
from hipsta_bids.types import BodyMask, Coordinates, Flag, HemisphereMaps, Sheet, TetMesh

NX, NY, NZ = 5, 4, 3
THICKNESS = 1.5
NAME = HemisphereName(subject="01", session=None, hemi="L", seg="demo")
TISSUES = (Tissue.SUBICULUM, Tissue.CA1, Tissue.CA3)


def make_scheme(name="demo"):
    labels = [
        Label(
            code=10 * (k + 1) + part,
            tissue=tissue,
            part=Part(part),
            name=f"{tissue.name}-{Part(part).name}",
            abbreviation=("Sub", "CA1", "CA3")[k],
            color=("#ff0000", "#00ff00", "#0000ff")[k],
        )
        for k, tissue in enumerate(TISSUES)
        for part in (Part.HEAD, Part.BODY)
    ]
    return Protocol(
        name=name,
        title="Protocol of the tests",
        citation="Nobody N. A protocol. 2020.",
        sheet=TISSUES,
        layer=(),
        interior=(),
        labels=tuple(labels),
    )


def make_maps(*, hemi="L", flags=(), repairs=(), holes=(), repaired=()):
    """A flat sheet of constant thickness: x along RAS x (away from the midline), y along y."""
    side = -1.0 if hemi == "L" else 1.0
    x, y, z = np.meshgrid(np.arange(NX), np.arange(NY), np.linspace(-0.5, 0.5, NZ), indexing="ij")
    points = np.stack([side * (20 + x), 2.0 * y, THICKNESS * z], axis=-1)
    thickness = np.full((NX, NY), THICKNESS)
    valid = np.ones((NX, NY), bool)
    for i, j in holes:
        points[i, j], thickness[i, j], valid[i, j] = np.nan, np.nan, False
    touched = np.zeros((NX, NY), bool)
    for i, j in repaired:
        touched[i, j] = True
    subfield = np.repeat([[t] for t in np.resize(TISSUES, NX)], NY, axis=1)
    sheet = Sheet(points=points, valid=valid)
    maps = {row.name: np.full((NX, NY), 0.1 * k) for k, row in enumerate(MAPS)}
    maps |= {
        "thickness": thickness,
        "curvature_interior": np.full((NX, NY), 0.2),
        "curvature": np.full((NX, NY), 0.1),
        "curvature_exterior": np.full((NX, NY), -1e-9),
    }
    return HemisphereMaps(
        sheet=sheet,
        layers=sheet,
        maps=maps,
        profiles=average_profiles(maps, sheet),
        sections={row.name: np.arange(NY) + k for k, row in enumerate(SECTIONS)},
        subfield=subfield,
        repaired=touched,
        doubtful=touched,
        body_mask=BodyMask(
            inside=np.eye(3)[None] > 0,
            start=(1, 0, 2),
            shape=(2, 4, 6),
            affine=np.diag([0.4, 0.5, 2.0, 1.0]),
        ),
        summary={
            "thickness_mean": THICKNESS,
            "extent_x": 4.0,
            "extent_y": 6.0,
            "extent_z": THICKNESS,
            "volume": 36.0,
            "area_interior": 24.0,
            "area_mid": 24.0,
            "area_exterior": 24.0,
            "thickness_mean_CA1": THICKNESS,
            "area_CA1": 8.0,
            "volume_CA1": np.nan,
        },
        qc={"voxels": np.int64(7), "ratio": np.float64("nan"), "caps": np.array([1, 2])},
        flags=flags,
        repairs=repairs,
        mesh=TetMesh(
            vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
            tetrahedra=np.array([[0, 1, 2, 3]]),
        ),
        coordinates=Coordinates(values=np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    )


def make_input(folder, subject="01", *, hemi="L", act="ok", problem=None, session=None):
    """An input whose file says what the stand-in measurement is to do with it."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"sub-{subject}_{hemi}.txt"
    text = f"{act} is what sub-{subject} {session} {hemi} does"  # each file another one
    if not path.is_file() or path.read_text() != text:  # never empty while another run reads it
        path.write_text(text)
    return HemisphereInput(
        subject=subject,
        session=session,
        hemi=hemi,
        protocol=make_scheme(),
        files=(path,),
        source="tests",
        source_path=folder,
        explanation="it is the only one",
        passed_over=((str(folder / "other.txt"), "coarser"),),
        problem=problem,
    )


class Act(str):
    """What a stand-in does, as its volume of labels."""

    __slots__ = ()
    affine = np.diag([-0.4, 0.4, 1.2, 1.0])
    protocol = make_scheme()
    tissue = np.pad(np.resize(np.array(TISSUES, np.uint8), (8, 8, 8)), 1)

    @property
    def notes(self):
        return ("in.nii: odd header",) if self == "noted" else ()


def act_out(act, hemi, clock):
    """Behave as the input file says."""
    with clock("surface"):
        if act == "flagged":
            return make_maps(hemi=hemi, flags=(Flag(reason="odd-shape", message="look at it"),))
        if act == "repaired":
            return make_maps(hemi=hemi, repairs=("closed 1 hole",))
        if act == "bad-input":
            raise InputError("file.nii: all zero; segment again", reason="empty-labels")
        if act == "bad-shape":
            raise GeometryError("body is 2 mm long; too short", reason="body-too-short")
        if act == "bug":
            raise ZeroDivisionError("tests divide by zero")
        if act == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        if act == "hang":
            time.sleep(60)
        if act == "slow":
            time.sleep(0.5)
    return make_maps(hemi=hemi)


def replace_measurement():
    """Put stand-ins in the place of reading and measuring, in this process."""
    images = types.ModuleType("hipsta_bids.inputs.labels")
    images.read_label_volume = lambda item, _region: Act(item.files[0].read_text().split()[0])
    participant = types.ModuleType("hipsta_bids.participant.measure")
    participant.find_body = lambda *_: None
    participant.measure_hemisphere = lambda volume, hemi, _, clock: act_out(volume, hemi, clock)
    sys.modules[images.__name__] = images
    sys.modules[participant.__name__] = participant


def stand_in_jobs(jobs):
    """Take the place of ``run_alone`` in workers, which are processes of their own."""
    replace_measurement()
    return run_alone(jobs)


def thread_jobs(jobs):
    """Say what a worker sees of its surroundings."""
    seen = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "TMPDIR")}
    Path(jobs[0].result.root, "seen.json").write_text(json.dumps(seen))
    return stand_in_jobs(jobs)
