"""Boutiques descriptors of the participant level, of the group level, and of both."""

import argparse
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode
from hipsta_bids.joints import is_present

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
    "named_path": {"type": "File"},
    "positive_int": {"type": "Number", "integer": True, "minimum": 1},
    "int": {"type": "Number", "integer": True},
    "_copies": {"type": "Number", "integer": True, "minimum": 0},
    "positive_float": {"type": "Number", "minimum": 0, "exclusive-minimum": True},
    "float": {"type": "Number"},
    "_hemi": {"type": "String", "value-choices": ["L", "R"]},
}

#: Inputs that make others void; argparse cannot say so.
_DISABLES = {"model": ("formula", "contrast")}


def inputs_of(parser: argparse.ArgumentParser) -> list[Entry]:
    """Describe all arguments of a parser."""
    actions = list(_arguments(_actions(parser)))
    known = {action.dest for action in actions}
    return [_input(action, known) for action in actions]


def groups_of(parser: argparse.ArgumentParser) -> list[Entry]:
    """List the sections of the help, and the options that exclude each other."""
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
    """Join the inputs of several levels into one list, in which the level switches them."""
    merged: dict[str, Entry] = {}
    texts: dict[str, dict[str, str]] = {}
    for level, inputs in levels.items():
        for entry in inputs:
            kind = {key: value for key, value in entry.items() if key != "description"}
            choices = merged.get(entry["id"], {}).get("value-choices")
            if choices and kind.get("value-choices"):  # words of either level
                words = list(dict.fromkeys([*choices, *kind["value-choices"]]))
                merged[entry["id"]]["value-choices"] = kind["value-choices"] = words
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


_ROOT = "[OUTPUT_DIR]"

#: Files of the output dataset: name, description. A part of the subjects (``shard``) has a table
#: and a log of its own, without pages and maybe without hemispheres; ``dry_run`` writes nothing.
_DATASET = {
    "status": ("status.tsv", "one row per hemisphere: decision, reason, message, time, memory"),
    "measures": ("measures.tsv", "one row per hemisphere: decision, rating, origin, all numbers"),
    "inputs": ("inputs.tsv", "what was found: used, failed, not used, or no segmentation"),
    "settings": ("desc-settings.json", "all settings of these results, and their hash"),
    "description": ("dataset_description.json", "the dataset's description, as BIDS asks for"),
    "citation": ("CITATION.md", "a methods paragraph with references"),
    "readme": ("README.md", "what is in the dataset"),
    "page": ("report.html", "all hemispheres on one page, to look at"),
    "pages": ("sub-*.html", "a page per subject and session, to look at"),
    "logs": ("logs/*", "one file per run"),
}

#: Files of a hemisphere: what follows the protocol in their names, description.
_HEMISPHERE = {
    "sheets": ("_desc-sheet_morph.tsv", "thickness, curvatures and subfield per point"),
    "summaries": ("_desc-summary_morph.tsv", "one row of measures per hemisphere"),
    "profiles": ("_desc-profile_morph.tsv", "maps averaged along one axis"),
    "sections": ("_desc-sections_morph.tsv", "one row per cross-section"),
    "surfaces": ("_midthickness.surf.gii", "surfaces of the sheet, with two walls beside"),
    "maps": ("_*.shape.gii", "thickness, curvatures and extents per vertex"),
    "subfields": ("_dseg.label.gii", "subfield per vertex"),
    "masks": ("_desc-body_mask.nii.gz", "the measured body on the grid of the labels"),
    "records": ("_desc-qc_metrics.json", "status, flags, inputs, quality metrics"),
    "layers": ("_desc-layers_morph.tsv", "points of all layers (write_meshes)"),
    "meshes": ("_desc-tet_mesh.vtu", "tetrahedral meshes (write_meshes)"),
}
if is_present("signals"):
    _HEMISPHERE["other_maps"] = ("_desc-*_map.tsv", "other images on the sheet (map)")
    _HEMISPHERE["regions"] = ("_desc-roi_morph.tsv", "maps summed up in regions (roi)")
if is_present("uncertainty"):
    text = "SD over perturbed labels (uncertainty)"
    _HEMISPHERE["uncertainties"] = ("_desc-*uncertainty_morph.tsv", text)

