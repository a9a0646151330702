"""Work for worker processes, which import it."""

import os
import time

from hipsta_bids.errors import GeometryError


def work(case):
    """Do as the case says."""
    if case == "refuse":
        raise GeometryError("too thin; use smaller voxels", reason="sheet-too-thin")
    if case == "bug":
        raise ZeroDivisionError("one by zero")
    if case == "die":
        os.abort()
    if case == "hang":
        time.sleep(600)
    return case * 2
