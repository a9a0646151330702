"""Which extensions there are: tests of the core that need one are skipped without it."""

import pytest

from hipsta_bids.extensions import NAMES
from hipsta_bids.joints import is_present

PRESENT = {name for name in NAMES if is_present(name)}


def needs(name):
    """Return a mark that skips a test without an extension."""
    return pytest.mark.skipif(name not in PRESENT, reason=f"the extension {name} was deleted")
