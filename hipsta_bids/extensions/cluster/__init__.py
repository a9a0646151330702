"""Cluster: the participant level on the workers of Dask or SLURM."""

from hipsta_bids.joints import Engine, Extension

EXTENSION = Extension(
    package=__name__,
    meaning="Measure hemispheres on the workers of Dask or SLURM.",
    engines=(
        Engine(
            options=f"{__name__}.options:add_options", make=f"{__name__}.options:choose_workers"
        ),
    ),
)
