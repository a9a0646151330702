"""Settings of norms."""

from typing import Annotated

from pydantic import Field, NonNegativeInt

from hipsta_bids.stats.settings import Codes
from hipsta_bids.types import tables


class NormSettings(tables.SettingsTable):
    """Norms of a reference cohort, and scores of new participants."""

    age: str = "age"
    """Column of age, in years."""
    sex: str = "sex"
    """Column of sex."""
    site: str = "site"
    """Column of the site or scanner; its values are names."""
    knots: Annotated[int, Field(ge=3)] = 5
    """Knots of the natural cubic spline of age, at equal shares of the participants."""
    shared_knots: Codes = ()
    """Knots in years on which sites agree, at least three. Norms are then normal at each age, and
    ``norms.json`` has the sums by which ``meta --norms`` merges sites."""
    edge: Annotated[int, Field(ge=3)] = 5
    """Norms reach from the age with this rank from below to the age with this rank from above. They
    are rounded to years outward, so that they reveal no single participant's age."""
    least_participants: Annotated[int, Field(ge=50)] = 100
    """Smaller reference cohorts are refused."""
    least_site: Annotated[int, Field(ge=10)] = 15
    """Participants that a site of the reference needs; a point needs half as many with a value."""
    least_controls: Annotated[int, Field(ge=25)] = 25
    """Controls that a new site needs; a point needs half as many with a value."""
    seed: NonNegativeInt = 0
    """Of the folds."""
    charts: tables.Texts = ("thickness_mean", "volume", "curvature_mean", "area_mid", "extent_y")
    """Summary measures that get a chart."""
