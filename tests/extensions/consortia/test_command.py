"""The command and the option of several sites: help, wrong use, and sheets with head and tail."""

import os

import pandas as pd
import pytest
from extension_marks import PRESENT, needs
from small_cohorts import FAST
from whole_cohorts import QUICK, REGION, N, write_whole

from hipsta_bids.cli.main import main
from hipsta_bids.cli.parser import help_texts
from hipsta_bids.extensions.consortia.commands import meta_parser
from hipsta_bids.group.output import write


def test_the_texts_of_the_help_have_no_leftovers():
    names = {(action.option_strings or [action.dest])[0] for action in meta_parser()._actions}
    texts = help_texts("hipsta_bids.extensions.consortia")["meta"]
    absent = set() if "norms" in PRESENT else {"--norms"}
    assert texts.keys() - {"description", "epilog"} - absent == names - {"-h"}


def test_an_option_that_takes_a_folder_is_one_line(capsys):
    assert main(["--export-summary", "in", "out", "group"]) == 64
    error = capsys.readouterr().err
    assert "--export-summary: its values are in; write" in error
    assert error.count("\n") == 1


def test_models_with_maps_as_covariates_have_no_summary(study, capsys):
    data, out = study
    formula = ["--formula", "thickness ~ group + map(curvature)", "--name", "refused"]
    command = [str(data), str(out), "group", *formula, "--export-summary", "a", *FAST]
    assert main(command) == 65
    error = capsys.readouterr().err
    assert "map()" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_summaries_that_are_no_regular_files_end_at_once(tmp_path, capsys, make):
    sites = [tmp_path / name for name in ("a.json", "b.json")]
    for site in sites:
        make(site)
    assert main(["meta", *map(str, sites), str(tmp_path / "out")]) in {64, 65}
    error = capsys.readouterr().err
    assert "no regular file" in error
    assert error.count("\n") == 1


@needs("regions")
def test_sites_are_combined_and_plots_name_the_part(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))
    data, out = write_whole(tmp_path)
    run = [str(data), str(out), "group", "--region", REGION, *QUICK, "--no-classification"]
    run += ["--no-reports"]
    assert main([*run, "--name", "one", "--export-summary", "one"]) == 0
    one, two = (out / "group" / name / "summary.json" for name in ("one", "two"))
    half = [f"{i:02d}" for i in range(3, N - 1)]
    more = ["--export-summary", "two", "--template", str(one), "--participant-label", *half]
    assert main([*run, "--name", "two", *more]) == 0
    assert main(["meta", str(one), str(two), str(tmp_path / "both")]) == 0
    forest = pd.read_csv(tmp_path / "both/meta/forest.tsv", sep="\t")
    peaks = forest[forest.x.notna()]
    assert "head" in set(peaks.part)
    assert ((peaks.part == "head") == (peaks.y > 1)).all()
    text = (tmp_path / "both/meta/methods.md").read_text()
    assert "whole hippocampus on one sheet" in text
