"""End planes that cut the sheet obliquely, and an uncus beside it."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import Status

PHANTOM = Phantom(PhantomSpec(kind="arc", thickness=2.0, length=18.0, end_length=4.0))


@pytest.fixture(scope="module")
def volume():
    return PHANTOM.label_volume(load_protocol("freesurfer"))


def cut(volume, degrees, about):
    """Labels whose head and tail begin at planes that are tilted about a direction of the sheet."""
    points = to_ras(np.moveaxis(np.indices(volume.tissue.shape), 0, -1), volume.affine)
    first, last = (PHANTOM.body.place(0.5, v, 0.0) for v in (0.2, 0.8))
    axis = (last - first) / np.linalg.norm(last - first)
    across = PHANTOM.body.place(0.5, 0.5, 1.0) - PHANTOM.body.place(0.5, 0.5, -1.0)
    across -= axis * (across @ axis)
    across /= np.linalg.norm(across)
    lean = across if about == "width" else np.cross(axis, across)
    normal = np.cos(np.deg2rad(degrees)) * axis + np.sin(np.deg2rad(degrees)) * lean
    below, above = (points - first) @ normal < 0, (points - last) @ normal > 0
    part = np.where(below, Part.TAIL, np.where(above, Part.HEAD, Part.BODY))
    labeled = (volume.tissue > 0) & (volume.tissue < Tissue.HIPPOCAMPUS)
    tissue = np.where(labeled & below, Tissue.HIPPOCAMPUS, volume.tissue)
    return replace(volume, tissue=tissue, part=np.where(tissue > 0, part, 0))


def measure(volume):
    return measure_hemisphere(volume, "L", Settings(), lambda _stage: nullcontext())


@pytest.mark.parametrize(("degrees", "about"), [(35, "width"), (35, "thickness")])
def test_rows_at_oblique_planes_are_as_thick_as_others(volume, degrees, about):
    """The last rows read up to .28 mm too thick where the mesh ended at the planes."""
    maps = measure(cut(volume, degrees, about))
    assert maps.status == Status.OK
    error = maps.thickness.mean(axis=0) - 2.0
    assert np.abs(error[[0, 1, -2, -1]]).max() < 0.08
    assert np.abs(error).mean() < 0.04
    assert np.abs(maps.thickness - 2.0).max() < 0.25


def test_rows_begin_and_end_at_the_planes(volume):
    tilted = cut(volume, 25, "thickness")
    maps = measure(tilted)
    for row, end in ((0, "posterior"), (-1, "anterior")):
        plane = maps.qc[f"{end}_plane"]
        middle = maps.sheet.points[:, row, maps.sheet.middle]
        height = (middle - plane["point_ras_mm"]) @ np.array(plane["normal_ras"])
        assert np.abs(height).max() < 0.15
    # The volume is that between the planes, wherever the mesh ends.
    straight = measure(cut(volume, 0, "width"))
    assert maps.summary["volume"] == pytest.approx(straight.summary["volume"], rel=0.01)


def with_uncus(whole, bridge=0.0):
    """Add a piece of CA2/3 medially of the body at its front, with CA1 towards the body (mm)."""
    points = to_ras(np.moveaxis(np.indices(whole.tissue.shape), 0, -1), whole.affine)
    front = PHANTOM.body.place(0.5, 0.8, 0.0)
    medial = PHANTOM.body.place(0.0, 0.8, 0.0)
    away = (medial - front) / np.linalg.norm(medial - front)
    center = medial + 3.5 * away
    axis = PHANTOM.body.place(0.5, 0.8, 0.0) - PHANTOM.body.place(0.5, 0.7, 0.0)
    axis /= np.linalg.norm(axis)
    along = (points - center) @ axis
    aside = np.linalg.norm(points - center - along[..., None] * axis, axis=-1)
    free = (np.abs(along) < 1.8) & (whole.tissue == 0)
    piece = free & (aside < 1.5)
    inward = (center - points) @ away
    off = np.linalg.norm(
        points - center - along[..., None] * axis + inward[..., None] * away, axis=-1
    )
    joined = free & ~piece & (off < 1.0) & (inward > 0) & (inward < bridge)
    tissue = np.where(piece, np.uint8(Tissue.CA2_3), whole.tissue)
    tissue = np.where(joined, np.uint8(Tissue.CA1), tissue)
    both = piece | joined
    part = np.where(both & (along > 0), Part.HEAD, np.where(both, Part.BODY, whole.part))
    return replace(whole, tissue=tissue, part=part)


def test_an_uncus_is_left_out_and_named(volume):
    whole = cut(volume, 0, "width")
    maps, plain = measure(with_uncus(whole)), measure(whole)
    assert maps.status == Status.REPAIRED
    (repair,) = maps.repairs
    assert repair.startswith("left out the uncus")
    assert np.abs(maps.thickness - plain.thickness).max() < 0.1
    assert maps.qc["changed_fraction"] == 0


def test_what_goes_with_an_uncus_does_not_depend_on_the_order_of_voxels(volume):
    attached = with_uncus(cut(volume, 0, "width"), bridge=3.5)
    detached = extract_body(with_uncus(cut(volume, 0, "width")), BodySettings()).uncus
    found = []
    for flips in ((), (0,), (1,), (2,), (0, 1, 2)):
        affine = attached.affine.copy()
        for axis in flips:
            affine[:3, 3] += affine[:3, axis] * (attached.tissue.shape[axis] - 1)
            affine[:3, axis] *= -1
        tissue, part = (np.flip(values, flips) for values in (attached.tissue, attached.part))
        body = extract_body(
            replace(attached, tissue=tissue, part=part, affine=affine), BodySettings()
        )
        points = to_ras(body.uncus, affine).round(3)
        found.append({tuple(point) for point in points.tolist()})
    assert len(found[0]) > len(detached) + 30  # some of the CA1, too
    assert all(one == found[0] for one in found)
