"""Small datasets and images for tests of what is searched and read."""

import json

import nibabel as nib
import numpy as np

from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.inputs.search import InputRequest, find_hemispheres

#: 0.5 mm voxels, rotated a little so that mistakes in affines show.
ANGLE = np.deg2rad(20)
AFFINE = np.array(
    [
        [-0.5 * np.cos(ANGLE), 0.5 * np.sin(ANGLE), 0.0, 10.0],
        [0.5 * np.sin(ANGLE), 0.5 * np.cos(ANGLE), 0.0, -20.0],
        [0.0, 0.0, 0.5, 5.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def touch(root, *names):
    """Make empty files: enough wherever no image is to be opened."""
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def describe(root, generator=None, kind="derivative"):
    root.mkdir(parents=True, exist_ok=True)
    contents = {"Name": "test", "BIDSVersion": "1.9.0", "DatasetType": kind}
    if generator:
        contents["GeneratedBy"] = [{"Name": generator}]
    (root / "dataset_description.json").write_text(json.dumps(contents), encoding="utf-8")


def save(path, data, affine=AFFINE):
    """Write labels as NIfTI or MGZ, by the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = nib.MGHImage if path.suffix in {".mgz", ".mgh"} else nib.Nifti1Image
    nib.save(kind(data, affine), path)
    return path


def save_values(path, values):
    """Write an image that holds given labels, side by side, and background around them."""
    data = np.zeros((len(values) + 2, 3, 3), dtype=np.int16)
    data[1:-1, 1, 1] = values
    return save(path, data)


def find(bids_dir, **options):
    return find_hemispheres(InputRequest(bids_dir=bids_dir, **options))


def by_key(items):
    """Index inputs by subject, session, hemisphere and protocol, which has to be unique."""
    found = {item.key: item for item in items}
    assert len(found) == len(items)
    return found


def put_visits(root, *names, sides="lr"):
    for name in names:
        for side in sides:
            path = (
                root / "derivatives/freesurfer" / name / f"mri/{side}h.hippoAmygLabels-T1.v22.mgz"
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"use {name} {side}")


def said_of(capsys, *arguments, code=ExitCode.OK):
    assert main.main([str(word) for word in arguments]) == code
    said = capsys.readouterr()
    return said.out + said.err
