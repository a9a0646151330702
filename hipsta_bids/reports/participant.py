"""The page about one visit: is this hemisphere usable, and what went wrong."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.joints import find_measurements, load
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.reports.cohort import MEASURES, SMALLEST_COHORT, Cohort, card_of, correction_of
from hipsta_bids.reports.display import (
    MAP_KINDS,
    THICKNESS,
    colors_of,
    palette,
    scale_of,
    subfield_title,
)
from hipsta_bids.reports.page import Section, build_sections, number, render, usual_ranges
from hipsta_bids.reports.results import (
    SURFACES,
    Finding,
    Hemisphere,
    Views,
    find_results,
    input_path,
    read_views,
)
from hipsta_bids.reports.slices import stack_of
from hipsta_bids.reports.unfolded import draw_map, draw_profiles
from hipsta_bids.reports.verdict import of_flag
from hipsta_bids.types import RATINGS, Decision, Float

#: Finer masks of failed hemispheres are thinned to about this edge before they are drawn, mm.
_EDGE = 0.9


def scene_of(hemisphere: Hemisphere, views: Views | None, names: Sequence[str]) -> dict[str, Any]:
    """Collect the scene of one hemisphere."""
    scene: dict[str, Any] = {
        "side": hemisphere.side,
        "hemi": hemisphere.result.name.hemi,
        "findings": [
            {
                "kind": min(f.kind for f in group),  # failure, flag, repair
                "message": "; ".join(f.message for f in group),
                "point": point,
                "number": number,
            }
            for number, (point, group) in enumerate(_points_of(hemisphere).items(), start=1)
        ],
    }
    if hemisphere.measured:
        return scene | _sheet_scene(hemisphere, names)
    if views is not None and views.mask is not None:
        vertices, triangles = _body(views.mask, views)
        scene["body"] = {"vertices": _flat(vertices, 2), "triangles": triangles.ravel().tolist()}
    return scene


def _points_of(hemisphere: Hemisphere) -> dict[tuple[float, float, float], list[Finding]]:
    """Collect what is said about each point that messages name."""
    points: dict[tuple[float, float, float], list[Finding]] = {}
    for finding in hemisphere.findings:
        if finding.point is not None:
            points.setdefault(finding.point, []).append(finding)
    return points


def scales_of(hemispheres: Sequence[Hemisphere]) -> dict[str, Any]:
    """Collect the color scales that all scenes of a page share."""
    scales: dict[str, Any] = {}
    for kind in MAP_KINDS:
        low, high = scale_of(kind, [h.sheet.columns[kind.column] for h in hemispheres])
        scales[kind.column] = {
            "title": kind.title,
            "unit": kind.unit,
            "low": low,
            "high": high,
            "digits": kind.digits,
            "colors": colors_of(kind.colors).tolist(),
        }
    return scales


def _sheet_scene(hemisphere: Hemisphere, names: Sequence[str]) -> dict[str, Any]:
    sheet = hemisphere.sheet
    index = {name: n for n, name in enumerate(names)}
    return {
        "shape": sheet.shape,
        "parts": sheet.parts,
        "ends": sheet.end_rows,
        "extent": [hemisphere.summary.get(f"extent_{axis}", 1.0) for axis in "xy"],
        "surfaces": {name: _flat(sheet.points[name], 2) for name in SURFACES},
        "maps": {kind.column: _flat(sheet.columns[kind.column], 4) for kind in MAP_KINDS},
        "subfields": [
            {"name": name, "color": color}
            for name, color in palette(hemisphere.protocol, names).items()
        ],
        "subfield": [index.get(str(name), -1) for name in sheet.subfield.ravel()],
        "valid": sheet.valid.astype(int).ravel().tolist(),
        "repaired": sheet.repaired.astype(int).ravel().tolist(),
        "planes": list(_planes(hemisphere)),
    }


def _planes(hemisphere: Hemisphere) -> Iterator[dict[str, Any]]:
    """Describe the end planes by their points nearest to the middle of the sheet's end."""
    sheet = hemisphere.sheet
    rows = sheet.ends or (0, -1)
    for end, (name, row) in enumerate(zip(("posterior", "anterior"), rows, strict=True)):
        plane = hemisphere.metrics.get(f"{name}_plane")
        if isinstance(plane, Mapping):
            point, normal = (np.array(plane[key]) for key in ("point_ras_mm", "normal_ras"))
            center = np.nanmean(sheet.points["midthickness"][:, row], axis=0)
            center += ((point - center) @ normal) * normal
            yield {"point": center.round(2).tolist(), "normal": normal.tolist(), "end": end}


