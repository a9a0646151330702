import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
from extension_marks import PRESENT, needs
from stand_ins import make_input, stand_in_jobs

from hipsta_bids import __version__
from hipsta_bids.cli import main
from hipsta_bids.cli.commands import (
    phantom_parser,
)
from hipsta_bids.cli.main import EPILOG
from hipsta_bids.cli.parser import help_texts
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.errors import ExitCode, NothingToDoError
from hipsta_bids.inputs import search
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import Findings
from hipsta_bids.joints import find_extensions, load
from hipsta_bids.participant import run as runner
from hipsta_bids.participant.run import RunOptions
from hipsta_bids.settings import Settings, load_settings

HEAVY = (
    *("bids", "hipsta_bids.participant.run", "nibabel", "numpy", "pandas", "pydantic", "scipy"),
    "tqdm",
)


def python(*arguments, **options):
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, **options
    )


def opening(folder):
    return f"hipsta_bids {__version__}, participant level of {folder}"


@pytest.fixture
def seen(monkeypatch, tmp_path):
    """What the command line hands on; nothing is searched for or measured."""
    record = {}

    def find(request):
        record["request"] = request
        return Findings(items=(make_input(tmp_path / "in"),))

    def run(items, out, settings, options, report):
        record.update(items=items, out=out, settings=settings, options=options, report=report)
        return runner.RunResult(outcomes=(), n_requested=0, log=out / "log")

    monkeypatch.setattr(search, "find_inputs", find)
    monkeypatch.setattr(search, "dataset_notes", lambda *_: ())
    monkeypatch.setattr(runner, "run_participants", run)
    return record


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_loads_nothing_heavy(option):
    script = (
        "import sys\nfrom hipsta_bids.cli.main import main\n"
        f"try:\n    main(['{option}'])\n"
        "except SystemExit as end:\n    assert end.code == 0\n"
        f"print(sorted(set(sys.modules) & set({HEAVY!r})), file=sys.stderr)"
    )
    done = python("-c", script)
    assert done.stderr == "[]\n"
    assert ("usage: hipsta-bids" if option == "--help" else __version__) in done.stdout


def test_help_documents_every_exit_code():
    documented = {line.split()[0] for line in EPILOG.split("exit codes:")[1].splitlines() if line}
    assert {str(int(code)) for code in ExitCode} <= documented


def test_installed_command_runs():
    command = Path(sys.executable).with_name("hipsta-bids")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"hipsta_bids {__version__}\n")


def test_the_package_is_a_command():
    done = python("-m", "hipsta_bids.cli", "--version")
    assert (done.returncode, done.stdout) == (0, f"hipsta_bids {__version__}\n")


@pytest.mark.parametrize("command", sorted(main.COMMANDS))
def test_every_command_has_help_and_is_loaded_by_its_name(command, capsys):
    with pytest.raises(SystemExit) as end:
        main.main([command, "--help"])
    assert end.value.code == 0
    assert "usage: hipsta-bids" in capsys.readouterr().out
    assert f"hipsta-bids {command}" in EPILOG


@pytest.mark.parametrize("level", [["participant"], ["group"]])
def test_help_begins_with_what_a_first_run_needs(level, capsys):
    texts = []
    for more in ([], ["all"]):
        with pytest.raises(SystemExit) as end:
            main.main(["in", "out", *level, "--help", *more])
        assert end.value.code == 0
        texts.append(capsys.readouterr().out)
    short, whole = (re.findall(r"^  (-\S.*?)(?:  |$)", text, re.MULTILINE) for text in texts)
    assert 8 <= len(short) <= 14 < len(whole)
    assert set(short) < set(whole)
    assert f"{len(whole) - len(short)} more options" in texts[0]
    assert "--help all" in texts[0]


def test_help_of_the_group_level(capsys):
    for arguments in (["group", "--help"], ["in", "out", "group", "--help"]):
        with pytest.raises(SystemExit) as end:
            main.main(arguments)
        assert end.value.code == 0
        assert "--formula" in capsys.readouterr().out


@pytest.mark.usefixtures("seen")
def test_options_without_meaning_are_noted(tmp_path, capsys):
    options = "--omp-nthreads 4 --low-mem --notrack --clean-workdir --fs-license-file l.txt"
    assert main.main(["in", str(tmp_path), "participant", *options.split()]) == 0
    said = capsys.readouterr().out
    for name in (word for word in options.split() if word.startswith("--")):
        assert f"note: {name} has no effect: " in said
    assert main.main(["in", str(tmp_path), "participant"]) == 0
    assert "has no effect" not in capsys.readouterr().out


