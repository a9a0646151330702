"""Studies with fewer sheets than a template of registration takes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from extension_marks import needs
from small_cohorts import PLAN, methods_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.reports.group import group_page

STATMAPS = [f"hemi-{hemi}_contrast-CNAD_desc-thickness_statmap.tsv" for hemi in "LR"]
NOTE = "maps are not registered: hemisphere L has 8 sheets, a template needs 10"


def call(study, *options):
    data, out = study
    line = [str(data), str(out), "group", "--formula", "group", "--measures", "thickness"]
    return main([*line, "--no-classification", *options])


def align_of(study, name):
    record = json.loads((study[1] / "group" / name / "analysis.json").read_text())
    return record["settings"]["registration"]["align"]


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("eight")
    return write_dataset(folder, plan=replace(PLAN, sizes=(4, 4)))


def test_eight_participants_are_compared_without_registration(eight, capsys):
    assert call(eight, "--name", "default") == 0
    printed = " ".join("".join(capsys.readouterr()).split())
    assert NOTE in printed
    assert call(eight, "--name", "none", "--align", "none", "--no-reports") == 0
    assert NOTE not in " ".join("".join(capsys.readouterr()).split())
    folders = [eight[1] / "group" / name for name in ("default", "none")]
    for statmap in STATMAPS:
        maps = [table(folder / statmap) for folder in folders]
        np.testing.assert_array_equal(maps[0], maps[1])
    assert align_of(eight, "default") == "none"
    reason = "not registered to each other, since a template needs 10 sheets per hemisphere."
    assert reason in " ".join(methods_of(folders[0]).split())
    page = " ".join(group_page(folders[0]).split())
    assert NOTE in page
    assert "registered to each other (a template needs 10 sheets per hemisphere)" in page


def test_registration_that_is_asked_for_is_refused(eight, capsys, tmp_path):
    assert call(eight, "--name", "asked", "--align", "registr") == 65
    said = "8 profiles are too few for a template (least 10); use --align none or --template FILE"
    assert said in capsys.readouterr().err
    settings = tmp_path / "group.toml"
    settings.write_text('[registration]\nalign = "registr"\n')
    assert call(eight, "--name", "asked", "--settings", str(settings)) == 65
    assert not (eight[1] / "group" / "asked").exists()


def test_few_sheets_are_registered_to_a_template_of_another_cohort(eight, tmp_path, capsys):
    others = write_dataset(tmp_path)
    assert call(others, "--name", "others", "--no-reports") == 0
    assert align_of(others, "others") == "registr"
    template = others[1] / "group" / "others" / "template.json"
    capsys.readouterr()
    assert call(eight, "--name", "given", "--template", str(template), "--no-reports") == 0
    assert "not registered" not in "".join(capsys.readouterr())
    assert align_of(eight, "given") == "registr"
    assert "not registered" not in methods_of(eight[1] / "group" / "given")


@needs("trials")
def test_sample_sizes_of_few_participants_are_not_registered(eight, capsys):
    data, out = eight
    line = [str(data), str(out), "group", "--measures", "thickness", "--no-reports"]
    assert main([*line, "--formula", "group", "--power", "thinning=5%", "--name", "power"]) == 0
    assert NOTE in " ".join("".join(capsys.readouterr()).split())
    assert align_of(eight, "power") == "none"
    assert "Sheets were not registered to each other" in methods_of(out / "group" / "power")
