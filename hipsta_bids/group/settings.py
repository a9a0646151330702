"""Every number that changes a result of the group level: default, range, unit, meaning."""

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import PositiveInt, create_model

from hipsta_bids.joints import find_settings, load
from hipsta_bids.protocols import toml
from hipsta_bids.stats import settings as statistics
from hipsta_bids.types import tables


class AsymmetrySettings(tables.SettingsTable):
    """Differences between left and right."""

    relative: tables.Texts = ("thickness",)
    """Maps of positive measures: their difference is divided by the mean of both sides. Differences
    of other maps keep their unit."""


class ShapeSettings(tables.SettingsTable):
    """Average surfaces; no statistic depends on them."""

    most: PositiveInt = 500
    """Sheets per hemisphere that are averaged, spread evenly over all; bounds time and memory."""


class GroupSettings(tables.SettingsTable):
    """All settings of the group level; extensions add tables."""

    registration: statistics.RegistrationSettings = statistics.RegistrationSettings()
    model: statistics.DefaultModelSettings = statistics.DefaultModelSettings()
    design: statistics.DesignSettings = statistics.DesignSettings()
    glm: statistics.GlmSettings = statistics.GlmSettings()
    longitudinal: statistics.LongitudinalSettings = statistics.LongitudinalSettings()
    asymmetry: AsymmetrySettings = AsymmetrySettings()
    multiplicity: statistics.MultiplicitySettings = statistics.MultiplicitySettings()
    joint: statistics.JointSettings = statistics.JointSettings()
    shapes: ShapeSettings = ShapeSettings()
    classification: statistics.ClassificationSettings = statistics.ClassificationSettings()

    def of(self, kind: type[tables.Table]) -> tables.Table:
        """Return the settings of an extension, by their class."""
        return next(value for _, value in self if isinstance(value, kind))


if not TYPE_CHECKING:
    _TABLES = {name: load(place) for name, place in find_settings().items()}
    GroupSettings = create_model(
        "GroupSettings",
        __base__=GroupSettings,
        __doc__=GroupSettings.__doc__,
        __module__=__name__,
        **{name: (kind, kind()) for name, kind in _TABLES.items()},
    )


def load_group_settings(path: Path | None) -> GroupSettings:
    """Read settings of the group level; see :func:`hipsta_bids.settings.load_settings`."""
    return toml.read_settings(path, GroupSettings)
