"""Slits through the sheet are filled; crevices between folds are not."""

import numpy as np
import pytest
from geometry_cases import resampled, solid_of

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.completion import fill_pits, fill_slits
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings, TopologySettings
from validation.damage import Site, make_defect

BODY = BodySettings()
VOXEL = 0.4
AFFINE = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
SHAPE = (30, 16, 40)


def plate(two=False):
    """Tissue of a plate of five voxels, CA1 and CA2/3, or of two with one voxel between."""
    tissue = np.zeros(SHAPE, dtype=np.uint8)
    layers = [slice(2, 7), slice(8, 13)] if two else [slice(4, 9)]
    for layer in layers:
        tissue[2:28, layer, 2:38] = Tissue.CA1
        tissue[15:28, layer, 2:38] = Tissue.CA2_3
    return tissue


def slits(tissue, settings=BODY, unlabeled=None):
    empty = tissue == 0 if unlabeled is None else unlabeled
    return fill_slits(tissue, tissue > 0, empty, AFFINE, settings)


def with_slit(length=12, *, depth=16):
    """A slit, one voxel wide, through the plate, or as deep as said from one side of it."""
    tissue = plate()
    tissue[15, :depth, 14 : 14 + length] = 0
    return tissue


def test_a_sound_plate_is_left_alone():
    found = slits(plate())
    assert len(found.filled) == len(found.gap) == 0
    np.testing.assert_array_equal(found.tissue, plate())


def test_a_slit_is_filled_with_the_labels_beside_it():
    found = slits(with_slit())
    assert len(found.filled) == 12 * 5
    np.testing.assert_array_equal(found.tissue > 0, plate() > 0)
    assert set(np.unique(found.tissue[15, 4:9, 14:26])) <= {Tissue.CA1, Tissue.CA2_3}
    assert len(found.gap) == 0


def test_a_crevice_from_one_side_stays_and_is_reported():
    """As between two folds: it is open on one side only."""
    tissue = with_slit(depth=8)  # four of five voxels deep
    found = slits(tissue)
    assert len(found.filled) == 0
    np.testing.assert_array_equal(found.tissue, tissue)
    assert len(found.gap) == 12 * 4


def test_two_sheets_side_by_side_stay_apart():
    tissue = plate(two=True)
    found = slits(tissue)
    np.testing.assert_array_equal(found.tissue, tissue)


def test_a_small_slit_is_left_to_the_smoothing():
    area = 4 * 5 * VOXEL**2
    assert area > BODY.slit_area
    assert len(slits(with_slit(4)).filled) == 4 * 5
    assert len(slits(with_slit(4), BodySettings(slit_area=area + 0.1)).filled) == 0


def test_between_thick_slices_nothing_is_filled():
    tissue = with_slit()
    affine = np.diag([VOXEL, VOXEL, 1.5, 1.0])
    found = fill_slits(tissue, tissue > 0, tissue == 0, affine, BODY)
    assert len(found.filled) == 0
    assert len(found.gap) == 12 * 5


def test_a_sheet_that_moves_from_thick_slice_to_thick_slice_has_no_gap():
    """What lies beside it has the sheet on both sides in the slices before and behind only."""
    tissue = np.zeros(SHAPE, dtype=np.uint8)
    for number in range(2, 38):
        first = 4 if number % 2 else 8
        tissue[2:28, first : first + 4, number] = Tissue.CA1
    fine, thick = (
        fill_slits(tissue, tissue > 0, tissue == 0, np.diag([VOXEL, VOXEL, step, 1.0]), BODY)
        for step in (VOXEL, 2.0)
    )
    assert len(fine.gap) + len(fine.filled) > 1000
    assert len(thick.gap) == len(thick.filled) == 0


def test_slits_with_another_label_are_none():
    """Such as the fissure: it says that nothing of the sheet is missing there."""
    tissue = with_slit()
    labeled = tissue == 0
    labeled[15, 4:9, 14:26] = False
    found = slits(tissue, unlabeled=labeled)
    assert len(found.filled) == len(found.gap) == 0


@pytest.mark.parametrize("place", [(0.5, 0.5), (0.15, 0.5)])
def test_a_slit_in_a_phantom_is_filled(arc, place):
    damaged = make_defect(Site(arc.volume, arc.sheet), "slit", VOXEL, place).volume
    body = extract_body(damaged, BODY)
    lost = arc.body.inside & (damaged.tissue == Tissue.BACKGROUND)
    assert np.count_nonzero(lost) > 30
    # All but voxels at the slit's openings, which do not lie between two others.
    assert np.count_nonzero(lost & ~body.inside) <= 0.25 * np.count_nonzero(lost)
    # The labels may move the end planes by a hair; elsewhere nothing is added.
    added = body.inside & ~arc.body.inside
    assert np.count_nonzero(added) <= 0.001 * np.count_nonzero(body.inside)
    solid = solid_of(resampled(body), TopologySettings())
    # Where the slit meets the dentate gyrus, it is a cavity.
    assert {"slit"} <= {repair.kind for repair in solid.repairs} <= {"slit", "cavity"}
    assert solid.changed_fraction > 0
    assert solid.touched.any()


def pits(tissue, settings=BODY, affine=AFFINE):
    return fill_pits(tissue, tissue > 0, tissue == 0, affine, settings)


def with_pit(width=2, depth=2, length=2):
    """A pit of some voxels in one face of the plate."""
    tissue = plate()
    tissue[8 : 8 + width, 4 : 4 + depth, 20 : 20 + length] = 0
    return tissue


def test_a_pit_in_a_wall_is_filled_with_the_labels_beside_it():
    filled, where = pits(with_pit())
    assert len(where) == 8
    np.testing.assert_array_equal(filled, plate())


@pytest.mark.parametrize(
    "tissue",
    [
        plate(),
        with_pit(1, 1, 3),  # roughness of the labels
        with_pit(2, 5, 2),  # a hole through the plate
        with_pit(2, 2, 18),  # a furrow: open along it
        with_pit(9, 3, 9),  # a dent
    ],
)
def test_what_is_no_pit_stays(tissue):
    filled, where = pits(tissue)
    assert len(where) == 0
    assert filled is tissue


def test_pits_are_not_sought_between_thick_slices():
    thick = np.diag([0.4, 0.4, 2.0, 1.0])
    assert len(pits(with_pit(), affine=thick)[1]) == 0


def test_a_mirrored_pit_is_filled_alike():
    tissue = with_pit()
    tissue[14:16, 4:6, 30:32] = 0  # on the border of two subfields
    filled, _ = pits(tissue)
    mirrored, _ = pits(np.ascontiguousarray(tissue[:, :, ::-1]))
    np.testing.assert_array_equal(mirrored[:, :, ::-1], filled)
