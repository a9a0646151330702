"""Files of the sheet that visits share, above the folders of sessions, and of each visit."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hipsta_bids.derivatives.hemisphere import write_sources
from hipsta_bids.derivatives.results import ResultPlace
from hipsta_bids.geometry.sheet import is_left_handed
from hipsta_bids.io import files, gifti
from hipsta_bids.io.volumes import mask_bytes
from hipsta_bids.participant.job import Job
from hipsta_bids.types import BodyMask, Float, Sheet

_SURFACES = ("interior", "midthickness", "exterior")
_KEYS = (*_SURFACES, "thickness", "sd", "mask", "qc")


def template_place(result: ResultPlace) -> ResultPlace:
    """Return where the files of the common sheet of a visit are."""
    return replace(result, name=replace(result.name, session=None))


def write_template(
    place: ResultPlace, sheet: Sheet, thickness: Float, mask: BodyMask, record: Mapping[str, Any]
) -> None:
    """Write the sheet and the mask of the mean of all visits, and statistics of their maps.

    ``thickness`` is (visits, Nx, Ny), mm.
    """
    remove_template(place)
    hemi, (count, nx, ny) = place.name.hemi, thickness.shape
    sd = thickness.std(axis=0, ddof=1) if count > 1 else np.full((nx, ny), np.nan)
    triangles = gifti.sheet_triangles(nx, ny, flip=is_left_handed(sheet.points))
    for name, level in zip(_SURFACES, (0, sheet.middle, -1), strict=True):
        points = sheet.points[:, :, level].reshape(-1, 3)
        content = gifti.surface_bytes(points, triangles, hemi=hemi, secondary=None, unfolded=False)
        files.write_bytes(place.path(f"template_{name}"), content)
    for name, values in (("thickness", thickness.mean(axis=0)), ("sd", sd)):
        content = gifti.shape_bytes(values.ravel(), hemi=hemi, name=name, unit="mm")
        files.write_bytes(place.path(f"template_{name}"), content)
    files.write_bytes(place.path("template_mask"), mask_bytes(mask))
    write_sources(place, record)
    files.write_json(place.path("template_qc"), record)


def remove_template(place: ResultPlace) -> None:
    """Remove the files of a common sheet."""
    files.remove([place.path(f"template_{key}") for key in reversed(_KEYS)])


def write_change(result: ResultPlace, change: Float, record: Mapping[str, Any]) -> None:
    """Write the thickness (Nx, Ny) of a visit minus the mean of all visits, mm."""
    name = "thickness_change"
    content = gifti.shape_bytes(change.ravel(), hemi=result.name.hemi, name=name, unit="mm")
    files.write_bytes(result.path("change"), content)
    write_sources(result, record)


def has_change(job: Job) -> bool:
    """Return whether the file of a visit on a common sheet exists."""
    return job.result.path("change").exists()
