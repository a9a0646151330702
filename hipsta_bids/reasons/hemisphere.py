"""Reasons why a hemisphere has no maps, that lie in its files, labels or shape."""

from hipsta_bids.reasons.reason import Reason

LABELS: dict[str, Reason] = {
    "ambiguous-atlas": Reason(
        "The values in the file of ASHS fit several atlases.",
        "Say which was used: `--ashs-atlas`, or keep `snaplabels.txt` in the dataset.",
    ),
    "unknown-atlas": Reason(
        "The labels fit no atlas that is known.",
        "Describe them in a TOML file, for `--ashs-atlas` or `--scheme`.",
    ),
    "analysis-missing": Reason(
        "The subject has no FreeSurfer analysis of the name of `--fs-analysis`.",
        "Choose one that every subject has; the message lists those found.",
    ),
    "no-subfields": Reason(
        "FreeSurfer's folder has head, body and tail (`.HBT`) only.",
        "Keep the file without a suffix, or `.FS60` or `.CA` too; else run the segmentation again.",
    ),
    "several-files": Reason(
        "Several files are equally good for the same hemisphere.",
        "Keep one, or make the pattern match one.",
    ),
    "unknown-hemisphere": Reason(
        "Neither left nor right is in the file's name.",
        "Rename it, or set `right_offset` in the protocol file.",
    ),
    "template-space": Reason(
        "The labels are in the space of a template, which changes thickness.",
        "Use labels in the subject's own space.",
    ),
    "undescribed-labels": Reason(
        "No `_dseg.tsv` says what the labels are.",
        "Add one, or describe the protocol for `--scheme`.",
    ),
    "unclear-names": Reason(
        "The names in the label table do not include a subiculum and a CA1.",
        "Describe the labels in a TOML file for `--scheme`.",
    ),
    "unknown-labels": Reason(
        "Values occur that the protocol does not list.",
        "If the protocol is right, copy its TOML file, add the labels, and use `--scheme`.",
    ),
    "wrong-scheme": Reason(
        "No label of the protocol's sheet occurs.",
        "Another protocol was used; name it by `--scheme` or `--ashs-atlas`.",
    ),
    "no-cortex-labels": Reason(
        "`--region extended` or `entorhinal` was asked for, but cortex has no labels.",
        "Measure the body, or list the cortex as `neighbors` in a protocol file.",
    ),
    "empty-labels": Reason(
        "All labels, or all of this hemisphere, are zero.",
        "Check that the segmentation finished.",
    ),
    "non-integer-labels": Reason(
        "Labels are not whole numbers.",
        "The file was resampled with interpolation; use nearest neighbor.",
    ),
    "grid-mismatch": Reason(
        "Two files that belong together have different grids.",
        "Use files of the same run.",
    ),
    "not-3d": Reason("The labels are not one volume.", "Extract the volume."),
    "not-scalar": Reason(
        "A map has colors or complex numbers.",
        "Extract the magnitude or one channel.",
    ),
    "too-many-axes": Reason("A map has five or more axes.", "Extract what is meant."),
    "empty-image": Reason("The image has no voxels.", "Make the file again."),
    "bad-affine": Reason(
        "The header does not say where the voxels lie, or says it wrongly.",
        "Copy the orientation from the image that was segmented.",
    ),
    "bad-voxel-size": Reason(
        "The voxels are too small or too large to be millimeters.",
        "Check the units of the header.",
    ),
    "unreadable-image": Reason(
        "The file is damaged or no image.",
        "Copy it or make it again.",
    ),
    "unreadable-table": Reason(
        "A table cannot be read, or lacks its columns.",
        "Correct it; a `_dseg.tsv` needs `index` and `name`. Tables of results: run again with"
        " `--force`.",
    ),
    "unreadable-file": Reason(
        "The file does not exist, or may not be read.",
        "Check the path and its permissions.",
    ),
    "unreadable-json": Reason("A JSON file is damaged.", "Restore or delete it."),
    "bad-json": Reason(
        "A JSON file does not hold what it should.",
        "Restore or delete it; of results, run the participant level again.",
    ),
    "bad-table": Reason(
        "A table lacks a column, or its rows differ in length.",
        "The message names the column. Tables of results: run again with `--force`.",
    ),
    "edited-elsewhere": Reason(
        "The edited labels lie elsewhere than the ones that they correct.",
        "Keep the orientation and position of the image that was edited.",
    ),
    "edited-mask-elsewhere": Reason(
        "The edited mask and the labels have no voxel in common between the end planes.",
        "Check that the mask is of this hemisphere and in the same space.",
    ),
    "edited-mask-empty": Reason("The edited mask is empty.", "Delete it, or save it again."),
    "edited-mask-not-binary": Reason(
        "The edited mask has more values than 0 and one other.",
        "Save edited labels as `desc-edited_dseg` instead.",
    ),
    "edited-mask-region": Reason(
        "An edited mask is about the body, but another region is measured.",
        "Edit the labels instead.",
    ),
}

