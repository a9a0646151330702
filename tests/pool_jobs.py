"""What workers do in the tests of the pool; light, since each worker loads it."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path


def work(job):
    act, _, number = job.partition(" ")
    if act == "square":
        return int(number) ** 2
    if act == "exit":
        os._exit(int(number))
    if act == "kill":
        os.kill(os.getpid(), int(number))
    if act == "raise":
        raise ValueError("asked to")
    if act == "sleep":
        time.sleep(float(number))
    if act == "helper":
        helper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        return [os.getpid(), helper.pid]
    if act == "oom-score":
        return int(Path("/proc/self/oom_score_adj").read_text())
    return json.dumps(dict(os.environ))


def broken_start():
    raise ModuleNotFoundError("not installed")


#: Jobs in work, each time that one began.
HEARD = []


def hear(jobs):
    HEARD.append(list(jobs))
