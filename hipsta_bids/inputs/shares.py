"""Probabilities as shares of voxels: checked, brought to the labels' lattice, summed by tissue."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.errors import InputError
from hipsta_bids.geometry import digital
from hipsta_bids.inputs.scan import Probabilities
from hipsta_bids.io.volumes import read_scalars
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.types import Bool, Float, LabelVolume

#: Values may exceed 0 and 1 by this much, and their sum 1: six labels in 8 bits, rounded, by .012.
_ROUNDING, _SUM = 1e-3, 1.02
#: Scales that are recognized by the largest value, which is more than that of noise.
_SCALES, _NOISE = (100, 255, 1000, 65535), 1.5
#: Share of the sheet's voxels in which probabilities may prefer other tissue.
_DISAGREEMENT = 0.2
#: Lattices whose affines differ by less, voxels, are one.
_SAME_GRID = 1e-3


class Layer(NamedTuple):
    """Probabilities of one label."""

    name: str
    """For messages."""
    tissue: Tissue
    values: NDArray[np.floating]
    """(I, J, K)."""
    affine: Float
    """(4, 4), voxel index to RAS mm."""


def read_shares(volume: LabelVolume, source: Probabilities, *, edited: bool) -> LabelVolume:
    """Add the shares that files have to a volume of labels."""
    layers = (layer for file in source.files for layer in read_layers(*file, volume))
    path = source.files[0][0]
    place = str(path if len(source.files) == 1 else path.parent)
    return add_shares(volume, layers, place, weights=source.weights, edited=edited)


def read_layers(path: Path, tissues: Sequence[Tissue], volume: LabelVolume) -> Iterator[Layer]:
    """Read the part of a file around the labels; ``tissues`` are the tissues of its volumes."""
    corners = np.argwhere(np.ones((2, 2, 2))) * (np.array(volume.tissue.shape) - 1)
    part = read_scalars(path, digital.to_ras(corners, volume.affine))
    count = part.values.shape[3]
    if count != len(tissues):
        labels = f"{len(tissues)} labels; name its volumes in LabelMap of its sidecar"
        raise _bad(str(path), f"has {count} volumes, but {labels}")
    for number, tissue in enumerate(tissues):
        yield Layer(str(path), tissue, part.values[..., number], part.affine)


def add_shares(
    volume: LabelVolume,
    layers: Iterable[Layer],
    place: str,
    *,
    weights: bool = False,
    edited: bool = False,
) -> LabelVolume:
    """Add shares by tissue to a volume of labels; ``place`` is what messages call all layers.

    ``weights`` are divided by their sum. Labels that were ``edited`` are certain where they are no
    longer the likeliest ones.

    Raises
    ------
    InputError
        ``bad-probabilities``: the values are no probabilities, or do not match the labels.
    """
    sheet = np.isin(volume.tissue, (*volume.protocol.sheet, *volume.protocol.layer))
    shares: dict[int, NDArray[np.float32]] = {}
    for layer in layers:
        _check_values(layer, weights=weights)
        share = _sampled(layer, volume, sheet)
        shares[layer.tissue] = shares.get(layer.tissue, np.float32(0)) + share
    total = reduce(np.add, shares.values())
    if not weights and (highest := float(total.max())) > _SUM:
        raise _bad(place, f"the probabilities of a voxel add up to {highest:.2f}")
    scale = np.maximum(total, np.float32(1e-9)) if weights else np.float32(1)
    shares = {kind: np.clip(share / scale, 0, 1) for kind, share in shares.items()}
    likely = _likely_sheet(volume, shares)
    if (off := float(1 - likely[sheet].mean())) > _DISAGREEMENT:
        raise _bad(
            place,
            f"in {off:.0%} of the sheet's voxels other tissue is likelier; check run and side",
        )
    if edited:
        for kind, share in shares.items():
            share[likely != sheet] = volume.tissue[likely != sheet] == kind
    return replace(volume, shares=shares)


def _likely_sheet(volume: LabelVolume, shares: dict[int, NDArray[np.float32]]) -> Bool:
    """Mark voxels (I, J, K) in which the sheet is likelier than each other tissue.

    What the files do not have is one more tissue.
    """
    sheet, remainder = np.zeros((2, *volume.tissue.shape), dtype=np.float32)
    remainder += 1
    largest = np.zeros_like(sheet)
    for kind, share in shares.items():
        remainder -= share
        if kind in (*volume.protocol.sheet, *volume.protocol.layer):
            sheet += share
        else:
            largest = np.maximum(largest, share)
    return np.asarray(sheet >= np.maximum(largest, remainder))


def _check_values(layer: Layer, *, weights: bool) -> None:
    low, high = float(layer.values.min()), float(layer.values.max())
    fault = ""
    if not np.isfinite(low + high):
        fault = "has values that are NaN or infinite"
    elif low < -_ROUNDING:
        fault = f"has values down to {low:.3g}, probabilities are 0 to 1"
    elif high > 1 + _ROUNDING and not weights:
        scale = next((scale for scale in _SCALES if _NOISE < high <= scale), None)
        fault = f"has values up to {high:.4g}, probabilities are 0 to 1"
        fault += f"; divide by {scale}" if scale else ""
    if fault:
        raise _bad(layer.name, fault)


def _sampled(layer: Layer, volume: LabelVolume, sheet: Bool) -> NDArray[np.float32]:
    """Interpolate linearly at the voxels of labels; refuse values that do not reach the sheet."""
    to_layer = np.linalg.inv(layer.affine) @ volume.affine
    if np.abs(to_layer - np.rint(to_layer)).max() < _SAME_GRID:
        to_layer = np.rint(to_layer)
    index = digital.to_ras(digital.positions(sheet), to_layer)
    beyond = np.array(layer.values.shape) - 0.5 + _SAME_GRID
    if (index < -0.5 - _SAME_GRID).any() or (index > beyond).any():
        raise _bad(layer.name, "does not cover the labels; check its space and side")
    sampled: NDArray[np.float32] = ndimage.affine_transform(
        layer.values,
        to_layer[:3, :3],
        to_layer[:3, 3],
        output_shape=volume.tissue.shape,
        output=np.float32,
        order=1,
        mode="nearest",
    )
    return sampled


def _bad(place: str, fault: str) -> InputError:
    message = f"{place}: {fault}; correct it, or omit it (--probabilities never)"
    return InputError(message, reason="bad-probabilities")
