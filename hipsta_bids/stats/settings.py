"""Every number that changes a statistic: default, range, unit, meaning."""

from typing import Annotated, Literal, get_args

from pydantic import (
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Strict,
)

from hipsta_bids.types import tables

#: Numbers of either sign; TOML has lists.
Codes = Annotated[tuple[float, ...], Strict(strict=False)]
Splines = Annotated[int, Field(ge=4)]
AtLeastTwo = Annotated[int, Field(ge=2)]
#: Fields that say where labels come from, as ``PROVENANCE`` of ``derivatives`` has them.
Provenance = Literal[
    "tool",
    "version",
    "analysis",
    "atlas",
    "hierarchy",
    "space",
    "design",
    "edited",
    "probabilities",
    "voxel_size",
]
#: How to allow for many tests, as the command line spells it.
Correction = Literal["fdr2", "bh", "permutation-tfce", "permutation-max"]
CORRECTIONS: tuple[str, ...] = get_args(Correction)


class RegistrationSettings(tables.SettingsTable):
    """Registration of curvature profiles along x.

    The numbers of splines, components and iterations follow the paper (Diers et al. 2023,
    appendix B) and of R's ``registr``.
    """

    align: Literal["auto", "registr", "none"] = "auto"
    """``registr`` (Wrobel et al. 2018), ``none``, or ``auto``: ``registr``, or ``none`` with a note
    where sheets are too few for a template (``min_subjects``)."""
    standardize: bool = True
    """Subtract each profile's mean and divide it by its own standard deviation. Curvature that is
    larger everywhere is then not taken for a displacement; R's ``registr`` does not do this."""
    template_splines: Splines = 8
    """Cubic B-splines of the template (Kt)."""
    warp_splines: Splines = 4
    """Cubic B-splines of a warp (Kh); 4 leave two numbers free."""
    components: PositiveInt = 1
    """Principal components by which a profile may differ from the mean one (npc)."""
    center: bool = True
    """Keep the mean warp at identity in each iteration; else all maps drift together. R's
    ``registr`` does not."""
    iterations: NonNegativeInt = 10
    """Most turns of template and warps."""
    min_subjects: PositiveInt = 10
    """Fewer profiles than this give no template."""
    max_gap: tables.Fraction = 0.2
    """Profiles are filled along x if at most this fraction of them is missing."""
    extreme: NonNegativeFloat = 4.0
    """Flag warps whose mean displacement is above the median by more than this many robust
    SDs."""
    group_permutations: PositiveInt = 1999
    """Permutations of participants for the difference of displacements between groups."""


class DesignSettings(tables.SettingsTable):
    """When a model is refused before it is fitted."""

    min_level: PositiveInt = 3
    """Fewer subjects in a level of a factor are too few."""
    min_residual_df: PositiveInt = 3
    """Fewer subjects beyond the columns are too few."""
    factors: tables.Texts = (
        *("group", "diagnosis", "dx", "diagnostic_group", "arm", "treatment"),
        *("cohort", "study"),
        *("sex", "gender", "ethnicity", "race"),
        *("site", "site_id", "scanner", "scanner_id", "center", "center_id", "vendor"),
    )
    """Columns of names, in any case of letters, even if they are written as numbers. Other columns
    are too if the table's sidecar has ``Levels`` for all their values."""
    reference_levels: tables.Texts = ()
    """Further words for controls. A level that is a word for controls, in several languages, is
    the reference of its factor."""
    missing_codes: Codes = (
        *(-9.0, -99.0, -999.0, -9999.0, -99999.0),
        *(99.0, 999.0, 9999.0, 99999.0, 777.0, 7777.0, 888.0, 8888.0),
    )
    """Numbers that often stand for missing ones. Negative ones are missing out of the range of all
    other values. Positive ones far from all other values are refused."""
    farthest: PositiveFloat = 1e4
    """Numbers farther than this from the median, in ranges between quartiles, are refused."""
    mixed: Annotated[tuple[Provenance, ...], Strict(strict=False)] = ()
    """Fields of provenance in which hemispheres of an analysis may differ; else it is refused."""


class DefaultModelSettings(tables.SettingsTable):
    """The model when none is given."""

    group_columns: tables.Texts = (
        *("group", "diagnosis", "dx", "diagnostic_group", "arm", "treatment"),
    )
    """The first of these columns, in any case of letters, has the groups."""
    covariates: tables.Texts = ("age", "sex", "site")
    """Further columns of the model, where the table has them and they vary."""
    age: Literal["linear", "quadratic", "spline"] = "linear"
    """Age in the model: as a line, with its square, or as a natural cubic spline of three
    columns."""
    icv_columns: tables.Texts = ("icv", "etiv", "tiv", "intracranial_volume")
    """The first of these columns is the covariate of volumes, areas and extents; else what
    FreeSurfer or ASHS estimated."""


