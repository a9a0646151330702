"""Both tutorials: their commands work, and print the numbers that the pages show.

The whole of them takes minutes: ``tools/test-tutorials`` runs it, which sets HIPSTA_BIDS_TUTORIALS.
"""

import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage
from small_cohorts import write_dataset

from hipsta_bids.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
PHANTOM, OWN = ((DOCS / f"tutorial-{name}.md").read_text() for name in ("phantom", "own-data"))
MODEL = "group-age-sex-site"
THINNED = "187"  # points that were thinned, of `phantom_effect.tsv`
whole = pytest.mark.skipif(
    os.environ.get("HIPSTA_BIDS_TUTORIALS") != "required", reason="run tools/test-tutorials"
)


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here, whose names they print."""


def blocks(page):
    """Contents of the fenced blocks, also of those in tabs."""
    found = re.findall(r"^( *)```\n(.*?)^ *```$", page, re.MULTILINE | re.DOTALL)
    return [re.sub(f"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def commands(page):
    """List command lines with the block that follows each: what it prints, if it is no command."""
    every = blocks(page)
    for text, following in zip(every, [*every[1:], ""], strict=True):
        if text.startswith("hipsta-bids"):
            printed = "" if following.startswith("hipsta-bids") else following
            yield shlex.split(text.replace("\\\n", " "))[1:], printed


def plain(text):
    """One blank between words, and no seconds: those are the machine's."""
    return " ".join(re.sub(r"\d+\.\d s\b", "", text).split())


def check_printed(shown, printed):
    """Each line that a page shows is the beginning of a line that was printed."""
    lines = [plain(line) for line in printed.splitlines()]
    for line in shown.splitlines():
        if line.strip() not in {"...", ""}:
            assert any(one.startswith(plain(line)) for one in lines), line


def table(path):
    return pd.read_csv(path, sep="\t", na_values="n/a")


def participants():
    """The table of participants of the page about own data."""
    (text,) = (text for text in blocks(OWN) if text.startswith("participant_id"))
    assert "\t" in text
    return text


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
    monkeypatch.setattr("hipsta_bids.group.write.draw_figures", lambda *_: iter(()))
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
    assert inside[0] == where.sum() == int(THINNED)
    assert (
        f"of its {THINNED} points (`phantom_effect.tsv`), all on the left and {inside[1]}" in page
    )
    assert f"with {beside[0]} and {beside[1]} within two nodes of its border" in page
    measures = table(folder / "measures.tsv").set_index(["measure", "hemi"]).p
    assert f"(left: p = {measures['thickness_mean', 'L']:.2f})" in page
    assert f"on the left (p = {measures['thickness_mean_CA1', 'L']:.3f})" in page
    assert f"on the right (p = {measures['thickness_mean_CA1', 'R']:.2f})" in page
    assert f"and {int((right < 0).sum())} points of this survive" in page
    assert not (left < 0).any()
    curved = table(folder / "maps.tsv").query("measure == 'curvature'")
    assert curved.n_significant.sum() == 0
    strict = [found(study, "tfce", hemi)[0] for hemi in "LR"]
    counts = [int((signs > 0).sum()) for signs in strict], int((strict[1] < 0).sum())
    assert f"{counts[0][0]} points remain on the left and {counts[0][1]} on the right" in page
    assert f"and {counts[1] or 'no'} violet ones" in page