SHAPE: dict[str, Reason] = {
    "no-sheet-labels": Reason(
        "No voxel has a label of the sheet's subfields.",
        "Check that the protocol is the right one.",
    ),
    "no-body": Reason(
        "There are no head and tail labels, and no slice has both CA1 and CA2 or CA3.",
        "Check the orientation of the image and the protocol; add head and tail labels.",
    ),
    "body-too-short": Reason(
        "The end planes are less than `body.min_length` apart.",
        "Check the head and tail labels.",
    ),
    "left-right-swapped": Reason(
        "The subiculum lies lateral of CA1.",
        "Check the image's affine, and which file is left.",
    ),
    "cortex-incomplete": Reason(
        "Cortex has labels along too little of the body.",
        "Measure the body, or label the cortex beside all of it.",
    ),
    "end-plane-tilted": Reason(
        "An end plane is tilted too much against the long axis.",
        "Check the head and tail labels at that end.",
    ),
    "ends-crossed": Reason(
        "The two end planes meet beside the body.",
        "Check the head and tail labels.",
    ),
    "sheet-too-thin": Reason(
        "The sheet has too few voxels across it.",
        "Use a finer segmentation: FreeSurfer's file without `.FSvoxelSpace`, for example.",
    ),
    "body-interrupted": Reason(
        "No connected path of labels leads from one end plane to the other.",
        "Fill missing slices; correct head and tail labels inside the body.",
    ),
    "body-split": Reason(
        "A gap from end to end parts the sheet into strips.",
        "Fill it in the labels, or check that the protocol fits them.",
    ),
    "topology": Reason(
        "Holes or bridges could not be repaired.",
        "Correct the labels at the place that the message names.",
    ),
    "surface-topology": Reason(
        "The surface is not one closed sphere.",
        "Correct the labels by hand.",
    ),
    "tetrahedralization": Reason(
        "The surface cannot be filled with tetrahedra.",
        "Look where the message says for parts that touch or cross, and correct the labels.",
    ),
    "boundaries": Reason(
        "The medial and lateral boundary do not part the interior from the exterior side.",
        "Look for folds that touch each other, and part them in the labels.",
    ),
    "laplace": Reason(
        "A coordinate has no solution: the mesh is broken.",
        "Correct the labels; please report it if they look right.",
    ),
    "sheet-incomplete": Reason(
        "Too many columns of the sheet lie in no tetrahedron.",
        "Check the labels near the end planes.",
    ),
    "label-order": Reason(
        "The subfields do not follow each other from medial to lateral.",
        "Check that the protocol fits the labels.",
    ),
    "thickness-implausible": Reason(
        "Mean thickness contradicts volume over area: the map would be wrong.",
        "Check the labels for bridges and missing parts.",
    ),
    "surrogate-empty": Reason(
        "`hipsta-bids surrogate`: the slice has no labels.",
        "Choose another slice (`surrogate.positions`).",
    ),
    "surrogate-loop": Reason(
        "`hipsta-bids surrogate`: the ribbon closes on itself in the slice.",
        "Choose another slice, or look for a bridge there.",
    ),
    "surrogate-short": Reason(
        "`hipsta-bids surrogate`: the medial axis is no line in the slice.",
        "Choose another slice, or look at its labels.",
    ),
}
