"""Which extensions there are: tests of the core that need one are skipped without it."""

import pytest

from hipsta_bids.joints import find_extensions

PRESENT = {one.package.rpartition(".")[2] for one in find_extensions()}


def needs(name):
    """Return a mark that skips a test without an extension."""
    return pytest.mark.skipif(name not in PRESENT, reason=f"the extension {name} was deleted")
