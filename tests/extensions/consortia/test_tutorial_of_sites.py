"""The tutorial of several sites: its commands work, and print the numbers that the page shows."""

import json
import os
import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from scipy import stats
from small_cohorts import table
from tutorial_pages import blocks, plain, whole

from hipsta_bids.cli.commands import phantom_parser
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main
from hipsta_bids.extensions.consortia.commands import meta_parser

DOCS = Path(__file__).parents[3] / "docs"
SITES = (DOCS / "tutorial-consortium.md").read_text()
THINNED = "187"  # points that were thinned, of `phantom_effect.tsv`


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


@needs("norms")
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
