"""Visits that share a sheet: one warp per participant, and a note."""

import json

import numpy as np
import pandas as pd
import pytest
from small_cohorts import begin_dataset, place_of, write_hemisphere

from hipsta_bids.errors import InputError
from hipsta_bids.group.cohort.collect import (
    GroupRequest,
    _shared_sheets,
    collect_sheets,
    grid_of,
)
from hipsta_bids.group.cohort.data import Cohort, Grid
from hipsta_bids.group.questions.aligning import register_side
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import SideMaps

NX, NY, PEOPLE, VISITS = 41, 5, 8, 2


@pytest.fixture(scope="module")
def cohort():
    """Return participants with a bump of their own, and visits with noise of the curvature."""
    random = np.random.default_rng(3)
    x = np.linspace(0, 1, NX)
    shifts = np.repeat(random.uniform(-0.08, 0.08, PEOPLE), VISITS)
    profiles = np.exp(-(((x - 0.5 - shifts[:, None]) / 0.12) ** 2)) + 0.3 * x
    noise = random.normal(0, 0.1, (PEOPLE * VISITS, NX, NY))
    curvature = profiles[:, :, None] + noise
    table = pd.DataFrame(
        {
            "participant_id": np.repeat([f"sub-{n}" for n in range(PEOPLE)], VISITS),
            "session_id": np.tile(["ses-1", "ses-2"], PEOPLE),
        }
    )
    side = SideMaps(
        rows=np.arange(len(table)),
        maps={"curvature": curvature, "thickness": 2 + profiles[:, :, None] + 0 * noise},
        names=(),
        summary=pd.DataFrame(),
        subfield=np.full(curvature.shape, -1, dtype=np.int8),
    )
    axes = {"x": np.linspace(-1, 1, NX), "y": np.linspace(-1, 1, NY)}
    return Cohort(table=table, sides={"L": side}, units={}, **axes)


def registered(cohort, *, shared):
    cohort = Cohort(**{**vars(cohort), "shared": shared})
    return register_side(cohort, "L", groups=None, settings=GroupSettings(), templates=None)


def within(values):
    """Return the SD within participants of values (visits, ...)."""
    pairs = values.reshape(PEOPLE, VISITS, -1)
    return float(np.sqrt(pairs.var(axis=1, ddof=1).mean()))


def test_visits_that_share_a_sheet_have_one_warp(cohort):
    result, maps = registered(cohort, shared=True)
    assert within(result.warps) == 0
    # These maps do not differ between the visits, and registration adds no difference.
    assert within(maps.maps["thickness"]) < 1e-12
    separate, moved = registered(cohort, shared=False)
    assert within(separate.warps) > 0
    assert within(moved.maps["thickness"]) > 0.001


def test_participants_are_registered_as_well(cohort):
    spread = [
        float(np.var(registered(cohort, shared=shared)[1].maps["thickness"], axis=0).mean())
        for shared in (False, True)
    ]
    before = float(np.var(cohort.sides["L"].maps["thickness"], axis=0).mean())
    assert spread[1] < 0.2 * before
    assert spread[1] < spread[0]  # the mean profile has less noise


@pytest.mark.parametrize(("frame", "count"), [("visit", 0), ("person", 1), ("shared", 1)])
def test_a_note_names_shared_sheets(tmp_path, frame, count):
    grid = Grid(frame=frame).model_dump()
    (tmp_path / "desc-settings.json").write_text(json.dumps({"settings": {"sheet": grid}}))
    notes = _shared_sheets(grid_of(tmp_path))
    assert len(notes) == count
    assert all("participant --longitudinal" in note for note in notes)


def test_datasets_of_earlier_versions_have_separate_sheets(tmp_path):
    grid = Grid().model_dump()
    del grid["frame"]
    (tmp_path / "desc-settings.json").write_text(json.dumps({"settings": {"sheet": grid}}))
    assert _shared_sheets(grid_of(tmp_path)) == ()


def write_on_sheets(folder, sheets, subject="02"):
    """Write a hemisphere per session, with the sessions of its common sheet."""
    for session, sessions in sheets.items():
        visits = [
            {"session": name, "file": f"bids:fs:{name}/{part}", "sha256": "0"}
            for name in sessions
            for part in ("labels.mgz", "mask.mgz")
        ]
        maps = np.ones((2, 3)), np.ones((2, 3))
        write_hemisphere(place_of(folder, subject, "L", session=session), *maps, visits=visits)


EARLIER = ("base", "m12")


@pytest.mark.parametrize(
    ("sheets", "words"),
    [
        ({"base": EARLIER, "m12": EARLIER, "m24": ("m24",)}, "base, m12; m24"),
        # The result of a session is left over after its labels were removed.
        ({"base": ("base",), "m12": EARLIER}, "base; base, m12"),
    ],
)
def test_sessions_on_different_sheets_are_refused(tmp_path, sheets, words):
    _, out = begin_dataset(tmp_path)
    write_on_sheets(out, {"base": EARLIER, "m12": EARLIER}, "01")
    write_on_sheets(out, sheets)
    with pytest.raises(InputError) as refusal:
        collect_sheets(GroupRequest(roots=(out,)))
    text = f"sub-02 hemi-L: sessions are on different sheets ({words}); run participant"
    assert str(refusal.value).startswith(text)
    # Those on one sheet can be analyzed.
    found = collect_sheets(GroupRequest(roots=(out,), sessions=("base",)))
    assert [record.result.name.subject for record in found.records] == ["01", "02"]


def test_participants_may_differ_in_their_sessions(tmp_path):
    _, out = begin_dataset(tmp_path)
    write_on_sheets(out, {"base": EARLIER, "m12": EARLIER[::-1]}, "01")
    write_on_sheets(out, {"base": ("base", "m24"), "m24": ("base", "m24")})
    assert len(collect_sheets(GroupRequest(roots=(out,))).records) == 4
    write_on_sheets(out, {"base": ("base",)}, "01")
    write_on_sheets(out, {"base": ("base",)})
    with pytest.raises(InputError, match="sub-01 hemi-L, and 1 more: sessions"):
        collect_sheets(GroupRequest(roots=(out,)))
