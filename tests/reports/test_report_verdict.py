"""What a page says first: the decision, its reason, and what that may do to the map."""

import csv
import json

import numpy as np
import pytest

from hipsta_bids.reports.results import Hemisphere, find_results
from hipsta_bids.reports.verdict import RATINGS, verdict_of


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


def table_of(found):
    """Read the sheet table without the package: columns by name, (Nx, Ny)."""
    with found.result.path("sheet").open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    shape = int(rows[-1]["x"]), int(rows[-1]["y"])
    numbers = {k: np.array([float(r[k]) for r in rows]).reshape(shape) for k in ("r", "a", "s")}
    numbers["thickness"] = np.array([float(r["thickness"]) for r in rows]).reshape(shape)
    repaired = np.array([r["repaired"] == "true" for r in rows]).reshape(shape)
    return numbers, repaired


def areas_of(points):
    """A quarter of every quadrilateral to each of its corners, by two triangles."""
    area = np.zeros(points.shape[:2])
    for i, j in np.ndindex(points.shape[0] - 1, points.shape[1] - 1):
        a, b, c, d = points[i, j], points[i + 1, j], points[i + 1, j + 1], points[i, j + 1]
        whole = 0.5 * np.linalg.norm(np.cross(c - a, d - b))
        for k in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
            area[k] += whole / 4
    return area


def smoothed(values, where):
    """Let marked values become the mean of their neighbors, again and again."""
    found, known = values.copy(), np.pad(np.ones(values.shape), 1)
    count = known[:-2, 1:-1] + known[2:, 1:-1] + known[1:-1, :-2] + known[1:-1, 2:]
    for _ in range(4000):
        wide = np.pad(found, 1)
        mean = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / count
        found = np.where(where, mean, values)
    return found


def test_what_repairs_may_do_is_that_of_the_repaired_columns(out):
    found = hemisphere(out, "01", "R")
    numbers, repaired = table_of(found)
    assert repaired.any()
    thickness = numbers["thickness"]
    area = areas_of(np.stack([numbers[k] for k in "ras"], axis=-1))
    mean = np.average(thickness, weights=area)
    other = np.average(smoothed(thickness, repaired), weights=area)
    verdict = verdict_of(found)
    assert verdict.reason == "No check found anything to look at."
    assert found.metrics["repaired_change_mm"] == pytest.approx(mean - other, abs=1e-5)
    assert verdict.consequence == (
        f"1 repair of the labels, {repaired.mean():.1%} of the map; with values"
        f" of the neighbors, the mean would be {other:.2f} mm."
    )
    assert verdict_of(hemisphere(out, "01", "L")).consequence == "No label was repaired."


def test_a_flag_decides_whatever_was_repaired(out):
    found = hemisphere(out, "01", "R")
    mean = found.summary["thickness_mean"]
    flags = [
        flag("edge-notch", "a notch near RAS 1 2 3 mm: look; it concerns 20%", 0.2, -0.05),
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
