"""Registration of sheets in memory, as the group level does it."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import hipsta_bids as hb
from hipsta_bids.errors import ModelError
from hipsta_bids.group.questions.aligning import register_side
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import SideMaps

NX, NY, COUNT = 41, 5, 12


def bumps(shifts):
    """Maps (sheets, x, y) with a bump that lies elsewhere in each, and its shape."""
    x = np.linspace(0, 1, NX)
    profile = np.exp(-(((x - 0.5 - np.asarray(shifts)[:, None]) / 0.12) ** 2)) + 0.3 * x
    return np.repeat(profile[:, :, None], NY, axis=2)


@pytest.fixture(scope="module")
def shifts():
    return np.random.default_rng(0).uniform(-0.08, 0.08, COUNT)


@pytest.fixture(scope="module")
def labeled(shifts):
    """Two sides; the second moves the other way and lacks a participant; subfields end at .5."""
    curvature = np.stack([bumps(shifts), bumps(-shifts)], axis=1)
    curvature[3, 1] = np.nan
    edges = np.stack([shifts, -shifts], axis=1)[:, :, None, None] + 0.5
    x = np.linspace(0, 1, NX)[:, None]
    names = np.where(x + np.zeros(NY) < edges, "Sub", "CA1")
    axes = ("participant", "side", "x", "y")
    position = np.stack([curvature, 2 * curvature, -curvature], axis=-1)
    return xr.Dataset(
        {
            "thickness": (axes, 2 + curvature, {"units": "mm"}),
            "curvature": (axes, curvature),
            "subfield": (axes, names.astype(object)),
            "position": ((*axes, "ras"), position),
            "decision": (axes[:2], np.full((COUNT, 2), "use")),
        },
        coords={"participant": [f"sub-{i:02d}" for i in range(COUNT)], "side": ["L", "R"]},
    )


def spread(values):
    return float(np.nanmean(np.nanvar(values, axis=0)))


def test_maps_are_those_of_the_group_level(labeled):
    found = hb.register(labeled)
    for side in "LR":
        own = labeled.sel(side=side)
        keep = np.isfinite(own.curvature).any(["x", "y"]).to_numpy()
        maps = {name: own[name].to_numpy()[keep] for name in ("thickness", "curvature")}
        sheets = SideMaps(
            rows=np.arange(keep.sum()), maps=maps, names=(), summary=pd.DataFrame(),
            subfield=np.full(maps["curvature"].shape, -1, dtype=np.int8),
        )  # fmt: skip
        cohort = SimpleNamespace(sides={side: sheets}, y=np.linspace(-1, 1, NY), shared=False)
        result, registered = register_side(
            cohort, side, groups=None, settings=GroupSettings(), templates=None
        )
        carried = found.thickness.sel(side=side).to_numpy()
        np.testing.assert_array_equal(carried[keep], registered.maps["thickness"])
        np.testing.assert_array_equal(found["shift"].sel(side=side)[keep], result.shifts)
        assert np.isnan(carried[~keep]).all()
        assert found.explained_after.sel(side=side).item() == result.explained_after


def test_bumps_and_subfields_come_to_lie_alike(labeled, shifts):
    found = hb.register(labeled)
    for side in "LR":
        before, after = (data.thickness.sel(side=side).to_numpy() for data in (labeled, found))
        assert spread(after) < 0.1 * spread(before)
        borders = (found.subfield.sel(side=side) == "Sub").sum("x").isel(y=0).to_numpy()
        assert np.ptp(np.delete(borders, 3)) <= 2  # of 41 nodes; 6 before
    # A bump that lies lateral moves to medial.
    move = found["shift"].sel(side="L").isel(x=NX // 2)
    assert np.corrcoef(move, shifts)[0, 1] < -0.99
    np.testing.assert_allclose(found.position.isel(ras=1), 2 * found.curvature, atol=1e-12)


def test_axes_units_and_other_variables_stay(labeled):
    found = hb.register(labeled)
    assert found.thickness.dims == labeled.thickness.dims
    assert found.thickness.attrs == {"units": "mm"}
    assert found["shift"].attrs["units"] == "nodes"
    assert (found.decision == "use").all()
    assert "shift" not in labeled
    np.testing.assert_array_equal(labeled.thickness, 2 + labeled.curvature)


def test_arrays_and_sessions_are_taken(labeled, shifts):
    array = hb.register({"curvature": bumps(shifts), "area": 1 + bumps(shifts)})
    side = hb.register(labeled.sel(side="L", drop=True))
    np.testing.assert_array_equal(array.curvature, side.curvature)
    np.testing.assert_allclose(array.area, 1 + array.curvature, atol=1e-12)
    # Visits are sheets of one template.
    halves = [labeled.sel(side="L").isel(participant=part) for part in (slice(6), slice(6, 12))]
    names = [f"sub-{i}" for i in range(6)]
    visits = xr.concat(
        [half.assign_coords(participant=names) for half in halves], dim="session", join="exact"
    )
    found = hb.register(visits.transpose("participant", "session", ...))
    assert found["shift"].dims == ("participant", "session", "x")
    np.testing.assert_allclose(
        found.explained_before.item(), side.explained_before.item(), rtol=1e-12
    )


def test_what_cannot_be_registered_is_refused(labeled):
    with pytest.raises(ValueError, match="needs curvature with the axes participant, x and y"):
        hb.register(labeled[["thickness"]])
    with pytest.raises(ModelError, match=r"4 profiles are too few.*min_subjects"):
        hb.register(labeled.isel(participant=slice(4)))
