"""Cross-sections and rows of the sheet that do not go with their neighbors."""

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Flag, Float, Sheet
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import name_place
from hipsta_bids.geometry.grid import Field
from hipsta_bids.settings import CheckSettings


def check_cross_sections(
    field: Field, body: Body, settings: CheckSettings, cuts: Bool | None = None
) -> list[Flag]:
    """Flag a body of which a part is missing between cross-sections that have it, or added.

    Each cross-section is compared with those at a distance on both sides. What both lack, or have
    of the interior labels instead, is judged by how far it stands out from the same body's other
    cross-sections: a bent ribbon moves sideways everywhere, a leak is in one place.

    Parameters
    ----------
    field : Field
        After the repair of its topology.
    body : Body
    settings : CheckSettings
    cuts : (A, B, W) array of bool, optional
        Nodes at which bridges were cut: their stubs are known, and nothing that is added.

    Returns
    -------
    list of Flag
        ``section-notch``, ``section-bump``, ``section-intrusion``.
    """
    solid, interior = field.values > 0, _interior_nodes(field, body)
    strange = np.ones_like(solid)
    if cuts is not None and cuts.any():
        strange = ndimage.distance_transform_edt(~cuts) > settings.stub_nodes
    length = body.ends.length(body.inside_points()[1])
    step = length / (field.grid.shape[2] - 1)
    area = float(np.median(solid.sum(axis=(0, 1))))
    notch, bump, intrusion = _Oddest(), _Oddest(), _Oddest()
    for reach, limit in zip(settings.notch_reach, settings.notch_share, strict=True):
        k = max(round(reach / step), 1)
        if 2 * k >= solid.shape[2]:
            continue
        before, here, after = solid[:, :, : -2 * k], solid[:, :, k:-k], solid[:, :, 2 * k :]
        missing = before & after & ~here
        notch.look(missing, missing.sum(axis=(0, 1)) / here.sum(axis=(0, 1)), limit, k)
        unknown = here & strange[:, :, k:-k]
        enclosed = unknown & interior[:, :, : -2 * k] & interior[:, :, 2 * k :]
        added = unknown & ~before & ~after
        noise = settings.section_noise
        for oddest, part, least in ((bump, added, noise * reach), (intrusion, enclosed, noise)):
            share = part.sum(axis=(0, 1)) / area
            usual = settings.bump_contrast * (float(np.median(share)) + least)
            oddest.look(part, share, usual, k)
    rows = (
        ("section-notch", notch, "lacks what its neighbors have", "complete the labels there"),
        ("section-bump", bump, "has what its neighbors lack", "look for leaks and bridges there"),
        (
            "section-intrusion",
            intrusion,
            "has the sheet between interior labels of its neighbors",
            "look for bridges there",
        ),
    )
    return [
        Flag(
            reason=reason,
            message=f"a cross-section {what}, {oddest.share:.0%} of its area, at "
            f"{name_place(field.grid.to_ras(oddest.nodes), body)}: {remedy}",
        )
        for reason, oddest, what, remedy in rows
        if oddest.excess > 1
    ]


def _interior_nodes(field: Field, body: Body) -> Bool:
    """Nodes whose nearest voxel has an interior label and is not of the sheet."""
    points = field.grid.node_points(clamp=0.0)
    voxels = np.rint(body.to_voxels(points)).astype(np.intp)
    voxels = np.clip(voxels, 0, np.array(body.interior.shape) - 1)
    return np.asarray((body.interior & (body.tissue == 0))[tuple(np.moveaxis(voxels, -1, 0))])


class _Oddest:
    """The cross-section that departs most from its neighbors."""

    excess = 1.0
    """Times the limit."""
    share = 0.0
    """Of its area that departs."""
    nodes: Float = np.zeros((0, 3))
    """Grid nodes that depart."""

    def look(self, part: Bool, share: Float, limit: float, first: int) -> None:
        """Take note if a cross-section is odder than those seen before."""
        at = int(share.argmax())
        if share[at] > limit * self.excess:
            self.excess = float(share[at] / limit)
            self.share = float(share[at])
            nodes = np.argwhere(part[:, :, at]).astype(float)
            self.nodes = np.column_stack([nodes, np.full(len(nodes), at + first)])


