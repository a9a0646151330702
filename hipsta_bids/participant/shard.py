"""Equal parts of a dataset (shards), each for a separate run into one folder."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from hipsta_bids.errors import UsageError

FROM_SLURM = "slurm"
"""Value of ``--shard`` that takes the part from SLURM's array job."""
_ARRAY = "SLURM_ARRAY_TASK_"


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One of ``count`` equal parts of a dataset, each for a run of its own into one folder."""

    index: int
    """From 1."""
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise UsageError(
                f"--shard {self.index}/{self.count}: parts are numbered from 1 to {self.count}"
            )

    @property
    def name(self) -> str:
        """The part as file names have it."""
        return f"{self.index}of{self.count}"

    def take(self, subjects: Iterable[str]) -> tuple[str, ...]:
        """Choose this part of some subjects, in whatever order."""
        return tuple(sorted(set(subjects))[self.index - 1 :: self.count])


def parse_shard(text: str, environment: Mapping[str, str]) -> Shard:
    """Read ``I/N``, or take both from SLURM's array job."""
    if text == FROM_SLURM:
        return _from_array(environment)
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    if match is None:
        raise UsageError(
            f"--shard {text}: write I/N, such as 3/100 for the third of 100 parts, or"
            f" {FROM_SLURM} in an array job"
        )
    return Shard(index=int(match[1]), count=int(match[2]))


def _from_array(environment: Mapping[str, str]) -> Shard:
    """Find the position of this task in its array, whatever its first number and its step."""
    try:
        task, first, last, count, step = (
            int(environment[f"{_ARRAY}{name}"]) for name in ("ID", "MIN", "MAX", "COUNT", "STEP")
        )
    except (KeyError, ValueError):
        raise UsageError(
            f"--shard {FROM_SLURM}: this is no array job (sbatch --array=1-N); write I/N"
        ) from None
    if last - first != step * (count - 1):
        # As when some tasks are run again: parts would not be those of the first time.
        raise UsageError(
            f"--shard {FROM_SLURM}: the array's numbers leave gaps; to run some parts of N again"
            f" write --shard ${_ARRAY}ID/N"
        )
    return Shard(index=(task - first) // step + 1, count=count)