def subfields_of(hemispheres: Sequence[Hemisphere]) -> list[str]:
    """List the subfields of measured hemispheres from medial to lateral."""
    columns: dict[str, list[float]] = {}
    for hemisphere in hemispheres:
        subfield = hemisphere.sheet.subfield
        for name in np.unique(subfield[subfield != ""]).tolist():
            columns.setdefault(name, []).extend(np.nonzero(subfield == name)[0].tolist())
    return sorted(columns, key=lambda name: float(np.mean(columns[name])))


def _flat(values: Float, digits: int) -> list[float | None]:
    """Round to a list; missing values are ``None``."""
    return [
        round(value, digits) if np.isfinite(value) else None for value in values.ravel().tolist()
    ]


def _body(mask: NDArray[np.bool_], views: Views) -> tuple[Float, NDArray[np.int64]]:
    """Wrap a mask in triangles."""
    from skimage.measure import marching_cubes  # noqa: PLC0415  (slow to load, rarely needed)

    step = max(1, round(_EDGE / float(views.voxel.max())))
    padded = np.pad(mask, 2 * step).astype(np.float32)
    vertices, triangles, _, _ = marching_cubes(padded, 0.5, step_size=step)  # type: ignore[no-untyped-call]  # typed in part only
    points = (vertices - 2 * step) @ views.affine[:3, :3].T + views.affine[:3, 3]
    return points, triangles


#: Rows of the quality table that hold words, and the keys of the quality record.
_FACTS = (
    ("End planes", "posterior_end_rule", "anterior_end_rule"),
    ("Interior side found by", "side_rule"),
)


@dataclass(frozen=True, eq=False)
class Series:
    """Both hemispheres of one visit, measured with one protocol in one region."""

    hemispheres: tuple[Hemisphere, ...]
    """Left before right; one may be missing."""
    cohort: Cohort
    bids_dir: Path | None = None
    """The dataset with anatomical images and dates of sessions; ``None`` shows neither."""
    anatomy: bool = True
    """Whether anatomical images are shown."""

    @property
    def measured(self) -> list[Hemisphere]:
        """Hemispheres with maps."""
        return [h for h in self.hemispheres if h.measured]

    @property
    def title(self) -> str:
        """Protocol and region."""
        first = self.hemispheres[0]
        name = first.result.name
        return ", ".join(filter(None, (name.seg, name.region_title)))

    @property
    def whole(self) -> bool:
        """Whether the head is on the sheet."""
        return self.hemispheres[0].result.name.region in EXPERIMENTAL

    @cached_property
    def views(self) -> Mapping[str, Views | None]:
        """Labels and mask by hemisphere."""
        images = self.bids_dir if self.anatomy else None
        return {h.result.name.hemi: read_views(h, images) for h in self.hemispheres}

    def view(self, hemisphere: Hemisphere) -> Views | None:
        """Labels and mask of one hemisphere."""
        return self.views[hemisphere.result.name.hemi]


def _key_numbers(series: Series) -> Mapping[str, Any] | None:
    """Compare the numbers of both hemispheres with those of the cohort."""
    measured = series.measured
    if not measured:
        return None
    measures = MEASURES | _subfield_measures(series)
    rows = [
        (about, [_value_in_cohort(h, name, series.cohort, about["digits"]) for h in measured])
        for name, about in measures.items()
    ]
    counts = [len(series.cohort.values(h.result.name, "thickness_mean")) for h in measured]
    return {
        "sides": [h.side for h in measured],
        "rows": rows,
        "others": min(counts) if min(counts) >= SMALLEST_COHORT else 0,
        "smallest": SMALLEST_COHORT,
    }


def _subfield_measures(series: Series) -> dict[str, dict[str, Any]]:
    """Mean thickness of each subfield that one of the hemispheres has."""
    prefix = "thickness_mean_"
    measures = {}
    for hemisphere in series.measured:
        for name, value in hemisphere.summary.items():
            if name.startswith(prefix) and np.isfinite(value):
                title = f"Mean thickness, {subfield_title(name.removeprefix(prefix))}"
                measures[name] = {"title": title, "unit": "mm", "digits": 2}
    return measures