def check_rows(sheet: Sheet, settings: CheckSettings) -> list[Flag]:
    """Flag a sheet whose medial-to-lateral length jumps from row to row, or dips.

    Returns
    -------
    list of Flag
        ``extent-jump``, or ``extent-dip`` where rows are narrower than some on both sides.
    """
    middle = sheet.points[:, :, sheet.middle]
    lengths = np.linalg.norm(np.diff(middle, axis=0), axis=-1).sum(axis=0)
    jumps = np.abs(np.diff(lengths)) / np.minimum(lengths[1:], lengths[:-1])
    dips = 1 - lengths / _wider(lengths, middle, settings.row_dip_reach)
    found = []
    for reason, change, limit, what in (
        ("extent-jump", jumps, settings.flag_row_jump, "changes by {} from one row to the next"),
        ("extent-dip", dips, settings.flag_row_dip, "dips by {}"),
    ):
        row = int(np.nanargmax(change))
        if change[row] > limit:
            place = " ".join(f"{value:.1f}" for value in np.nanmean(middle[:, row], axis=0))
            found.append(
                Flag(
                    reason=reason,
                    message=f"the sheet's width {what.format(f'{change[row]:.0%}')}, near RAS "
                    f"{place} mm: look for missing or added parts in the labels",
                )
            )
    return found


def check_ridges(sheet: Sheet, thickness: Float, settings: CheckSettings) -> list[Flag]:
    """Flag a band across the axis where the sheet is thicker, or thinner, than on both sides.

    Labels that leaked, or that a bar or a dent has changed, show in few cross-sections; thickness
    of a whole sheet changes more slowly along the axis.

    Parameters
    ----------
    sheet : Sheet
    thickness : (Nx, Ny) array
        mm
    settings : CheckSettings

    Returns
    -------
    list of Flag
        ``thickness-ridge``, ``thickness-groove``.
    """
    middle = sheet.points[:, :, sheet.middle]
    flags = []
    for reason, sign, limits, what in (
        ("thickness-ridge", 1, settings.flag_ridge, "thicker"),
        ("thickness-groove", -1, settings.flag_groove, "thinner"),
    ):
        bands = _bands(sign * thickness, limits, _row_step(middle), settings)
        excess, size, at = max(bands, default=(0.0, 0.0, (0, 0)))
        if excess > 1:
            place = " ".join(f"{value:.1f}" for value in middle[at])
            flags.append(
                Flag(
                    reason=reason,
                    message=f"a band of the sheet is {size:.1f} mm {what} than the sheet before "
                    f"and behind it, near RAS {place} mm: look at the labels there",
                )
            )
    return flags


def _bands(
    thickness: Float, limits: tuple[float, ...], step: float, settings: CheckSettings
) -> Iterator[tuple[float, float, tuple[int, int]]]:
    """Thickest band at each distance: times the limit, mm above both sides, and column."""
    for reach, limit in zip(settings.ridge_reach, limits, strict=True):
        k = max(round(reach / step), 1)
        if 2 * k >= thickness.shape[1]:
            continue
        sides = np.maximum(thickness[:, : -2 * k], thickness[:, 2 * k :])
        above = np.nan_to_num(thickness[:, k:-k] - sides)
        band = ndimage.uniform_filter1d(above, settings.ridge_columns, axis=0)
        at = np.unravel_index(band.argmax(), band.shape)
        size = float(band[at])
        yield size / limit, size, (int(at[0]), int(at[1]) + k)


def _row_step(middle: Float) -> float:
    """Distance of neighboring rows of the mid-surface (Nx, Ny, 3), mm."""
    return float(np.nanmedian(np.linalg.norm(np.diff(middle, axis=1), axis=-1)))


def _wider(lengths: Float, middle: Float, reach: float) -> Float:
    """Width (Ny,) that rows within a distance (mm) reach on both sides of each row."""
    rows = np.arange(len(lengths))
    offset = rows[None, :] - rows[:, None]
    near = np.abs(offset) <= max(round(reach / _row_step(middle)), 1)
    before = np.where(near & (offset <= 0), lengths, -np.inf).max(axis=1)
    after = np.where(near & (offset >= 0), lengths, -np.inf).max(axis=1)
    return np.asarray(np.minimum(before, after))
