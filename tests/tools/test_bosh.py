"""What the real ``bosh`` makes of the descriptors: command lines, refusals, and runs."""

import json
import re
import shlex

import pytest
from bosh_cases import (
    bosh,
    descriptor_path,
    launch,
    outputs_found,
    outputs_missing,
    read_descriptor,
    simulate,
)
from extension_marks import PRESENT

from descriptors import DESCRIPTORS
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset

PARSERS = {"participant": build_parser, "group": group_parser}
SPEC = PhantomSpec(length=8.0, end_length=2.0)

#: What options such as FACTOR=LEVEL show in the help is what they accept.
FORMS = {
    action.dest: action.metavar
    for build in PARSERS.values()
    for action in build()._actions
    if isinstance(action.metavar, str) and re.fullmatch(r"\w+=\w+", action.metavar)
}

#: What is accepted for other strings of a form of their own.
SAMPLES = {
    "map": ["a=b c.nii", "d={subject}.nii"],
    "volumes": ["a={subject} b.txt"],
    "maps": ["a={subject}_{hemi}.gii"],
    "maps_surface": ["a={hemi}.gii"],
    "map_sampling": ["a=mid"],
    "map_interpolation": ["nearest"],
    "mem": "8G",
    "shard": "1/4",
    "power": "thinning=5%",
    "allocation": "2:1",
    "visits": "0,12,24",
    "contrast": ["group[NAME]-group[SEG]", "age"],
    "formula": "thickness ~ group * age",
    "exclude_qc": ["a > 1", "b < 2"],
}


def full_invocation(descriptor):
    """A value for every input but those that others make void."""
    void = {"model"}  # rather than those that it disables
    for group in descriptor["groups"]:
        if "mutually-exclusive" in group:
            void.update(group["members"][1:])
    inputs = descriptor["inputs"]
    return {entry["id"]: sample_of(entry) for entry in inputs if entry["id"] not in void}


def sample_of(entry):
    if entry["id"] in SAMPLES:
        return SAMPLES[entry["id"]]
    if "value-choices" in entry:
        value = entry["value-choices"][-1]
    else:
        text = FORMS.get(entry["id"], "x1")
        kinds = {"Flag": True, "Number": 1234, "File": f"some/{entry['id']} $1", "String": text}
        value = kinds[entry["type"]]
    return [value] * entry["min-list-entries"] if entry.get("list") else value


def display_name(level, given):
    """The command line as a user would write it, without quotes."""
    given = dict(given)
    words = [given.pop("bids_dir"), given.pop("output_dir"), level]
    for key, value in given.items():
        values = [] if value is True else value if isinstance(value, list) else [value]
        words += ["--" + key.replace("_", "-"), *map(str, values)]
    return words


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_descriptors_are_valid(name, tmp_path):
    done = bosh(tmp_path, "validate", descriptor_path(name))
    assert (done.returncode, done.stdout.strip()) == (0, "OK"), done.stderr


def test_descriptor_of_both_levels_is_one_of_a_bids_app(tmp_path):
    done = bosh(tmp_path, "validate", "--bids", descriptor_path("hipsta_bids"))
    assert done.returncode == 0, done.stderr
    assert "BIDS validation OK" in done.stdout


@pytest.mark.parametrize("level", PARSERS)
def test_minimal_command_lines(level, tmp_path):
    given = {"bids_dir": "my data", "output_dir": "out"}
    expected = f"hipsta-bids 'my data' out {level}"
    assert simulate(tmp_path, f"hipsta_bids_{level}", **given) == expected
    both = simulate(tmp_path, "hipsta_bids", **given, analysis_level=level)
    assert both == f"mkdir -p out; {expected}"


def test_usual_command_lines(tmp_path):
    participant = simulate(
        tmp_path,
        "hipsta_bids_participant",
        bids_dir="bids",
        output_dir="out",
        participant_label=["01", "sub-02"],
        session_label=["a"],
        freesurfer_dir="fs",
        derivatives=["one", "other set"],
        n_procs=2,
        force=True,
        verbose=False,
    )
    assert participant == (
        "hipsta-bids bids out participant --participant-label 01 sub-02 --session-label a"
        " --derivatives one 'other set' --freesurfer-dir fs --force --n-procs 2"
    )
    group = simulate(
        tmp_path,
        "hipsta_bids",
        bids_dir="bids",
        output_dir="out",
        output_mount="out",
        analysis_level="group",
        derivatives=["one", "other set"],
        formula="thickness ~ group",
        contrast=["group[NAME]-group[CN]", "age"],
        name="mine",
    )
    # The contrast has square brackets of its own, round a word that names an option.
    assert group == (
        "mkdir -p out; hipsta-bids bids out group --derivatives one 'other set'"
        " --formula 'thickness ~ group' --contrast 'group[NAME]-group[CN]' age --name mine"
    )


@pytest.mark.parametrize("level", PARSERS)
def test_full_command_lines_are_understood_as_they_were_meant(level, tmp_path):
    name = f"hipsta_bids_{level}"
    given = full_invocation(read_descriptor(name))
    parse = PARSERS[level]().parse_args
    meant = vars(parse(display_name(level, given)))
    defaults = vars(parse(["in", "out", level]))
    assert all(meant[key] != defaults[key] for key in given)
    command = simulate(tmp_path, name, **given)
    assert command.startswith("hipsta-bids ")
    assert vars(parse(shlex.split(command)[1:])) == meant
    both = simulate(tmp_path, "hipsta_bids", **given, analysis_level=level)
    first, _, second = both.partition("; hipsta-bids ")
    assert first == f"mkdir -p {given['output_dir']}"
    assert vars(parse(shlex.split(second))) == meant


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("hipsta_bids", {"analysis_level": "session"}),
        ("hipsta_bids", {}),
        ("hipsta_bids", {"analysis_level": "group", "output_dir": None, "output_mount": "out"}),
        ("hipsta_bids_participant", {"n_procs": 0}),
        ("hipsta_bids_participant", {"n_procs": 1.5}),
        ("hipsta_bids_participant", {"timeout": 0}),
        ("hipsta_bids_participant", {"timeout": "long"}),
        ("hipsta_bids_participant", {"hemi": ["M"]}),
        ("hipsta_bids_participant", {"participant_label": []}),
        ("hipsta_bids_participant", {"seg": "a"}),
        ("hipsta_bids_group", {"model": "m.json", "formula": "thickness ~ age"}),
        ("hipsta_bids_group", {"align": "rigid"}),
    ],
)
def test_wrong_values_are_refused(name, wrong, tmp_path):
    given = {"bids_dir": "bids", "output_dir": "out"} | wrong
    given = {key: value for key, value in given.items() if value is not None}
    assert simulate(tmp_path, name, **given) is None


@pytest.mark.parametrize("level", PARSERS)
def test_missing_folder_is_reported_with_the_meaning_of_its_code(level, tmp_path):
    done = launch(tmp_path, f"hipsta_bids_{level}", bids_dir="nowhere", output_dir="out")
    assert f"Exit code\n{int(ExitCode.BAD_DATA)}\n" in done.stdout
    assert EXIT_MEANINGS[ExitCode.BAD_DATA] in done.stdout
    assert outputs_found(done) == set()
    # At the participant level there is an option without each output, --dry-run.
    assert ("output_dataset" in outputs_missing(done)) == (level == "group")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """One hemisphere in FreeSurfer's layout, in a folder of its own beside the BIDS dataset."""
    root = tmp_path_factory.mktemp("with blank")
    write_dataset(root / "made", [Hemisphere(subject="01", hemi="L", spec=SPEC)])
    (root / "made" / "derivatives" / "freesurfer").rename(root / "subjects dir")
    (root / "bids").mkdir()
    (root / "bids" / "dataset_description.json").write_text(
        json.dumps({"Name": "test", "BIDSVersion": "1.9.0"}), encoding="utf-8"
    )
    return root


