"""The descriptors against the command line, the tables of outputs, and the exit codes."""

import argparse
import fnmatch
import json
import shutil
import subprocess
import sys

import pytest
import yaml
from bosh_cases import ROOT, read_descriptor

from descriptors import (
    DESCRIPTORS,
    SHIPPED,
    describe,
    descriptor_text,
    groups_of,
    inputs_of,
    merge_inputs,
)
from hipsta_bids import __version__
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main
from hipsta_bids.cli.participant import REGIONS, build_parser
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    EXTRA_OUTPUTS,
    OUTPUTS,
    HemisphereName,
    group_report,
    output_name,
    participant_report,
)
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode

PARSERS = {"participant": build_parser, "group": group_parser}


def input_by_id(descriptor, key):
    return next(entry for entry in descriptor["inputs"] if entry["id"] == key)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_committed_descriptors_are_those_of_the_command_line(name):
    text = json.dumps(read_descriptor(name), indent=2, ensure_ascii=False) + "\n"
    assert text == descriptor_text(DESCRIPTORS[name]), (
        "the command line has changed: run tools/make-descriptors and commit descriptors/"
    )


def test_exec_spec_is_the_descriptor_of_both_levels(capsys):
    assert main(["--bids-exec-spec"]) == ExitCode.OK
    assert capsys.readouterr().out == descriptor_text()


