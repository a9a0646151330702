"""Results of several regions in one folder: the one that is asked for, and a note of the others."""

import json

import pytest
from small_cohorts import PLAN, place_of, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.dataset import identity, update_status
from hipsta_bids.group.cohort.collect import GroupRequest, collect_sheets
from hipsta_bids.io import files

QUICK = ["group", "--align", "none", "--measures", "thickness", "--formula", "group", "--contrast"]
QUICK += ["group[CN]-group[AD]"]
EXTENDED = ["--region", "extended"]


@pytest.fixture
def study(tmp_path, monkeypatch):
    """All participants, measured with the neighboring cortex."""
    monkeypatch.setattr("hipsta_bids.group.questions.compare.draw", lambda *_, **__: ())
    data, out = write_dataset(tmp_path, region="extended")
    return [str(data), str(out)], out


def test_extended_results_are_analyzed_when_asked_for(study, capsys):
    folders, out = study
    assert main([*folders, *QUICK, *EXTENDED]) == 0
    assert "are not in this analysis" not in capsys.readouterr().out
    folder = out / "group" / "thickness_group_extended"
    record = json.loads((folder / "analysis.json").read_text())
    assert record["inputs"]["region"] == "extended"
    assert record["hemispheres"] == {"L": sum(PLAN.sizes), "R": sum(PLAN.sizes)}
    text = (folder / "methods.md").read_text()
    assert "Measures of the hippocampal body and the neighboring cortex [1]" in text


def test_body_is_the_default_and_others_are_counted(study, capsys):
    folders, out = study
    for path in out.glob("sub-*/anat/*_label-extended_*"):
        body = path.with_name(path.name.replace("_label-extended", ""))
        body.write_bytes(path.read_bytes())
    assert main([*folders, *QUICK]) == 0
    said = capsys.readouterr().out
    assert "60 hemispheres of region extended are not in this analysis; --region extended" in said
    record = json.loads((out / "group" / "thickness_group" / "analysis.json").read_text())
    assert record["inputs"]["region"] == "body"
    assert any("60 hemispheres of region extended" in note for note in record["notes"])
    assert main([*folders, *QUICK, *EXTENDED]) == 0
    assert "60 hemispheres of region body" in capsys.readouterr().out
    names = {path.name for path in (out / "group").iterdir()}
    assert names == {"thickness_group", "thickness_group_extended"}


@pytest.mark.parametrize(("seg", "count"), [(None, 2), ("demo", 1)])
def test_others_are_counted_in_the_protocol_that_is_asked_for(tmp_path, seg, count):
    for one in ("demo", "ashs"):
        files.write_json(place_of(tmp_path, "01", "L", seg=one, region="extended").path("qc"), {})
    found = collect_sheets(GroupRequest(roots=(tmp_path,), seg=seg), may_lack=True)
    (note,) = found.notes
    assert note.startswith(f"{count} hemispheres of region extended are not in this analysis;")


def test_missing_region_is_refused_with_what_there_is(study, capsys):
    folders, _ = study
    assert main([*folders, *QUICK]) == 66
    assert "there is demo --region extended" in capsys.readouterr().err
    assert main([*folders, *QUICK, "--region", "entorhinal"]) == 66
    assert "as asked for --region entorhinal; there is demo" in capsys.readouterr().err


def test_unfinished_hemispheres_count_in_their_region(study, capsys):
    folders, out = study
    row = identity(place_of(out, "99", "L").name)
    update_status(out, [row | {"decision": "failed", "reason": "not-finished"}])
    assert main([*folders, *QUICK, *EXTENDED]) == 0
    row = identity(place_of(out, "99", "L", region="extended").name)
    update_status(out, [row | {"decision": "failed", "reason": "not-finished"}])
    assert main([*folders, *QUICK, *EXTENDED]) == 65
    assert "sub-99_hemi-L" in capsys.readouterr().err


@pytest.mark.parametrize(("rating", "kept"), [("use", True), ("unsure", False), (None, False)])
def test_a_rating_for_use_overrules_the_decision(study, rating, kept, tmp_path):
    _, out = study
    path = place_of(out, "02", "R", region="extended").path("qc")
    files.write_json(path, json.loads(path.read_text()) | {"decision": "look", "reason": "notch"})
    table = tmp_path / "ratings.tsv"
    cells = "" if rating is None else f"sub-02\tR\t{rating}\n"
    table.write_text(f"participant_id\themi\trating\nsub-03\tL\tuse\n{cells}")
    request = GroupRequest(roots=(out,), region="extended", exclude_look=True, ratings=table)
    found = collect_sheets(request)
    left_out = [(one.participant, one.hemi, one.reason) for one in found.exclusions]
    assert left_out == ([] if kept else [("sub-02", "R", "look: notch")])
    assert not any(record.doubtful for record in found.records)


def test_a_side_without_a_result_is_listed_if_others_have_it(tmp_path):
    _, out = write_dataset(tmp_path)
    place_of(out, "02", "R").path("qc").unlink()
    (absent,) = collect_sheets(GroupRequest(roots=(out,))).exclusions
    assert (absent.participant, absent.hemi, absent.reason) == ("sub-02", "R", "no-result")
    for path in out.rglob("*_hemi-R_*desc-qc_metrics.json"):
        path.unlink()
    assert not collect_sheets(GroupRequest(roots=(out,))).exclusions
