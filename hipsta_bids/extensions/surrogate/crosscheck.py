"""``hipsta-bids surrogate``: thickness in single slices, beside that of the sheet."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.hemisphere import format_column
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace, read_sheet
from hipsta_bids.errors import ExitCode, HipstaError, InputError, OutputError, ProtocolError
from hipsta_bids.extensions.surrogate.medial_axis import SurrogateProfile, surrogate_profiles
from hipsta_bids.extensions.surrogate.settings import SurrogateSettings
from hipsta_bids.geometry.agreement import agreement, compare_nearby
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io import files
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float

#: Compared with points of the mid-surface that lie this near, mm.
MATCH_REACH = 1.0

_DIGITS = 4


def crosscheck(
    items: Sequence[HemisphereInput],
    out_dir: Path,
    settings: Settings,
    echo: Callable[[str], None],
    warn: Callable[[str], None],
) -> ExitCode:
    """Measure hemispheres in single slices and write one table each."""
    dataset.check_own_dataset(out_dir)
    files.check_writable(out_dir)
    dataset.settle_settings(out_dir, settings)
    sources = dataset.source_names((item.source, item.source_path) for item in items)
    dataset.write_description(out_dir, sources)
    errors = []
    for item in items:
        name = HemisphereName(
            subject=item.subject, session=item.session, hemi=item.hemi, seg=item.protocol.name
        )
        result = ResultPlace(root=out_dir, name=name)
        files.remove([result.path("surrogate"), result.path("surrogate_sidecar")])
        title = f"{result.name.stem}_seg-{result.name.seg}"
        try:
            for line in _measure(item, result, settings):
                echo(f"{title}  {line}")
        except OutputError:
            raise
        except HipstaError as error:
            errors.append(error)
            warn(f"{title}  failed  {error}")
    if not errors:
        return ExitCode.OK
    bad = all(isinstance(error, (InputError, ProtocolError)) for error in errors)
    return ExitCode.BAD_DATA if bad and len(errors) == len(items) else ExitCode.SOME_FAILED


def _measure(item: HemisphereInput, result: ResultPlace, settings: Settings) -> list[str]:
    """Measure one hemisphere, write its table, and return a line per slice."""
    body = extract_body(read_label_volume(item), settings.body.changed(region="body"))
    sheet = _read_sheet(result)
    rows: list[list[str]] = []
    lines = []
    for position in settings.of(SurrogateSettings).positions:
        for profile in surrogate_profiles(body, position, settings.sheet):
            mesh = np.full(len(profile.points), np.nan)
            if sheet is not None:
                mesh = compare_nearby(profile.points, *sheet, MATCH_REACH)
            rows += _rows(profile, mesh)
            if profile.sampling == "proportional":
                lines.append(_line(profile, mesh))
    columns = dataset.TABLES["surrogate"]
    files.write_tsv(result.path("surrogate"), list(columns), rows)
    files.write_json(result.path("surrogate_sidecar"), dataset.describe_columns(columns))
    return lines


def _read_sheet(result: ResultPlace) -> tuple[Float, Float] | None:
    """Read points (M, 3), RAS mm, and thickness (M,), mm, that the participant level measured."""
    with suppress(InputError):
        names = ("r", "a", "s", "thickness")
        *axes, thickness = (v.ravel() for v in read_sheet(result.path("sheet"), names).values())
        return np.stack(axes, axis=-1), thickness
    return None


def _rows(profile: SurrogateProfile, mesh: Float) -> Iterator[list[str]]:
    places = (profile.fraction, profile.distance, *profile.points.T)
    columns = (format_column(column, _DIGITS) for column in (*places, profile.thickness, mesh))
    for number, cells in enumerate(zip(*columns, strict=True), start=1):
        yield [f"{profile.position:g}", profile.sampling, str(number), *cells]


def _line(profile: SurrogateProfile, mesh: Float) -> str:
    line = f"slice at {profile.position:.0%}: mean thickness {profile.thickness.mean():.3f} mm"
    comparison = agreement(profile.thickness, mesh)
    if not comparison.count:
        return f"{line} (no sheet to compare with)"
    return (
        f"{line}, {comparison.difference:+.3f} mm to the sheet, r {comparison.correlation:.2f},"
        f" slope {comparison.slope:.2f} at {comparison.count} points"
    )