#: Files of one model of the group level: name, description, written whatever the model. Models of
#: volumes have no maps; those without groups, of one session or not registered lack others.
_MODEL = {
    "methods": ("methods.md", "what was done and found; to be read first", True),
    "peaks": ("peaks.tsv", "one row per cluster", False),
    "statistics": ("maps.tsv", "one row per map: points tested and found", False),
    "measures": ("measures.tsv", "the model for each summary measure", False),
    "descriptives": ("descriptives.tsv", "means and standard deviations by group", False),
    "classification": ("classification.tsv", "pairs of groups, by logistic regression", False),
    "agreement": ("retest*.tsv", "agreement of repeated sessions (`--retest`)", False),
    "sample_sizes": ("power*.tsv", "participants per arm of a trial (`--power`)", False),
    "registration": ("registration.tsv", "variance explained before and after", False),
    "excluded": ("excluded.tsv", "who is not in it, and why", True),
    "quality": ("quality.tsv", "decisions and ratings by group, with a test", False),
    "covariates": ("covariates.tsv", "the table that was fitted", True),
    "demographics": ("demographics.tsv", "age, sex and covariates by group, with tests", True),
    "design": ("design.tsv", "the same as a design matrix", False),
    "statistical_maps": ("hemi-*_statmap.tsv", "statistics at each point", False),
    "all_maps": ("maps.parquet", "all maps, original and registered", False),
    "template": ("template.json", "the template of registration", False),
    "model_file": ("model.json", "the model, in the form of BIDS Stats Models", False),
    "record": ("analysis.json", "command, settings, seeds, versions", True),
    "figures": ("figures/*", "figures as papers print them (PDF, PNG, SVG)", False),
}


def output_folder(*, optional: bool = False) -> Entry:
    """Describe the output dataset as a whole."""
    return _output("dataset", _ROOT, "the output dataset", optional=optional)


def participant_outputs() -> list[Entry]:
    """List what the participant level writes, of hemispheres with and without sessions.

    A wildcard of Boutiques stays within one folder. All are optional, since there is an option
    without each of them; what a run has left undone is in its exit code and in ``status.tsv``.
    """
    outputs = [output_folder(optional=True)]
    for key, (name, text) in _DATASET.items():
        entry = _output(key, f"{_ROOT}/{name}", text, optional=True)
        outputs.append(entry | ({"list": True} if "*" in name else {}))
    for key, (ending, text) in _HEMISPHERE.items():
        for suffix, folder, where in (
            ("", "sub-*", "datasets without sessions"),
            ("_of_sessions", "sub-*/ses-*", "datasets with sessions"),
        ):
            path = f"{_ROOT}/{folder}/anat/sub-*_hemi-*_seg-*{ending}"
            entry = _output(f"{key}{suffix}", path, f"{text}; {where}", optional=True)
            outputs.append(entry | {"list": True})
    return outputs


def group_outputs() -> list[Entry]:
    """List what the group level writes; a model's folder has its formula's name or --name."""
    models = _output("models", f"{_ROOT}/group/*", "one folder per model", optional=False)
    pages = _output("pages", f"{_ROOT}/group/*.html", "a page per model, to look at", optional=True)
    outputs = [output_folder(), models | {"list": True}, pages | {"list": True}]
    for key, (name, text, always) in _MODEL.items():
        entry = _output(key, f"{_ROOT}/group/*/{name}", text, optional=not always)
        outputs.append(entry | ({"list": True} if "*" in name else {}))
    return outputs


def ids_inside(outputs: Sequence[Entry]) -> list[str]:
    """List the outputs that are part of the output dataset, which is the first of them."""
    return [str(entry["id"]) for entry in outputs[1:]]


def _output(key: str, path: str, text: str, *, optional: bool) -> Entry:
    return {
        "id": f"output_{key}",  # or it would meet the options of that name
        "name": key.replace("_", " ").capitalize(),
        "description": text,
        "path-template": path,
        "optional": optional,
    }


#: Name of each descriptor, and the level that it is for; ``None`` is both.
DESCRIPTORS: dict[str, str | None] = {
    "hipsta_bids": None,
    "hipsta_bids_participant": "participant",
    "hipsta_bids_group": "group",
}

SHIPPED = "hipsta_bids/cli/descriptor.json"
"""What the package prints for ``--bids-exec-spec``: the descriptor of both levels."""

NIPOPPY = "descriptors/nipoppy/hipsta_bids/descriptor.json"
"""That of the participant level again: a pipeline of Nipoppy holds all of its files."""

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


IMAGE = f"hipsta_bids:{__version__}"
"""The image, as it is called where it was built."""

#: Of the paper that describes the method; the code has none of its own yet.
_DOI = "10.1016/j.neuroimage.2023.120182"


def describe(level: str | None = None, *, image: str = IMAGE, url: str = "") -> Entry:
    """Describe the command line of one level, or of both with the level as an input.

    ``image`` is the name by which it is had, ``url`` the public address of the code; no address is
    known here, so that there is none unless it is given.
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
        **({"url": url} if url else {}),
        "tool-doi": _DOI,
        "command-line": _command(level, inputs),
        "container-image": {"type": "docker", "image": image},
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


def descriptor_text(level: str | None = None, *, image: str = IMAGE, url: str = "") -> str:
    """Return the text of a descriptor's file."""
    content = describe(level, image=image, url=url)
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


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
    """Describe the output folder as a file, too, as ``bosh validate --bids`` demands.

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
    """List examples for ``bosh test``.

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
    """Return the settings of CBRAIN: what it keeps.

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
