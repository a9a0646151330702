"""Reasons to look at a hemisphere that was measured."""

from hipsta_bids.reasons.reason import Reason

FLAGS: dict[str, Reason] = {
    "repaired": Reason(
        "Small holes or bridges of the labels were mended (status `repaired`, unless there are"
        " flags, too).",
        "Look at the places. If the repair fits, the hemisphere can be used.",
    ),
    "large-repair": Reason(
        "A hole was filled, or a bridge cut, against clear evidence of the labels.",
        "Look at the place. If the repair is wrong, correct the labels there.",
    ),
    "much-repaired": Reason(
        "Repairs changed a large share of the body.",
        "Look at the labels as a whole. The segmentation may be poor, or of another protocol.",
    ),
    "subfield-missing": Reason(
        "The body has no subiculum, no CA1, or no CA2 or CA3. The sheet ends where the labels do.",
        "Complete the labels, or compare this hemisphere with none that has them.",
    ),
    "boundary-doubtful": Reason(
        "Two ways to find the medial and the lateral boundary differ by much of the thickness.",
        "Look at the rims in the report. Correct labels that bulge or fork there.",
    ),
    "side-doubtful": Reason(
        "Labels of the dentate gyrus lie on the outer side of the bend, or labels and bending"
        " disagree on which side is interior.",
        "Look which surface is called interior. Check the dentate gyrus and CA4 labels.",
    ),
    "folded": Reason(
        "The coordinates turn back on themselves in part of the volume.",
        "Look at the map. Leave the hemisphere out if columns cross.",
    ),
    "columns-filled": Reason(
        "Many columns of the sheet could not be measured and were filled from their neighbors.",
        "Look where they are (column `valid` of the sheet table). Leave those points out, or"
        " correct the labels.",
    ),
    "thickness-doubtful": Reason(
        "Mean thickness and volume over area do not fit each other well.",
        "Look at the map and the cross-sections for bridges and missing parts.",
    ),
    "thickness-ridge": Reason(
        "A band across the axis is thicker than the sheet before and behind it.",
        "Look for labels that leaked in these slices.",
    ),
    "thickness-groove": Reason(
        "A band across the axis is thinner than the sheet before and behind it.",
        "Look for missing labels in these slices.",
    ),
    "section-notch": Reason(
        "A cross-section lacks what its neighbors have.",
        "Complete the labels there.",
    ),
    "section-bump": Reason(
        "A cross-section has what its neighbors lack.",
        "Look for leaks and bridges there.",
    ),
    "section-intrusion": Reason(
        "A cross-section has the sheet where its neighbors have the dentate gyrus or CA4.",
        "Look for bridges across the inside there.",
    ),
    "extent-jump": Reason(
        "The width of the sheet jumps from one row to the next.",
        "Look for parts that are missing or were added near the place.",
    ),
    "extent-dip": Reason(
        "The sheet is narrower than before and behind.",
        "Look for a tip that is missing in these slices.",
    ),
    "noisy-labels": Reason(
        "Many single voxels inside the sheet lack its label.",
        "Smooth or correct the labels; check that no interpolation was used.",
    ),
    "thin-gap": Reason(
        "A thin layer of voxels without a label parts the sheet.",
        "Fill it in the labels.",
    ),
    "loose-part": Reason(
        "A large part of the sheet touches the rest by edges of voxels at most.",
        "Fill the gap in the labels.",
    ),
    "slices-along-axis": Reason(
        "The longest voxel edge lies across the long axis of the hippocampus.",
        "Check the header of the image. Slices should lie across the hippocampus.",
    ),
    "image-border": Reason(
        "The body touches the border of the image.",
        "Check that the image holds all of it; crop with a margin.",
    ),
    "end-labels-inside": Reason(
        "Head or tail voxels lie inside the body. Refused if they lie on both sides of it.",
        "Correct these labels.",
    ),
    "labels-end": Reason(
        "The labels end where the body does: it may be cut short. Refused if one end is missing.",
        "Label the whole hippocampus, head and tail included.",
    ),
    "layers-fold": Reason(
        "With equal volumes between layers, some layers fold; these columns have equal distances.",
        "Set `sheet.depths` to `distance`, or leave these points out.",
    ),
    "edited-mask-coarse": Reason(
        "The voxels of the edited mask are coarser than those of the labels.",
        "Draw on the grid of `desc-body_mask`.",
    ),
    "edited-mask-different": Reason(
        "The edited mask adds or removes a large share of the body.",
        "Check that it is the right mask. Edit the labels where so much is wrong.",
    ),
    "map-outside": Reason(
        "More than 5 % of the sheet lie outside of a volume given to `--map`.",
        "Check that it is in the space of the labels and covers the hippocampus.",
    ),
    "map-unusable": Reason(
        "A volume given to `--map` cannot be used. The shape measures are unharmed.",
        "The message says what is wrong with the file.",
    ),
    "roi-unusable": Reason(
        "The table of `--roi` cannot be used. The shape measures are unharmed.",
        "The message says which line or column to correct.",
    ),
}