class GlmSettings(tables.SettingsTable):
    """The linear model at each point."""

    covariance: Literal["ordinary", "hc3"] = "ordinary"
    """Of the coefficients: ``ordinary`` (equal variances) or ``hc3`` (any variances; MacKinnon and
    White 1985)."""
    confidence: tables.OpenFraction = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    min_residual_df: PositiveInt = 3
    """Points with fewer residual degrees of freedom are excluded."""


class LongitudinalSettings(tables.SettingsTable):
    """Repeated sessions of the same participants."""

    random: Literal["auto", "intercept", "slope", "visits"] = "auto"
    """Random effects of participants: an ``intercept``, or also a ``slope`` over time. ``auto``
    takes slopes where ``slope_participants`` have three visits. Without them tests of changes take
    differences between participants for noise, and find too much. ``visits``: visits are
    categories, with any covariance, and no random effects."""
    slope_participants: PositiveInt = 10
    """Participants with three visits or more that ``auto`` wants for slopes."""
    freedom: Literal["satterthwaite", "kenward-roger"] = "kenward-roger"
    """Degrees of freedom of models with visits as categories. ``kenward-roger`` also corrects
    standard errors for the estimated covariance (Kenward and Roger 1997)."""
    time_columns: tables.Texts = ("time", "years", "months", "days")
    """The time is the first of these columns, in any case, that varies between sessions. Else it is
    the years since the first session, from ``acq_time`` or age."""
    confidence: tables.OpenFraction = 0.95
    """Coverage of two-sided confidence limits, fraction."""


class MultiplicitySettings(tables.SettingsTable):
    """How many tests are allowed for."""

    method: Correction = "fdr2"
    """False discovery rate: ``fdr2`` (two-stage, Benjamini, Krieger and Yekutieli 2006; the
    paper's), or ``bh`` (Benjamini and Hochberg 1995). Family-wise error by permutation:
    ``permutation-tfce`` (threshold-free cluster enhancement), or ``permutation-max`` (largest
    t)."""
    scope: Literal["map", "hemispheres", "all"] = "map"
    """One family of tests: each ``map`` (measure, contrast and hemisphere), both ``hemispheres``
    together, or ``all`` maps of a contrast."""
    alpha: tables.OpenFraction = 0.05
    """False discovery rate, or family-wise error rate of permutation tests."""
    permutations: AtLeastTwo = 5000
    """Permutations, the unpermuted data included."""
    seed: NonNegativeInt = 0
    """Of the permutations."""
    blocks: str = ""
    """Column whose levels participants are permuted within, as of sites; empty is all."""
    visits: Literal["auto", "whole", "within", "flip"] = "auto"
    """Exchange of repeated visits: ``whole`` participants with all their visits, if they have
    equally many; visits ``within`` participants. Or ``flip``: signs of all visits of a participant
    together. ``auto`` chooses by the contrast."""
    neighbors: Literal[4, 8] = 8
    """Neighbors of a point on the sheet, 4 or 8."""


class ClassificationSettings(tables.SettingsTable):
    """Logistic models and how well they discriminate groups."""

    base: tables.Texts = ("volume",)
    """Summary measures and covariates of the base model."""
    added: tables.Texts = (
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
    confidence: tables.OpenFraction = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    folds: AtLeastTwo = 10
    """Folds of the cross-validation, or as many as the smaller group has members."""
    repeats: PositiveInt = 20
    """Repetitions of the cross-validation."""
    seed: NonNegativeInt = 0
    """Of the cross-validation."""
    least_calibrated: AtLeastTwo = 100
    """Calibration is judged where both groups have this many, a rule of thumb. Below it, curve and
    slope are too uncertain (Snell et al. 2021)."""


class ExchangeSettings(tables.SettingsTable):
    """The content of a summary for other sites."""

    min_cell: Annotated[int, Field(ge=5)] = 5
    """Fewest participants in a cell of all factors of the model, and behind a sum."""
    min_residual_df: PositiveInt = 10
    """Fewest participants beyond the columns of the model."""
    max_leverage: tables.OpenFraction = 0.5
    """Largest share of a fitted value due to one participant's own value."""
