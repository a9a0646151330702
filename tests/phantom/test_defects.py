"""Defects change what they say, where they say, and nothing else."""

import numpy as np
import pytest
from measured_phantoms import LENGTH, measured, spiral

from hipsta_bids.errors import SettingsError
from hipsta_bids.protocols.protocol import Part, Tissue
from validation.damage import DEFECTS, Site, make_defect

#: One size at which every kind changes something.
SIZES = {"salt": 0.05, "wrong-voxels": 2.0, "cut-short": 6.0, "at-border": 1.0, "waist": 0.5}


@pytest.fixture(scope="module")
def case():
    return measured(spiral())


@pytest.fixture(scope="module")
def site(case):
    return Site(case.volume, case.maps.sheet)


def changed(site, defect):
    return (defect.volume.tissue != site.volume.tissue) | (defect.volume.part != site.volume.part)


@pytest.mark.parametrize("kind", [kind for kind in DEFECTS if kind != "stratum"])
def test_every_kind_changes_the_labels_and_tells_where(site, kind):
    before = site.volume.tissue.copy()
    defect = make_defect(site, kind, SIZES.get(kind, 0.8))
    assert defect.changed.shape[1] == 3
    assert len(defect.changed)
    np.testing.assert_array_equal(site.volume.tissue, before)
    if defect.volume.tissue.shape == before.shape and kind not in ("salt", "wrong-voxels"):
        where = changed(site, defect)
        np.testing.assert_array_equal(defect.changed, site.points[where])


def test_a_stratum_needs_labels_of_the_molecular_layer(site):
    with pytest.raises(SettingsError, match="changes no voxel"):
        make_defect(site, "stratum", 6.0)


def test_places_agree_with_the_phantoms_own_coordinates(case, site):
    for place in ((0.2, 0.3), (0.5, 0.5), (0.8, 0.7)):
        u, v, n = case.phantom.body.locate(site.column(place)[len(site.column(place)) // 2][None])[
            0
        ]
        # The sheet's grid leaves out 5 % of the width, rims are uncertain by half a thickness.
        assert u == pytest.approx(place[0], abs=0.06)
        assert v == pytest.approx(place[1], abs=0.03)
        assert abs(n) < 0.2  # mm, half a voxel
    assert site.length == pytest.approx(LENGTH, abs=0.2)  # mm, half a voxel


def test_a_hole_is_round_and_goes_through(case, site):
    defect = make_defect(site, "hole", 1.0)
    assert (defect.volume.tissue[changed(site, defect)] == Tissue.BACKGROUND).all()
    middle = site.column((0.5, 0.5)).mean(axis=0)
    off = defect.changed - middle
    off -= np.outer(off @ site.normal((0.5, 0.5)), site.normal((0.5, 0.5)))
    assert np.linalg.norm(off, axis=1).max() < 1.1  # mm, a bent line through the wall
    n = case.phantom.body.locate(defect.changed)[:, 2]
    assert n.min() < -0.7  # mm, both walls are at 1 mm
    assert n.max() > 0.7


def test_bridges_join_what_they_say(case, site):
    defect = make_defect(site, "bridge-ca3-subiculum", 0.5)
    assert not site.wall[changed(site, defect)].any()
    off = case.phantom.body.locate(defect.changed, reach=6.0)
    near = off[np.abs(off[:, 2]) < 1.5]
    assert np.nanmin(near[:, 0]) < 0.3
    assert np.nanmax(near[:, 0]) > 0.8


def test_a_gap_goes_from_end_to_end_and_beyond(site):
    defect = make_defect(site, "gap", 0.8)
    along = (defect.changed - site.column((0.5, 0.0)).mean(axis=0)) @ site.axis / site.length
    # The tail has no subfields in this protocol, so the gap begins with the body.
    assert along.min() < 0.05
    assert along.max() > 1


def test_a_subfield_is_erased_as_a_whole(site):
    defect = make_defect(site, "missing-subfield", 200.0, (0.5, 0.5))
    assert not (defect.volume.tissue == Tissue.CA1).any()
    assert (defect.volume.tissue == Tissue.SUBICULUM).any()


def test_a_subfield_is_erased_over_a_part_of_the_axis(site):
    defect = make_defect(site, "missing-subfield", 4.0, (0.5, 0.5))
    along = (site.v[changed(site, defect)] - 0.5) * site.length
    assert np.abs(along).max() <= 2.0
    assert set(np.unique(site.volume.tissue[changed(site, defect)])) == {Tissue.CA1}


def test_parts_inside_the_body(site):
    for kind, part in (("tail-inside", Part.TAIL), ("head-inside", Part.HEAD)):
        defect = make_defect(site, kind, 1.0)
        assert (defect.volume.part[changed(site, defect)] == part).all()


def test_voxels_are_stretched_across_the_long_axis(site):
    defect = make_defect(site, "wrong-voxels", 4.0)
    ratio = np.linalg.norm(defect.volume.affine[:3, :3], axis=0) / 0.4
    np.testing.assert_allclose(np.sort(ratio), [1, 1, 4], rtol=1e-9)
    assert ratio[1] == pytest.approx(1.0)  # the phantom's long axis lies near the second axis


def test_what_changes_nothing_is_an_error(site):
    with pytest.raises(SettingsError, match="changes no voxel: make it larger"):
        make_defect(site, "waist", 0.05)
    with pytest.raises(SettingsError, match="'tear' is unknown; choose one of hole, cavity"):
        make_defect(site, "tear", 1.0)
