"""Boutiques descriptors of the participant level, of the group level, and of both."""

import json
from collections.abc import Sequence
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.boutiques.inputs import (
    BIDS_KEYS,
    Entry,
    groups_of,
    inputs_of,
    merge_groups,
    merge_inputs,
)
from hipsta_bids.boutiques.outputs import (
    group_outputs,
    ids_inside,
    output_folder,
    participant_outputs,
)
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode
from hipsta_bids.group_parser import group_parser
from hipsta_bids.parser import build_parser

#: Name of each descriptor, and the level that it is for; ``None`` is both.
DESCRIPTORS: dict[str, str | None] = {
    "hipsta_bids": None,
    "hipsta_bids_participant": "participant",
    "hipsta_bids_group": "group",
}

_PARSERS = {"participant": build_parser, "group": group_parser}

_DESCRIPTIONS = {
    "participant": "Thickness, curvature and shape maps of the hippocampal body from subfield"
    " segmentations (FreeSurfer, ASHS, HippUnfold or others)",
    "group": "Registration of hippocampal sheets, point-wise statistics of thickness and curvature,"
    " and classification, from results of the participant level",
}

#: Gigabytes and seconds, rounded up from what was measured on one busy core: 10 s, 0.4 GB with
#: TetGen's process and 1 MB of output for one subject; 16 s and 0.4 GB for a group of 200.
_RESOURCES = {
    "participant": {"cpu-cores": 1, "ram": 1, "disk-space": 0.1, "walltime-estimate": 30},
    "group": {"cpu-cores": 1, "ram": 1, "disk-space": 0.1, "walltime-estimate": 60},
}

_DEMO = {"bids_dir": "demo/bids", "output_dir": "demo/out"}
_COHORT = {"bids_dir": "cohort", "output_dir": "cohort/derivatives/hipsta_bids"}
_NOWHERE = {"bids_dir": "no-such-folder", "output_dir": "no-such-output"}


def describe(level: str | None = None) -> Entry:
    """Describe the command line.

    Parameters
    ----------
    level : str, optional
        ``participant`` or ``group``, which the command then has built in; else both levels, with
        the level as an input.

    Returns
    -------
    dict
        A descriptor of Boutiques' schema 0.5.
    """
    levels = [level] if level else list(_PARSERS)
    name = next(key for key, value in DESCRIPTORS.items() if value == level)
    inputs, groups = _both() if level is None else _one(level)
    outputs = _outputs(level)
    return {
        "name": name,
        "description": "; ".join(_DESCRIPTIONS[each] for each in levels),
        "tool-version": __version__,
        "schema-version": "0.5",
        "author": "The hipsta_bids developers",
        "command-line": _command(level, inputs),
        "container-image": {"type": "docker", "image": f"hipsta_bids:{__version__}"},
        "inputs": inputs,
        "groups": groups,
        "output-files": outputs,
        "error-codes": [
            {"code": int(code), "description": meaning}
            for code, meaning in EXIT_MEANINGS.items()
            if code != ExitCode.OK
        ],
        "suggested-resources": _resources(levels),
        "tags": {
            "domain": ["neuroinformatics", "neuroimaging"],
            "modality": ["MRI"],
            "toolbox": ["hipsta_bids"],
            "bids-app": True,
            "analysis-level": levels,
        },
        "tests": [test for each in levels for test in _tests(each, choose=level is None)],
        "custom": _custom(outputs),
    }


def descriptor_text(level: str | None = None) -> str:
    """Spell a descriptor as the text of its file.

    Parameters
    ----------
    level : str, optional
        See :func:`describe`.

    Returns
    -------
    str
        JSON with a line feed at its end.
    """
    return json.dumps(describe(level), indent=2, ensure_ascii=False) + "\n"


def _one(level: str) -> tuple[list[Entry], list[Entry]]:
    parser = _PARSERS[level]()
    inputs = [entry for entry in inputs_of(parser) if entry["id"] != "analysis_level"]
    return inputs, groups_of(parser)


