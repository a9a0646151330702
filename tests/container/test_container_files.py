"""What keeps container, workflows and project together; none of it needs Docker."""

import re
import shutil
import subprocess
import tomllib

import pytest
import yaml
from container_runs import ROOT

from hipsta_bids import __version__
from hipsta_bids.derivatives.dataset import CODE_URL_VARIABLE, CONTAINER_VARIABLES

DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = {
    path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))
    for path in (ROOT / ".github" / "workflows").glob("*.yml")
}
#: The default base is an official image of this Python.
BASE_PYTHON = re.findall(r"^ARG BASE_IMAGE=python:(3\.\d+)-slim\b", DOCKERFILE, re.MULTILINE)[0]


def steps(workflow):
    return [step for job in WORKFLOWS[workflow]["jobs"].values() for step in job.get("steps", [])]


def test_labels_are_those_of_the_project():
    labels = dict(re.findall(r"org\.opencontainers\.image\.(\w+)=\"([^\"$]+)\"", DOCKERFILE))
    assert labels == {
        "title": PROJECT["name"],
        "description": PROJECT["description"],
        "version": __version__,
        "authors": PROJECT["authors"][0]["name"],
        "licenses": PROJECT["license"],
    }


def test_datasets_name_the_image_and_its_code():
    last = DOCKERFILE.rpartition("FROM ")[2]
    given = dict(re.findall(r"\b(HIPSTA_BIDS_\w+)=(\S+)", last))
    assert given == {
        CONTAINER_VARIABLES["Type"]: "docker",
        CONTAINER_VARIABLES["Tag"]: f"hipsta_bids:{__version__}",
        CODE_URL_VARIABLE: "${CODE_URL}",
    }
    build = next(s for s in steps("release") if "BUILD_OPTIONS" in s.get("env", {}))
    assert "--build-arg CODE_URL=" in build["env"]["BUILD_OPTIONS"]


def test_both_stages_have_the_same_base():
    stages = re.findall(r"^FROM (\S+)(?: AS (\w+))?$", DOCKERFILE, re.MULTILINE)
    assert stages == [("${BASE_IMAGE}", "build"), ("${BASE_IMAGE}", "")]


def test_only_what_the_package_is_made_of_goes_to_the_build():
    rules = [
        line
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    ]
    assert rules[0] == "*"  # nothing at all, but for
    allowed = {rule[1:] for rule in rules if rule.startswith("!")}
    copied = set(re.search(r"^COPY (.+) \./$", DOCKERFILE, re.MULTILINE)[1].split())
    made_of = {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], PROJECT["name"]}
    assert allowed == made_of | copied
    assert all((ROOT / name).exists() for name in allowed)


def test_build_tools_come_from_the_lock():
    """The image's only package without a wheel is built by a setuptools with hashes."""
    script = re.search(r"sed -n '([^']+)' (\S+) > build\.lock", DOCKERFILE)
    sed = shutil.which("sed")
    done = subprocess.run(
        [sed, "-n", script[1], ROOT / script[2]], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert re.fullmatch(r"setuptools==[\d.]+ \\", lines[0])
    assert sum(line.strip().startswith("--hash=sha256:") for line in lines) >= 1
    assert not any("==" in line for line in lines[1:])


def test_workflows_test_the_pythons_that_the_package_names():
    prefix = "Programming Language :: Python :: 3."
    named = [name.removeprefix(prefix) for name in PROJECT["classifiers"] if prefix in name]
    tested = WORKFLOWS["test"]["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tested == [f"3.{minor}" for minor in named]
    assert PROJECT["requires-python"] == f">={tested[0]}"
    assert BASE_PYTHON in tested


@pytest.mark.parametrize("workflow", ["container", "release"])
def test_images_are_compared_with_their_own_python(workflow):
    """Results are promised to be equal to the last byte for one version of Python only."""
    pythons = {step["with"]["python-version"] for step in steps(workflow) if "with" in step
               if "python-version" in step["with"]}  # fmt: skip
    assert pythons == {BASE_PYTHON}


def test_workflows_call_what_there_is():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    commands = [step["run"] for name in WORKFLOWS for step in steps(name) if "run" in step]
    targets = {match for text in commands for match in re.findall(r"^make (\w+)", text)}
    tools = {match for text in commands for match in re.findall(r"^tools/\S+", text)}
    assert targets == {"test", "env"}
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    assert tools == {"tools/test-container"}
    assert all((ROOT / tool).stat().st_mode & 0o100 for tool in tools)


def test_a_release_waits_for_the_tests():
    jobs = WORKFLOWS["release"]["jobs"]
    waits = {name: job.get("needs", []) for name, job in jobs.items()}
    needs = {name: [need] if isinstance(need, str) else need for name, need in waits.items()}
    assert jobs["test"]["uses"] == "./.github/workflows/test.yml"
    assert "workflow_call" in WORKFLOWS["test"][True]  # YAML 1.1 takes the key "on" for a boolean
    assert {"test", "package"} <= set(needs["container"])
    assert needs["publish"] == ["container"]
    assert needs["page"] == ["publish"]
