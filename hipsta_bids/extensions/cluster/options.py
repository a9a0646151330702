"""The options ``--dask-scheduler`` and ``--slurm``."""

import argparse
from functools import partial

from hipsta_bids.cli.parser import adder
from hipsta_bids.participant.pool import RunJobs


def add_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of workers elsewhere."""
    add = adder(group)
    add(
        "--dask-scheduler",
        "ADDRESS",
        "measure on the workers of this Dask scheduler (tcp://HOST:PORT, or its file)",
    )
    add(
        "--slurm",
        "OPTIONS",
        "measure in --n-procs SLURM jobs: sbatch's options in quotes, as '-p short'",
    )


def choose_workers(options: argparse.Namespace) -> RunJobs | None:
    """Return what runs jobs on these workers; ``None`` without an option."""
    from hipsta_bids.extensions.cluster import engine  # noqa: PLC0415  (start-up time)

    if options.dask_scheduler is None and options.slurm is None:
        return None
    cluster = engine.Cluster(scheduler=options.dask_scheduler, slurm=options.slurm)
    engine.check_cluster(cluster)
    return partial(engine.run_on_cluster, cluster)
