"""What tests get: pages, workers, a browser on request only, and no reason the table lacks."""

import os
import sys
from pathlib import Path

import pytest

import hipsta_bids
from hipsta_bids.errors import HipstaError
from hipsta_bids.participant.pool import run_jobs
from hipsta_bids.reports.page import read_table
from hipsta_bids.types import Flag


def pytest_collection_modifyitems(items):
    """Skip what takes a browser, and what takes long, unless a script in ``tools`` asks for it."""
    browser = os.environ.get("HIPSTA_BIDS_BROWSER") == "required"
    long = os.environ.get("HIPSTA_BIDS_LONG") == "required"
    for item in items:
        if "browser" in item.fixturenames and not browser:
            item.add_marker(pytest.mark.skip(reason="takes a browser: run tools/test-reports"))
        if item.get_closest_marker("long") and not long:
            item.add_marker(pytest.mark.skip(reason="takes long: run tools/test-long"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Chromium without a network."""
    from browsing import open_browser  # noqa: PLC0415  (takes selenium)

    with open_browser(tmp_path_factory.mktemp("browser")) as session:
        yield session


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Make no pages, for the sake of time: they have tests of their own, in ``reports/``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hipsta_bids.participant.pages._try_all", lambda *_: None)
        patch.setattr("hipsta_bids.group.output.pages.write_group_report", lambda *_: None)
        yield


#: What starts worker processes.
_STARTERS = ("hipsta_bids.participant.run", "hipsta_bids.participant.pages", "validation.cases")


@pytest.fixture(scope="session", autouse=True)
def without_workers():
    """Do all jobs in this process: workers take seconds to start, and have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        for module in _STARTERS:
            patch.setattr(
                f"{module}.run_jobs",
                lambda plan, jobs: ((job, plan.work(job)) for job in jobs),
            )
        yield


@pytest.fixture
def workers():
    """Let runs start worker processes."""
    with pytest.MonkeyPatch.context() as patch:
        for module in _STARTERS:
            patch.setattr(f"{module}.run_jobs", run_jobs)
        yield


@pytest.fixture(scope="session", autouse=True)
def known_reasons():
    """Fail where an error or a flag of the package gives a reason without a row in the table."""
    sections = read_table("reasons.toml")["section"]
    known = {name for section in sections for name in section["reasons"]}
    package = Path(hipsta_bids.__file__).parent

    def checked(kind):
        make = kind.__init__

        def begin(self, *positional, **named):
            make(self, *positional, **named)
            giver = Path(sys._getframe(1).f_code.co_filename)
            if giver.is_relative_to(package) and giver.name != "errors.py":  # not of stand-ins
                assert not self.reason or self.reason in known, f"{self.reason}: no row of reasons"

        return begin

    with pytest.MonkeyPatch.context() as patch:
        for kind in (HipstaError, Flag):
            patch.setattr(kind, "__init__", checked(kind))
        yield
