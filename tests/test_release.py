"""Files of a release: one version, one list of dependencies, and places for persons to decide."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

import hipsta_bids

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


def test_the_recipe_has_the_dependencies_of_the_package():
    recipe = yaml.safe_load(read("recipe/recipe.yaml"))
    assert recipe["context"]["version"] == hipsta_bids.__version__
    project = tomllib.loads(read("pyproject.toml"))["project"]
    requirements = [Requirement(text) for text in project["dependencies"]]
    expected = {f"{CONDA.get(one.name, one.name)} {one.specifier}" for one in requirements}
    run = set(recipe["requirements"]["run"])
    assert run - {"python >=${{ python_min }}"} == expected
    assert project["requires-python"] == f">={recipe['context']['python_min']}"


def test_the_definition_for_apptainer_converts_this_image():
    text = read("descriptors/hipsta_bids.def")
    assert f"From: hipsta_bids:{hipsta_bids.__version__}" in text


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
    assert len(page.split()) <= 400
