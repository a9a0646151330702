"""Every number that changes a result of the group level: default, unit, meaning."""

from dataclasses import dataclass, field

from hipsta_bids.errors import SettingsError


def _require(condition: bool, message: str) -> None:
    """Refuse values that no analysis could work with."""
    if not condition:
        raise SettingsError(f"settings: {message}", reason="setting-out-of-range")


@dataclass(frozen=True, kw_only=True)
class GlmSettings:
    """The linear model at each point."""

    covariance: str = "ordinary"
    """Of the coefficients: ``ordinary`` (equal variances) or ``hc3`` (any variances; MacKinnon and
    White 1985)."""
    confidence: float = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    min_residual_df: int = 3
    """Points with fewer residual degrees of freedom are left out."""
    min_information: float = 1e-8
    """Points are left out where the missing values take away all but this fraction of what the
    data say about a direction of the coefficients."""

    def __post_init__(self) -> None:
        kinds = ("ordinary", "hc3")
        _require(self.covariance in kinds, f"glm.covariance must be {' or '.join(kinds)}")
        _require(0 < self.confidence < 1, "glm.confidence must lie between 0 and 1")
        _require(self.min_residual_df >= 1, "glm.min_residual_df must be at least 1")
        _require(0 < self.min_information < 1, "glm.min_information must lie between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class MultiplicitySettings:
    """How many tests are allowed for."""

    alpha: float = 0.05
    """False discovery rate, or family-wise error rate of permutation tests."""
    permutations: int = 5000
    """Permutations, the unpermuted data included."""
    seed: int = 0
    """Of the permutations."""
    tfce_extent: float = 0.5
    """Exponent of a cluster's extent (Smith and Nichols 2009)."""
    tfce_height: float = 2.0
    """Exponent of the statistic's height."""
    tfce_step: float = 0.1
    """Step of the height, in units of t (of the square root of F)."""
    neighbors: int = 8
    """Neighbors of a point on the sheet, 4 or 8."""

    def __post_init__(self) -> None:
        _require(0 < self.alpha < 1, "multiplicity.alpha must lie between 0 and 1")
        _require(self.permutations > 1, "multiplicity.permutations must be at least 2")
        _require(self.tfce_step > 0, "multiplicity.tfce_step must be positive")
        _require(self.neighbors in (4, 8), "multiplicity.neighbors must be 4 or 8")


@dataclass(frozen=True, kw_only=True)
class ClassificationSettings:
    """Logistic models and how well they tell groups apart."""

    confidence: float = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    folds: int = 10
    """Folds of the cross-validation, or as many as the smaller group has members."""
    repeats: int = 20
    """Repetitions of the cross-validation."""
    seed: int = 0
    """Of the cross-validation."""
    bins: int = 10
    """Groups of equal size in the table of calibration."""
    iterations: int = 100
    """Most steps of a fit."""
    tolerance: float = 1e-16
    """Steps end when they promise to raise the log likelihood by less than this."""

    def __post_init__(self) -> None:
        _require(0 < self.confidence < 1, "classification.confidence must lie between 0 and 1")
        _require(self.folds > 1, "classification.folds must be at least 2")
        _require(self.repeats > 0, "classification.repeats must be at least 1")
        _require(self.bins > 1, "classification.bins must be at least 2")


@dataclass(frozen=True, kw_only=True)
class GroupSettings:
    """All settings of the group level."""

    glm: GlmSettings = field(default_factory=GlmSettings)
    multiplicity: MultiplicitySettings = field(default_factory=MultiplicitySettings)
    classification: ClassificationSettings = field(default_factory=ClassificationSettings)
