"""Files of a release: one version, one list of dependencies, and places for persons to decide."""

import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

import hipsta_bids
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.derivatives.names import HemisphereName, output_name

ROOT = Path(__file__).parents[1]
#: Names of packages at conda-forge; the second is missing there (docs/release.md).
CONDA = {"matplotlib": "matplotlib-base", "tetgen": "python-tetgen"}


def read(name):
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["codemeta.json", ".zenodo.json"])
def test_metadata_have_this_version(name):
    content = json.loads(read(name))
    assert content["version"] == hipsta_bids.__version__
    assert "AGPL-3.0-or-later" in content["license"]


def test_metadata_have_one_title_and_one_description():
    citation, archive = yaml.safe_load(read("CITATION.cff")), json.loads(read(".zenodo.json"))
    descriptions = {json.loads(read("codemeta.json"))["description"], archive["description"]}
    assert descriptions == {citation["abstract"].strip()}
    assert archive["title"] == citation["title"]
    assert f'title: "{citation["title"]}"' in read("paper/paper.md")


def test_wheel_and_sdist_hold_the_files_of_the_package(tmp_path):
    """None is missing, and none that Python or an editor left beside them is added."""
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a clone: there is no list of tracked files")
    command = [git, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "hipsta_bids"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    names = {name for name in listed.split("\0") if name and (ROOT / name).is_file()}
    for name in ("pyproject.toml", "README.md", "LICENSE", *names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    for extra in ("__pycache__/x.cpython-311.pyc", "cli/__pycache__/y.pyc", "cli/help.toml~"):
        (tmp_path / "hipsta_bids" / extra).parent.mkdir(exist_ok=True)
        (tmp_path / "hipsta_bids" / extra).touch()
    for kind in ("sdist", "wheel"):
        build = f"from setuptools import build_meta; build_meta.build_{kind}('dist')"
        subprocess.run([sys.executable, "-c", build], cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        assert {n for n in archive.namelist() if n.startswith("hipsta_bids/")} == names
    with tarfile.open(sdist) as archive:
        members = [m.name.partition("/")[2] for m in archive.getmembers() if m.isfile()]
    assert {n for n in members if n.startswith("hipsta_bids/")} == names


def test_the_gate_tests_what_is_installed():
    """The tests of `make test` import the wheel; nothing leads to the checkout's package."""
    if os.environ.get("HIPSTA_BIDS_INSTALLED") != "required":
        pytest.skip("not the gate: the package may be the checkout's")
    assert Path(hipsta_bids.__file__).parents[1].name == "site-packages"
    source = (ROOT / "hipsta_bids").resolve()
    assert [one for one in sys.path if (Path(one) / "hipsta_bids").resolve() == source] == []


def test_the_recipe_has_the_dependencies_of_the_package():
    recipe = yaml.safe_load(read("recipe/recipe.yaml"))
    assert recipe["context"]["version"] == hipsta_bids.__version__
    project = tomllib.loads(read("pyproject.toml"))["project"]
    requirements = [Requirement(text) for text in project["dependencies"]]
    expected = {f"{CONDA.get(one.name, one.name)} {one.specifier}" for one in requirements}
    run = set(recipe["requirements"]["run"])
    assert run - {"python >=${{ python_min }}"} == expected
    assert project["requires-python"] == f">={recipe['context']['python_min']}"


def test_dependencies_have_lower_bounds_only():
    """What has an upper bound needs a reason beside it in pyproject.toml, and a line here."""
    project = tomllib.loads(read("pyproject.toml"))["project"]
    extras = project["optional-dependencies"].values()
    names = [*project["dependencies"], *(name for extra in extras for name in extra)]
    bounds = [one.operator for name in names for one in Requirement(name).specifier]
    assert len(bounds) > len(project["dependencies"])
    assert set(bounds) == {">="}


def test_ci_installs_the_wheel_on_each_python_that_is_named():
    jobs = yaml.safe_load(read(".github/workflows/test.yml"))["jobs"]
    named = {
        line.rpartition(":: ")[2]
        for line in tomllib.loads(read("pyproject.toml"))["project"]["classifiers"]
        if re.search(r"Python :: 3\.\d", line)
    }
    for name in ("test", "install"):
        assert set(jobs[name]["strategy"]["matrix"]["python"]) == named
    assert jobs["install"]["steps"][-1]["run"].split()[0] == "tools/test-install"
    assert (ROOT / "tools" / "test-install").is_file()


def test_workflows_run_actions_of_one_commit_with_its_version_beside_it():
    """A tag can be moved to other code; a hash cannot."""
    texts = [path.read_text("utf-8") for path in (ROOT / ".github" / "workflows").glob("*.yml")]
    used = {line for text in texts for line in re.findall(r"uses: (?!\./)(.+)", text)}
    assert used
    assert [
        u for u in used if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+", u)
    ] == []
    assert len({line.partition("@")[0] for line in used}) == len(used)  # one version of each


def test_the_definition_for_apptainer_converts_this_image():
    text = read("descriptors/hipsta_bids.def")
    assert f"From: hipsta_bids:{hipsta_bids.__version__}" in text


def test_the_pipeline_of_nipoppy_is_this_version_with_options_that_exist():
    folder = ROOT / "descriptors" / "nipoppy" / "hipsta_bids"
    parts = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.iterdir()}
    config, descriptor = parts["config"], parts["descriptor"]
    assert descriptor == json.loads(read("descriptors/hipsta_bids_participant.json"))
    assert config["VERSION"] == hipsta_bids.__version__ == descriptor["tool-version"]
    (step,) = config["STEPS"]
    names = {value for key, value in step.items() if key.endswith("_FILE")} | {"config.json"}
    assert names == {path.name for path in folder.iterdir()}
    inputs = {entry["id"] for entry in descriptor["inputs"]}
    assert set(parts["invocation"]) <= inputs
    # Brackets are replaced by Nipoppy: paths and IDs by its own names, else by variables.
    used = set(re.findall(r"\[\[(?!NIPOPPY_|HPC_|PIPELINE_)(\w+)\]\]", json.dumps(parts)))
    assert used == set(config["VARIABLES"])
    # Records are written last, so that they mark what is complete.
    name = output_name(HemisphereName(subject="1", session="2", hemi="L", seg="x"), "qc")
    (path, _) = parts["tracker"]["PATHS"]
    assert fnmatch.fnmatch(name, path.rpartition("/")[2])


def test_the_configuration_of_babs_has_this_version_and_options_that_exist():
    config = yaml.safe_load(read("descriptors/babs/hipsta_bids.yaml"))
    (version,) = config["zip_foldernames"].values()
    assert version == hipsta_bids.__version__.replace(".", "-")
    options = dict(config["bids_app_args"])
    line = [options.pop("$SUBJECT_SELECTION_FLAG"), "sub-01"]
    for flag, value in options.items():
        line += [flag, value]
    parsed = build_parser().parse_args(["in", "out", "participant", *line])
    assert parsed.participant_label == ["01"]
    assert (parsed.n_procs, parsed.mem) == (1, 2.0)
    # BABS unzips to a folder of the name of the input.
    folder = config["input_datasets"]["freesurfer"]["path_in_babs"]
    assert options["--freesurfer-dir"] == f"${{PWD}}/{folder}/freesurfer"


def test_pixi_has_the_package_and_commands_that_exist():
    content = tomllib.loads(read("pyproject.toml"))
    pixi, project = content["tool"]["pixi"], content["project"]
    assert pixi["pypi-dependencies"] == {project["name"]: {"path": ".", "editable": True}}
    words = pixi["tasks"]["demo"].split()
    assert words[0] in project["scripts"]
    extras = pixi["feature"]["dev"]["pypi-dependencies"][project["name"]]["extras"]
    assert set(extras) <= set(project["optional-dependencies"])


def test_the_paper_has_the_sections_of_the_journal():
    """Order and words of https://joss.readthedocs.io: 750 to 1,750 words, here below 1,750."""
    text = read("paper/paper.md")
    sections = re.findall(r"^# (.+)$", text, re.MULTILINE)
    assert sections == [
        "Summary",
        "Statement of need",
        "State of the field",
        "Software design",
        "Research impact statement",
        "AI usage disclosure",
        "Acknowledgments",
        "References",
    ]
    assert len(text.split()) < 1750
    cited = set(re.findall(r"@([a-z]+\d*)", text.partition("# Summary")[2]))
    entries = set(re.findall(r"^@\w+\{(\w+),", read("paper/paper.bib"), re.MULTILINE))
    assert cited == entries


def test_placeholders_are_listed_in_one_place():
    page = read("docs/release.md")
    for name in ("paper/paper.md", "CODE_OF_CONDUCT.md", "recipe/recipe.yaml", "codemeta.json"):
        assert name in page
    assert len(page.split()) <= 650
