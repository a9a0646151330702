"""Changes of a visit that flags should find: what they do to labels, and what the table counts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.types import LabelVolume, Sheet
from validation import visit_flags
from validation.visit_flags import Outcome, hemispheres, lose_edge, shift_end


@pytest.fixture
def plate():
    """A flat ribbon of 40 x 8 x 60 voxels of 0.5 mm: x medial to lateral, z from tail to head."""
    shape = (44, 12, 64)
    tissue = np.zeros(shape, dtype=np.uint8)
    tissue[2:42, 2:10, 2:62] = Tissue.CA1
    part = np.where(tissue > 0, Part.BODY, Part.UNKNOWN).astype(np.uint8)
    part[2:42, 2:10, 2:12], part[2:42, 2:10, 52:62] = Part.TAIL, Part.HEAD
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    protocol = load_protocol("freesurfer")
    return LabelVolume(tissue=tissue, part=part, affine=affine, protocol=protocol)


@pytest.fixture
def sheet():
    """Columns of the plate's body, without its outer tenths along x, as sheets are."""
    axes = np.linspace(3, 19, 17), np.linspace(6, 25.5, 20), np.linspace(1, 4.5, 4)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)[..., [0, 2, 1]]
    return Sheet(points=points, valid=np.ones((17, 20), dtype=bool))


@pytest.mark.parametrize(("size", "layers"), [(0.5, 1), (1.2, 2), (2.0, 4)])
def test_an_end_moves_by_whole_voxels_within_its_distance(plate, size, layers):
    for part, before, after in (
        (Part.HEAD, slice(52 - layers, 52), slice(12, 52 - layers)),
        (Part.TAIL, slice(12, 12 + layers), slice(12 + layers, 52)),
    ):
        moved = shift_end(plate, part, size)
        assert (moved.tissue == plate.tissue).all()
        assert (moved.part[2:42, 2:10, before] == part).all()
        assert (moved.part[2:42, 2:10, after] == Part.BODY).all()


def test_labels_without_a_head_have_no_end_to_move(plate):
    body = np.where(plate.part == Part.HEAD, Part.BODY, plate.part)
    assert shift_end(replace(plate, part=body), Part.HEAD, 1.0) is None


@pytest.mark.parametrize("lateral", [False, True])
def test_an_edge_loses_its_share_of_the_body_and_nothing_else(plate, sheet, lateral):
    less = lose_edge(plate, sheet, lateral=lateral)
    gone = less.tissue != plate.tissue
    body = plate.part == Part.BODY
    assert gone.sum() == pytest.approx(0.05 * body.sum(), rel=0.03)  # a layer at either end
    assert not (gone & ~body).any()
    assert (less.part[gone] == Part.UNKNOWN).all()
    # Two of forty layers, and none away from the edge.
    places = np.nonzero(gone)[0]
    assert (places >= 38).all() if lateral else (places <= 5).all()


def outcome(change, *flags, refused="", new=()):
    return Outcome(
        change=change,
        refused=refused,
        flags=tuple(map(frozenset, flags)),
        new=frozenset(new),
        distance=np.nan if refused else 0.1,
        overlap=0.9,
        filled=0.0,
        effect=-0.02,
    )


def test_the_table_counts_false_alarms_and_detections():
    sound = [outcome("sound", [], [], []) for _ in range(9)]
    sound.append(outcome("sound", ["visits-differ"], ["noisy-labels"], []))
    wrong = [
        outcome("wrong participant", [], [], ["visit-unlike"], refused="visit-unlike"),
        outcome("wrong participant", ["columns-filled"], [], ["visits-differ", "columns-filled"]),
        outcome("wrong participant", [], [], ["cavities"], new=["cavities"]),
    ]
    first, second = visit_flags._flags({"1 L": [*sound, *wrong]}).rows
    assert first["flagged or refused"] == "0%"
    assert first["visits with a flag, all"] == "1 of 30"
    assert first["met"] is True
    assert [second[name] for name in ("refused", "visits-differ", "columns-filled")] == [1, 1, 1]
    assert second["flagged or refused"] == "67%"
    assert second["with other new flags"] == "100%"
    assert second["visits with a flag, all"] == "3 of 9"
    assert second["reasons of refusals"] == "visit-unlike"
    assert second["change of the mean, mm"] == pytest.approx(0.02)
    assert second["met"] is False
    (row,) = visit_flags._flags({"1 L": [outcome("sound", ["visits-differ"], [], [])]}).rows
    assert row["met"] is False


def test_strangers_and_other_sides_come_from_the_same_program(monkeypatch, tmp_path):
    items = {
        (subject, hemi): SimpleNamespace(subject=subject, hemi=hemi)
        for subject in ("1A", "2A", "3A")
        for hemi in "LR"
    }
    monkeypatch.setattr(
        visit_flags, "revisions", lambda *_: [SimpleNamespace(first=i) for i in items.values()]
    )
    listed = hemispheres(tmp_path / "labels", full=True)
    assert len(listed) == len({h.seed for h in listed}) == 6
    for hemisphere in listed:
        stranger = hemisphere.others["wrong participant"]
        side = hemisphere.others["swapped side"]
        assert stranger.hemi == hemisphere.source.hemi
        assert stranger.subject != hemisphere.source.subject
        assert side.hemi != hemisphere.source.hemi
        assert side.subject == hemisphere.source.subject
