"""Pages from templates: one file each, without anything from outside."""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files as package_files
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hipsta_bids import __version__

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
    """Gives what the template shows; ``None`` leaves the section out."""


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
    """Build sections; one that fails says so in the page and in the log, and harms no other."""
    built = []
    for section in sections:
        try:
            values = section.build(topic)
        except Exception as error:  # a page with a gap is better than none
            _LOGGER.exception("report: section %s of %s", section.key, prefix)
            values = {"problem": f"{type(error).__name__}: {error}"}
        if values is not None:
            built.append(
                Content(
                    key=f"{prefix}-{section.key}",
                    title=section.title,
                    template=section.template if "problem" not in values else "problem.html",
                    values=values,
                )
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
        """Give a file of the package's own as it is."""
        source = package_files("hipsta_bids.reports") / "assets" / name
        return Markup(source.read_text(encoding="utf-8"))  # noqa: S704  (no user's text in it)

    environment.globals["asset"] = asset
    return environment