def test_participant_level_leaves_all_outputs(dataset):
    labels = dataset / "subjects dir" / "sub-{subject}" / "mri" / "lh.hippoAmygLabels-T1.v22.mgz"
    (dataset / "roi.tsv").write_text("x\ty\tregion\n3\t3\tmine\n4\t3\tmine\n", encoding="utf-8")
    done = launch(
        dataset,
        "hipsta_bids_participant",
        bids_dir="bids",
        output_dir="out put",
        freesurfer_dir="subjects dir",
        **(
            {"map": [f"codes={labels}"], "map_interpolation": ["codes=nearest"], "roi": "roi.tsv"}
            if "signals" in PRESENT
            else {}
        ),
        write_meshes=True,
        **({"uncertainty": 2} if "uncertainty" in PRESENT else {}),
        n_procs=1,
    )
    assert "Exit code\n0\n" in done.stdout, done.stdout
    listed = {entry["id"] for entry in read_descriptor("hipsta_bids_participant")["output-files"]}
    assert outputs_found(done) == {key for key in listed if not key.endswith("_of_sessions")}
    assert outputs_missing(done) == ""


def test_pages_need_not_be_there():
    """With ``--no-reports`` none is made."""
    outputs = read_descriptor("hipsta_bids_participant")["output-files"]
    pages = [entry for entry in outputs if entry["id"].startswith("output_page")]
    assert pages
    assert all(entry["optional"] for entry in pages)


@pytest.mark.parametrize(
    ("descriptor", "options", "found"),
    [
        ("hipsta_bids_participant", {"shard": "2/2"}, set()),  # of one subject
        ("hipsta_bids", {"dry_run": True, "analysis_level": "participant"}, {"output_dataset"}),
    ],
)
def test_runs_that_leave_no_results_lack_nothing(dataset, tmp_path, descriptor, options, found):
    folders = {"bids_dir": "bids", "output_dir": tmp_path.name, "freesurfer_dir": "subjects dir"}
    done = launch(dataset, descriptor, **folders, **options)
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert (outputs_found(done), outputs_missing(done)) == (found, "")


@pytest.mark.long
def test_participant_level_by_the_descriptor_of_both_with_sessions(dataset):
    (dataset / "subjects dir" / "sub-01").rename(dataset / "subjects dir" / "sub-01_ses-1")
    try:
        done = launch(
            dataset,
            "hipsta_bids",
            bids_dir="bids",
            output_dir="new/out",
            analysis_level="participant",
            derivatives=["subjects dir"],
        )
    finally:
        (dataset / "subjects dir" / "sub-01_ses-1").rename(dataset / "subjects dir" / "sub-01")
    assert "Exit code\n0\n" in done.stdout, done.stdout
    assert outputs_found(done) == {"output_dataset"}
    outputs = read_descriptor("hipsta_bids_participant")["output-files"]
    templates = [
        entry["path-template"].replace("[OUTPUT_DIR]", "new/out")
        for entry in outputs
        if entry["id"].endswith("_of_sessions")
        and not re.search(r"\((write_meshes|map|roi|uncertainty)\)", entry["description"])
    ]
    assert len(templates) == 9
    assert all(list(dataset.glob(template)) for template in templates)


@pytest.mark.long
def test_tests_in_the_descriptor_pass(dataset):
    """``bosh test`` takes containers only, so the descriptor goes without its image."""
    descriptor = read_descriptor("hipsta_bids_participant")
    del descriptor["container-image"]
    folder = dataset / "tests"
    write_dataset(folder / "demo" / "bids", [Hemisphere(subject="01", hemi="R", spec=SPEC)])
    path = folder / "descriptor.json"
    path.write_text(json.dumps(descriptor), encoding="utf-8")
    done = bosh(folder, "test", path)
    assert done.returncode == 0, done.stdout
    assert f"{len(descriptor['tests'])} passed" in done.stdout
