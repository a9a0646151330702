"""Cortex beside the body: joined, checked for its reach, and its sides distinguished."""

import numpy as np
import pytest
from geometry_cases import plain_body

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body, check_reach, extract_body, join_cortex
from hipsta_bids.geometry.ends import EndPlane, EndPlanes
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import LabelVolume

UP = np.array([0.0, 0.0, 1.0])
ENDS = EndPlanes(
    posterior=EndPlane(np.zeros(3), UP, "labels"),
    anterior=EndPlane(10 * UP, UP, "labels"),
    axis=UP,
    half_slice=0.5,
)
SUB, CA1, ERC = Tissue.SUBICULUM, Tissue.CA1, Tissue.ENTORHINAL


def line(*tissues):
    return np.array(tissues, dtype=np.uint8).reshape(-1, 1, 1)


def volume(*tissues, protocol="ashsPMC"):
    tissue = line(*tissues)
    return LabelVolume(
        tissue=tissue,
        part=np.zeros_like(tissue),
        affine=np.eye(4),
        protocol=load_protocol(protocol),
    )


def test_cortex_is_joined_or_taken_alone():
    labels = volume(ERC, ERC, 0, SUB, CA1, Tissue.BA36, Tissue.DENTATE_GYRUS)
    hippocampal = line(0, 0, SUB, SUB, CA1, 0, 0)  # one voxel came from the molecular layer
    joined = join_cortex(labels, hippocampal, "extended")
    assert joined.ravel().tolist() == [ERC, ERC, SUB, SUB, CA1, 0, 0]
    alone = join_cortex(labels, hippocampal, "entorhinal")
    assert alone.ravel().tolist() == [ERC, ERC, 0, 0, 0, 0, 0]


def test_missing_cortex_is_named():
    with pytest.raises(GeometryError, match="BA35 or ENTORHINAL or PARAHIPPOCAMPAL") as caught:
        join_cortex(volume(SUB, CA1), line(SUB, CA1), "extended")
    assert caught.value.reason == "no-cortex-labels"
    with pytest.raises(GeometryError, match="no voxel is labeled ENTORHINAL;"):
        join_cortex(volume(SUB, CA1, protocol="ashsUtrecht7T"), line(SUB, CA1), "extended")


@pytest.mark.parametrize(("levels", "enough"), [(10, True), (9, True), (8, False), (1, False)])
def test_cortex_has_to_reach_along_nine_tenths(levels, enough):
    """Ten voxels lie between planes 10 mm apart; ``levels`` of them are cortex."""
    points = np.array([[x, 0.0, k + 0.5] for x in (0.0, 1.0) for k in range(10)])
    tissue = np.repeat([ERC, CA1], 10).astype(np.uint8)
    tissue[levels:10] = SUB
    settings = BodySettings(region="extended")
    if enough:
        check_reach(points, tissue, ENDS, settings)
        return
    with pytest.raises(GeometryError, match=rf"{levels:.1f} of 10\.0 mm") as caught:
        check_reach(points, tissue, ENDS, settings)
    assert caught.value.reason == "cortex-incomplete"


def test_lateral_is_near_the_hippocampus_in_cortex_alone():
    tissue = line(ERC, ERC, ERC, 0, 0)
    body = plain_body(tissue, np.eye(4), ENDS)
    alone = Body(
        **{name: getattr(body, name) for name in ("tissue", "interior", "affine", "ends")},
        layer_voxels=0,
        inside=body.inside,
        region="entorhinal",
        hippocampal=line(0, 0, 0, SUB, CA1),
    )
    assert alone.lateral.tolist() == [-3.0, -2.0, -1.0]  # mm from the subiculum
    joined = plain_body(line(Tissue.BA35, ERC, SUB, CA1), np.eye(4), ENDS)
    assert joined.lateral.tolist() == [-2.0, -1.0, SUB, CA1]


def test_regions_are_refused_before_any_end_is_sought():
    with pytest.raises(GeometryError, match="no voxel of the sheet's subfields"):
        extract_body(volume(ERC, ERC), BodySettings(region="entorhinal"))