def _value_in_cohort(
    hemisphere: Hemisphere, name: str, cohort: Cohort, digits: int
) -> tuple[float, Mapping[str, Any] | None]:
    """Look up a number, with its position in the range of the cohort."""
    value = hemisphere.summary.get(name, np.nan)
    values = cohort.values(hemisphere.result.name, name)
    comparable = len(values) >= SMALLEST_COHORT and np.isfinite(value)
    return value, _strip(value, values, digits) if comparable else None


def _strip(value: float, values: Float, digits: int) -> Mapping[str, Any]:
    """Positions of one value and all of the cohort between 0 and 100."""
    low, high = float(values.min()), float(values.max())
    median = float(np.median(values))
    share = float(np.mean(values <= value))

    def scaled(v: float) -> float:
        return round(100 * (v - low) / max(high - low, 1e-9), 1)

    return {
        "dots": [scaled(float(v)) for v in values],
        "value": scaled(value),
        "median": scaled(median),
        "words": f"{value:.{digits}f}; cohort of {len(values)}: {low:.{digits}f} to"
        f" {high:.{digits}f}, median {median:.{digits}f}; {share:.0%} are not larger",
    }


def _quality_numbers(series: Series) -> Mapping[str, Any] | None:
    """Compare the quality numbers of both hemispheres with their usual ranges."""
    measured = series.measured
    if not measured:
        return None
    thickness = float(np.nanmean([h.summary.get("thickness_mean", np.nan) for h in measured]))
    rows = []
    lengths = np.array([number(h.metrics, "body_length_mm") for h in measured])
    opposite = lengths[::-1] if len(lengths) > 1 else np.full(1, np.nan)
    ranges = usual_ranges(thickness, series.cohort.settings, whole=series.whole)
    for name, usual in ranges.items():
        values = [number(h.metrics, name) for h in measured]
        if name == "length_difference_mm":
            values = (lengths - opposite).tolist()
        if not np.isnan(values).all():
            rows.append((usual, values))
    return {"sides": [h.side for h in measured], "rows": rows, "facts": list(_facts(series))}


def _facts(series: Series) -> Iterator[tuple[str, list[str]]]:
    for title, *keys in _FACTS:
        if not series.whole or any(key in h.metrics for key in keys for h in series.measured):
            values = ([str(h.metrics.get(key, "n/a")) for key in keys] for h in series.measured)
            yield title, [", ".join(texts) for texts in values]


def participant_page(
    root: Path,
    subject: str,
    session: str | None,
    cohort: Cohort,
    bids_dir: Path | None = None,
    *,
    anatomy: bool = True,
) -> str | None:
    """Make the page about one visit, with images and dates of sessions of ``bids_dir``."""
    kinds: dict[tuple[str, str], list[Hemisphere]] = {}
    for hemisphere in find_results(root, subject, session):
        name = hemisphere.result.name
        kinds.setdefault((name.seg, name.region), []).append(hemisphere)
    if not kinds:
        return None
    series = [Series(tuple(group), cohort, bids_dir, anatomy) for group in kinds.values()]
    parts = [
        {
            "title": part.title,
            "protocol": part.hemispheres[0].record.get("scheme_title") or part.title,
            "prefix": f"p{n}",
            "sections": build_sections(SECTIONS, part, f"p{n}", kind="participant_sections"),
        }
        for n, part in enumerate(series, start=1)
    ]
    visit = f"sub-{subject}" + (f", ses-{session}" if session else "")
    hemispheres = [hemisphere for part in series for hemisphere in part.hemispheres]
    versions = sorted({str(h.record.get("version")) for h in hemispheres})
    hashes = sorted({str(h.record.get("settings_hash")) for h in hemispheres})
    return render(
        "participant.html",
        title=visit,
        parts=parts,
        anatomy=any(view and view.anatomy for part in series for view in part.views.values()),
        versions=versions,
        hashes=hashes,
        measured=max(_origin_of(h, cohort)[1] for h in hemispheres),
    )


def _origin_of(hemisphere: Hemisphere, cohort: Cohort) -> tuple[str | None, str]:
    """Find which command measured a hemisphere, and when; without its log, when that was."""
    title = hemisphere.result.name.title
    if title in cohort.origins:
        return cohort.origins[title]
    written = hemisphere.result.path("qc").stat().st_mtime
    return None, f"{datetime.fromtimestamp(written, UTC):%Y-%m-%d %H:%M} UTC"


