"""Statistics stand alone: of the package they import errors, types and each other."""

import subprocess
import sys

import pytest

#: Import all modules of ``stats``, with all else of the package blocked.
ALONE = """
import importlib
import pkgutil
import sys

PERMITTED = ("hipsta_bids.stats", "hipsta_bids.errors", "hipsta_bids.types")


class Blocked:
    def find_spec(self, name, path=None, target=None):
        permitted = any(name == part or name.startswith(f"{part}.") for part in PERMITTED)
        if name.startswith("hipsta_bids.") and not permitted:
            raise ImportError(f"{name} is blocked")


import hipsta_bids

sys.meta_path.insert(0, Blocked())
modules = ["hipsta_bids.stats", *sys.argv[1:]]
for name in modules:
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(getattr(package, "__path__", ()), f"{name}."):
        print(importlib.import_module(module.name).__name__)
"""


def imported(*others):
    return subprocess.run(
        [sys.executable, "-c", ALONE, *others], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_all_modules_import_without_the_rest_of_the_package():
    run = imported()
    assert run.returncode == 0, run.stderr
    assert {"hipsta_bids.stats.glm", "hipsta_bids.stats.settings"} <= set(run.stdout.split())


@pytest.mark.slow
def test_the_rest_of_the_package_is_blocked():
    run = imported("hipsta_bids.io")
    assert run.returncode == 1
    assert "hipsta_bids.io is blocked" in run.stderr