def test_exec_spec_loads_nothing_heavy():
    script = (
        "import sys\nfrom hipsta_bids.cli.main import main\nmain(['--bids-exec-spec'])\n"
        "print(sorted(set(sys.modules) & {'bids', 'numpy', 'pandas', 'scipy'}), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.stderr == "[]\n"


@pytest.mark.parametrize("level", PARSERS)
def test_every_option_of_a_level_is_an_input(level):
    usage = PARSERS[level]().format_help()
    flags = {entry.get("command-line-flag") for entry in describe(level)["inputs"]} - {None}
    assert len(flags) > 10
    assert all(flag in usage for flag in flags)
    # Each line of the help that begins with options has one of them; two print and end.
    lines = [line.split() for line in usage.splitlines() if line.startswith("  -")]
    offered = [{word.rstrip(",") for word in words} for words in lines]
    without = [words for words in offered if not words & (flags | {"--help", "--version"})]
    assert not without
    both = {entry["id"] for entry in describe()["inputs"]}
    assert {entry["id"] for entry in describe(level)["inputs"]} <= both


def test_kinds_of_values():
    inputs = {entry["id"]: entry for entry in describe("participant")["inputs"]}
    assert inputs["n_procs"]["integer"]
    assert inputs["n_procs"]["minimum"] == 1
    assert (inputs["timeout"]["minimum"], inputs["timeout"]["exclusive-minimum"]) == (0, True)
    assert inputs["hemi"]["value-choices"] == ["L", "R"]
    assert inputs["region"]["value-choices"] == list(REGIONS)
    for key in ("freesurfer_dir", "ashs_dir", "hippunfold_dir", "derivatives", "bids_dir"):
        assert inputs[key]["type"] == "File"
    for key in ("output_dir", "work_dir", "bids_database_dir"):  # need not exist
        assert inputs[key]["type"] == "String"
    lists = {key for key, entry in inputs.items() if entry.get("list")}
    assert lists >= {"participant_label", "session_label", "hemi", "derivatives"}
    group = {entry["id"]: entry for entry in describe("group")["inputs"]}
    assert group["model"]["disables-inputs"] == ["formula", "contrast"]
    for key in ("derivatives", "covariates"):
        assert group[key]["type"] == "File"
        assert group[key]["list"]


def test_level_switches_inputs():
    level = input_by_id(describe(), "analysis_level")
    assert level["value-choices"] == list(PARSERS)
    for name, disabled in level["value-disables"].items():
        own = {entry["id"] for entry in describe(name)["inputs"]}
        assert own.isdisjoint(disabled)
        everything = {entry["id"] for entry in describe()["inputs"]}
        assert own | set(disabled) | {"analysis_level", "output_mount"} == everything


def test_descriptions_differ_by_level_where_they_do():
    both = describe()
    assert input_by_id(both, "seg")["description"].startswith("group: ")
    settings = input_by_id(both, "settings")["description"]
    assert settings.index("participant: ") < settings.index("group: ")


def test_one_option_with_two_meanings_is_a_mistake():
    one = argparse.ArgumentParser()
    one.add_argument("--x", type=int)
    two = argparse.ArgumentParser()
    two.add_argument("--x")
    with pytest.raises(ValueError, match="x: the levels give it different kinds"):
        merge_inputs({"a": inputs_of(one), "b": inputs_of(two)})


def test_options_that_exclude_each_other_are_a_group():
    parser = argparse.ArgumentParser()
    for required in (False, True):
        rivals = parser.add_mutually_exclusive_group(required=required)
        rivals.add_argument(f"--left-{required}", action="store_true")
        rivals.add_argument(f"--right-{required}", nargs=2)
    free, forced = groups_of(parser)
    assert free["members"] == ["left_False", "right_False"]
    assert free["mutually-exclusive"]
    assert "one-is-required" not in free
    assert forced["one-is-required"]
    pair = next(entry for entry in inputs_of(parser) if entry["id"] == "right_True")
    assert (pair["min-list-entries"], pair["max-list-entries"]) == (2, 2)


@pytest.mark.parametrize("level", [None, *PARSERS])
def test_each_input_is_in_at_most_one_section(level):
    groups = [group for group in describe(level)["groups"] if "mutually-exclusive" not in group]
    members = [name for group in groups for name in group["members"]]
    assert len(members) == len(set(members))
    options = {entry["id"] for entry in describe(level)["inputs"] if "command-line-flag" in entry}
    assert set(members) == options


def test_each_output_of_the_table_has_a_template():
    templates = [
        entry["path-template"].split("/")[-1] for entry in describe("participant")["output-files"]
    ]
    name = HemisphereName(subject="X", session=None, hemi="L", seg="P")
    shown = {"interior_surface", "exterior_surface"} | {f"{s}_unfold" for s in (
        "interior", "midthickness", "exterior")}  # fmt: skip
    for output in (*OUTPUTS, *EXTRA_OUTPUTS):
        if "hipsta-bids surrogate" in output.description or output.key.startswith("surrogate"):
            continue  # another command
        found = [t for t in templates if fnmatch.fnmatch(output_name(name, output.key, "m"), t)]
        # Sidecars and series lie beside their table, and other surfaces beside the middle one.
        beside = output.key.endswith(("_sidecar", "_series")) or output.key in shown
        assert found or beside, output.key
    whole = ("status", "settings", "description", "citation", "readme", "report")
    assert {DATASET_FILES[key] for key in whole} <= set(templates)


@pytest.mark.parametrize(
    ("level", "page"),
    [
        ("participant", DATASET_FILES["report"]),
        ("participant", participant_report("01", "a")),
        ("group", group_report("mine")),
    ],
)
def test_pages_are_outputs(level, page):
    outputs = describe(level)["output-files"]
    root = "[OUTPUT_DIR]/"
    found = [
        entry
        for entry in outputs
        if fnmatch.fnmatch(page, entry["path-template"].removeprefix(root))
        and entry["path-template"].endswith(".html")
    ]
    assert [entry["optional"] for entry in found] == [True]  # --no-reports


@pytest.mark.parametrize("level", [None, *PARSERS])
def test_descriptors_name_the_paper_the_published_image_and_the_code(level):
    local = describe(level)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert local["tool-doi"] in {entry["doi"] for entry in citation["references"]}
    assert local["container-image"]["image"] == f"hipsta_bids:{__version__}"
    assert "url" not in local  # nobody has said where it is
    names = {"image": "registry.example/lab/hipsta_bids:1.2", "url": "https://example.org/code"}
    published = describe(level, **names)
    assert published["container-image"]["image"] == names["image"]
    assert published["url"] == names["url"]
    same = local.keys() - {"container-image"}
    assert {key: published[key] for key in same} == {key: local[key] for key in same}


def test_published_descriptors_are_written_everywhere(tmp_path):
    for part in ("tools", "hipsta_bids"):
        ignored = shutil.ignore_patterns("__pycache__", "*.png")
        shutil.copytree(ROOT / part, tmp_path / part, ignore=ignored)
    image, url = "registry.example/lab/hipsta_bids:1.2", "https://example.org/code"
    script = [sys.executable, tmp_path / "tools" / "make-descriptors", "--image", image]
    subprocess.run([*script, "--url", url], check=True, capture_output=True)
    written = [*tmp_path.glob("descriptors/*.json"), tmp_path / SHIPPED]
    assert len(written) == len(DESCRIPTORS) + 1
    for path in written:
        content = json.loads(path.read_text(encoding="utf-8"))
        assert (content["container-image"]["image"], content["url"]) == (image, url)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_exit_codes(name):
    codes = {entry["code"]: entry["description"] for entry in read_descriptor(name)["error-codes"]}
    assert codes == {code: text for code, text in EXIT_MEANINGS.items() if code != ExitCode.OK}
    assert set(EXIT_MEANINGS) == set(ExitCode) | {130, 143}
