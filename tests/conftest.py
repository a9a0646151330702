"""Makes the stand-ins beside it importable from every folder of tests."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Make no pages, for the sake of time: they have tests of their own, in ``reports/``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hipsta_bids.reporting._try_all", lambda *_: None)
        patch.setattr("hipsta_bids.group_runner.write_group_report", lambda *_: None)
        yield
