"""What each machine-readable reason means, and what to do about it.

One table for the reference page and for whoever meets a reason in ``status.tsv``, ``excluded.tsv``
or on the terminal. A test compares it with the reasons that the package gives.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from hipsta_bids.reasons.command import COMMAND, RUN
from hipsta_bids.reasons.flags import FLAGS
from hipsta_bids.reasons.group import EXCLUSIONS, GROUP
from hipsta_bids.reasons.hemisphere import LABELS, SHAPE
from hipsta_bids.reasons.phantoms import PHANTOMS
from hipsta_bids.reasons.reason import Reason

__all__ = ["SECTIONS", "Reason", "Section"]


@dataclass(frozen=True, kw_only=True)
class Section:
    """Reasons that are met in the same place."""

    title: str
    text: str
    reasons: Mapping[str, Reason]
    """By their names."""


#: Every reason, in the order of the reference page.
SECTIONS: tuple[Section, ...] = (
    Section(
        title="Flags",
        text="The hemisphere was measured and has the status `flagged`; several reasons are joined"
        " by `+`. Its page in the report shows the place. Look, then use it, correct the labels,"
        " or leave it out of the group level (`--exclude-flagged`, `--exclude`).",
        reasons=FLAGS,
    ),
    Section(
        title="Refused: files and labels",
        text="The hemisphere has the status `failed`, and there are no maps. The others go on.",
        reasons=LABELS,
    ),
    Section(
        title="Refused: shape",
        text="Likewise: the labels could be read, but a map of them would be wrong. The report"
        " shows labels and surface up to the step that failed.",
        reasons=SHAPE,
    ),
    Section(
        title="Refused: the run",
        text="Likewise, for reasons that do not lie in the labels. The same command tries again"
        " what is not done.",
        reasons=RUN,
    ),
    Section(
        title="The command stops",
        text="Nothing or no more is computed; the exit code is 64, 65, 66 or 73. What was written"
        " before stays.",
        reasons=COMMAND,
    ),
    Section(
        title="Not in a group analysis",
        text="The column `reason` of `excluded.tsv`. With `failed:` or `flagged:` before it, it is"
        " that of the hemisphere, as above.",
        reasons=EXCLUSIONS,
    ),
    Section(
        title="The group level stops",
        text="The model cannot be fitted to these data, or inputs do not fit each other. Earlier"
        " results stay as they are.",
        reasons=GROUP,
    ),
    Section(
        title="Phantoms and validation",
        text="Only `hipsta-bids phantom` and `hipsta-bids validate` give these.",
        reasons=PHANTOMS,
    ),
)
