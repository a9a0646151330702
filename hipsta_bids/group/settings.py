"""Every number that changes a result of the group level: default, range, unit, meaning."""

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import PositiveInt

from hipsta_bids.joints import find_settings
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


class GroupSettings(tables.ExtendedSettings):
    """All settings of the group level; extensions add tables."""

    registration: statistics.RegistrationSettings = statistics.RegistrationSettings()
    model: statistics.DefaultModelSettings = statistics.DefaultModelSettings()
    design: statistics.DesignSettings = statistics.DesignSettings()
    glm: statistics.GlmSettings = statistics.GlmSettings()
    longitudinal: statistics.LongitudinalSettings = statistics.LongitudinalSettings()
    asymmetry: AsymmetrySettings = AsymmetrySettings()
    multiplicity: statistics.MultiplicitySettings = statistics.MultiplicitySettings()
    shapes: ShapeSettings = ShapeSettings()
    classification: statistics.ClassificationSettings = statistics.ClassificationSettings()


if not TYPE_CHECKING:  # type checkers know the tables of the core
    GroupSettings = GroupSettings.extended(find_settings("group"))


def load_group_settings(path: Path | None) -> GroupSettings:
    """Read a user's TOML file of the group level; settings that it omits keep their defaults.

    Parameters
    ----------
    path : Path or None
        The file; ``None`` gives the defaults.

    Returns
    -------
    GroupSettings
        All settings of the group level.

    Raises
    ------
    SettingsError
        If the file cannot be read, or a key or a value in it is wrong.
    """
    return toml.read_settings(path, GroupSettings)
