"""Settings of visits that share a sheet, and what messages and texts say about them."""

from typing import TYPE_CHECKING, Literal

from hipsta_bids.errors import UsageError
from hipsta_bids.extensions.visits.options import FRAMES, OPTION
from hipsta_bids.joints import find_measurements, read_texts
from hipsta_bids.types import tables

if TYPE_CHECKING:
    from argparse import Namespace

    from hipsta_bids.settings import Settings


class FrameSettings(tables.SettingsTable):
    """Whose sheet it is: added to the settings of the sheet."""

    frame: Literal["visit", "person", "shared"] = "visit"
    """Each ``visit`` has its own sheet, or all visits of a ``person`` lie on one sheet
    (`--longitudinal`). ``shared``: likewise, and their labels share a space."""


def apply(options: "Namespace", settings: "Settings") -> "Settings":
    """Set whose sheet it is; UsageError with options that measure something else."""
    if options.longitudinal:
        settings = settings.changed(sheet={"frame": FRAMES[options.longitudinal]})
    names = [measurement.name for measurement in find_measurements() if measurement.options]
    is_more = settings.body.region != "body" or any(getattr(options, name) for name in names)
    if settings.of(FrameSettings).frame != "visit" and is_more:
        flags = " and ".join(f"--{name}" for name in ("region", *names))
        raise UsageError(f"{OPTION} measures the body; omit {flags}")
    return settings


def advise(before: object, current: object) -> str:
    """Return what to do in a folder made with or without the option."""
    if before == current or before not in {"visit", *FRAMES.values()}:
        return ""
    if before == "visit":
        return f"this folder was made without {OPTION}; omit it"
    words = f"{OPTION} shared" if before == "shared" else OPTION
    words += " auto" if (before, current) == ("person", "shared") else ""  # as without a choice
    return f"this folder was made with {words}; {'add' if current == 'visit' else 'use'} {words}"


def write_sentences(settings: "Settings") -> str:
    """Write the sentences of the methods text."""
    texts: dict[str, str] = read_texts("hipsta_bids.extensions.visits")["methods"]["frame"]
    return texts[settings.of(FrameSettings).frame]
