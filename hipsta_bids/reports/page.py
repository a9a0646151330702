"""What pages say and how they are made: reasons, usual ranges, and templates.

A page is one file that asks for nothing from outside.
"""

import logging
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hipsta_bids import __version__
from hipsta_bids.reports.display import ORIENTATION
from hipsta_bids.settings import Settings

if TYPE_CHECKING:
    from jinja2 import Environment

_LOGGER = logging.getLogger(__name__)
_Topic = TypeVar("_Topic")


@dataclass(frozen=True, kw_only=True)
class Section(Generic[_Topic]):
    """One part of a page."""

    key: str
    """Its anchor."""
    title: str
    template: str
    """File in ``templates/``."""
    build: Callable[[_Topic], Mapping[str, Any] | None]
    """Returns what the template shows; ``None`` leaves the section out."""


@dataclass(frozen=True, kw_only=True)
class Content:
    """A section that is ready for its template."""

    key: str
    title: str
    template: str
    values: Mapping[str, Any]
    """With ``problem``, a phrase, where it could not be built."""


def build_sections(
    sections: Iterable[Section[_Topic]], topic: _Topic, prefix: str
) -> list[Content]:
    """Build sections; one that fails is noted in the page and in the log, and harms no other."""
    built = []
    for section in sections:
        try:
            values = section.build(topic)
        except Exception as error:  # a page with a gap is better than none
            _LOGGER.exception("report: section %s of %s", section.key, prefix)
            values = {"problem": f"{type(error).__name__}: {error}"}
        if values is not None:
            template = section.template if "problem" not in values else "problem.html"
            key = f"{prefix}-{section.key}"
            built.append(Content(key=key, title=section.title, template=template, values=values))
    return built


def render(template: str, **values: Any) -> str:  # noqa: ANN401  (what the template shows)
    """Fill a page's template."""
    return _environment().get_template(template).render(version=__version__, **values)


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415  (start-up)
    from markupsafe import Markup  # noqa: PLC0415

    environment = Environment(
        loader=PackageLoader("hipsta_bids.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    def asset(name: str) -> Markup:
        """Return one of the package's own files as it is."""
        source = files("hipsta_bids.reports") / "assets" / name
        return Markup(source.read_text(encoding="utf-8"))  # noqa: S704  (no user's text in it)

    environment.globals |= {"asset": asset, "orientation": ORIENTATION}
    return environment


@dataclass(frozen=True, kw_only=True)
class Reason:
    """What a machine-readable reason means, and what to do about it."""

    action: str
    """What kind of thing to do, a key of :func:`reason_actions`."""
    meaning: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
class ReasonSection:
    """Reasons that occur in the same situation."""

    title: str
    text: str
    reasons: Mapping[str, Reason]
    """By their names."""


@cache
def reason_sections() -> tuple[ReasonSection, ...]:
    """Read the table of all reasons, in the order of the reference page."""
    return tuple(
        ReasonSection(
            title=section["title"],
            text=section["text"],
            reasons={name: Reason(**row) for name, row in section["reasons"].items()},
        )
        for section in _reason_table()["section"]
    )


def reason_actions() -> Mapping[str, str]:
    """Titles of what to do, in the order of the reference page, by the keys that reasons name."""
    actions: Mapping[str, str] = _reason_table()["actions"]
    return actions


@cache
def _reason_table() -> dict[str, Any]:
    text = (files("hipsta_bids.reports") / "reasons.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@dataclass(frozen=True, kw_only=True)
class Usual:
    """A quality number and its usual range."""

    name: str
    """In the quality record."""
    title: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    percent: bool = False

    def text(self, value: float) -> str:
        """Format a value with its unit."""
        if self.percent:
            return f"{value:.1%}"
        return f"{value:.3g}{f' {self.unit}' if self.unit else ''}"

    @property
    def range(self) -> str:
        """Format the usual range."""
        low, high = math.isfinite(self.low), math.isfinite(self.high)
        if low and high:
            return f"{self.text(self.low)} to {self.text(self.high)}"
        if low:
            return f"at least {self.text(self.low)}"
        return f"at most {self.text(self.high)}" if high else "any"


def usual_ranges(
    thickness: float, settings: Mapping[str, Any], *, whole: bool = False
) -> tuple[Usual, ...]:
    """List the quality numbers that a page shows; some limits are relative to the thickness, mm.

    ``whole`` are sheets with a head, which are folded where their map is.
    """
    usual = Settings().model_dump()
    stages = {name: usual[name] | dict(settings.get(name) or {}) for name in usual}
    checks, topology, body = stages["checks"], stages["topology"], stages["body"]
    return (
        Usual(
            name="voxels_across",
            title="Voxels across the sheet",
            meaning="mean thickness in in-plane voxels: fewer make thickness coarse",
            low=checks["min_voxels_across"],
        ),
        Usual(
            name="body_length_mm",
            title="Distance of the end planes",
            meaning="along the body, from the posterior plane to the anterior one",
            low=body["min_length"],
            unit="mm",
        ),
        Usual(
            name="length_difference_mm",
            title="Difference of these distances",
            meaning="this side minus the other; look at ends without labels",
            low=-checks["usual_length_difference"],
            high=checks["usual_length_difference"],
            unit="mm",
        ),
        *(
            Usual(
                name=f"{end}_end_uncertainty_mm",
                title=f"Uncertainty of the {end} end",
                meaning="standard error over the cues by which it was found, 0 with labels",
                high=checks["flag_end"],
                unit="mm",
            )
            for end in ("posterior", "anterior")
        ),
        Usual(
            name="changed_fraction",
            title="Changed by repairs",
            meaning="share of the body that repairs of its topology added or removed",
            high=topology["flag_fraction"],
            percent=True,
        ),
        Usual(
            name="boundary_rim_distance_mm",
            title="Disagreement of the boundaries",
            meaning="how far two ways to find the medial and the lateral boundary differ",
            high=checks["flag_rim_distance"] * thickness,
            unit="mm",
        ),
        Usual(
            name="label_order",
            title="Order of labels",
            meaning="rank correlation of x with the order of labels from medial to lateral",
            low=checks["min_label_order"],
        ),
        Usual(
            name="folded_fraction",
            title="Folded coordinates",
            meaning=f"share of the {'area' if whole else 'volume'} whose coordinates are inverted",
            high=math.inf if whole else checks["flag_folded"],
            percent=True,
        ),
        Usual(
            name="masked_fraction",
            title="Area without values",
            meaning="share of the sheet within 1 mm of edges, ends and holes",
            percent=True,
        ),
        Usual(
            name="filled_fraction",
            title="Filled columns",
            meaning="share of the columns that were filled from their neighbors",
            high=checks["flag_filled"],
            percent=True,
        ),
        Usual(
            name="repaired_fraction",
            title="Repaired columns",
            meaning="share of the columns that a repair touched; they are hatched on the sheet",
            percent=True,
        ),
        Usual(
            name="tetra_quality_median",
            title="Quality of tetrahedra",
            meaning="median, 1 for regular ones",
        ),
    )


def number(metrics: Mapping[str, Any], name: str) -> float:
    """Look up a number of the quality record; NaN where there is none."""
    value = metrics.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan
