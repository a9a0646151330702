"""The file of norms, ``norms.json``: what it holds, and how it is checked when it is read."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms.centiles import LEVELS, NORM_ARRAYS, Norms, People
from hipsta_bids.group.output.saved import LARGEST_FILE
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Float, Key
from hipsta_bids.types.tables import TomlTable

_Age = Annotated[files.Number, Field(ge=-1000, le=1000)]  # charts have a row for each year

_MAX_PARTICIPANTS = 10**9  # participants, which have to fit in a float


class NormArrays(TomlTable):
    """The arrays of :class:`Norms`; null where nothing is known."""

    mean: list[files.FileNumbers]
    spread: Annotated[list[files.FileNumbers], Field(min_length=2, max_length=2)]
    shape: Annotated[list[files.FileNumbers], Field(min_length=2, max_length=2)]
    shift: list[files.FileNumbers]
    scale: list[list[Annotated[files.Number, Field(gt=0)] | None]]
    n: list[list[Annotated[int, Field(ge=0, le=_MAX_PARTICIPANTS)]]]


class NormsFile(TomlTable):
    """Norms of a reference cohort, and the facts that new participants have to match; sums only."""

    description: files.Text
    format: Literal[1]
    hash: files.Text
    """Of all else."""
    version: files.Text
    """Of hipsta_bids, at the group level."""
    versions: list[files.Text]
    """Of hipsta_bids, at the participant level."""
    seg: files.Text
    region: files.Text
    labels: dict[files.Text, list[files.Text]] = Field(default_factory=dict)
    """Values of each field of provenance of the labels."""
    settings_hash: files.Text
    """Of the settings of the participant level."""
    registration: dict[str, Any]
    """Settings of registration."""
    template: dict[str, Any] | None
    """As in ``template.json``; ``None`` without registration."""
    x: list[files.Number]
    y: list[files.Number]
    """Coordinates of the nodes of the sheet."""
    age: files.Text
    sex: files.Text
    site: files.Text
    """Columns."""
    knots: Annotated[list[_Age], Field(min_length=3, max_length=50)]
    """Of the spline of age; the outer ones are the range."""
    sexes: list[files.Text]
    """Levels; empty where sex was not known."""
    sites: Annotated[dict[files.Text, Annotated[int, Field(ge=1)]], Field(min_length=1)]
    """Participants by site."""
    participants: Annotated[int, Field(ge=1)]
    norms: dict[Literal["L", "R", "LR"], dict[files.Text, NormArrays]]
    """By hemisphere and measure; summary measures are single points."""
    columns: list[list[list[list[files.Number]]]] = Field(default_factory=list)
    """Sums of products of columns, for merging (:func:`sum_columns`); empty without."""
    sums: dict[Literal["L", "R", "LR"], dict[files.Text, list[list[list[files.FileNumbers]]]]] = (
        Field(default_factory=dict)
    )
    """Sums of products with values by hemisphere and measure (:func:`sum_values`)."""

    @property
    def middle(self) -> People:
        """A participant of the age of the middle knot, halfway between the sexes."""
        age, n = self.knots[len(self.knots) // 2], max(len(self.sexes), 1)
        sex = np.full((1, n - 1), 1 / n)
        return People(age=np.array([age]), sex=sex, site=np.zeros(1, dtype=np.int64))

    def centiles(self, norms: Norms) -> pd.DataFrame:
        """List centiles of a summary measure at each year, by sex, at the average site."""
        ages = np.arange(self.knots[0], self.knots[-1] + 1)
        blocks = []
        for number, sex in enumerate(self.sexes or [files.MISSING]):
            kind = np.tile(np.eye(max(len(self.sexes), 1))[number, 1:], (len(ages), 1))
            people = People(age=ages, sex=kind, site=np.zeros(len(ages), dtype=np.int64))
            values = norms.centiles(people, LEVELS)[:, :, 0]
            columns = {f"p{100 * level:g}": row for level, row in zip(LEVELS, values, strict=True)}
            blocks.append(pd.DataFrame({"sex": sex, "age": ages, **columns}))
        return pd.concat(blocks)

    def arrays(self) -> dict[Key, Norms]:
        """Return norms by hemisphere and measure; ValueError if these do not fit."""
        knots = np.array(self.knots, dtype=np.float64)
        if not (np.diff(knots) > 0).all():
            raise ValueError("knots of age do not ascend")
        rows = {"mean": len(knots) + max(len(self.sexes) - 1, 0), "spread": 2, "shape": 2}
        norms = {}
        for hemi, measures in self.norms.items():
            for measure, entry in measures.items():
                lengths = {len(row) for _, value in entry for row in value}
                if len(lengths) != 1 or any(
                    len(value) != rows.get(name, len(self.sites)) for name, value in entry
                ):
                    raise ValueError(f"numbers of {measure}, {hemi}, that do not fit each other")
                values = {name: np.array(value, dtype=np.float64) for name, value in entry}
                norms[str(hemi), measure] = Norms(
                    knots=knots, **{**values, "n": values["n"].astype(int)}
                )
        if self.hash != _digest(self.model_dump(exclude_unset=True)):
            raise ValueError("changed after it was written")
        return norms

    def site_sums(self) -> dict[Key, Float]:
        """Return sums by hemisphere and measure as arrays; ValueError if these do not fit."""
        n_sites, n_columns = len(self.sites), len(self.knots) + max(len(self.sexes) - 1, 0)
        if np.shape(self.columns) != (n_sites, 2, n_columns, n_columns):
            raise ValueError("sums of columns that do not fit")
        sums = {}
        for hemi, measures in self.sums.items():
            for measure, values in measures.items():
                sums[str(hemi), measure] = np.array(values, dtype=np.float64)
                if sums[hemi, measure].shape[:3] != (n_sites, 2, n_columns + 1):
                    raise ValueError(f"sums of {measure}, {hemi}, that do not fit")
        return sums


def save_norms(path: Path, file: NormsFile, norms: Mapping[Key, Norms]) -> None:
    """Write norms, to be read by :func:`load_norms`."""
    content = {**file.model_dump(exclude_unset=True), "norms": files.as_nested(norms, NORM_ARRAYS)}
    files.write_json(path, {**content, "hash": _digest(content)})


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps({**content, "hash": ""}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def load_norms(path: Path) -> tuple[NormsFile, dict[Key, Norms]]:
    """Read what :func:`save_norms` wrote; nothing in it is run.

    ModelError if it is too large, changed, of another format, or its parts do not fit each other.
    """
    try:
        file = files.read_foreign(path, NormsFile, max_bytes=LARGEST_FILE)
        _ = file.site_sums() if file.columns else None
        return file, file.arrays()
    except (ValueError, RecursionError) as error:
        raise ModelError(
            f"{path}: not a file of norms ({error}); use the norms.json of --fit-norms"
        ) from error
