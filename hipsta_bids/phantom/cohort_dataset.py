"""A synthetic cohort as files: a BIDS dataset, participants, true maps, planted effect."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.bids import files
from hipsta_bids.phantom.cohort import (
    CohortPlan,
    Subject,
    make_cohort,
    region_limits,
    typical_shape,
)
from hipsta_bids.phantom.dataset import Hemisphere, Participants, refuse_taken, write_dataset
from hipsta_bids.phantom.phantom import Phantom

#: True maps of each hemisphere, and where the effect was planted; below the dataset.
MAPS_FOLDER = "phantom_maps"
EFFECT_TABLE = "phantom_effect.tsv"

#: Nodes of the true maps along x and y: as many as the default sheet has.
NODES = (41, 21)

_ROUNDING = 1e-9  # nodes on the border of a region belong to it


def write_cohort(
    out: Path,
    plan: CohortPlan,
    *,
    layout: str = "freesurfer",
    voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
) -> None:
    """Write a cohort as a BIDS dataset with segmentations, participants and all truth.

    Parameters
    ----------
    out : Path
        New or empty folder, or an earlier dataset of phantoms.
    plan : CohortPlan
        Who is in it.
    layout : str
        One of ``LAYOUTS``; cortex needs one whose protocol has labels for it.
    voxel_size : tuple of float
        mm along the image's axes, which point left, inferior and anterior.

    Raises
    ------
    UsageError
        If the folder holds something else.
    SettingsError
        If the layout is unknown or a phantom impossible.
    OutputError
        If a file cannot be written.
    """
    refuse_taken(out)
    subjects = make_cohort(plan)
    hemispheres = [item for subject in subjects for item in subject.hemispheres]
    write_dataset(
        out,
        hemispheres,
        layouts=(layout,),
        voxel_size=voxel_size,
        participants=_participants(plan, subjects),
    )
    for item in hemispheres:
        _write_maps(out, item)
    _write_effect(out, plan)


def _participants(plan: CohortPlan, subjects: Sequence[Subject]) -> Participants:
    rows = {
        subject.label: (
            subject.group,
            f"{subject.age:.1f}",
            subject.sex,
            f"{subject.icv:.1f}",
            subject.site,
        )
        for subject in subjects
    }
    groups = {
        name: "no effect" if not dose else f"effect planted {dose} time(s)"
        for dose, name in enumerate(plan.groups)
    }
    sites = {f"site{i}": f"{add:+g} mm of thickness" for i, add in enumerate(plan.sites, 1)}
    return Participants(
        columns={
            "group": {"Description": "group of the cohort", "Levels": groups},
            "age": {"Description": "age", "Units": "year"},
            "sex": {"Description": "sex", "Levels": {"F": "female", "M": "male"}},
            "icv": {"Description": "intracranial volume", "Units": "mL"},
            "site": {"Description": "place of the scan", "Levels": sites},
        },
        rows=rows,
    )


def _grid() -> tuple[Float, Float]:
    """Sheet coordinates u and v of the nodes of the true maps."""
    u, v = (np.linspace(0.0, 1.0, nodes) for nodes in NODES)
    u, v = np.meshgrid(u, v, indexing="ij")
    return u, v


def _write_maps(out: Path, item: Hemisphere) -> None:
    """Write the true map of one hemisphere: one row per node, x slowest."""
    phantom = Phantom(item.spec)
    u, v = _grid()
    truth = phantom.truth(u, v, hemi=item.hemi, pose=item.pose)
    columns: dict[str, Any] = {
        "x": np.repeat(np.arange(1, NODES[0] + 1), NODES[1]),
        "y": np.tile(np.arange(1, NODES[1] + 1), NODES[0]),
        "u": u,
        "v": v,
        **{name: truth.points[..., axis] for axis, name in enumerate("ras")},
        "thickness": truth.thickness,
        "curvature": truth.curvature,
        "curvature_interior": truth.curvature_interior,
        "curvature_exterior": truth.curvature_exterior,
    }
    path = out / MAPS_FOLDER / f"sub-{item.subject}_hemi-{item.hemi}_truth.tsv"
    _write_columns(path, columns)


def _write_effect(out: Path, plan: CohortPlan) -> None:
    """Write the plan, and by how much a group's wall differs at each place of the sheet."""
    u, v = _grid()
    doses = (0, min(1, len(plan.groups) - 1))
    without, with_effect = (Phantom(typical_shape(plan, dose)) for dose in doses)
    planted = replace(with_effect.spec, offset=0.0)
    thinning = Phantom(planted).body.thickness(u, v) - without.body.thickness(u, v)
    observed = with_effect.body.thickness(u, v) - without.body.thickness(u, v)
    limits = region_limits(plan)
    inside = np.logical_and.reduce(
        [
            (low - _ROUNDING <= at) & (at <= high + _ROUNDING)
            for at, (low, high) in zip((u, v), limits, strict=True)
        ]
    )
    _write_columns(
        out / EFFECT_TABLE,
        {
            "x": np.repeat(np.arange(1, NODES[0] + 1), NODES[1]),
            "y": np.tile(np.arange(1, NODES[1] + 1), NODES[0]),
            "u": u,
            "v": v,
            "in_region": inside.astype(int),
            "difference": thinning,
            "difference_unregistered": observed,
        },
    )
    files.write_json(
        (out / EFFECT_TABLE).with_suffix(".json"),
        {
            "in_region": {
                "Description": "1 within the limits of the region; at them, half of the effect"
            },
            "difference": {
                "Description": "thickness of the second group minus that of the first, at the same"
                " anatomical place",
                "Units": "mm",
            },
            "difference_unregistered": {
                "Description": "the same at equal u, where the planted shift counts too",
                "Units": "mm",
            },
            "Plan": asdict(plan),
        },
    )


def _write_columns(path: Path, columns: Mapping[str, Any]) -> None:
    text = [
        [str(x) for x in values.ravel()]
        if np.issubdtype(values.dtype, np.integer)
        else [f"{x:.5f}" for x in values.ravel()]
        for values in map(np.asarray, columns.values())
    ]
    files.write_tsv(path, list(columns), [list(row) for row in zip(*text, strict=True)])
