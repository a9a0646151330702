"""Phantoms whose medial end is labeled as neighboring cortex."""

import numpy as np
import pytest

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.phantom.labels import CORTEX, subfield_at
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue

SPEC = PhantomSpec(kind="s-shape", width=30.0, curvature=(-0.15, 0.3), cortex=10.0, length=8.0)
PMC = load_protocol("ashsPMC")


def test_cortex_takes_its_share_of_the_mid_curve():
    u, v = np.array([0.0, 0.13, 0.14, 0.33, 0.34, 0.99])[:, None], np.array([0.2, 0.8])
    far, near = Tissue.BA35, (Tissue.PARAHIPPOCAMPAL, Tissue.ENTORHINAL)
    # A third is cortex, of which BA35 has two fifths: up to 0.133.
    assert Phantom(SPEC).truth(u, v).subfield.tolist() == [
        [far, far],
        [far, far],
        [*near],
        [*near],
        [Tissue.PRESUBICULUM] * 2,
        [Tissue.CA3] * 2,
    ]


def test_subfields_keep_their_proportions():
    place = np.linspace(0.0, 1.0, 50)
    truth = Phantom(SPEC).truth(1 / 3 + place * 2 / 3 + 1e-9, 0.5)
    assert (truth.subfield == subfield_at(place)).all()


def test_the_shape_does_not_depend_on_the_labels():
    plain = PhantomSpec(kind="s-shape", width=30.0, curvature=(-0.15, 0.3), length=8.0)
    volume, other = (Phantom(spec).label_volume(PMC) for spec in (SPEC, plain))
    wall = np.isin(volume.tissue, (*PMC.sheet, *CORTEX))
    differs = np.argwhere(wall != np.isin(other.tissue, PMC.sheet))
    v = Phantom(plain).body.locate(differs @ volume.affine[:3, :3].T + volume.affine[:3, 3])[:, 1]
    # Beyond the body, CA2 and CA3 end where the protocol has no labels for head and tail.
    assert ((v < 0) | (v > 1)).all()
    assert not np.isin(other.tissue, CORTEX).any()


def test_volumes_of_the_regions():
    phantom = Phantom(SPEC)
    parts = [phantom.region_summary(region) for region in ("entorhinal", "body", "extended")]
    for column in ("volume", "extent_x", "area_interior", "area_mid", "area_exterior"):
        first, second, both = (part[column] for part in parts)
        assert first + second == pytest.approx(both, rel=1e-9)  # as exact as the quadrature
    assert [part["extent_x"] for part in parts] == pytest.approx([10.0, 20.0, 30.0])
    volume = phantom.label_volume(PMC, supersample=2)
    inside = volume.tissue > 0
    voxels = np.argwhere(inside) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    v = phantom.body.locate(voxels)[:, 1]
    between = (v >= 0) & (v <= 1)
    counted = np.isin(volume.tissue[inside][between], CORTEX).sum() * 0.4**3
    # One layer of 0.4 mm voxels more or less in a length of 8 mm.
    assert counted == pytest.approx(parts[0]["volume"], rel=0.05)


def test_cortex_goes_on_beside_head_and_tail_as_cortex():
    volume = Phantom(SPEC).label_volume(load_protocol("ashsABC3T"))
    cortex = np.isin(volume.tissue, CORTEX)
    assert (volume.part[cortex] == Part.UNKNOWN).all()
    points = np.argwhere(cortex) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    v = Phantom(SPEC).body.locate(points)[:, 1]
    # Ends of 4 mm beside a body of 8 mm.
    assert v.min() < -0.4
    assert v.max() > 1.4


def test_a_protocol_draws_the_cortex_that_it_has():
    kinds = [
        set(np.unique(Phantom(SPEC).label_volume(load_protocol(name)).tissue)) & set(Tissue)
        for name in ("ashsUtrecht7T", "freesurfer")
    ]
    assert kinds[0] & set(CORTEX) == {Tissue.ENTORHINAL}
    assert not kinds[1] & set(CORTEX)


def test_shifted_patterns_shift_the_border():
    moved = Phantom(PhantomSpec(cortex=5.0, width=20.0, offset=0.1))
    assert moved.region_summary("entorhinal")["extent_x"] == pytest.approx(7.0)
    subfield = moved.truth(np.array([0.34, 0.36]), 0.5).subfield
    assert subfield.tolist() == [Tissue.ENTORHINAL, Tissue.PRESUBICULUM]


def test_the_hippocampus_keeps_a_fifth():
    with pytest.raises(SettingsError, match="less than a fifth"):
        PhantomSpec(width=20.0, cortex=17.0)
