"""Flags, each with a case that must raise it, and the numbers behind them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.geometry.sheet import sample_sheet, whole_body
from hipsta_bids.geometry.topology import Repair
from hipsta_bids.participant.evidence import Evidence, find_all
from hipsta_bids.participant.measure import quality_metrics
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import Sheet


@pytest.fixture
def evidence(arc):
    """Nothing to warn about."""
    body, middle = arc.body, arc.sheet.points[:, :, arc.sheet.middle]
    nearest = body.nearest(middle.reshape(-1, 3)).reshape(arc.sheet.valid.shape)
    return Evidence(
        body=body,
        surface=arc.surface,
        mesh=arc.mesh,
        sheet=arc.sheet,
        subfield=body.tissue[body.inside][nearest],
        whole=sample_sheet(arc.mesh, arc.coordinates, whole_body(Settings().sheet)),
        settings=Settings(),
        coordinates=arc.coordinates,
        image=(),
        side=5.0,
        solid=arc.solid,
        voxels_across=5.0,
        smoothed=0,
        boundaries=arc.boundaries,
        label_order=0.95,
        bending=2.4,
        folded=0.0,
        rivals={},
    )


def findings(evidence):
    return find_all(evidence)


def reasons(evidence):
    return [found.reason for found in findings(evidence) if found.raised]


def test_a_sound_hemisphere_has_no_flags(evidence):
    assert reasons(evidence) == []


@pytest.mark.parametrize(
    "absent", [(Tissue.PRESUBICULUM, Tissue.SUBICULUM), (Tissue.CA1,), (Tissue.CA2_3,)]
)
def test_a_missing_end_of_the_ribbon_is_flagged(evidence, absent):
    body = evidence.body
    inside = body.inside & ~np.isin(body.tissue, absent)
    found = reasons(replace(evidence, body=replace(body, inside=inside)))
    # Without CA1 the rest is two pieces, too.
    assert found == ["subfield-missing"] + ["loose-part"] * (absent == (Tissue.CA1,))


def repair(excess):
    return Repair(
        kind="cut",
        voxels=30,
        cost=12.0,
        position=(1.0, 2.0, 3.0),
        excess=excess,
        points=np.array([[1.0, 2.0, 3.0]]),
    )


def test_large_repairs_are_flagged_one_by_one(evidence):
    repairs = (repair(1.5), repair(0.7), repair(np.inf))
    found = findings(replace(evidence, solid=replace(evidence.solid, repairs=repairs)))
    large = [finding for finding in found if finding.reason == "large-repair"]
    assert [finding.margin for finding in large] == [1.5, 0.7, np.inf]
    assert [finding.raised for finding in large] == [True, False, True]
    assert "a bridge of 30 grid nodes was cut at RAS 1.0 2.0 3.0 mm" in large[0].text


@pytest.mark.parametrize(("fraction", "wanted"), [(0.06, ["much-repaired"]), (0.04, [])])
def test_much_repaired(evidence, fraction, wanted):
    solid = replace(evidence.solid, changed_fraction=fraction)
    assert reasons(replace(evidence, solid=solid)) == wanted


@pytest.mark.parametrize(("tilt", "wanted"), [(0, []), (1, ["boundary-doubtful"])])
def test_a_boundary_of_another_operator_is_flagged(evidence, tilt, wanted):
    boundaries = replace(evidence.boundaries, tilt=tilt)
    assert reasons(replace(evidence, boundaries=boundaries)) == wanted


@pytest.mark.parametrize(("step", "wanted"), [(0.11, []), (0.13, ["second-choice"])])
def test_a_second_choice_that_moves_the_map_is_flagged(evidence, step, wanted):
    rivals = {"repair": evidence.thickness + step}
    assert reasons(replace(evidence, rivals=rivals)) == wanted


@pytest.mark.parametrize(
    ("rule", "bending", "wanted"),
    [
        ("labels", -0.6, ["side-doubtful"]),
        ("labels", -0.4, []),  # nearly flat: the bend says nothing
        ("bending", -0.6, []),  # it is the bend that decided
    ],
)
def test_side_doubtful(evidence, rule, bending, wanted):
    boundaries = replace(evidence.boundaries, side_rule=rule)
    assert reasons(replace(evidence, boundaries=boundaries, bending=bending)) == wanted


@pytest.mark.parametrize(("folded", "wanted"), [(0.06, ["folded"]), (0.04, [])])
def test_folded(evidence, folded, wanted):
    assert reasons(replace(evidence, folded=folded)) == wanted


@pytest.mark.parametrize(("columns", "wanted"), [(25, ["columns-filled"]), (10, [])])
def test_columns_filled(evidence, columns, wanted):
    sheet = evidence.sheet
    valid = np.ones(sheet.valid.shape, dtype=bool)
    valid.reshape(-1)[:columns] = False  # of 861, 2 % are 17
    sheet = Sheet(points=sheet.points, valid=valid)
    assert reasons(replace(evidence, sheet=sheet)) == wanted


def test_metrics_are_json_and_complete(evidence):
    metrics = quality_metrics(evidence)
    again = json.loads(json.dumps(metrics))
    assert again["body_voxels"] == np.count_nonzero(evidence.body.inside)
    assert again["voxel_size_mm"] == [0.4, 0.4, 0.4]
    assert again["body_length_mm"] == pytest.approx(8.0, abs=0.2)  # half a voxel
    assert again["posterior_end_rule"] == again["anterior_end_rule"] == "labels"
    assert again["euler_before"] == again["euler_after"] == 1
    assert again["surface_vertices"] == len(evidence.surface.vertices)
    assert again["tetrahedra"] == len(evidence.mesh.tetrahedra)
    assert 0 < again["tetra_quality_p01"] < again["tetra_quality_median"] <= 1
    assert again["filled_columns"] == 0
    assert again["repaired_fraction"] == evidence.repaired.mean()
    assert "mask_change" not in again  # no mask was edited
    assert again["thickness_expected_mm"] == pytest.approx(2.0, rel=0.05)  # rims
    assert np.linalg.norm(again["posterior_plane"]["normal_ras"]) == pytest.approx(1, abs=1e-3)
    for plane in (evidence.body.ends.posterior, evidence.body.ends.anterior):
        # As the planes found without labels, whose point may lie anywhere on them.
        far = plane._replace(point=plane.point + 30 * np.linalg.svd(plane.normal[None])[2][1])
        inside = evidence.body.inside_points()[1]
        place = np.array(far.entry(inside)["point_ras_mm"])
        assert abs((place - plane.point) @ plane.normal) < 0.01
        assert np.linalg.norm(inside - place, axis=1).min() < 1
