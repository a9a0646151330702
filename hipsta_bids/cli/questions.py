"""Questions of the group level other than comparisons: their options, and which go together."""

import argparse
import math
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING

from hipsta_bids import joints
from hipsta_bids.cli.parser import Parser, adder, factor_level
from hipsta_bids.errors import UsageError

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions, GroupResult
    from hipsta_bids.group.settings import GroupSettings

#: Options that only comparisons have.
_COMPARISON_ONLY = (
    *("asymmetry", "model", "contrast"),
    *("permutations", "blocks", "fdr_scope", "base", "no_classification"),
)


def listed_questions() -> str:
    """List the options that ask questions, for the help."""
    flags = [_flag(name) for question in joints.find_questions() for name in question.flags]
    return f"{', '.join(flags)}: questions of their own, each in a folder of OUT_DIR/group"


def add_questions(parser: Parser) -> None:
    """Add all options of these questions."""
    for question in joints.find_questions():
        joints.load(question.options)(parser)
    if not joints.find_questions():
        return
    adder(parser.add_argument_group("for trials and norms"))(
        "--among",
        "COLUMN=LEVEL",
        "only participants like this, as group=AD",
        type=factor_level,
    )


def is_question(parsed: argparse.Namespace) -> bool:
    """Check whether something other than a comparison is asked."""
    return any(
        getattr(parsed, name) for question in joints.find_questions() for name in question.flags
    )


def run_comparison(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Compare participants."""
    from hipsta_bids.group.questions.compare import run_group  # noqa: PLC0415  (heavy)

    for question in joints.find_questions():
        refuse(parsed, question.dependents, f"without {question.without}")
    multiplicity = settings.multiplicity
    permuting = joints.find_permuting(settings)
    if not any(permuting.values()) and not multiplicity.method.startswith("permutation"):
        flags = " or ".join(["--correction", *permuting])
        refuse(parsed, ("permutations", "blocks"), f"without permutations, by {flags}")
    elif multiplicity.permutations * multiplicity.alpha < 1:
        raise UsageError(
            f"{multiplicity.permutations} permutations cannot give p of"
            f" {multiplicity.alpha:g}; at least {math.ceil(1 / multiplicity.alpha)}"
            " are needed, and thousands are better"
        )
    protocols = tuple(dict.fromkeys(parsed.seg))
    if len(protocols) < 2:  # noqa: PLR2004  (to compare)
        return run_group(options, settings)
    if not joints.find_protocols():
        raise UsageError("--seg: name one protocol")
    result: GroupResult = joints.load(joints.find_protocols())(options, settings, protocols)
    return result


def run_question(
    parsed: argparse.Namespace, options: "GroupOptions", settings: "GroupSettings"
) -> "GroupResult":
    """Answer the question that options ask."""
    questions = [
        q for q in joints.find_questions() if any(getattr(parsed, name) for name in q.flags)
    ]
    flags = [_flag(name) for q in questions for name in q.flags if getattr(parsed, name)]
    if len(questions) > 1:
        raise UsageError(f"give one of {', '.join(flags)}")
    (question,) = questions
    _check_alone(parsed, question, " and ".join(flags), settings)
    result: GroupResult = joints.load(question.run)(parsed, options, settings)
    return result


def _check_alone(
    parsed: argparse.Namespace, question: joints.Question, flags: str, settings: "GroupSettings"
) -> None:
    """Refuse options and settings that a question does not take."""
    named = [name for choice in joints.find_sessions() for name in choice.names]
    names = [part.name for part in joints.find_parts()]
    names += [name for step in joints.find_steps() for name in step.names]
    refuse(parsed, (*named, *_COMPARISON_ONLY, *names), f"with {flags}")
    if len(set(parsed.seg)) > 1:
        raise UsageError(f"--seg: name one protocol with {flags}")
    for setting in filter(None, (step.setting for step in joints.find_steps())):
        if attrgetter(setting)(settings):
            raise UsageError(
                f"{flags}: {setting.partition('.')[0]} is not possible; remove {setting} from the"
                " settings"
            )
    for further in joints.find_questions():
        if further is not question:
            names = [name for name in further.dependents if name not in question.dependents]
            refuse(parsed, names, f"without {further.without}")


def refuse(parsed: argparse.Namespace, names: Sequence[str], context: str) -> None:
    """Refuse options that would have no effect; ``names`` are of Python."""
    flags = [_flag(name) for name in names if getattr(parsed, name)]
    if flags:
        raise UsageError(f"{', '.join(flags)}: has no effect {context}; remove the option")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
