"""Every number that changes a result of the group level: default, unit, meaning."""

from dataclasses import dataclass, field
from pathlib import Path

from hipsta_bids.errors import SettingsError
from hipsta_bids.settings import read_settings


def _require(condition: bool, message: str) -> None:
    """Refuse values that no analysis could work with."""
    if not condition:
        raise SettingsError(f"settings: {message}", reason="setting-out-of-range")


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """Registration of curvature profiles along x.

    The first numbers are those of the paper (Diers et al. 2023, appendix B) and of R's
    ``registr``; those that start with ``penalized`` belong to the other method.
    """

    align: str = "registr"
    """``registr`` (Wrobel et al. 2018), ``penalized`` (finer warps, held back by a penalty that is
    estimated) or ``none``."""
    template_splines: int = 8
    """Cubic B-splines of the template (Kt)."""
    warp_splines: int = 4
    """Cubic B-splines of a warp (Kh); 4 leave two numbers free."""
    components: int = 1
    """Principal components by which a profile may differ from the mean one (npc)."""
    penalized_template_splines: int = 12
    """As above."""
    penalized_warp_splines: int = 6
    """As above."""
    penalized_components: int = 2
    """As above."""
    penalized_start_sd: float = 0.3
    """Standard deviation of the logarithms of a warp's local stretch, to start with."""
    center: bool = True
    """Keep the mean warp at identity in each iteration; else all maps drift together."""
    iterations: int = 10
    """Most turns of template and warps."""
    tolerance: float = 1e-4
    """Turns end when warps change by less than this, mean square, sheet = 1."""
    penalized_iterations: int = 20
    """As above."""
    penalized_tolerance: float = 1e-7
    """As above."""
    em_iterations: int = 50
    """Most steps of expectation and maximization for the components."""
    em_tolerance: float = 1e-4
    """They end when squared coefficients, of profiles over their SD, change by less than this."""
    warp_steps: int = 60
    """Most steps of a warp's fit."""
    warp_tolerance: float = 1e-10
    """A warp's fit ends when its loss falls by less than this fraction."""
    least_stretch: float = 0.02
    """No increment of a warp's coefficients starts below this; sheet = 1."""
    min_subjects: int = 10
    """Fewer profiles than this give no template."""
    max_gap: float = 0.2
    """Profiles are filled along x if at most this fraction of them is missing."""
    extreme: float = 4.0
    """Flag warps whose mean displacement is so many robust SDs above the median."""

    def __post_init__(self) -> None:
        ways = ("registr", "penalized", "none")
        _require(self.align in ways, f"registration.align must be one of {', '.join(ways)}")
        for name in ("template", "warp", "penalized_template", "penalized_warp"):
            splines = getattr(self, f"{name}_splines")
            _require(splines >= 4, f"registration.{name}_splines must be at least 4")  # noqa: PLR2004 -- said there
        _require(self.components > 0, "registration.components must be at least 1")
        _require(
            self.penalized_components > 0, "registration.penalized_components must be at least 1"
        )


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """When a model is refused before it is fitted."""

    min_level: int = 3
    """Fewer subjects in a level of a factor are too few."""
    min_residual_df: int = 3
    """Fewer subjects beyond the columns are too few."""
    dependence: float = 1e-9
    """A column is a combination of others if less than this fraction of its length is its own."""
    numeric_share: float = 0.5
    """A column with text is taken for a damaged number if more of it than this is numbers."""

    def __post_init__(self) -> None:
        _require(self.min_level >= 1, "design.min_level must be at least 1")
        _require(self.min_residual_df >= 1, "design.min_residual_df must be at least 1")
        _require(0 < self.dependence < 1, "design.dependence must lie between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class DefaultModelSettings:
    """What is fitted when no model is given."""

    group_columns: tuple[str, ...] = ("group", "diagnosis", "dx", "diagnostic_group")
    """The first of these columns, in any case of letters, tells the groups."""
    reference_levels: tuple[str, ...] = ("CN", "CU", "HC", "NC", "CTRL", "control", "healthy")
    """The first of these, in any case and singular or plural, is the reference level of the
    groups; else the most frequent one is."""
    covariates: tuple[str, ...] = ("age", "sex", "site")
    """Further columns of the model, where the table has them and they vary."""
    icv_columns: tuple[str, ...] = ("icv", "etiv", "tiv", "intracranial_volume")
    """The first of these columns is the covariate of volumes; else what FreeSurfer or ASHS
    estimated."""


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
class LongitudinalSettings:
    """Repeated sessions of the same participants."""

    random: str = "intercept"
    """What participants have of their own: an ``intercept``, or also a ``slope`` over time."""
    time_columns: tuple[str, ...] = ("time", "years", "months", "days")
    """The first of these columns, in any case, that varies between sessions is the time; else it
    is made, in years since the first session, from ``acq_time`` or age."""
    confidence: float = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    max_correlation: float = 0.999
    """Largest correlation between a participant's sessions that is looked for."""
    grid: int = 40
    """Correlations at which the likelihood is looked at first."""
    halvings: int = 50
    """Halvings of the interval that holds the best one."""
    slope_steps: int = 60
    """Most steps of the fit with random slopes."""
    slope_tolerance: float = 1e-8
    """They end when minus twice the likelihood falls by less than this."""
    min_information: float = 1e-8
    """As ``glm.min_information``."""

    def __post_init__(self) -> None:
        _require(0 < self.confidence < 1, "longitudinal.confidence must lie between 0 and 1")
        kinds = ("intercept", "slope")
        _require(self.random in kinds, f"longitudinal.random must be {' or '.join(kinds)}")
        _require(
            0 < self.max_correlation < 1, "longitudinal.max_correlation must lie between 0 and 1"
        )
        _require(self.grid > 2, "longitudinal.grid must be at least 3")  # noqa: PLR2004 -- said there


#: How to allow for many tests, as the command line spells it.
CORRECTIONS = ("fdr2", "bh", "permutation-tfce", "permutation-max")


@dataclass(frozen=True, kw_only=True)
class MultiplicitySettings:
    """How many tests are allowed for."""

    method: str = "fdr2"
    """``fdr2`` (two-stage false discovery rate, Benjamini, Krieger and Yekutieli 2006; the
    paper's), ``bh`` (Benjamini and Hochberg 1995), or family-wise error by permutation:
    ``permutation-tfce`` (threshold-free cluster enhancement) or ``permutation-max`` (largest t)."""
    scope: str = "map"
    """What is one family: each ``map`` (measure, contrast and hemisphere), or both ``hemispheres``
    together."""
    alpha: float = 0.05
    """False discovery rate, or family-wise error rate of permutation tests."""
    permutations: int = 5000
    """Permutations, the unpermuted data included."""
    seed: int = 0
    """Of the permutations."""
    blocks: str = ""
    """Column whose levels participants are permuted within, as of sites; empty is all."""
    tfce_extent: float = 0.5
    """Exponent of a cluster's extent (Smith and Nichols 2009)."""
    tfce_height: float = 2.0
    """Exponent of the statistic's height."""
    tfce_step: float = 0.1
    """Step of the height, in units of t (of the square root of F)."""
    neighbors: int = 8
    """Neighbors of a point on the sheet, 4 or 8."""

    def __post_init__(self) -> None:
        scopes = ("map", "hemispheres")
        _require(
            self.method in CORRECTIONS,
            f"multiplicity.method must be one of {', '.join(CORRECTIONS)}",
        )
        _require(self.scope in scopes, f"multiplicity.scope must be {' or '.join(scopes)}")
        _require(0 < self.alpha < 1, "multiplicity.alpha must lie between 0 and 1")
        _require(self.permutations > 1, "multiplicity.permutations must be at least 2")
        _require(self.tfce_step > 0, "multiplicity.tfce_step must be positive")
        _require(self.neighbors in (4, 8), "multiplicity.neighbors must be 4 or 8")


@dataclass(frozen=True, kw_only=True)
class AsymmetrySettings:
    """Differences between left and right."""

    relative: tuple[str, ...] = ("thickness",)
    """Maps, of positive measures, whose difference is taken over the mean of both sides; that of
    others is in their own unit."""


@dataclass(frozen=True, kw_only=True)
class ShapeSettings:
    """Average surfaces; no statistic depends on them."""

    most: int = 500
    """Sheets per hemisphere that are averaged, spread evenly over all; bounds time and memory."""
    iterations: int = 50
    """Most turns of alignment to the mean and of the mean."""
    tolerance: float = 1e-6
    """They end when no point of the mean moves by more than this, mm."""

    def __post_init__(self) -> None:
        _require(self.most >= 1, "shapes.most must be at least 1")


@dataclass(frozen=True, kw_only=True)
class ClassificationSettings:
    """Logistic models and how well they tell groups apart."""

    base: tuple[str, ...] = ("volume",)
    """Summary measures and covariates of the base model."""
    added: tuple[str, ...] = (
        "thickness_mean",
        "extent_x",
        "extent_y",
        "circumference_mean",
        "interior_exterior_ratio_mean",
        "area_interior",
        "area_mid",
        "area_exterior",
        "shape_index_mean",
        "curvature_mean",
    )
    """Summary measures that are added to it, each by itself, where they were measured."""
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
    firth_iterations: int = 2000
    """Most steps of a fit by Firth's method, which takes hundreds where groups are far apart."""
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

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    model: DefaultModelSettings = field(default_factory=DefaultModelSettings)
    design: DesignSettings = field(default_factory=DesignSettings)
    glm: GlmSettings = field(default_factory=GlmSettings)
    longitudinal: LongitudinalSettings = field(default_factory=LongitudinalSettings)
    asymmetry: AsymmetrySettings = field(default_factory=AsymmetrySettings)
    multiplicity: MultiplicitySettings = field(default_factory=MultiplicitySettings)
    shapes: ShapeSettings = field(default_factory=ShapeSettings)
    classification: ClassificationSettings = field(default_factory=ClassificationSettings)


def load_group_settings(path: Path | None) -> GroupSettings:
    """Read settings of the group level; see :func:`load_settings`."""
    return read_settings(path, GroupSettings)