def _sides(series: Series) -> Mapping[str, Any]:
    """Collect what decides about each hemisphere: slices, map, findings and rating."""
    cards = []
    for hemisphere in series.hemispheres:
        view = series.view(hemisphere)
        card = card_of(hemisphere, series.cohort, view)
        points = _points_of(hemisphere)
        placeless = [f for f in hemisphere.findings if f.point is None]
        cards.append(
            {
                **card,
                "points": [
                    (min(f.kind for f in group), "; ".join(_message(f, hemisphere) for f in group))
                    for group in points.values()
                ],
                "rest": [(f.kind, _message(f, hemisphere)) for f in placeless],
                "map": draw_map(THICKNESS, [hemisphere], pins=list(points))
                if hemisphere.measured
                else None,
                "hemisphere": hemisphere,
                "path": input_path(hemisphere),
                "view": view,
                "stack": stack_of(hemisphere, view) if view else None,
            }
        )
    return {"cards": cards, "ratings": RATINGS, "legend": _legend(series), "whole": series.whole}


def _message(finding: Finding, hemisphere: Hemisphere) -> str:
    """Write a finding; flags, except the headline's, with their consequence."""
    if np.isnan(finding.share) or finding.message == hemisphere.findings[0].message:
        return finding.message
    return f"{finding.message}. {of_flag(hemisphere, finding)}"


def _legend(series: Series) -> Mapping[str, str]:
    """Colors of the labels by their names."""
    colors: dict[str, str] = {}
    for hemisphere in series.hemispheres:
        view = series.view(hemisphere)
        names = [name for name, _ in view.names.values()] if view else []
        colors |= palette(hemisphere.protocol, list(dict.fromkeys(names)))
    return colors


def _sheets(series: Series) -> Mapping[str, Any] | None:
    measured = series.measured
    if not measured:
        return None
    pictures = [draw_map(kind, measured) for kind in MAP_KINDS if kind != THICKNESS]
    places = (measurement.pictures for measurement in find_measurements())
    added = [load(place)(measured) for place in places if place]
    return {
        "pictures": [*pictures, *chain.from_iterable(further for further, _ in added)],
        "lines": list(chain.from_iterable(lines for _, lines in added)),
        "whole": series.whole,
        "doubtful": any(h.sheet.doubtful.any() for h in measured),
        "invalid": any(not h.sheet.valid.all() for h in measured),
    }


def _view(series: Series) -> Mapping[str, Any] | None:
    names = subfields_of(series.measured)
    scenes = [scene_of(h, series.view(h), names) for h in series.hemispheres]
    scenes = [scene for scene in scenes if "surfaces" in scene or "body" in scene]
    if not scenes:
        return None
    data = {"scenes": scenes, "scales": scales_of(series.measured)}
    return {"data": data, "measured": bool(series.measured)}


def _profiles(series: Series) -> Mapping[str, Any] | None:
    measured = series.measured
    if not measured:
        return None
    profiles = {kind.column: _cohort_profiles(series, kind.column) for kind in MAP_KINDS}
    pictures = [draw_profiles(kind, measured, profiles[kind.column]) for kind in MAP_KINDS]
    return {"pictures": pictures, "others": bool(profiles["thickness"])}


def _cohort_profiles(series: Series, column: str) -> dict[str, Float]:
    """Mean profiles along x of all hemispheres of the same kind."""
    profiles = {}
    for hemisphere in series.measured:
        like = series.cohort.profiles(hemisphere.result.name, column)
        if len(like) >= SMALLEST_COHORT:
            profiles[hemisphere.result.name.hemi] = like
    return profiles


def _correct(series: Series) -> Mapping[str, Any] | None:
    """How to correct what was measured; nothing if all is well."""
    doubtful = [h for h in series.hemispheres if h.decision != Decision.USE]
    return correction_of(doubtful, series.cohort.settings) if doubtful else None


def _origin(series: Series) -> Mapping[str, Any]:
    return {"rows": [(h, *_origin_of(h, series.cohort)) for h in series.hemispheres]}


#: From top to bottom: key, which is also the template's name, title, and what builds it.
SECTIONS: tuple[Section[Series], ...] = tuple(
    Section(key=key, title=title, template=f"sections/{key}.html", build=build)
    for key, title, build in (
        ("status", "Hemispheres", _sides),
        ("numbers", "Key numbers", _key_numbers),
        ("sheet", "Unfolded maps", _sheets),
        ("view", "Three dimensions", _view),
        ("profiles", "Profiles", _profiles),
        ("quality", "Quality", _quality_numbers),
        ("correct", "How to correct it", _correct),
        ("origin", "Origin", _origin),
    )
)
