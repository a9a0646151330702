"""Folders made with and without common sheets, and what a dry run says of them."""

import pytest
from input_cases import put_visits, said_of

from hipsta_bids.derivatives import dataset
from hipsta_bids.errors import SettingsError
from hipsta_bids.settings import Settings


@pytest.mark.parametrize(
    ("before", "now", "advice"),
    [
        ("person", "visit", "with --longitudinal; add --longitudinal"),
        ("shared", "visit", "with --longitudinal shared; add --longitudinal shared"),
        ("visit", "shared", "without --longitudinal; omit it"),
        ("person", "shared", "with --longitudinal auto; use --longitudinal auto"),
        ("shared", "person", "with --longitudinal shared; use --longitudinal shared"),
    ],
)
def test_folders_name_the_option_that_they_were_made_with(tmp_path, before, now, advice):
    dataset.settle_settings(tmp_path, Settings().changed(sheet={"frame": before}))
    settings = Settings().changed(sheet={"frame": now})
    with pytest.raises(SettingsError) as refusal:
        dataset.settle_settings(tmp_path, settings)
    advice = f"{tmp_path}: this folder was made {advice}, or choose another output folder"
    assert str(refusal.value) == advice
    with pytest.raises(SettingsError) as refusal:
        dataset.settle_settings(tmp_path, settings.changed(grid={"spacing": 0.5}))
    assert str(refusal.value).startswith(f"{advice} (other settings: grid.spacing was ")


def test_a_dry_run_counts_common_sheets(tmp_path, capsys, monkeypatch):
    # The files are no images, whose labels a dry run could check.
    monkeypatch.setattr("hipsta_bids.participant.job.check_item", lambda *_: [])
    put_visits(tmp_path / "bids", "sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1", "sub-02_ses-3")
    put_visits(tmp_path / "bids", "sub-01_ses-3", sides="r")
    command = (tmp_path / "bids", tmp_path / "out", "participant", "--dry-run")
    text = said_of(capsys, *command, "--longitudinal")
    several = "sheets of several visits: 4 of 2 participants"
    assert f"{several} (sub-01 ses-1 ses-2 ses-3, sub-02 ses-1 ses-3)\n" in text
    assert "a single visit" not in text
    put_visits(tmp_path / "bids", *(f"sub-1{n}_ses-1" for n in range(7)))
    put_visits(tmp_path / "bids", "sub-03_ses-1")
    put_visits(tmp_path / "bids", "sub-03_ses-2", sides="l")
    text = said_of(capsys, *command, "--longitudinal")
    assert "sheets of several visits: 5 of 3 participants (sub-01" in text
    assert "sheets of a single visit: 15 of 8 participants (sub-03 ses-1, sub-10 ses-1" in text
    assert "sub-14 ses-1, ...)\n" in text
    assert "sheets of" not in said_of(capsys, *command)