def test_the_group_level_accepts_them_too(tmp_path, capsys):
    options = ["--omp-nthreads", "4", "--low-mem", "--skip-bids-validation"]
    assert main.main([str(tmp_path), str(tmp_path), "group", *options]) == 66
    said = capsys.readouterr().out
    for name in ("--omp-nthreads", "--low-mem", "--skip-bids-validation"):
        assert f"note: {name} has no effect: " in said


@pytest.mark.usefixtures("seen")
def test_quiet(tmp_path, capsys):
    assert main.main(["in", str(tmp_path), "participant", "--quiet", "--notrack"]) == 0
    assert capsys.readouterr() == ("", "")


def test_defaults(seen, tmp_path):
    assert main.main(["in", str(tmp_path), "participant"]) == 0
    request = InputRequest(bids_dir=Path("in"), output_dir=tmp_path, probabilities="auto")
    assert seen["request"] == request
    assert seen["settings"] == Settings()
    n_procs = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    command = f"hipsta-bids in {tmp_path} participant"
    assert [row["status"] for row in seen["options"].inputs] == ["used", "not used"]
    assert replace(seen["options"], inputs=()) == RunOptions(
        n_procs=n_procs, reports=True, bids_dir=Path("in"), command=command
    )
    assert seen["out"] == tmp_path


def test_everything_reaches_its_place(seen, tmp_path):
    settings = tmp_path / "s.toml"
    settings.write_text('[body]\nlayer_rule = "nearest-label"\n')
    text = (
        f"in {tmp_path}/out participant --participant-label sub-01 02 --session-label ses-a b"
        " --hemi r"
        " -d one=x -d two=y z --freesurfer-dir f --ashs-dir a --hippunfold-dir h --fs-analysis T1"
        " --ashs-atlas ashsPMC --scheme s.toml --edited-dir e --bids-filter-file j"
        f" --bids-database-dir db --skip-bids-validation --settings {tmp_path}/s.toml"
        " --write-meshes"
        f" --force --n-procs 3 --mem 4G --timeout 9 -w {tmp_path}/work --stop-on-first-crash -vv"
        " --no-reports --no-anatomy --probabilities p"
    )
    assert main.main(text.split()) == 0
    assert seen["request"] == InputRequest(
        bids_dir=Path("in"),
        probabilities=Path("p"),
        derivatives={"one": Path("x"), "two": Path("y"), "z": Path("z")},
        freesurfer_dir=Path("f"),
        ashs_dir=Path("a"),
        hippunfold_dir=Path("h"),
        participant_labels=("01", "02"),
        session_labels=("a", "b"),
        hemis=("R",),
        fs_analysis="T1",
        ashs_atlas="ashsPMC",
        protocol=Path("s.toml"),
        edited_dir=Path("e"),
        output_dir=tmp_path / "out",
        bids_filter_file=Path("j"),
        bids_database_dir=Path("db"),
    )
    assert replace(seen["options"], inputs=()) == RunOptions(
        is_whole=False,
        bids_dir=Path("in"),
        anatomy=False,
        pybids=True,
        n_procs=3,
        mem_gb=4.0,
        work_dir=tmp_path / "work",
        stop_on_first_crash=True,
        verbosity=2,
        force=True,
        write_meshes=True,
        timeout=9.0,
        command=f"hipsta-bids {text}",
    )
    assert seen["settings"] == load_settings(settings)
    assert (tmp_path / "work").is_dir()


