"""Spatial transforms of other programs (ITK, FreeSurfer's LTA, FSL), read by nitransforms."""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.opening import open_regular
from hipsta_bids.types import Float


def check_installed(option: str) -> None:
    """Refuse an option that needs nitransforms, where it is not installed."""
    if find_spec("nitransforms") is None:
        raise UsageError(f"{option}: install nitransforms, or hipsta_bids[transforms]")


def read_transform(
    path: Path, image: Path, reference: Path | None = None
) -> Callable[[Float], Float]:
    """Read a transform of an image to the space of the labels, as a function of points.

    The function maps points (N, 3) in RAS mm of the labels to RAS mm of the image. ITK's files
    (``.txt``, ``.tfm``, ``.mat``, ``.h5``), LTA (``.lta``) and displacement fields of ITK
    (``.nii.gz``) hold all that is needed; matrices of FSL (``.mat``) are of ``image`` and of the
    ``reference`` that FSL registered it to. Raises InputError if the file cannot be read.
    """
    try:
        with open_regular(path) as file:
            is_fsl = path.suffix == ".mat" and file.read(1) in b" -0123456789"
        with warnings.catch_warnings(action="ignore"):
            transform = _load_fsl(path, image, reference) if is_fsl else _load(path)
    except Exception as error:  # nitransforms raises whatever its parsers do
        first = " ".join(str(error).split())[:100] or type(error).__name__
        raise InputError(f"{path}: not readable as a transform: {first}") from error

    def to_image(points: Float) -> Float:
        return np.asarray(transform.map(points), dtype=np.float64)

    return to_image


def _load_fsl(path: Path, image: Path, reference: Path | None) -> Any:  # noqa: ANN401  (untyped)
    import nitransforms  # noqa: PLC0415  (slow to load)

    if reference is None:
        raise UsageError("FSL's matrix needs --map-reference")
    return nitransforms.linear.load(path, fmt="fsl", reference=reference, moving=image)


def _load(path: Path) -> Any:  # noqa: ANN401  (untyped)
    """Read a transform by the ending of its name."""
    import nitransforms  # noqa: PLC0415  (slow to load)

    if path.suffix == ".h5":
        return nitransforms.manip.TransformChain.from_filename(path, fmt="itk")
    if path.name.endswith((".nii", ".nii.gz")):
        field = nitransforms.io.itk.ITKDisplacementsField.from_filename(path)
        return nitransforms.nonlinear.DenseFieldTransform(field)
    return nitransforms.linear.load(path, fmt="fs" if path.suffix == ".lta" else "itk")
