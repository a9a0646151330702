"""Run the command line on files and formulas that are damaged at random.

Each case damages one valid input and runs in a process of its own, which is forked from one that
has loaded all libraries. A case is good if it ends within 20 s and the memory limit, with a
documented exit code other than 70, one line per problem, and no traceback.
"""

import argparse
import contextlib
import gc
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from random import Random
from typing import NamedTuple

import psutil
from checks import demand, echo
from fuzz_inputs import KINDS, MEM, Kind, call, run_here, write_inputs

from hipsta_bids.cli import main as command
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode

_SECONDS = 20
_MORE = 200  # MB beyond --mem, or beyond what the undamaged input takes
_ADDRESSES = 6e9  # bytes that a case may ask for: it protects the machine, the limits are smaller
_LINE = re.compile(r"(hipsta-bids|warning|report): |sub-\w+.* failed")
_BAD = re.compile(r"Traceback|internal error|Unable to allocate|out of memory|MemoryError")


class Outcome(NamedTuple):
    """How a run ended."""

    code: int
    """Exit code, or less than zero the number of a signal."""
    said: str
    """On the standard error."""
    seconds: float
    memory: float
    """Largest resident memory, MB, and what the process began with included."""


def run(arguments: Sequence[str]) -> Outcome:
    """Run the command line in a process of its own, within limits."""
    begin, wall = time.monotonic(), 3 * _SECONDS
    process = os.fork()
    if process == 0:
        code = int(ExitCode.INTERNAL)
        try:
            os.setsid()
            for stream, path in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), stream)
            size = int(psutil.Process().memory_info().vms + _ADDRESSES)
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
            resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))
            signal.alarm(wall)  # other programs may take the processor
            code = command.main(arguments)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        finally:
            sys.stderr.flush()
            os._exit(code)
    _, status, usage = os.wait4(process, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)  # what it started
    said = Path("stderr").read_text(encoding="utf-8", errors="replace")
    seconds = time.monotonic() - begin
    return Outcome(os.waitstatus_to_exitcode(status), said, seconds, usage.ru_maxrss / 1000)


def fault(outcome: Outcome, most_memory: float) -> str | None:
    """Say what is wrong with how a run ended, if anything is."""
    lines = outcome.said.splitlines()
    last = lines[-1][:300] if lines else ""
    if outcome.code not in EXIT_MEANINGS or outcome.code == ExitCode.INTERNAL:
        return f"exit code {outcome.code}: {last}"
    if _BAD.search(outcome.said):
        return f"said: {last}"
    if odd := [line for line in lines if not _LINE.match(line)]:
        return f"a line that is no message: {odd[0][:300]}"
    n_errors = sum(not line.startswith(("warning: ", "report: ")) for line in lines)
    if outcome.code > 1 and n_errors != 1:
        return f"{n_errors} lines of errors: {last}"
    if outcome.memory > most_memory:
        return f"{outcome.memory:.0f} MB, {most_memory:.0f} are allowed: {last}"
    return None


def run_kind(kind: Kind, random: Random) -> tuple[bytes, Outcome]:
    """Damage an input, run, and put the input back."""
    if kind.source.startswith("--"):
        content = kind.change(kind.content.encode(), random).replace(b"\0", b"")[:100_000]
        return content, run(call(kind.arguments, f"{kind.source}={os.fsdecode(content)}"))
    path = Path(kind.source)
    valid = path.read_bytes()
    content = kind.change(valid, random)
    path.write_bytes(content)
    try:
        return content, run(call(kind.arguments))
    finally:
        path.write_bytes(valid)


def find_limits(names: Sequence[str]) -> dict[str, float]:
    """Load libraries, and measure the memory (MB) that each kind may take."""
    calls = {}
    for name in names:
        source, _, words, content = KINDS[name]
        option = [f"{source}={content}"] if source.startswith("--") else []
        calls[name] = call(words, *option)
        run_here(*calls[name])
    gc.freeze()
    limits = {}
    for name, arguments in calls.items():
        shutil.rmtree("out")
        outcome = run(arguments)
        limits[name] = max(outcome.memory, MEM * ("participant" in arguments)) + _MORE
        what = f"{name}: undamaged, {outcome.seconds:.1f} s, {outcome.memory:.0f} MB"
        demand(outcome.code == 0 and not fault(outcome, limits[name]), what)
    return limits


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="tools/test-fuzz", description=__doc__)
    parser.add_argument("minutes", type=float, nargs="?", default=15)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--case", type=int, help="run this case alone, and print its messages")
    options = parser.parse_args(arguments)
    keep = Path(tempfile.mkdtemp(prefix="hipsta-fuzz-inputs-"))
    codes: Counter[tuple[str, int]] = Counter()
    findings = 0
    with tempfile.TemporaryDirectory(prefix="hipsta-fuzz-") as folder, contextlib.chdir(folder):
        write_inputs()
        limits = find_limits(options.kinds)
        end = time.monotonic() + 60 * options.minutes
        for number in count() if options.case is None else [options.case]:
            if time.monotonic() > end:
                break
            for name in options.kinds:
                random = Random(f"{options.seed} {name} {number}")  # noqa: S311  (no secret)
                content, outcome = run_kind(KINDS[name], random)
                codes[name, outcome.code] += 1
                if options.case is not None:
                    echo(f"{name}: {outcome}")
                if problem := fault(outcome, limits[name]):
                    findings += 1
                    (keep / f"{name}-{options.seed}-{number}").write_bytes(content)
                    echo(f"--kinds {name} --seed {options.seed} --case {number}: {problem}")
    for name in options.kinds:
        row = {code: times for (kind, code), times in sorted(codes.items()) if kind == name}
        echo(f"{name}: {sum(row.values())} cases, by exit code: {row}")
    demand(not findings, f"{codes.total()} cases, {findings} findings, inputs in {keep}")
    keep.rmdir()


if __name__ == "__main__":
    main()
