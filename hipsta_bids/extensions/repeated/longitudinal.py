"""All sessions of a participant, by a mixed model."""

from collections.abc import Callable, Sequence
from functools import partial

import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.repeated.methods import random_effects, slopes
from hipsta_bids.group.model import AllSessions, Cite, Groups, VisitTime
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.mixed import longitudinal_model
from hipsta_bids.types import PARTICIPANT


class Longitudinal(AllSessions):
    """All sessions, with random intercepts or slopes of participants."""

    has_changes = True

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        return "_longitudinal"

    def row_models(
        self,
        table: pd.DataFrame,
        time: str | None,
        groups: Groups | None,
        settings: GroupSettings,
    ) -> Callable[[Design], RowModel]:
        """Return what makes the mixed model of a design."""
        return partial(
            longitudinal_model,
            table=table,
            time=time,
            settings=settings.glm,
            longitudinal=settings.longitudinal,
        )

    def check_default(self, table: pd.DataFrame, time: str | None, settings: GroupSettings) -> None:
        """Refuse visits without a second one, or without time."""
        if not self.has_changes:
            return
        if not table[PARTICIPANT].duplicated().any():
            raise ModelError(
                "longitudinal model: no participant has a second session; remove --longitudinal"
            )
        if time is None:
            raise ModelError(
                "the default longitudinal model needs the time of each session: a column"
                f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
            )

    def contrasts(
        self, groups: Groups | None, visits: VisitTime | None, bends: Sequence[str]
    ) -> list[str]:
        """Return contrasts of groups, of changes over time in each, and their differences."""
        time = visits.column if visits else None
        if groups is None:
            return [*([time] if time else []), *bends]
        contrasts = super().contrasts(groups, visits, bends)
        if time is None:
            return contrasts
        slopes = {level: f"{groups.column}[T.{level}]:{time}" for level in groups.levels[1:]}
        contrasts.append(f"{time} in {groups.reference} = {time}")
        for level, slope in slopes.items():
            contrasts.append(f"{time} in {level} = {time} + {slope}")
            contrasts.append(f"{time} in {groups.reference}-{level} = -1*{slope}")
        return contrasts

    def words(self) -> tuple[str, str, str]:
        """Return the kind of model, its subject if that is not the maps, and Cohen's d."""
        d = "the estimate divided by the standard deviation of single visits"
        return "linear mixed model", "", d

    def methods(
        self,
        model: RowModel,
        fits: Sequence[PointwiseFit],
        settings: GroupSettings,
        cite: Cite,
    ) -> str:
        """Return sentences of the methods on random effects."""
        return random_effects(model, cite)

    def findings(self, fits: Sequence[PointwiseFit], cite: Cite) -> str:
        """Return at how many points slopes vary, and at how many they were omitted."""
        return slopes(fits, cite)
