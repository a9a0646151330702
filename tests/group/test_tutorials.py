"""The tutorials: their commands work, and print the numbers that the pages show.

The whole of them takes minutes: ``tools/test-tutorials`` runs it, which sets HIPSTA_BIDS_TUTORIALS.
"""

import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from small_cohorts import table, write_dataset
from tutorial_pages import blocks, check_printed, commands, plain, whole

from hipsta_bids.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
PHANTOM, OWN = ((DOCS / f"tutorial-{name}.md").read_text() for name in ("phantom", "own-data"))
MODEL = "group-age-sex-site"
THINNED = "187"  # points that were thinned, of `phantom_effect.tsv`


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here, whose names they print."""


def participants():
    """The table of participants of the page about own data."""
    (text,) = (text for text in blocks(OWN) if text.startswith("participant_id"))
    assert "\t" in text
    return text


@pytest.mark.long
def test_a_subject_of_the_tutorial_is_measured_as_printed(tmp_path, monkeypatch, capsys):
    """A subject is the same in a smaller cohort of the same seed."""
    monkeypatch.chdir(tmp_path)
    (make, _), (look, seen), (measure, shown), *_ = commands(PHANTOM)
    make[make.index("--n-subjects") + 1] = "2"
    assert main(make) == 0
    capsys.readouterr()
    one = ["--participant-label", "01", "--n-procs", "1"]
    assert main([*look, *one]) == 0
    check_printed(seen, capsys.readouterr().out)
    assert main([*measure, *one]) == 0
    check_printed(shown.splitlines()[0], capsys.readouterr().out)


def test_the_participants_of_the_page_about_own_data_can_be_compared(tmp_path, monkeypatch, capsys):
    """On maps that are made up, with its table and its command."""
    monkeypatch.setattr("hipsta_bids.group.output.write.draw_figures", lambda *_: iter(()))
    data, out = write_dataset(tmp_path)
    (data / "participants.tsv").write_text(participants())
    known = table(data / "participants.tsv").participant_id
    for folder in out.glob("sub-*"):
        if folder.name not in set(known):
            shutil.rmtree(folder)
    command, shown = list(commands(OWN))[-1]
    assert command == ["study", "out", "group"]
    assert main([str(data), str(out), "group"]) == 0
    check_printed(shown.splitlines()[0], capsys.readouterr().out)
    assert f"{len(known)} participants in the model" in shown


@whole
def test_own_data_from_the_first_command_to_the_last(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    people = participants()
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "participants.tsv").write_text(people)
    n = str(people.count("sub-"))
    asked = list(commands(OWN))
    for start, (tool, layout) in enumerate({"freesurfer": "freesurfer", "ashs": "ashsPMC"}.items()):
        assert main(["phantom", tool, "--n-subjects", n, "--layout", layout]) == 0
        (labels,) = (tool_folder for tool_folder in Path(tool, "derivatives").iterdir())
        places = {"/data/subjects": str(labels), "/data/ashs": str(labels), "out": f"out-{tool}"}
        for command, shown in (asked[start], asked[start + 2], asked[-1]):
            capsys.readouterr()
            assert main([places.get(word, word) for word in command]) == 0
            check_printed(shown.replace(" out/", f" out-{tool}/"), capsys.readouterr().out)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The folder in which every command of the phantom tutorial up to the first model was run."""
    folder = tmp_path_factory.mktemp("tutorial")
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


@whole
def test_the_phantom_tutorial_from_the_first_command_to_the_last(study, capsys):
    for command, shown in commands(PHANTOM):
        assert main(command) == 0
        check_printed(shown if shown.count("──") == 0 else "", capsys.readouterr().out)
    tree = next(text for text in blocks(PHANTOM) if "──" in text)
    for name in re.findall(r"── ([\w.]+)", tree)[:3]:
        assert (study / "cohort" / name).exists()
    rows = re.findall(r"^\| .*? \| `hipsta-bids (.*?)` \|$", PHANTOM, re.MULTILINE)
    assert len(rows) == 5
    for row in rows:
        assert main(shlex.split(row)) == 0


def found(study, model, hemi):
    """Signs of the points that survive, and where the wall was thinned."""
    path = study / "out" / "group" / model
    rows = table(path / f"hemi-{hemi}_contrast-ControlPatient_desc-thickness_statmap.tsv")
    signs = np.where(rows.significant == True, np.sign(rows.statistic), 0)  # noqa: E712
    thinned = table(study / "cohort" / "phantom_effect.tsv").in_region.to_numpy() == 1
    shape = rows.node_x.max(), rows.node_y.max()
    return signs.reshape(shape), thinned.reshape(shape)


@whole
def test_the_sentences_of_the_phantom_tutorial_say_what_came_out(study):
    page = plain(PHANTOM)
    folder = study / "out" / "group" / MODEL
    peaks = table(folder / "peaks.tsv").query("measure == 'thickness'")
    for hemi in "LR":
        row = peaks[peaks.hemi == hemi].iloc[0]
        cells = [hemi, f"{row.x:.2f}", f"{row.y:.2f}", row.subfield, f"{row.statistic:.1f}"]
        cells += [f"{row.p_corrected:.0e}", f"{row.effect_size:.1f}", f"{row.extent}"]
        assert f"| {' | '.join(cells)} |" in page
    (left, where), (right, _) = (found(study, MODEL, hemi) for hemi in "LR")
    inside = [int((signs[where] > 0).sum()) for signs in (left, right)]
    beside = [int((signs[~where] > 0).sum()) for signs in (left, right)]
    near = ndimage.binary_dilation(where, np.ones((3, 3)), iterations=2)
    assert not any((signs[~near] > 0).any() for signs in (left, right))
    assert where.sum() == int(THINNED)
    assert min(inside) > 0.9 * where.sum()
    assert (
        f"The planted region has {THINNED} points (`phantom_effect.tsv`). The analysis found"
        f" {inside[0]} of them on the left and {inside[1]} on the right." in page
    )
    assert f"A further {beside[0]} and {beside[1]} points lie within two nodes of its" in page
    measures = table(folder / "measures.tsv").set_index(["measure", "hemi"])
    p, p_fdr = measures.p, measures.p_fdr["thickness_mean_CA1", "L"]
    assert f"(left: p = {p['thickness_mean', 'L']:.2f};" in page
    left_p = f"(p = {p['thickness_mean_CA1', 'L']:.3f}; `p_fdr` = {p_fdr:.2f})"
    assert f"differed on the left before correction {left_p}" in page
    assert f"on the right (p = {p['thickness_mean_CA1', 'R']:.2f})" in page
    assert f"{int((right < 0).sum())} points survive where patients are thicker" in page
    assert not (left < 0).any()
    curved = table(folder / "maps.tsv").query("measure == 'curvature'")
    assert curved.n_significant.sum() == 0
    strict = [found(study, "tfce", hemi)[0] for hemi in "LR"]
    counts = [int((signs > 0).sum()) for signs in strict], int((strict[1] < 0).sum())
    assert f"{counts[0][0]} points survive on the left and {counts[0][1]} on the right" in page
    assert f"and {counts[1] or 'no'} violet one{'s' * (counts[1] != 1)}" in page
