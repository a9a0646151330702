"""Files that users name: volumes to sample (``--map``), regions (``--roi``), paths with labels.

Paths have placeholders, such as ``{subject}``, that stand for the labels of each hemisphere.
"""

import glob
import re
import string
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hipsta_bids.derivatives.names import EXTRA_OUTPUTS, OUTPUTS
from hipsta_bids.derivatives.results import SHEET_COLUMNS
from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sampling import Regions
from hipsta_bids.inputs.scan import HemisphereInput, MapSource
from hipsta_bids.io import files
from hipsta_bids.io.transforms import check_installed
from hipsta_bids.types import Visit

#: Columns of a file of regions: node numbers as in the sheet table, and the region's name.
COLUMNS = ("x", "y", "region")

#: What a pattern may contain; the side is the hemisphere as FreeSurfer spells it.
PLACEHOLDERS = ("subject", "session", "hemi", "side")

_SIDES = {"L": "lh", "R": "rh"}
_HEMIS = {side: hemi for hemi, side in _SIDES.items()}

#: A session's part of a path, which goes where there are no sessions.
_SESSION = re.compile(r"(?:^|(?<=/))ses-\{session\}/|_ses-\{session\}|\{session\}")

#: What a placeholder stands for.
_LABELS = {"subject": "[A-Za-z0-9]+", "session": "[A-Za-z0-9]+", "hemi": "[LR]", "side": "[lr]h"}
#: Wildcards as regular expressions; the others mean the same in both.
_WILDCARDS = {"**/": "(?:[^/]+/)*", "**": ".*", "*": "[^/]*", "?": "[^/]"}
_WILDCARD = re.compile(r"(\*\*/|\*\*|\*|\?|\[[^\]]+\])")


def _check_columns(path: Path, columns: Collection[str]) -> None:
    lacking = [name for name in COLUMNS if name not in columns]
    unknown = [name for name in columns if name not in {*COLUMNS, *SHEET_COLUMNS}]
    if lacking or unknown:
        fault = f"lacks {', '.join(lacking)}" if lacking else f"has unknown {', '.join(unknown)}"
        raise InputError(
            f"{path}: {fault}; its columns are {', '.join(COLUMNS)} (and any of the sheet table)"
        )


def read_regions(path: Path, shape: tuple[int, int]) -> Regions:
    """Read regions drawn on the sheet, one row per point and region."""
    rows = files.read_tsv(path)
    if rows:
        _check_columns(path, rows[0])
    drawn = [row for row in rows if not files.is_missing(row["region"])]
    if not drawn:
        raise InputError(f"{path}: no point belongs to a region; draw one")
    nodes = _nodes(path, drawn, shape)
    names = [row["region"].strip() for row in drawn]
    counts = Counter(zip(names, *nodes.T.tolist(), strict=True))
    (name, x, y), times = counts.most_common(1)[0]
    if times > 1:
        raise InputError(
            f"{path}: point x={x + 1}, y={y + 1} occurs {times} times in region {name}; keep one"
        )
    regions = tuple(dict.fromkeys(names))
    member = np.zeros((len(regions), *shape), dtype=bool)
    member[[regions.index(name) for name in names], nodes[:, 0], nodes[:, 1]] = True
    return Regions(names=regions, member=member)


def _nodes(
    path: Path, rows: list[dict[str, str]], shape: tuple[int, int]
) -> np.ndarray[tuple[int, int], np.dtype[np.intp]]:
    """Find the nodes of the rows, (N, 2) indices."""
    wrong = [row for row in rows if not (row["x"].isdecimal() and row["y"].isdecimal())]
    off = [
        row
        for row in rows
        if not wrong and not (1 <= int(row["x"]) <= shape[0] and 1 <= int(row["y"]) <= shape[1])
    ]
    if wrong or off:
        first, count = (wrong or off)[0], len(wrong or off)
        fault = "is no pair of whole numbers" if wrong else "lies off the sheet"
        raise InputError(
            f"{path}: point x={first['x']}, y={first['y']} {fault} ({count} in all); x runs from 1"
            f" to {shape[0]}, y from 1 to {shape[1]}"
        )
    return np.array([[int(row["x"]) - 1, int(row["y"]) - 1] for row in rows], dtype=np.intp)


@dataclass(frozen=True, kw_only=True)
class Found(Visit):
    """A file, and its participant as far as the path has it."""

    path: Path
    hemi: str | None


def check_pattern(option: str, name: str, pattern: str) -> None:
    """Refuse placeholders that do not exist."""
    try:
        unknown = fields_of(pattern) - set(PLACEHOLDERS)
    except ValueError:
        unknown = {pattern}
    if unknown:
        placeholders = ", ".join(f"{{{field}}}" for field in PLACEHOLDERS)
        raise UsageError(
            f"{option} {name}: {min(unknown)!r} is not understood; placeholders are {placeholders}"
        )


def fields_of(pattern: str) -> set[str]:
    """List the placeholders of a pattern; ``ValueError`` if braces do not match."""
    return {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}


def fill(pattern: str, subject: str, session: str | None, hemi: str) -> str:
    """Put one hemisphere's labels into a pattern."""
    text = pattern if session else _SESSION.sub("", pattern)
    return text.format(subject=subject, session=session, hemi=hemi, side=_SIDES[hemi])


def find(name: str, root: Path) -> list[Path]:
    """Find the files of a name with wildcards, absolute or relative to a folder."""
    matches = glob.glob(name, root_dir=root, recursive=True)  # noqa: PTH207 (root_dir)
    return [root / match for match in sorted(matches)]


