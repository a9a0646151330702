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
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import Decision
from validation.damage import Site, make_defect
from validation.ends import cut_obliquely

PHANTOM = Phantom(PhantomSpec(kind="arc", thickness=2.0, length=18.0, end_length=4.0))


@pytest.fixture(scope="module")
def volume():
    return PHANTOM.label_volume(load_protocol("freesurfer"))


def cut(volume, degrees, about):
    """Labels whose head and tail begin at planes that are tilted about a direction of the sheet."""
    return cut_obliquely(PHANTOM, volume, degrees, about)


def measure(volume):
    return measure_hemisphere(volume, "L", Settings(), lambda _stage: nullcontext())


@pytest.mark.parametrize(("degrees", "about"), [(35, "width"), (35, "thickness")])
def test_rows_at_oblique_planes_are_as_thick_as_others(volume, degrees, about):
    """The last rows read up to .28 mm too thick where the mesh ended at the planes."""
    maps = measure(cut(volume, degrees, about))
    assert maps.decision == Decision.USE
    error = maps.thickness.mean(axis=0) - 2.0
    assert np.abs(error[[0, 1, -2, -1]]).max() < 0.08
    assert np.abs(error).mean() < 0.04
    assert np.abs(maps.thickness - 2.0).max() < 0.25


def test_rows_begin_and_end_at_the_planes(volume, plain):
    tilted = cut(volume, 25, "thickness")
    maps = measure(tilted)
    for row, end in ((0, "posterior"), (-1, "anterior")):
        plane = maps.qc[f"{end}_plane"]
        middle = maps.sheet.points[:, row, maps.sheet.middle]
        height = (middle - plane["point_ras_mm"]) @ np.array(plane["normal_ras"])
        assert np.abs(height).max() < 0.15
    # The volume is that between the planes, wherever the mesh ends.
    assert maps.summary["volume"] == pytest.approx(plain.summary["volume"], rel=0.01)


@pytest.fixture(scope="module")
def plain(volume):
    """Maps between straight end planes."""
    return measure(cut(volume, 0, "width"))


def with_uncus(whole, plain, kind="uncus"):
    """Add a piece of CA2/3 medially of the body at its front."""
    return make_defect(Site(whole, plain.sheet), kind, 1.8).volume


def test_an_uncus_is_left_out_and_named(volume, plain):
    maps = measure(with_uncus(cut(volume, 0, "width"), plain))
    assert maps.decision == Decision.USE
    (repair,) = maps.repairs
    assert repair.startswith("the uncus was excluded")
    assert np.abs(maps.thickness - plain.thickness).max() < 0.1
    assert maps.qc["changed_fraction"] == 0


def test_what_goes_with_an_uncus_does_not_depend_on_the_order_of_voxels(volume, plain):
    whole = cut(volume, 0, "width")
    attached = with_uncus(whole, plain, "attached-uncus")
    detached = extract_body(with_uncus(whole, plain), BodySettings()).uncus
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
