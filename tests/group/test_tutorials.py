"""The tutorials: their commands work, and print the numbers that the pages show.

The whole of them takes minutes: ``tools/test-tutorials`` runs it, which sets HIPSTA_BIDS_TUTORIALS.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage, stats
from small_cohorts import table, write_dataset

from hipsta_bids.cli.commands import meta_parser, phantom_parser
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
PHANTOM, OWN, SITES = (
    (DOCS / f"tutorial-{name}.md").read_text() for name in ("phantom", "own-data", "consortium")
)
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
    assert f"and {counts[1] or 'no'} violet ones" in page


def consortium(page=SITES):
    """Command lines of the page of the consortium, those of one site for all of the table."""
    rows = re.findall(r"^\| (\w+) \| ([\d.]+) \| (\d) \|$", page, re.MULTILINE)
    (first, thickness, seed), *_ = rows
    for text in blocks(page):
        lines = text.replace("\\\n", " ").splitlines()
        for line in lines if re.match("hipsta-bids|mkdir", text) else ():
            own_site = "paris" in line  # the sixth, which has commands of its own
            if own_site or not re.search(r" phantom | participant$| --export-summary ", line):
                yield shlex.split(line) if line.startswith("hipsta") else line
                continue
            for site, own, number in rows if "--export" not in line or "Bonn" in line else ():
                given = re.sub("Bonn|Berlin", site, line)
                given = re.sub(r"(?<= )(bonn|berlin)(?=-out | )", site.lower(), given)
                given = given.replace(f"--thickness {thickness}", f"--thickness {own}")
                yield shlex.split(given.replace(f"--seed {seed}", f"--seed {number}"))
    assert first == "Berlin"


def test_the_commands_of_the_consortium_are_understood():
    """Those that take long are only parsed here."""
    every = [line for line in consortium() if not isinstance(line, str)]
    assert len(every) == 5 + 5 + 1 + 5 + 1 + 2 + 4
    for _, first, *rest in every:
        if first == "phantom":
            assert phantom_parser().parse_args(rest).n_subjects == (70 if "paris" in rest else 40)
        elif first == "meta":
            assert len(meta_parser().parse_intermixed_args(rest).sites) == 5
        elif rest[1] == "group":
            group_parser().parse_args([first, *rest])
    assert [one[2] for one in every[:5]] == ["berlin", "bonn", "lyon", "oslo", "turin"]


@pytest.fixture(scope="module")
def sites(tmp_path_factory):
    """The folder in which every command of the consortium was run."""
    folder = tmp_path_factory.mktemp("consortium")
    before = Path.cwd()
    os.chdir(folder)
    for line in consortium():
        if isinstance(line, str):
            subprocess.run(["sh", "-c", line], check=True)
        else:
            assert main(line[1:]) == 0
    os.chdir(before)
    return folder


@whole
def test_the_sentences_of_the_consortium_say_what_came_out(sites):
    check_consortium(sites)


def check_consortium(folder):
    page = plain(SITES)
    meta, pooled = folder / "consortium" / "meta", folder / "pooled" / "group"
    for _, row in table(meta / "peaks.tsv").iterrows():
        cells = [row.hemi, row.contrast.split("(")[1].rstrip(")"), f"{row.x:.2f}", f"{row.y:.2f}"]
        cells += [f"{row.statistic:.1f}", f"{row.df:.0f}", f"{row.p_corrected:.0e}"]
        assert f"| {' | '.join([*cells, f'{row.effect_size:.2f}', str(row.extent)])} |" in page
    thinned = table(folder / "berlin" / "phantom_effect.tsv").in_region.to_numpy() == 1
    maps, counts, between, away = {}, {}, [], []
    for hemi in "LR":
        for kind, path in (
            ("fixed", meta / f"hemi-{hemi}_contrast-ControlPatientFixedEffect"),
            ("random", meta / f"hemi-{hemi}_contrast-ControlPatientRandomEffects"),
            ("pooled", pooled / "pooled" / f"hemi-{hemi}_contrast-ControlPatient"),
            ("harmonized", pooled / "harmonized" / f"hemi-{hemi}_contrast-ControlPatient"),
        ):
            own = maps[kind, hemi] = table(f"{path}_desc-thickness_statmap.tsv")
            found = (own.significant == True).to_numpy()  # noqa: E712
            counts[kind, hemi] = int(found[thinned].sum()), int(found[~thinned].sum())
        between.append(f"{maps['random', hemi].i2.median():.0%}".replace("%", " %"))
        sd = (maps["pooled", hemi].estimate / maps["pooled", hemi].cohen_d).to_numpy()
        moved = maps["fixed", hemi].estimate - maps["pooled", hemi].estimate
        away.append(np.nanmax(np.abs(moved) / sd))
    for kind in ("fixed", "random"):
        (left, more), (right, beside) = counts[kind, "L"], counts[kind, "R"]
        assert (
            f"{left} and {right} of its {THINNED} points, and {more} and {beside} beside it" in page
        )
    assert f"{between[0]} on the left and {between[1]} on the right" in page
    assert f"differ by at most {max(away):.1f} SD" in page
    total = [sum(counts["harmonized", hemi]) for hemi in "LR"]
    assert f"{total[0]} and {total[1]} points survive" in page
    left_out = table(meta / "leave_one_out.tsv").set_index("contrast").n_significant
    assert f"at least {left_out['control-patient (fixed effect)'].min()} points" in page
    shifts = table(pooled / "harmonized" / "sites.tsv").query("measure == 'thickness'")
    for name in ("offset_before", "offset_after"):
        assert f"{shifts[name].min():.2f} to {shifts[name].max():.2f}" in page
    check_norms(folder, page, thinned)


def check_norms(folder, page, thinned):
    norms, scores = folder / "norms" / "group" / "norms_control", folder / "paris-out/group/scores"
    reference = len(table(norms / "covariates.tsv"))
    first, *_, last = json.loads((norms / "norms.json").read_text())["knots"]
    assert f"{reference} of the 100 controls" in page
    assert f"at ages of {first:g} to {last:g} years" in page
    people = table(folder / "paris" / "participants.tsv").set_index("participant_id").group
    z = pd.read_parquet(scores / "zscores.parquet")
    scored = z[z.thickness_z.notna()].participant_id.unique()
    left_out = table(scores / "excluded.tsv").participant_id.nunique()
    controls = int((people[scored] == "control").sum())
    words = (
        f"{len(scored)} participants are scored, {controls} of them controls; the other {left_out}"
    )
    assert words in page
    means, low, beside, healthy = [], [], [], []
    for hemi in "LR":
        for group in ("patient", "control"):
            own = z[(z.hemi == hemi) & (people[z.participant_id].to_numpy() == group)]
            of_all = own.thickness_z.to_numpy().reshape(-1, len(thinned))
            known = of_all[np.isfinite(of_all).any(axis=1)]
            below = known < stats.norm.ppf(0.05)
            if group == "control":
                healthy.append(f"{below[:, thinned].mean():.0%}".replace("%", " %"))
                continue
            means.append(f"{known[:, thinned].mean():.2f}")
            low.append(f"{below[:, thinned].mean():.0%}".replace("%", " %"))
            beside.append(f"{below[:, ~thinned].mean():.0%}".replace("%", " %"))
    assert f"mean z of {means[0]} on the left and {means[1]} on the right" in page
    assert f"{low[0]} and {low[1]} of its points are below the 5th centile" in page
    assert f"elsewhere {beside[0]} and {beside[1]} are" in page
    assert f"For controls, {healthy[0]} and {healthy[1]} in the region are." in page
