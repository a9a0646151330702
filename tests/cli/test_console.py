"""What a terminal gets: colors, tables of its width, time of stages; and what a pipe gets."""

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from hipsta_bids.cli.console import Progress, echo, echo_table, warn_if_lost
from hipsta_bids.cli.main import main
from hipsta_bids.progress import each, listening, tell

RED = "\x1b[1;31mhipsta-bids:\x1b[0m"
ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if name not in {"NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES"}
} | {"TERM": "xterm"}


def on_terminal(*arguments, columns=80, **environment):
    """Run the command on a terminal of a width, and return what that shows."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with subprocess.Popen(
        [sys.executable, "-m", "hipsta_bids.cli", *arguments],
        stdin=its,
        stdout=its,
        stderr=its,
        env=ENVIRONMENT | environment,
    ):
        os.close(its)
        shown = b""
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # Linux says so that nobody writes any more
                break
            if not part:
                break
            shown += part
    os.close(ours)
    return shown.decode()


def through_pipe(*arguments, **environment):
    command = [sys.executable, "-m", "hipsta_bids.cli", *arguments]
    environment = ENVIRONMENT | environment
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.mark.parametrize(
    ("environment", "colored"),
    [
        ({}, True),
        ({"NO_COLOR": "1"}, False),
        ({"NO_COLOR": "1", "FORCE_COLOR": "1"}, False),
        ({"NO_COLOR": ""}, True),
        ({"TERM": "dumb"}, False),
        ({"TERM": "dumb", "FORCE_COLOR": "1"}, True),
    ],
)
def test_a_terminal_gets_colors_unless_it_is_told_otherwise(environment, colored):
    shown = on_terminal("demo", **environment)
    assert "required: DIR" in shown
    assert (RED in shown) is colored
    assert ("\x1b" in shown) is colored


@pytest.mark.parametrize(("environment", "colored"), [({}, False), ({"FORCE_COLOR": "1"}, True)])
def test_a_pipe_gets_colors_only_if_it_is_told(environment, colored):
    assert (RED in through_pipe("demo", **environment).stderr) is colored


def test_names_of_files_do_not_reach_into_the_terminal(capsys):
    echo("label \x1b]0;title\x07 \x9b2J\u00e4\u6d77\tof a name")
    assert capsys.readouterr().out == "label \ufffd]0;title\ufffd \ufffd2J\u00e4\u6d77\tof a name\n"


def test_tables_fit_the_terminal_and_are_whole_in_a_pipe():
    whole = through_pipe("protocols").stdout
    assert max(map(len, whole.splitlines())) > 300
    for columns in (220, 60):
        shown = on_terminal("protocols", columns=columns)
        assert max(map(len, shown.splitlines())) <= columns
        # The same words, wherever lines are broken.
        assert set(shown.replace(":", "").split()) >= set(whole.replace(":", "").split())


def test_long_paths_lose_their_middle_on_a_terminal(monkeypatch, capsys):
    path = "sub-01/ses-first/mri/lh.hippoAmygLabels-T1.v22.mgz"
    rows = [{"subject": "01", "file": path, "why": "it is the only one that was found there"}]
    monkeypatch.setenv("COLUMNS", "60")
    echo_table(rows)
    assert path in capsys.readouterr().out
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("NO_COLOR", "1")
    echo_table(rows)
    heading, *lines = capsys.readouterr().out.splitlines()
    assert heading.split() == ["subject", "file", "why"]
    assert max(map(len, lines)) <= 60
    assert re.match(r"01 +sub-01/\S+\.\.\.\S+v22\.mgz  it is the only one", lines[0])
    assert " ".join(" ".join(line[30:] for line in lines).split()).endswith("was found there")


def test_counts_of_decisions_have_colors(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    echo("4 hemispheres: 2 failed, 1 look, 1 use (2 unchanged, skipped)")
    said = capsys.readouterr().out
    assert "2 \x1b[1;31mfailed\x1b[0m, 1 \x1b[33mlook\x1b[0m, 1 \x1b[32muse\x1b[0m (2" in said
    echo("token /data/use/failed.txt userlook")
    assert "\x1b" not in capsys.readouterr().out


def test_a_stage_ends_with_its_time(capsys):
    with Progress(0):
        tell("reading")
        tell("models", 0, 2)
        tell("models", 1, 2)
    tell("unheard")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["reading", "models"]
    assert all(re.fullmatch(r"  \w+ +\d+\.\d s", line) for line in lines)


def test_a_stage_that_fails_has_no_time(capsys):
    def fail():
        tell("reading")
        tell("models")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), Progress(0):
        fail()
    assert "models" not in capsys.readouterr().out


def test_a_terminal_sees_how_much_of_a_stage_is_left(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Progress(0):
        tell("figures", 0, 12)
    assert "figures:   0%" in (said := capsys.readouterr().err)
    assert "| 0/12 [00:00<?" in said
    with Progress(-1):
        tell("figures", 0, 12)
    assert capsys.readouterr().err == ""


def test_the_clock_of_a_stage_moves_without_news(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    before = signal.getsignal(signal.SIGALRM)
    with Progress(0):
        tell("hemispheres", 0, 4)
        tell("hemispheres", None, current="sub-01 L")
        end = time.monotonic() + 2.2
        while time.monotonic() < end:
            time.sleep(0.05)
    said = capsys.readouterr().err
    assert "hemispheres (sub-01 L):   0%" in said
    assert re.search(r"\| 0/4 \[00:0[12]<\?", said)
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_long_lines_break_at_words_on_a_terminal(monkeypatch, capsys):
    text = "sub-01 look " + " ".join(["words"] * 30) + " /a/path/of/" + 90 * "x"
    echo(text)
    assert capsys.readouterr().out == f"{text}\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("NO_COLOR", "1")
    echo(text)
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(line.strip() for line in lines) == text
    assert all(len(line) <= 60 for line in lines[:-1])
    assert lines[-1].endswith(90 * "x")


def test_parts_are_told_as_they_are_done():
    told = []
    with listening(lambda *what: told.append(what)):
        assert list(each("models", ["L", "R"])) == ["L", "R"]
    assert told == [("models", 0, 2, ""), ("models", 1, 2, ""), ("models", 2, 2, "")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--participant-lable 01 in out participant", "did you mean --participant-label?"),
        ("in out participant --participant_lable 01", "did you mean --participant-label?"),
        ("in out particpant", "did you mean participant?"),
        ("in out groop", "did you mean group?"),
        ("protocls", "'protocls' is no command and no dataset; did you mean protocols?"),
        ("protocls --help", "did you mean protocols?"),
        ("in out participant --region bodi", "did you mean body?"),
        ("in out group --correction permutaton-max", "did you mean permutation-max?"),
        ("in out group --asymetry", "did you mean --asymmetry?"),
        ("phantom x --region CA1-anteriro", "did you mean CA1-anterior?"),
        ("phantom x --layout freesurfr", "did you mean freesurfer?"),
        ("phantom x --kind spirale", "did you mean spiral?"),
    ],
)
def test_what_is_nearly_right_gets_a_proposal(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 64
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("folder", "is_lost"),
    [("/out/a", False), ("/my data/x", False), ("/results", True), ("/tmp/a", True)],  # noqa: S108
)
def test_results_in_no_mounted_folder_are_said_to_be_lost(
    folder, is_lost, tmp_path, monkeypatch, capsys
):
    mounts = tmp_path / "mounts"
    mounts.write_text(
        "overlay / overlay rw,relatime 0 0\nproc /proc proc rw 0 0\ntmpfs /tmp tmpfs rw 0 0\n"
        "/dev/sda1 /out ext4 rw 0 0\ntmpfs /my\\040data tmpfs rw 0 0\n"
    )
    monkeypatch.setattr(os, "access", lambda *_: True)
    warn_if_lost(Path(folder), mounts)
    assert capsys.readouterr().err == ""  # outside of containers
    monkeypatch.setenv("HIPSTA_BIDS_CONTAINER_TYPE", "docker")
    warn_if_lost(Path(folder), mounts)
    expected = (
        f"warning: {folder} is lost with the container; mount a folder, as -v HOST:{folder}\n"
    )
    assert capsys.readouterr().err == expected * is_lost
    monkeypatch.setattr(os, "access", lambda *_: False)
    warn_if_lost(Path(folder), mounts)
    assert capsys.readouterr().err == ""  # one line will say that it cannot be written