def scan(pattern: str, root: Path) -> list[Found]:
    """Find the files of all hemispheres, with sessions or without."""
    matches: dict[Path, Found] = {}
    for variant in dict.fromkeys((pattern, _SESSION.sub("", pattern))):
        expression = re.compile(_expression(variant))
        name = "".join(
            literal + ("" if field is None else "*")
            for literal, field, _, _ in string.Formatter().parse(variant)
        )
        for path in find(name, root):
            text = path if Path(variant).is_absolute() else path.relative_to(root)
            if (match := expression.fullmatch(text.as_posix())) and path.is_file():
                labels = match.groupdict()
                entry = Found(
                    path=path,
                    subject=labels["subject"],
                    session=labels.get("session"),
                    hemi=labels.get("hemi") or _HEMIS.get(labels.get("side", "")),
                )
                matches.setdefault(path, entry)
    return sorted(matches.values(), key=lambda entry: str(entry.path))


def _expression(pattern: str) -> str:
    """Regular expression with a group per placeholder; further ones of a kind must be equal."""
    expression = ""
    used_fields: set[str] = set()
    for literal, field, _, _ in string.Formatter().parse(pattern):
        for part in _WILDCARD.split(literal):
            is_set = part.startswith("[") and part.endswith("]")
            expression += _WILDCARDS.get(part) or (
                part.replace("[!", "[^", 1) if is_set else re.escape(part)
            )
        if field is not None:
            expression += (
                f"(?P={field})" if field in used_fields else f"(?P<{field}>{_LABELS[field]})"
            )
            used_fields.add(field)
    return expression


def _check_names(names: Sequence[str]) -> None:
    reserved = {"x", "y", *(row.desc for row in (*OUTPUTS, *EXTRA_OUTPUTS))}
    reserved |= {m.name for m in MAPS}
    for name in names:
        if not name.isalnum() or not name.isascii():
            raise UsageError(f"--map: {name!r} is not a name of letters and digits")
        if name in reserved or names.count(name) > 1:
            fault = "belongs to other outputs" if name in reserved else "occurs twice"
            raise UsageError(f"--map: the name {name} {fault}; choose another one")


def map_requests(
    patterns: Sequence[tuple[str, str]],
    samplings: Sequence[tuple[str | None, str]],
    interpolations: Sequence[tuple[str | None, str]],
    transforms: Sequence[tuple[str, str]] = (),
    references: Sequence[tuple[str, str]] = (),
) -> tuple[MapSource, ...]:
    """Combine and check the options about maps; choices without a name are for all other maps."""
    names = [name for name, _ in patterns]
    _check_names(names)
    for name, pattern in patterns:
        check_pattern("--map", name, pattern)
    if transforms:
        check_installed("--map-transform")
    for option, files_of in (("transform", transforms), ("reference", references)):
        for name, pattern in files_of:
            check_pattern(f"--map-{option}", name, pattern)
    options = {
        "sampling": samplings,
        "interpolation": interpolations,
        "transform": transforms,
        "reference": references,
    }
    for option, choices in options.items():
        if unknown_names := [name for name, _ in choices if name not in {None, *names}]:
            raise UsageError(f"--map-{option}: there is no --map {unknown_names[0]}=...")
    sampling_of = {None: "depth", **dict(samplings)}
    interpolation_of = {None: "linear", **dict(interpolations)}
    return tuple(
        MapSource(
            name=name,
            pattern=pattern,
            sampling=sampling_of.get(name, sampling_of[None]),
            interpolation=interpolation_of.get(name, interpolation_of[None]),
            transform_pattern=dict(transforms).get(name),
            reference_pattern=dict(references).get(name),
        )
        for name, pattern in patterns
    )


def attach(
    items: Iterable[HemisphereInput],
    requests: Sequence[MapSource],
    regions: Path | None,
    bids_dir: Path,
) -> tuple[tuple[HemisphereInput, ...], tuple[str, ...]]:
    """Look for the volumes of each hemisphere, and count them in one note per map."""
    attached = tuple(
        replace(
            item,
            maps=tuple(_source(item, request, bids_dir) for request in requests),
            regions=regions,
        )
        for item in items
    )
    notes = []
    for number, request in enumerate(requests):
        without = [item for item in attached if item.maps[number].path is None]
        line = f"map {request.name}: {len(attached) - len(without)} of {len(attached)} hemispheres"
        if without:
            first = without[0]
            line += (
                f" have a file; not sub-{first.subject} hemi-{first.hemi}"
                f" ({first.maps[number].missing})"
            ) + (f" and {len(without) - 1} more" if len(without) > 1 else "")
        notes.append(line)
    return attached, tuple(notes)


def _source(item: HemisphereInput, request: MapSource, bids_dir: Path) -> MapSource:
    patterns = {
        "path": request.pattern,
        "transform": request.transform_pattern,
        "reference": request.reference_pattern,
    }
    paths: dict[str, Path | None] = {}
    missing = None
    for key, pattern in patterns.items():
        if pattern is None:
            continue
        name = fill(pattern, item.subject, item.session, item.hemi)
        matches = find(name, bids_dir)
        if not matches:
            missing = missing or f"no file {name}"
        elif len(matches) > 1:
            missing = missing or f"{len(matches)} files match {name}: {matches[0]}, {matches[1]}"
        else:
            paths[key] = matches[0]
    return replace(
        request,
        path=None if missing else paths["path"],
        transform=paths.get("transform"),
        reference=paths.get("reference"),
        missing=missing,
        source_path=None if Path(request.pattern).is_absolute() else bids_dir,
    )