@pytest.mark.parametrize(
    ("alias", "field", "value"),
    [
        ("--participant_label 01", "participant_label", ["01"]),
        ("--session_label 01", "session_label", ["01"]),
        ("--nprocs 5", "n_procs", 5),
        ("--n_procs 5", "n_procs", 5),
        ("--n-cpus 5", "n_procs", 5),
        ("--mem_mb 8000", "mem", 8.0),
        ("--mem 8000", "mem", 8.0),
        ("--mem 8GB", "mem", 8.0),
        ("--work-dir w", "work_dir", Path("w")),
        ("--fs-subjects-dir f", "freesurfer_dir", Path("f")),
        ("--stop_on_first_crash", "stop_on_first_crash", True),
        ("--skip_bids_validation", "skip_bids_validation", True),
        ("--nthreads 3", "n_procs", 3),
        ("--config-file c.toml", "settings", Path("c.toml")),
        ("-q", "quiet", True),
        ("--exclude_participant_label 01", "exclude_participant_label", ["01"]),
        ("--edited_dir e", "edited_dir", Path("e")),
        ("--bids_filter_file j", "bids_filter_file", Path("j")),
        ("--protocol p_1.toml", "scheme", Path("p_1.toml")),
        ("--work_dir=a_b", "work_dir", Path("a_b")),
        ("--participant-label 01 --participant_label 02", "participant_label", ["01", "02"]),
    ],
)
def test_spellings_of_other_bids_apps(alias, field, value):
    options = build_parser().parse_args(["in", "out", "participant", *alias.split()])
    assert getattr(options, field) == value


_ABOUT = {"description", "epilog"}


@pytest.mark.parametrize(
    ("command", "make"),
    [
        ("participant", build_parser),
        ("phantom", phantom_parser),
    ],
)
def test_the_texts_of_the_help_have_no_leftovers(command, make):
    actions = make()._actions
    names = {(action.option_strings or [action.dest])[0]: action.help for action in actions}
    texts = {k: text for k, text in help_texts()[command].items() if k not in _ABOUT}
    assert names.keys() >= texts.keys()
    # The help of the regions goes on with regions of extensions.
    assert all(names[name].startswith(text) for name, text in texts.items())


@pytest.mark.parametrize("name", sorted(PRESENT))
def test_the_texts_of_the_help_of_extensions_have_no_leftovers(name):
    extension = next(one for one in find_extensions() if one.package.endswith(f".{name}"))
    for command in extension.commands:
        actions = load(command.parser)()._actions
        names = {(action.option_strings or [action.dest])[0] for action in actions}
        absent = set() if "norms" in PRESENT else {"--norms"}
        assert help_texts(extension.package)[command.name].keys() - _ABOUT - absent <= names


def test_options_without_meaning_are_remembered_with_the_reason():
    given = ["--omp-nthreads", "4", "--notrack", "--notrack"]
    options = build_parser().parse_args(["in", "out", "participant", *given])
    assert dict(options.ignored) == {
        "--omp-nthreads": "each hemisphere uses one processor; --n-procs sets how many at a time",
        "--notrack": "nothing is tracked",
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "required: bids_dir, output_dir, analysis_level"),
        ("in out", "required: analysis_level"),
        ("in out cohort", "'cohort' does not exist; there are participant, collect and group"),
        ("in out participant --hemi X", "'X' is not a hemisphere; use L or R"),
        ("in out participant --n-procs 0", "'0' is not a whole number above 0"),
        ("in out participant --timeout -1", "'-1' is not a number above 0"),
        ("in out participant --timeout nan", "'nan' is not a number above 0"),
        ("in out participant --mem much", "'much' is not a size; write 8000 (MB) or 8G"),
        ("in out participant --mem 8", "8 MB is less than one hemisphere may need"),
        ("in out participant --participant-label a_b", "'a_b' is not a BIDS label"),
        ("in out participant -d a= ", "'a=' is not of the form NAME=PATH"),
        ("in out participant -d a=x a=y", "a name occurs twice"),
        ("in out participant --forc", "unrecognized arguments: --forc; did you mean --force?"),
        ("in out participant --particpant-label 1", "did you mean --participant-label?"),
        ("in out group --formla x", "did you mean --formula?"),
        ("in in participant", "the output folder is the BIDS dataset itself"),
        ("in out participant --settings none.toml", "settings cannot be read"),
        ("protocols x", "unrecognized arguments: x (see hipsta-bids protocols --help)"),
        ("settings x", "argument level: invalid choice: 'x'"),
        ("demo", "the following arguments are required: DIR"),
        ("demo-data a b", "unrecognized arguments: b"),
        ("in out group --formula thickness ~ group", "put the text of --formula and of each"),
        (
            "group --seg A B in out",
            "group: the folders precede the level; write hipsta-bids BIDS_DIR OUT_DIR group --seg",
        ),
        ("participant in out --hemi=L", "BIDS_DIR OUT_DIR participant --hemi\n"),
        ("collect in out", "write hipsta-bids BIDS_DIR OUT_DIR collect"),
        (
            "--seg A B in out group",
            "--seg: its values are A B in out group; write --seg after bids_dir, output_dir, anal",
        ),
        ("in --seg A out group", "values are A out group; write --seg after output_dir, anal"),
        (
            "--hemi L --participant-label 1 2 3 in out participant",
            "--participant-label: its values are ... 2 3 in out participant; write",
        ),
        ("in out --participant_label 01 participant", "--participant-label after analysis_level"),
        pytest.param(
            "export --participant-label 01 out dir",
            "write --participant-label after OUT_DIR, DIR",
            marks=needs("export"),
        ),
        ("figure --measures thickness group out -o a.pdf", "write --measures after what, OUT_DIR"),
        ("figure group out --measures thickness", "are required: -o/--output"),
    ],
)
@pytest.mark.usefixtures("seen")
def test_wrong_use_gets_one_line(arguments, message, capsys):
    assert main.main(arguments.split()) == ExitCode.USAGE
    said = capsys.readouterr()
    # What needs heavy libraries to be told from right use may come after the opening line.
    assert said.out in {"", f"{opening('in')}\n"}
    assert said.err.startswith("hipsta-bids: ")
    assert message in said.err
    assert said.err.count("\n") == 1


