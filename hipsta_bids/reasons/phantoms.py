"""Reasons of synthetic data and of the validation."""

from hipsta_bids.reasons.reason import Reason

PHANTOMS: dict[str, Reason] = {
    "folder-taken": Reason("The folder holds something else.", "Choose a new one."),
    "phantom-setting": Reason("A parameter is unknown or out of range.", "The message says which."),
    "phantom-region": Reason("There is no region of this name.", "The help lists them."),
    "phantom-folds": Reason("The wall or the axis bends too sharply.", "Bend or thicken it less."),
    "phantom-overlap": Reason("Turns of the wall overlap.", "Make it thinner or narrower."),
    "phantom-layer": Reason("The molecular layer fills the wall.", "Make the layer thinner."),
    "phantom-hemi": Reason("The hemisphere is neither L nor R.", "Choose one."),
    "phantom-pose": Reason("The pose is not rigid.", "Give a rotation matrix."),
    "phantom-scheme": Reason(
        "The protocol has no label for a tissue of the phantom.",
        "Choose another protocol.",
    ),
    "defect-kind": Reason("There is no defect of this kind.", "The message lists them."),
    "defect-empty": Reason("The defect changes no voxel.", "Make it larger."),
    "unknown-suite": Reason("There is no such suite.", "The message lists them."),
    "crash": Reason(
        "A measurement of the validation ended with a bug.",
        "Please report it; the table names the case.",
    ),
}
