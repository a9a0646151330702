"""Registration of the sheets of a cohort."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import data
from hipsta_bids.group.cohort.read import leave_rare
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats import arrays, registration
from hipsta_bids.stats.warps import Template, warp_labels, warp_values
from hipsta_bids.types import PARTICIPANT, parts_of


def register_side(
    cohort: data.Cohort,
    hemi: str,
    *,
    groups: modeling.Groups | None,
    settings: GroupSettings,
    templates: Mapping[str, Template] | None,
) -> tuple[registration.Registration, arrays.SideMaps]:
    """Register the sheets of one hemisphere, to a template or to each other; also the maps."""
    side = cohort.sides[hemi]
    profiles = registration.mean_profiles(side.curvature, settings.registration)
    if cohort.shared:
        people = pd.factorize(cohort.table[PARTICIPANT].iloc[side.rows])[0]
        profiles = pd.DataFrame(profiles).groupby(people).transform("mean").to_numpy()
    if templates is None:
        least = settings.registration.min_subjects
        if settings.registration.align == "registr" and len(profiles) < least:
            raise ModelError(
                f"registration: {len(profiles)} profiles are too few for a template (least"
                f" {least}); use --align none or --template FILE"
            )
        result = registration.register(profiles, settings.registration)
    else:
        result = registration.register_to(profiles, templates[hemi], settings.registration)
    if groups is not None:
        names = cohort.table[groups.column].iloc[side.rows]
        has_group = names.notna().to_numpy()
        grouped = replace(result, warps=result.warps[has_group])
        members = names[has_group].astype(str).to_numpy(dtype=np.str_)
        difference: Mapping[str, float] = {}
        if result.template is not None:
            difference = registration.shift_difference(
                grouped,
                members,
                cohort.table[PARTICIPANT].iloc[side.rows][has_group].to_numpy(),
                permutations=settings.registration.group_permutations,
                seed=settings.multiplicity.seed,
            )
        by_group = registration.shift_by_group(grouped, members)
        result = replace(result, by_group=by_group, difference=difference)
    arrays.return_memory()
    return result, _register_maps(side, result.warps, parts_of(cohort.y) is not None)


def _register_maps(side: arrays.SideMaps, warps: arrays.Float, rims: bool) -> arrays.SideMaps:
    """Carry all maps of sheets; a point beside ``rims`` that came to be known of few is none."""
    is_small = len(warps) <= arrays.MOST_KEPT
    maps = arrays.WarpedMaps(side.maps, warps, warp_values)
    labels = arrays.WarpedLabels(side.subfield[:], warps, warp_labels)
    registered = dict(maps) if is_small or rims else maps
    for values in registered.values() if rims else ():
        leave_rare(values)
    return replace(
        side,
        maps=registered,
        subfield=labels[:] if is_small else labels,
    )
