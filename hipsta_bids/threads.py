"""One thread per process: hemispheres are the unit of parallel work, not matrices."""

import os

#: Read by the numerical libraries when they load, so they have to be set before.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


def pin_threads() -> None:
    """Give the numerical libraries that this process is going to load one thread each.

    More would compete with each other and with other processes, and sums would be taken in another
    order. A process without threads can also be forked.
    """
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