@pytest.mark.usefixtures("seen")
def test_output_into_the_segmentations_is_refused(tmp_path, capsys):
    assert main.main(["x", str(tmp_path / "in"), "participant"]) == ExitCode.USAGE
    assert "holds the segmentations" in capsys.readouterr().err


def test_datasets_named_like_commands_are_datasets(seen, tmp_path):
    assert main.main(["demo", str(tmp_path), "participant"]) == 0
    assert seen["request"].bids_dir == Path("demo")


def test_datasets_named_like_levels_are_datasets(seen, tmp_path):
    assert main.main(["group", str(tmp_path), "participant"]) == 0
    assert seen["request"].bids_dir == Path("group")


def test_options_with_several_values_may_precede_other_options(seen, tmp_path):
    assert main.main(["--hemi", "L", "--", "in", str(tmp_path), "participant"]) == 0
    assert seen["request"].hemis == ("L",)
    assert main.main(["--hemi", "R", "--force", "in", str(tmp_path), "participant"]) == 0
    assert seen["request"].hemis == ("R",)


def test_dry_run_prints_and_writes_nothing(seen, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.main(["x", str(out), "participant", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "sub-01_L.txt" in said
    assert "it is the only one" in said
    assert not out.exists()
    assert "options" not in seen


def test_nothing_to_do(seen, monkeypatch, tmp_path, capsys):
    def find(_):
        raise NothingToDoError("nothing found in x; look")

    monkeypatch.setattr(search, "find_inputs", find)
    assert main.main(["x", str(tmp_path / "out"), "participant"]) == ExitCode.NOTHING_TO_DO
    assert capsys.readouterr().err == "hipsta-bids: nothing found in x; look\n"
    assert not (tmp_path / "out").exists()
    assert seen == {}


def test_bugs_show_their_traceback(monkeypatch, tmp_path, capsys):
    def find(_):
        raise ZeroDivisionError("tests divide by zero")

    monkeypatch.setattr(search, "find_inputs", find)
    assert main.main(["x", str(tmp_path), "participant"]) == ExitCode.INTERNAL
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "ZeroDivisionError: tests divide by zero" in said


@pytest.fixture
def stand_in_run(monkeypatch, tmp_path):
    """A whole run with stand-ins for the search and the measurement."""
    acts = {"01": "ok", "02": "bad-shape", "03": "flagged", "04": "bug"}
    items = [make_input(tmp_path / "in", subject, act=act) for subject, act in acts.items()]
    monkeypatch.setattr(search, "find_inputs", lambda _: Findings(items=tuple(items)))
    monkeypatch.setattr(search, "dataset_notes", lambda *_: ("no description",))
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(
        runner, "run_jobs", lambda _, jobs: ((job, stand_in_jobs(job)) for job in jobs)
    )
    return ["x", str(tmp_path / "out"), "participant"]


def test_run_says_what_happened(stand_in_run, tmp_path, capsys):
    assert main.main(stand_in_run) == ExitCode.INTERNAL
    said = capsys.readouterr()
    start, *lines = said.out.splitlines()
    assert start == opening(stand_in_run[0])
    assert lines[0] == "note: no description"
    assert lines.pop(1) == "inputs: 4 used, 0 failed, 4 not used, 0 not a segmentation"
    assert lines[1].startswith("sub-01_hemi-L_seg-demo  use  mean thickness 1.500 mm (by area)  ")
    assert lines[2].startswith("sub-03_hemi-L_seg-demo  look  mean thickness 1.500 mm")
    assert lines[2].endswith("[odd-shape] look at it")
    assert lines[3] == "4 hemispheres: 2 failed, 1 look, 1 use"
    assert lines[4] == f"maps: {tmp_path / 'out'}"
    assert lines[5] == f"table of all hemispheres: {tmp_path / 'out' / 'measures.tsv'}"
    assert lines[6].startswith(f"log: {tmp_path / 'out' / 'logs'}")
    errors = said.err.splitlines()
    assert len(errors) == 2
    assert errors[0].endswith("[body-too-short] body is 2 mm long; too short")
    assert "[internal-error] internal error (ZeroDivisionError: tests divide by zero)" in errors[1]


@pytest.mark.parametrize("level", ["participant", "group"])
@pytest.mark.usefixtures("seen")
def test_without_a_folder_for_temporary_files_nothing_begins(level, tmp_path, monkeypatch, capsys):
    def none():
        raise FileNotFoundError

    monkeypatch.setattr(tempfile, "gettempdir", none)
    assert main.main(["in", str(tmp_path / "out"), level]) == ExitCode.NOT_WRITABLE
    said = capsys.readouterr()
    assert said.err.startswith("hipsta-bids: no folder for temporary files can be written")
    assert said.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_opening_line_waits_for_no_library(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "hipsta_bids.inputs.search", None)  # takes longest to load
    assert main.main(["in", "out", "participant"]) == ExitCode.INTERNAL
    assert capsys.readouterr().out == f"{opening('in')}\n"


def test_second_run_says_that_it_skipped(stand_in_run, capsys):
    main.main(stand_in_run)
    capsys.readouterr()
    main.main([*stand_in_run, "-v"])
    said = capsys.readouterr()
    assert "sub-01_hemi-L_seg-demo  use  unchanged, skipped" in said.out
    assert "4 hemispheres: 2 failed, 1 look, 1 use (2 unchanged, skipped)" in said.out
    assert "Traceback" in said.err  # of the bug, since -v asks for more


def test_terminal_gets_a_bar(stand_in_run, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    main.main(stand_in_run)
    said = capsys.readouterr()
    assert "| 0/4 [" in said.err  # later counts come at most ten times a second
    assert "sub-01_hemi-L_seg-demo  use" in said.out


def test_settings_print_as_toml(capsys, tmp_path):
    assert main.main(["settings"]) == 0
    path = tmp_path / "s.toml"
    path.write_text(capsys.readouterr().out)
    assert load_settings(path) == Settings()


def test_protocols_are_listed(capsys):
    assert main.main(["protocols"]) == 0
    said = capsys.readouterr().out
    assert "freesurferCA" in said
    assert "ashsUtrecht7T" in said


def test_reader_that_goes_away_is_no_bug(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nfrom hipsta_bids.cli.main import main\n"
        "sys.stdin.readline()\nsys.exit(main(['protocols']))"
    )
    reading, writing = os.pipe()
    with subprocess.Popen(
        [sys.executable, script],
        stdin=subprocess.PIPE,
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        os.close(writing)
        os.close(reading)
        _, errors = process.communicate("go\n", timeout=20)
    assert errors == ""
    assert process.returncode == 128 + 13  # SIGPIPE


def test_demo_data_spares_other_folders(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("x")
    assert main.main(["demo-data", str(tmp_path)]) == ExitCode.USAGE
    assert "something other than a demo dataset" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    assert main.main(["demo-data", str(tmp_path / "mine.txt")]) == ExitCode.NOT_WRITABLE


def test_demo_data_is_written_twice_the_same(tmp_path, capsys):
    folder = tmp_path / "bids"
    assert main.main(["demo-data", str(folder)]) == 0
    assert str(folder) in capsys.readouterr().out
    assert (folder / "phantom_truth.tsv").exists()
    assert json.loads((folder / "dataset_description.json").read_text())["Name"]
    assert main.main(["demo-data", str(folder)]) == 0
