"""Options of argparse as inputs and groups of a Boutiques descriptor."""

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

Entry = dict[str, Any]

#: Positions and keys that ``bosh validate --bids`` asks for; other keys are longer, so that text
#: in square brackets, as in the contrast ``group[NAME]``, is never taken for one.
BIDS_KEYS = ("bids_dir", "output_dir", "analysis_level", "participant_label", "session_label")

#: Options that print and end.
_NOT_INPUTS = frozenset({"help", "version"})

#: Paths that need not exist beforehand: no files for a platform to look for or to mount.
_NEW_PATHS = frozenset({"output_dir", "work_dir", "bids_database_dir"})

#: What the parsers' converters accept, by name; of any other converter: a string.
_CONVERTERS: Mapping[str, Entry] = {
    "Path": {"type": "File"},
    "_folder": {"type": "File"},
    "_named_path": {"type": "File"},
    "_positive_int": {"type": "Number", "integer": True, "minimum": 1},
    "int": {"type": "Number", "integer": True},
    "_positive_float": {"type": "Number", "minimum": 0, "exclusive-minimum": True},
    "float": {"type": "Number"},
    "_hemi": {"type": "String", "value-choices": ["L", "R"]},
}

#: Inputs that make others void; argparse cannot say so.
_DISABLES = {"model": ("formula", "contrast")}


def inputs_of(parser: argparse.ArgumentParser) -> list[Entry]:
    """Describe all arguments of a parser.

    Parameters
    ----------
    parser : ArgumentParser
        Of one level.

    Returns
    -------
    list of dict
        Boutiques inputs; positional arguments first, then options in the order of the help.
    """
    actions = list(_arguments(_actions(parser)))
    known = {action.dest for action in actions}
    return [_input(action, known) for action in actions]


def groups_of(parser: argparse.ArgumentParser) -> list[Entry]:
    """List the sections of the help, and the options that exclude each other.

    Parameters
    ----------
    parser : ArgumentParser
        Of one level.

    Returns
    -------
    list of dict
        Boutiques groups.
    """
    groups = []
    # argparse shows nothing of this in public
    for section in parser._action_groups[2:]:  # noqa: SLF001
        members = [action.dest for action in _arguments(section._group_actions)]  # noqa: SLF001
        if members:
            groups.append(
                _group(f"section_{_slug(str(section.title))}", str(section.title), members)
            )
    for rivals in parser._mutually_exclusive_groups:  # noqa: SLF001
        members = [action.dest for action in _arguments(rivals._group_actions)]  # noqa: SLF001
        # The keys alone count, whatever their value: they are never written as false.
        rules = {"mutually-exclusive": True} | (
            {"one-is-required": True} if rivals.required else {}
        )
        name = "at most one of " + ", ".join(members)
        groups.append(_group(f"one_of_{'_'.join(members)}", name, members) | rules)
    return groups


def merge_inputs(levels: Mapping[str, Sequence[Entry]]) -> list[Entry]:
    """Join the inputs of several levels into one list, in which the level switches them.

    Parameters
    ----------
    levels : mapping of str to sequence of dict
        Inputs by level; the same option takes the same kind of value at all levels.

    Returns
    -------
    list of dict
        Boutiques inputs; ``analysis_level`` disables what its level does not have.

    Raises
    ------
    ValueError
        If two levels give one option different kinds of value.
    """
    merged: dict[str, Entry] = {}
    texts: dict[str, dict[str, str]] = {}
    for level, inputs in levels.items():
        for entry in inputs:
            kind = {key: value for key, value in entry.items() if key != "description"}
            if merged.setdefault(entry["id"], kind) != kind:
                raise ValueError(f"{entry['id']}: the levels give it different kinds of value")
            texts.setdefault(entry["id"], {})[level] = entry["description"]
    for key, by_level in texts.items():
        same = len(set(by_level.values())) == 1 and len(by_level) == len(levels)
        lines = [f"{level}: {text}" for level, text in by_level.items()]
        merged[key]["description"] = next(iter(by_level.values())) if same else "; ".join(lines)
    choice = merged["analysis_level"]
    choice["value-disables"] = {
        level: [key for key, by_level in texts.items() if level not in by_level] for level in levels
    }
    return list(merged.values())


def merge_groups(levels: Iterable[Sequence[Entry]]) -> list[Entry]:
    """Join groups of several levels; an input stays in the first section that it is in."""
    seen: set[str] = set()
    merged: list[Entry] = []
    for group in (group for groups in levels for group in groups):
        if group in merged:
            continue  # options that exclude each other at both levels
        members = [name for name in group["members"] if name not in seen]
        if "mutually-exclusive" in group:
            members = group["members"]
        else:
            seen.update(members)
        if members:
            merged.append(group | {"members": members})
    return merged


def _group(key: str, name: str, members: list[str]) -> Entry:
    return {"id": key, "name": name, "members": members}


def _slug(text: str) -> str:
    return re.sub(r"\W+", "_", text.lower()).strip("_")


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return parser._actions  # noqa: SLF001  (argparse shows nothing of this in public)


def _arguments(actions: Iterable[argparse.Action]) -> Iterator[argparse.Action]:
    for action in actions:
        if action.dest not in _NOT_INPUTS and action.help != argparse.SUPPRESS:
            yield action


def _input(action: argparse.Action, known: set[str]) -> Entry:
    """Describe one argument.

    ``--verbose`` and its like can be given once only: a flag of Boutiques cannot count.
    """
    entry: Entry = {
        "id": action.dest,
        "name": action.dest.replace("_", " ").capitalize(),
        "description": (action.help or "") % vars(action),
        "value-key": f"[{'' if action.dest in BIDS_KEYS else 'OPTION_'}{action.dest.upper()}]",
        "optional": bool(action.option_strings) and not action.required,
    }
    entry |= _values(action)
    if action.option_strings:
        long = [flag for flag in action.option_strings if flag.startswith("--")]
        entry["command-line-flag"] = (long or action.option_strings)[0]
    rivals = [name for name in _DISABLES.get(action.dest, ()) if name in known]
    return entry | ({"disables-inputs": rivals} if rivals else {})


def _values(action: argparse.Action) -> Entry:
    """Say which values an argument takes, and how many."""
    if action.nargs == 0:
        return {"type": "Flag"}
    if action.choices is not None:
        kind: Entry = {"type": "String", "value-choices": [str(value) for value in action.choices]}
    elif action.dest in _NEW_PATHS:
        kind = {"type": "String"}
    else:
        kind = dict(_CONVERTERS.get(getattr(action.type, "__name__", ""), {"type": "String"}))
    if action.nargs == "+":
        kind |= {"list": True, "list-separator": " ", "min-list-entries": 1}
    elif isinstance(action.nargs, int) and action.nargs > 1:
        kind |= {"list": True, "list-separator": " "}
        kind |= {"min-list-entries": action.nargs, "max-list-entries": action.nargs}
    return kind
