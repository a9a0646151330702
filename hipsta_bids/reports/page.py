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
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hipsta_bids import __version__
from hipsta_bids.io.files import MISSING
from hipsta_bids.reports.cells import FILTERS
from hipsta_bids.reports.display import ORIENTATION
from hipsta_bids.settings import Settings

if TYPE_CHECKING:
    from jinja2 import Environment

_LOGGER = logging.getLogger(__name__)
_Topic = TypeVar("_Topic")


@dataclass(frozen=True)
class Section(Generic[_Topic]):
    """One part of a page."""

    key: str
    """Its anchor."""
    title: str
    template: str
    """File in ``templates/``."""
    build: Callable[[_Topic], Mapping[str, Any] | None]
    """Returns what the template shows; ``None`` leaves the section out."""


def build_sections(
    sections: Iterable[Section[_Topic]], topic: _Topic, prefix: str
) -> list[SimpleNamespace]:
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
            built.append(
                SimpleNamespace(key=key, title=section.title, template=template, values=values)
            )
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

    environment.filters |= FILTERS
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
        for section in _table("reasons.toml")["section"]
    )


def reason_actions() -> Mapping[str, str]:
    """Titles of what to do, in the order of the reference page, by the keys that reasons name."""
    actions: Mapping[str, str] = _table("reasons.toml")["actions"]
    return actions


@cache
def _table(name: str) -> dict[str, Any]:
    return tomllib.loads((files("hipsta_bids.reports") / name).read_text(encoding="utf-8"))


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
        """Write a value with its unit."""
        if math.isnan(value):
            return MISSING
        if self.percent:
            return f"{value:.1%}"
        return f"{value:.3g}{f' {self.unit}' if self.unit else ''}"

    def excludes(self, value: float) -> bool:
        """Test whether a value is known and outside of the usual range."""
        return value < self.low or value > self.high

    @property
    def range(self) -> str:
        """Write the usual range."""
        low, high = math.isfinite(self.low), math.isfinite(self.high)
        if low and high:
            return f"{self.text(self.low)} to {self.text(self.high)}"
        if low:
            return f"at least {self.text(self.low)}"
        return f"at most {self.text(self.high)}" if high else "any"


def usual_ranges(
    thickness: float, settings: Mapping[str, Any], *, whole: bool = False
) -> list[Usual]:
    """List the quality numbers that a page shows; some limits are relative to the thickness, mm.

    ``whole`` are sheets with a head, which are folded where their map is.
    """
    usual, ranges = Settings().model_dump(), []
    for name, about in _table("usual.toml").items():
        row = about | about.get("whole", {}) if whole else about
        scale = thickness if row.get("relative") else 1.0
        limits = {}
        for end in (end for end in ("low", "high") if row.get(end)):
            stage, setting = row[end].removeprefix("-").split(".")
            value = scale * (usual[stage] | dict(settings.get(stage) or {}))[setting]
            limits[end] = -value if row[end].startswith("-") else value
        fields = {key: row[key] for key in row.keys() - {"low", "high", "relative", "whole"}}
        ranges.append(Usual(name=name, **fields, **limits))
    return ranges


def number(metrics: Mapping[str, Any], name: str) -> float:
    """Look up a number of the quality record; NaN where there is none."""
    value = metrics.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan
