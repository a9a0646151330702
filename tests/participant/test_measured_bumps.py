"""A ball of tissue on a wall: it makes the map wrong there, and is flagged there."""

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
