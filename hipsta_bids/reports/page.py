"""What pages say and how they are made: reasons, usual ranges, and templates.

A page is one file that asks for nothing from outside.
"""

import logging
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hipsta_bids import __version__
from hipsta_bids.joints import find_extensions, find_texts, load_all
from hipsta_bids.reports.cells import FILTERS
from hipsta_bids.reports.display import HATCHING, ORIENTATION
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
    after: str = ""
    """Of an extension: anchor of the section that it follows; empty to be first."""


def _add_sections(sections: Sequence[Section[_Topic]], kind: str) -> list[Section[_Topic]]:
    """Return sections with the ones of extensions, from a field of `Extension`, in order."""
    further = [s for added in load_all(kind) for s in added] if kind else []
    keys = [section.key for section in sections]
    ordered = [section for section in further if section.after not in keys]
    for section in sections:
        ordered += [section, *(s for s in further if s.after == section.key)]
    return ordered


def build_sections(
    sections: Sequence[Section[_Topic]], topic: _Topic, prefix: str, *, kind: str = ""
) -> list[SimpleNamespace]:
    """Build sections, and sections of extensions from a field of `Extension`, ``kind``.

    One that fails is noted in the page and in the log, and harms no other.
    """
    built = []
    for section in _add_sections(sections, kind):
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
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined  # noqa: PLC0415
    from markupsafe import Markup  # noqa: PLC0415

    environment = Environment(
        loader=ChoiceLoader(
            [
                PackageLoader("hipsta_bids.reports"),
                *(PackageLoader(e.package) for e in find_extensions() if e.has("templates")),
            ]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    def asset(name: str) -> Markup:
        """Return one of the package's files as it is."""
        source = files("hipsta_bids.reports") / "assets" / name
        return Markup(source.read_text(encoding="utf-8"))  # noqa: S704  (no user's text in it)

    environment.filters |= FILTERS
    environment.globals |= {"asset": asset, "orientation": ORIENTATION, "hatching": HATCHING}
    return environment


@cache
def read_table(name: str) -> dict[str, Any]:
    """Read a TOML file of this folder: ``reasons.toml``, with reasons of extensions, or another."""
    table = tomllib.loads((files("hipsta_bids.reports") / name).read_text(encoding="utf-8"))
    if name == "reasons.toml":
        sections = {section["title"]: section["reasons"] for section in table["section"]}
        for title, reasons in find_texts("reasons").items():
            sections[title] |= reasons
    return table


def usual_ranges(
    thickness: float, settings: Mapping[str, Any], *, whole: bool = False
) -> dict[str, dict[str, Any]]:
    """Return the rows of ``usual.toml`` with numbers as limits, infinite where there are none.

    Some limits are relative to the thickness, mm. ``whole`` are sheets with a head, which are
    folded where their map is.
    """
    usual, ranges = Settings().model_dump(), {}
    for name, about in read_table("usual.toml").items():
        row = about | about.get("whole", {}) if whole else about
        scale = thickness if row.get("relative") else 1.0
        limits = {"low": -math.inf, "high": math.inf}
        for end in (end for end in limits if row.get(end)):
            stage, setting = row[end].removeprefix("-").split(".")
            value = scale * (usual[stage] | dict(settings.get(stage) or {}))[setting]
            limits[end] = -value if row[end].startswith("-") else value
        ranges[name] = row | limits
    return ranges


def number(metrics: Mapping[str, Any], name: str) -> float:
    """Look up a number of the quality record; NaN where there is none."""
    value = metrics.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan
