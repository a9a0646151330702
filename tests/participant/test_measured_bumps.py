"""Damage of known size that makes a map wrong is flagged where it is."""

import re
from contextlib import nullcontext

import numpy as np
import pytest

from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision
from validation.damage import Site, make_defect

PHANTOM = Phantom(PhantomSpec(kind="arc", thickness=1.8, length=16.0, variation=0.2))


def measure(volume):
    return measure_hemisphere(volume, "L", Settings(), lambda _stage: nullcontext())


@pytest.fixture(scope="module")
def volume():
    return PHANTOM.label_volume(load_protocol("freesurfer"))


@pytest.fixture(scope="module")
def plain(volume):
    return measure(volume)


@pytest.mark.parametrize(("radius", "v"), [(0.8, 0.5), (1.6, 0.02), (1.6, 0.98)])
def test_a_ball_on_a_wall_is_flagged_where_the_map_is_wrong(volume, plain, radius, v):
    assert plain.decision == Decision.USE
    site = Site(volume, plain.sheet)
    maps = measure(make_defect(site, "leak", radius, (0.5, v)).volume)
    change = maps.thickness - plain.thickness
    assert change.max() > 0.5  # mm: the map is wrong
    (flag,) = maps.flags
    assert flag.reason == "wall-bump"
    assert "exterior wall" in flag.message
    center = site.beside((0.5, v), 0.6 * radius)
    assert np.linalg.norm(flag.points - center, axis=1).min() < radius + 0.4  # mm, a voxel
    assert np.linalg.norm(flag.points.mean(axis=0) - center) < radius + 0.8


@pytest.mark.parametrize(
    ("injury", "reason", "text"),
    [
        (("half-subfield", 0.4, (1.0, 1.0)), "subfield-gap", "CA2_3 over .* the anterior end"),
        (("half-subfield", 0.4, (0.0, 0.0)), "subfield-gap", "SUBICULUM over .* the posterior end"),
        (("thin-edge", 0.6, (0.0, 0.5)), "edge-thin", "the medial edge .* is 1.3 voxels thick"),
        (
            ("thin-edge", 0.4, (0.0, 0.5)),
            "edge-lost",
            "SUBICULUM lie .* beyond the medial edge",
        ),
        (
            ("thin-edge", 0.4, (1.0, 0.5)),
            "edge-lost",
            "CA2_3 lie .* beyond the lateral edge",
        ),
    ],
)
def test_a_sheet_that_ends_early_is_flagged(volume, plain, injury, reason, text):
    """The columns slide by millimeters, and the map looks plausible."""
    maps = measure(make_defect(Site(volume, plain.sheet), *injury).volume)
    shift = np.linalg.norm(
        (maps.sheet.points - plain.sheet.points)[:, :, maps.sheet.middle], axis=-1
    )
    assert np.quantile(shift, 0.95) > 1.0  # mm
    flag = next(flag for flag in maps.flags if flag.reason == reason)
    assert re.search(text, flag.message)
    assert "extent_x" in flag.message
