"""The BIDS validator on what the package writes: synthetic datasets, and both levels' output."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.names import EXTRA_OUTPUTS, OUTPUTS
from hipsta_bids.derivatives.results import list_results
from hipsta_bids.io import files
from hipsta_bids.joints import is_present

#: In the environment of the tests, else on the path.
PLACES = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
COHORT = ("--n-subjects", "5", "--voxel-size", "0.6", "0.6", "0.6", "--thickness", "2.2")


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here: their names count too."""


@pytest.fixture(scope="module")
def issues(tmp_path_factory):
    """Function that lists the validator's issues about a folder, as code and place."""
    program = shutil.which("bids-validator-deno", path=PLACES)
    assert program, "bids-validator-deno is not there: make env, or install requirements-dev.lock"
    cache = str(tmp_path_factory.mktemp("deno"))
    environment = os.environ | {"DENO_DIR": cache, "DENO_NO_UPDATE_CHECK": "1"}

    def run(folder, *options, severity="error"):
        done = subprocess.run(
            [program, str(folder), "--json", *options],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
            env=environment,
        )
        report = json.loads(done.stdout)
        run.checked = report["summary"]["totalFiles"]
        assert run.checked > 0
        found = report["issues"]["issues"]
        return [(i["code"], i.get("location")) for i in found if i["severity"] == severity]

    return run


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    folder = tmp_path_factory.mktemp("phantom") / "in"
    assert main(["phantom", str(folder), *COHORT]) == 0
    return folder


@pytest.fixture(scope="module")
def measured(phantom):
    """Output of the participant level."""
    out = phantom.with_name("out")
    line = [str(phantom), str(out), "participant", "--write-meshes", "--n-procs", "1", "--hemi"]
    assert main([*line, "L"]) == 0
    return out


def test_phantoms_are_valid_and_so_are_their_segmentations(phantom, issues):
    assert issues(phantom, "--recursive") == []


def test_the_demo_is_valid(tmp_path, issues):
    assert main(["demo-data", str(tmp_path / "demo")]) == 0
    assert issues(tmp_path / "demo", "--recursive") == []


def test_output_of_both_levels_is_valid(phantom, measured, issues):
    assert list(measured.glob("sub-*.html"))
    assert issues(measured) == []
    line = [str(phantom), str(measured), "group", "--formula", "thickness ~ age"]
    assert main([*line, "--align", "none"]) == 0  # a template takes ten
    assert list((measured / "group").glob("*/*"))
    if is_present("export"):
        assert main(["export", str(measured), str(measured), "--format", "prov"]) == 0
        assert list((measured / "prov").iterdir())
    assert issues(measured) == []
    # Whose dataset it is, we cannot know; all else that BIDS recommends is there.
    assert {code for code, _ in issues(measured, severity="warning")} == {"TOO_FEW_AUTHORS"}


def test_eight_patterns_hide_what_has_no_name_in_bids(measured, issues):
    """Labels of subfields are checked, and what the dataset is."""
    lines = (measured / ".bidsignore").read_text(encoding="utf-8").splitlines()
    patterns = [line for line in lines if line and not line.startswith("#")]
    assert len(patterns) <= 8
    assert issues(measured) == []
    count = len(list_results(measured))
    checked = [".bidsignore", "dataset_description.json", "README.md", "dseg.json"]
    assert issues.checked == len(checked) + 2 * count  # labels on the surface, and a sidecar
    # Without a pattern each would be an error: none hides nothing.
    for line in patterns:
        if line in {"/[gp]ro[uv]*", "*_label-*"}:
            continue  # not of this run
        (measured / ".bidsignore").write_text("\n".join(one for one in lines if one != line))
        assert issues(measured), line
    files.write_text(measured / ".bidsignore", "\n".join(lines) + "\n")


def test_every_name_of_the_table_is_valid(measured, tmp_path, issues):
    """Also with a session and in other regions; contents are read where BIDS has the name."""
    out = shutil.copytree(measured, tmp_path / "out")
    (first, *_) = list_results(out)
    for region in ("body", "extended", "entorhinal"):
        name = replace(first.name, session="1", region=region)
        place = replace(first, name=name)
        for row in (*OUTPUTS, *EXTRA_OUTPUTS):
            path = place.path(row.key, "T1w" if row.desc == "*" else None)
            if row.in_standard:
                files.write_bytes(path, first.path(row.key).read_bytes())
            else:
                files.write_text(path, "x")
    assert issues(out) == []


def test_the_validator_finds_what_is_wrong(measured, tmp_path, issues):
    out = shutil.copytree(measured, tmp_path / "out")
    place = list_results(out)[0]
    stray = place.path("sheet").with_name("sub-01_sheet.tsv")
    stray.write_text("x\n1\n")
    inside = f"/{stray.relative_to(out)}"
    assert ("NOT_INCLUDED", inside) in issues(out)
    (out / ".bidsignore").write_text("")
    found = issues(out)
    assert {"NOT_INCLUDED", "ALL_FILENAME_RULES_HAVE_ISSUES"} <= {code for code, _ in found}
    assert ("NOT_INCLUDED", "/status.tsv") in found
