"""What a page says first: the decision, its reason, and what that may do to the map."""

import csv
import json

import numpy as np
import pytest

from hipsta_bids.reports.results import Hemisphere, find_results
from hipsta_bids.reports.verdict import verdict_of
from hipsta_bids.types import RATINGS


def hemisphere(root, subject, hemi):
    return next(h for h in find_results(root, subject) if h.result.name.hemi == hemi)


def changed(found, **record):
    return Hemisphere(found.result, {**found.record, **record})


def flag(reason, message, share, change):
    return {
        "reason": reason,
        "message": message,
        "columns_share": share,
        "mean_change_mm": change,
    }


def test_each_decision_has_its_verdict(out):
    verdicts = [verdict_of(hemisphere(out, *one)) for one in zip(("01", "01", "02", "02"), "LRLR")]  # noqa: B905
    assert [v.title for v in verdicts] == ["Use", "Use", "Look before use", "Do not use"]
    assert [v.decision for v in verdicts] == ["use", "use", "look", "failed"]
    assert sorted(verdicts, key=lambda v: v.rank) == [verdicts[3], verdicts[2], *verdicts[:2]]
    assert "Fill missing slices" in verdicts[3].advice
    assert RATINGS[-1] == "exclude"


def test_repairs_are_the_headline_of_what_can_be_used(out):
    found = hemisphere(out, "01", "R")
    with found.result.path("sheet").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    share, hatched = (
        np.mean([row[name] == "true" for row in rows]) for name in ("repaired", "doubtful")
    )
    assert 0 < hatched <= share
    mean, change = found.summary["thickness_mean"], found.metrics["repaired_change_mm"]
    verdict = verdict_of(found)
    assert verdict.reason == "Labels were repaired: bridges cut (1)."
    assert abs(change) < 0.005  # a stump is left
    assert verdict.consequence == (
        f"Repairs touch {share:.1%} of the map; without repairs, the mean thickness would be"
        f" the same, {mean:.2f} mm. {hatched:.1%} of the map is hatched as doubtful."
    )
    sound = verdict_of(hemisphere(out, "01", "L"))
    assert (sound.reason, sound.consequence) == (
        "No check raised a flag, and no label was repaired.",
        "",
    )


def test_filled_gaps_have_a_rule(out):
    found = hemisphere(out, "01", "R")
    metrics = {
        "repair_kinds": {"cavity": 9, "slit": 2, "fill": 1, "uncus": 1},
        "repaired_fraction": 0.413,
        "repaired_change_mm": 0.06,
        "doubtful_fraction": 0.0,
    }
    verdict = verdict_of(changed(found, metrics=metrics))
    assert verdict.reason == (
        "Labels were repaired: gaps filled (9), slits filled (2), holes filled (1), uncus"
        " excluded (1)."
    )
    mean = found.summary["thickness_mean"]
    assert verdict.consequence == (
        "Repairs touch 41.3% of the map; without repairs, the mean thickness would be"
        f" {mean - 0.06:.2f} instead of {mean:.2f} mm. Nothing is hatched as doubtful."
    )
    beside = metrics | {"repair_kinds": {"uncus": 1}, "repaired_fraction": 0.0}
    verdict = verdict_of(changed(found, metrics=beside))
    assert (verdict.reason, verdict.consequence) == (
        "Labels were repaired: uncus excluded (1).",
        "",
    )


def test_a_flag_decides_whatever_was_repaired(out):
    found = hemisphere(out, "01", "R")
    mean = found.summary["thickness_mean"]
    flags = [
        flag("edge-notch", "a notch near RAS 1 2 3 mm: look", 0.2, -0.05),
        flag("noisy-labels", "noise: look", None, None),
    ]
    verdict = verdict_of(changed(found, decision="look", flags=flags))
    assert verdict.title == "Look before use"
    assert verdict.reason == "A notch near RAS 1 2 3 mm: look."
    assert verdict.consequence == (
        "The mean thickness could be 0.05 mm too small, and 20.0% of the map wrong:"
        f" {mean:.2f} mm as measured, {mean + 0.05:.2f} mm with values of the neighbors."
    )


@pytest.mark.parametrize(
    ("reason", "share", "change", "text"),
    [
        ("noisy-labels", None, None, "The effect on the mean thickness is unknown."),
        ("folded", 0.03, None, "It concerns 3.0% of the map; the effect on the mean"),
        ("subfield-missing", 1.0, None, "It concerns the whole map; the effect on the mean"),
        ("side-doubtful", 1.0, 0.0, "It concerns the whole map; the mean thickness hardly"),
        ("ends-uncertain", 0.0, 0.0, "No measured column lies there"),
        ("map-outside", None, None, "Thickness and shape do not depend on it."),
    ],
)
def test_what_is_not_known_is_said(out, reason, share, change, text):
    flags = [flag(reason, "doubtful", share, change)]
    verdict = verdict_of(changed(hemisphere(out, "01", "L"), decision="look", flags=flags))
    assert verdict.consequence.startswith(text)


def test_commands_open_the_files_from_the_output_folder(out):
    from hipsta_bids.reports.cohort import open_commands  # noqa: PLC0415

    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"))
    words = freeview.split()
    assert words[:2] == ["freeview", "-v"]
    files = [word.split(":")[0] for word in words if ":" in word]
    assert len(files) == 5
    assert all((out / name).exists() for name in files)
    record = json.loads(hemisphere(out, "01", "R").result.path("qc").read_text())
    assert " ".join(words[words.index("-ras") + 1 :]) in record["repairs"][0]
    labels, mask = files[:2]
    assert snap == (f"mri_convert {labels} labels.nii.gz && itksnap -g labels.nii.gz -s {mask}")
    image = out.parent / "T2w.nii.gz"
    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"), image)
    assert freeview.split()[2] == "../T2w.nii.gz"
    assert snap.endswith(f"-s {mask} -o ../T2w.nii.gz")


def test_commands_of_a_container_name_no_folder_of_it(out, monkeypatch):
    from hipsta_bids.reports.cohort import open_commands  # noqa: PLC0415

    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TYPE", "docker")
    (_, freeview), (_, snap) = open_commands(hemisphere(out, "01", "R"))
    assert freeview.startswith("freeview -v LABELS_DIR/")
    assert snap.startswith("mri_convert LABELS_DIR/")
    monkeypatch.setenv("APPTAINER_CONTAINER", "image.sif")  # which sees the folders of the machine
    assert "LABELS_DIR" not in open_commands(hemisphere(out, "01", "R"))[0][1]
