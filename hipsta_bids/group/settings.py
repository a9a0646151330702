"""Every number that changes a result of the group level: default, range, unit, meaning."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveInt

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


class ExchangeSettings(tables.SettingsTable):
    """The content of a summary for other sites."""

    min_cell: Annotated[int, Field(ge=5)] = 5
    """Fewest participants in a cell of all factors of the model, and behind a sum."""
    min_residual_df: PositiveInt = 10
    """Fewest participants beyond the columns of the model."""
    max_leverage: tables.OpenFraction = 0.5
    """Largest share of a fitted value due to one participant's own value."""


class GroupSettings(tables.SettingsTable):
    """All settings of the group level."""

    registration: statistics.RegistrationSettings = statistics.RegistrationSettings()
    model: statistics.DefaultModelSettings = statistics.DefaultModelSettings()
    design: statistics.DesignSettings = statistics.DesignSettings()
    glm: statistics.GlmSettings = statistics.GlmSettings()
    longitudinal: statistics.LongitudinalSettings = statistics.LongitudinalSettings()
    harmonization: statistics.HarmonizationSettings = statistics.HarmonizationSettings()
    asymmetry: AsymmetrySettings = AsymmetrySettings()
    multiplicity: statistics.MultiplicitySettings = statistics.MultiplicitySettings()
    joint: statistics.JointSettings = statistics.JointSettings()
    shapes: ShapeSettings = ShapeSettings()
    classification: statistics.ClassificationSettings = statistics.ClassificationSettings()
    retest: statistics.RetestSettings = statistics.RetestSettings()
    power: statistics.PowerSettings = statistics.PowerSettings()
    norms: statistics.NormSettings = statistics.NormSettings()
    exchange: ExchangeSettings = ExchangeSettings()
    meta: statistics.MetaSettings = statistics.MetaSettings()


def load_group_settings(path: Path | None) -> GroupSettings:
    """Read settings of the group level; see :func:`hipsta_bids.settings.load_settings`."""
    return toml.read_settings(path, GroupSettings)
