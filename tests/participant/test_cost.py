"""What a hemisphere costs: checked for what is counted, never for how fast it is."""

import subprocess
import sys
import time

import psutil
import pytest

from hipsta_bids.participant.job import CostClock, cpu_seconds, helpers

BUSY = "import time\nwhile time.process_time() < 0.3: pass\nprint('done', flush=True)\n"

linux = pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")


def test_sleeping_costs_no_processor_time_and_working_does():
    before = cpu_seconds()
    time.sleep(0.3)
    asleep = cpu_seconds() - before
    start = time.process_time()
    while time.process_time() < start + 0.3:
        pass
    awake = cpu_seconds() - before - asleep
    assert asleep < 0.2
    assert awake >= 0.3 - 1e-6  # clocks are read one after the other


@linux
def test_helpers_count_while_they_run_and_after():
    before = cpu_seconds()
    with subprocess.Popen(
        [sys.executable, "-c", BUSY + "input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as helper:
        helper.stdout.readline()
        assert psutil.Process(helper.pid) in helpers()
        running = cpu_seconds() - before
        number = helper.pid
        helper.stdin.close()
    assert running >= 0.28  # as above: ticks of 10 ms
    assert cpu_seconds() - before >= running - 0.02  # a clock tick each of user and system time
    assert number not in [process.pid for process in helpers()]


@linux
def test_peak_memory_remembers_what_was_given_back():
    """In a process of its own: the memory of other tests may be given back at any time."""
    ask = """
import numpy as np
from hipsta_bids.participant.job import peak_memory, reset_peak_memory
reset_peak_memory()
before = peak_memory()
block = np.ones(8_000_000)  # 64 MB
del block
print(peak_memory() - before)
reset_peak_memory()
print(peak_memory() - before)
"""
    told = subprocess.run([sys.executable, "-c", ask], check=True, capture_output=True, text=True)
    remembered, forgotten = map(float, told.stdout.split())
    assert 60e6 < remembered < 100e6
    assert forgotten < 30e6


def test_stages_of_one_name_add_up():
    clock = CostClock()
    for _ in range(2):
        with clock("read"):
            time.sleep(0.02)
    with pytest.raises(RuntimeError), clock("write"):
        raise RuntimeError
    spent = clock.spent()
    assert list(spent["stages"]) == ["read", "write"]
    assert 0.04 <= spent["stages"]["read"] <= spent["seconds"]
