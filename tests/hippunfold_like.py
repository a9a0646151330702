"""Files as HippUnfold writes them: names of versions 1 and 2, flat surfaces, one number per vertex.

Version 1: ``sub-X/surf/sub-X_hemi-L_space-T1w_den-1mm_label-hipp_thickness.shape.gii`` and, beside
it, ``..._space-unfold_den-1mm_label-hipp_midthickness.surf.gii``. Version 2: the map in
``metric/`` without ``space-``, densities by the number of vertices. The flat surface is 40 mm along
the first axis (anterior to posterior) and 20 mm along the second (subiculum to dentate gyrus).
"""

import numpy as np
from nibabel.cifti2 import BrainModelAxis, Cifti2Image, ScalarAxis
from nibabel.gifti import GiftiDataArray, GiftiImage
from scipy.spatial import Delaunay

DENSITY = {1: "1mm", 2: "2k"}


def flat_surface(count, seed=0):
    """Scattered points in the plane, and triangles between them."""
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(0, 40, count), random.uniform(0, 20, count)])
    triangles = Delaunay(points).simplices
    return np.column_stack([points, np.zeros(count)]), triangles


def write_surface(path, points, triangles):
    arrays = [
        GiftiDataArray(points.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        GiftiDataArray(triangles.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    write(path, arrays)


def write_map(path, *values):
    write(path, [GiftiDataArray(v.astype(np.float32), intent="NIFTI_INTENT_SHAPE") for v in values])


def write_cifti(path, values, *, structure="CORTEX", names=("thickness",)):
    """Left and right as one file; vertices of NaN are left out, as a medial wall is."""
    sides = {"L": "LEFT", "R": "RIGHT"}
    known = {hemi: np.flatnonzero(np.isfinite(own)) for hemi, own in values.items()}
    models = [
        BrainModelAxis.from_surface(known[hemi], len(own), f"{structure}_{sides[hemi]}")
        for hemi, own in values.items()
    ]
    data = np.concatenate([own[known[hemi]] for hemi, own in values.items()])
    axes = ScalarAxis(list(names)), sum(models[1:], start=models[0])
    path.parent.mkdir(parents=True, exist_ok=True)
    Cifti2Image(np.tile(data, (len(names), 1)).astype(np.float32), axes).to_filename(path)


def write(path, arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(GiftiImage(darrays=arrays).to_bytes())


def names(root, subject, hemi, *, version, measure="thickness", session=None):
    """Paths of a map and of the unfolded surface of its density."""
    stem = f"sub-{subject}_ses-{session}" if session else f"sub-{subject}"
    folder = root / f"sub-{subject}" / (f"ses-{session}" if session else "")
    den = f"den-{DENSITY[version]}_label-hipp"
    surface = folder / "surf" / f"{stem}_hemi-{hemi}_space-unfold_{den}_midthickness.surf.gii"
    if version == 1:
        name = f"{stem}_hemi-{hemi}_space-T1w_{den}_{measure}.shape.gii"
        return folder / "surf" / name, surface
    return folder / "metric" / f"{stem}_hemi-{hemi}_{den}_{measure}.shape.gii", surface


def cifti_name(root, subject, *, version):
    """Path of the map of both sides."""
    folder = root / f"sub-{subject}" / ("surf" if version == 1 else "cifti")
    space = "_space-T1w" if version == 1 else ""
    return folder / f"sub-{subject}{space}_den-{DENSITY[version]}_label-hipp_thickness.dscalar.nii"


PATTERNS = {
    1: "hippunfold/sub-{subject}/surf/sub-{subject}_hemi-{hemi}_space-T1w_den-1mm_label-hipp"
    "_thickness.shape.gii",
    2: "hippunfold/sub-{subject}/metric/*_hemi-{hemi}_den-2k_label-hipp_thickness.shape.gii",
}