def _both() -> tuple[list[Entry], list[Entry]]:
    parsers = {level: build() for level, build in _PARSERS.items()}
    by_level = {level: inputs_of(parser) for level, parser in parsers.items()}
    for inputs in by_level.values():
        for entry in inputs:
            if entry["id"] == "analysis_level":
                entry |= {"description": "level of the analysis", "value-choices": list(parsers)}
    inputs = merge_inputs(by_level)
    groups = merge_groups(groups_of(parser) for parser in parsers.values())
    place = 1 + [entry["id"] for entry in inputs].index("output_dir")
    inputs.insert(place, _mount())
    inputs[place + 1]["value-disables"]["participant"].append("output_mount")
    return inputs, groups


def _mount() -> Entry:
    """Give the output folder as a file, too, as ``bosh validate --bids`` demands.

    The key is that of ``output_dir``, which is required and comes first, so that the command line
    always has its value. In the other order, or if both were optional as in Boutiques' template
    for BIDS Apps, the key without a value would erase the folder from the command line.
    """
    return {
        "id": "output_mount",
        "name": "Output mount",
        "description": "output_dir once more, if it exists: platforms that mount files mount it",
        "value-key": "[OUTPUT_DIR]",
        "optional": True,
        "type": "File",
    }


def _command(level: str | None, inputs: Sequence[Entry]) -> str:
    keys = {entry["id"]: entry["value-key"] for entry in inputs}
    first = [keys.pop(name, level) for name in BIDS_KEYS]
    keys.pop("output_mount", None)
    # What ``bosh validate --bids`` expects of a descriptor of all levels begins like this.
    start = [] if level else ["mkdir -p [OUTPUT_DIR];"]
    return " ".join([*start, "hipsta-bids", *(key for key in first if key), *keys.values()])


def _outputs(level: str | None) -> list[Entry]:
    """List the outputs; of both levels the folder alone, as ``bosh validate --bids`` demands."""
    if level is None:
        return [output_folder()]
    return participant_outputs() if level == "participant" else group_outputs()


def _resources(levels: Sequence[str]) -> dict[str, float]:
    names = _RESOURCES[levels[0]]
    return {name: max(_RESOURCES[level][name] for level in levels) for name in names}


def _tests(level: str, *, choose: bool) -> list[Entry]:
    """Give examples for ``bosh test``.

    They run in a folder in which ``hipsta-bids demo-data demo/bids`` and ``hipsta-bids phantom
    cohort`` have been run, and the participant level on the latter.
    """
    chosen = {"analysis_level": level} if choose else {}
    good = _DEMO if level == "participant" else _COHORT
    return [
        _test(f"{level} level", good | chosen, ExitCode.OK, "output_dataset"),
        _test(f"{level} level without input", _NOWHERE | chosen, ExitCode.BAD_DATA),
    ]


def _test(name: str, invocation: Entry, code: ExitCode, *outputs: str) -> Entry:
    assertions: dict[str, Any] = {"exit-code": int(code)}
    if outputs:
        assertions["output-files"] = [{"id": key} for key in outputs]
    return {"name": name, "invocation": invocation, "assertions": assertions}


def _custom(outputs: Sequence[Entry]) -> Entry:
    """Tell CBRAIN what to keep.

    The output dataset is saved whole, so its parts are not saved again; and it is saved even if
    some hemisphere failed.
    """
    parts = ids_inside(outputs)
    kept = outputs[0]["id"]
    return {
        "cbrain:readonly-input-files": True,
        **({"cbrain:ignore_outputs": parts} if parts else {}),
        "cbrain:integrator_modules": {
            "BoutiquesFileTypeVerifier": {"bids_dir": ["FileCollection"]},
            "BoutiquesOutputFileTypeSetter": {kept: "FileCollection"},
            "BoutiquesAllowedExitCodes": [int(ExitCode.OK), int(ExitCode.SOME_FAILED)],
        },
    }
