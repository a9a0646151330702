"""``hipsta-bids surrogate``: thickness in single slices, to cross-check that of the mesh."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.bids import derivative, files, tables
from hipsta_bids.bids.images import read_label_volume
from hipsta_bids.bids.inputs import HemisphereInput
from hipsta_bids.bids.names import HemisphereName
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.errors import ExitCode, HipstaError, InputError, OutputError, SchemeError
from hipsta_bids.geometry.agreement import agreement, compare_nearby
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.surrogate import SurrogateProfile, surrogate_profiles
from hipsta_bids.settings import Settings

#: Columns of the table: definition and unit.
COLUMNS: dict[str, tuple[str, str | None]] = {
    "slice": ("where the slice is, fraction of the body's length from its posterior end", None),
    "sampling": (
        "proportional: where the sheet has its nodes along x; equidistant: in equal steps",
        None,
    ),
    "point": ("number along the medial axis, 1 nearest to the medial rim", None),
    "fraction": ("place on the medial axis, 0 at the medial and 1 at the lateral rim", None),
    "distance": ("from the medial rim along the medial axis", "mm"),
    "r": ("position on the medial axis, scanner RAS, left to right", "mm"),
    "a": ("position on the medial axis, scanner RAS, posterior to anterior", "mm"),
    "s": ("position on the medial axis, scanner RAS, inferior to superior", "mm"),
    "thickness": ("distances to the closest points of the contour on both sides, added", "mm"),
    "thickness_mesh": ("thickness of the sheet nearby, if the participant level has run", "mm"),
}

_DIGITS = 4


@dataclass(frozen=True, kw_only=True)
class _Sheet:
    """What the participant level wrote."""

    points: Float
    """(M, 3) RAS mm."""
    thickness: Float
    """(M,) mm."""


def crosscheck(
    items: Sequence[HemisphereInput],
    out_dir: Path,
    settings: Settings,
    say: Callable[[str], None],
    complain: Callable[[str], None],
) -> ExitCode:
    """Measure hemispheres in single slices and write one table each.

    Parameters
    ----------
    items : sequence of HemisphereInput
    out_dir : Path
        The output dataset; with results of the participant level, those are compared.
    settings : Settings
    say, complain : callable
        Receive one line per hemisphere that succeeded or failed.

    Returns
    -------
    ExitCode
        As at the participant level: failed hemispheres do not stop the others.

    Raises
    ------
    OutputError
        If a file cannot be written.
    SettingsError
        If the folder holds results with other settings.
    UsageError
        If it is a dataset of other software.
    """
    derivative.check_not_foreign(out_dir)
    files.check_writable(out_dir)
    derivative.settle_settings(out_dir, settings)
    sources = derivative.source_names((item.source, item.source_path) for item in items)
    derivative.write_description(out_dir, sources)
    errors = []
    for item in items:
        place = _place(item, out_dir)
        files.remove([place.path("surrogate"), place.path("surrogate_sidecar")])
        title = f"{place.name.stem}_seg-{place.name.seg}"
        try:
            for line in _measure(item, place, settings):
                say(f"{title}  {line}")
        except OutputError:
            raise
        except HipstaError as error:
            errors.append(error)
            complain(f"{title}  failed  [{error.reason}] {error}")
    if not errors:
        return ExitCode.OK
    bad = all(isinstance(error, (InputError, SchemeError)) for error in errors)
    return ExitCode.BAD_DATA if bad and len(errors) == len(items) else ExitCode.SOME_FAILED


def _place(item: HemisphereInput, out_dir: Path) -> ResultPlace:
    name = HemisphereName(
        subject=item.subject, session=item.session, hemi=item.hemi, seg=item.scheme.name
    )
    return ResultPlace(root=out_dir, name=name)


def _measure(item: HemisphereInput, place: ResultPlace, settings: Settings) -> Iterator[str]:
    """Measure one hemisphere, write its table, and give a line per slice."""
    body = extract_body(read_label_volume(item), replace(settings.body, region="body"))
    sheet = _read_sheet(place)
    rows: list[list[str]] = []
    lines = []
    for position in settings.surrogate.positions:
        profiles = surrogate_profiles(body, position, settings.sheet, settings.surrogate)
        mesh = [_mesh_thickness(profile, sheet, settings) for profile in profiles]
        rows += [
            row
            for profile, beside in zip(profiles, mesh, strict=True)
            for row in _rows(profile, beside)
        ]
        lines.append(_line(profiles[0], mesh[0]))
    files.write_tsv(place.path("surrogate"), list(COLUMNS), rows)
    files.write_json(
        place.path("surrogate_sidecar"),
        {
            name: {"Description": text} | ({"Units": unit} if unit else {})
            for name, (text, unit) in COLUMNS.items()
        },
    )
    yield from lines


def _read_sheet(place: ResultPlace) -> _Sheet | None:
    """Read the sheet that the participant level measured, if it did."""
    with suppress(InputError):
        rows = files.read_tsv(place.path("sheet"))
        columns = {
            name: np.array([np.nan if row[name] == files.MISSING else row[name] for row in rows])
            for name in ("r", "a", "s", "thickness")
        }
        values = {name: column.astype(np.float64) for name, column in columns.items()}
        return _Sheet(
            points=np.stack([values["r"], values["a"], values["s"]], axis=-1),
            thickness=values["thickness"],
        )
    return None


def _mesh_thickness(profile: SurrogateProfile, sheet: _Sheet | None, settings: Settings) -> Float:
    if sheet is None:
        return np.full(len(profile.points), np.nan)
    return compare_nearby(profile.points, sheet.points, sheet.thickness, settings.surrogate.reach)


def _rows(profile: SurrogateProfile, mesh: Float) -> Iterator[list[str]]:
    columns = [
        tables.format_column(values, _DIGITS)
        for values in (
            profile.fraction,
            profile.distance,
            *profile.points.T,
            profile.thickness,
            mesh,
        )
    ]
    for number, cells in enumerate(zip(*columns, strict=True), start=1):
        yield [f"{profile.position:g}", profile.sampling, str(number), *cells]


def _line(profile: SurrogateProfile, mesh: Float) -> str:
    line = f"slice at {profile.position:.0%}: mean thickness {profile.thickness.mean():.3f} mm"
    found = agreement(profile.thickness, mesh)
    if not found.count:
        return f"{line} (no sheet to compare with)"
    return (
        f"{line}, {found.difference:+.3f} mm to the sheet, r {found.correlation:.2f},"
        f" slope {found.slope:.2f} at {found.count} points"
    )
