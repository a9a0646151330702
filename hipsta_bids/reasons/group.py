"""Reasons of the group level."""

from hipsta_bids.reasons.reason import Reason

EXCLUSIONS: dict[str, Reason] = {
    "listed": Reason("It is in the table of `--exclude`.", "Take it out of the table."),
    "quality": Reason("It fulfills the condition of `--exclude-qc`.", "Change the condition."),
    "incomplete": Reason(
        "A variable of the model is missing.",
        "Complete `participants.tsv`, or use a model without it.",
    ),
    "later-session": Reason(
        "Of several sessions the first is taken.",
        "Compare sessions with `--longitudinal` or `--paired`.",
    ),
    "other-session": Reason(
        "`--paired` compares two other sessions.",
        "Name this one there.",
    ),
}

GROUP: dict[str, Reason] = {
    "no-derivatives": Reason(
        "The output folder of the participant level does not exist.",
        "Run the participant level first.",
    ),
    "no-folder": Reason("A folder of `--segmentations` does not exist.", "Check the path."),
    "no-hemisphere": Reason(
        "No hemisphere is left, or not both sides where both are needed.",
        "The message counts the exclusions by reason.",
    ),
    "several-protocols": Reason(
        "There are hemispheres of several protocols.",
        "Choose one with `--seg`; do not pool them.",
    ),
    "mixed-grids": Reason(
        "Sheets or maps have different numbers of points.",
        "Use one setting of the grid, or one density.",
    ),
    "duplicate-rows": Reason(
        "A participant or session stands more than once.",
        "Keep one row each; participants of different sites need different labels.",
    ),
    "other-participants": Reason(
        "A table of covariates has none of the participants that were measured.",
        "Check the table, and how it spells `participant_id`.",
    ),
    "unknown-measure": Reason(
        "No measure has this name.",
        "See [Outputs](outputs.md); the message names similar ones.",
    ),
    "quality-condition": Reason(
        "The condition of `--exclude-qc` is not understood.",
        'Write it as "filled_fraction > 0.01".',
    ),
    "no-groups": Reason(
        "No column of `participants.tsv` tells groups.",
        "Add a column `group`, or give a model by `--formula` and `--contrast`.",
    ),
    "group-numeric": Reason(
        "The column of the groups holds numbers.",
        "Give names, or a model by `--formula`.",
    ),
    "unknown-variable": Reason(
        "The model names a column that no table has.",
        "Check its spelling; the message lists the columns.",
    ),
    "unknown-level": Reason(
        "Nobody is in a group, level or session that was named.",
        "Check its spelling; the message lists the levels.",
    ),
    "not-numeric": Reason(
        "A column of numbers has some cells that are none.",
        "Correct them, or mark them `n/a`.",
    ),
    "constant-column": Reason(
        "A variable is the same for all.",
        "Leave it out of the formula.",
    ),
    "group-size": Reason(
        "Too few participants for the model, a level, or the registration.",
        "Use a smaller model, or `--align none`; the message has the numbers.",
    ),
    "formula": Reason("The formula cannot be read.", "Write it as `group + age`."),
    "contrast-syntax": Reason(
        "The contrast cannot be read.",
        "Write it as `group[A]-group[B]` or `0.5*age`.",
    ),
    "contrast-unknown": Reason(
        "The contrast names a level or variable that is not in the model.",
        "The message lists those that are.",
    ),
    "contrast-redundant": Reason(
        "Rows of a contrast say the same twice, or one is all zero.",
        "Leave out the redundant row.",
    ),
    "contrast-shape": Reason(
        "A contrast does not fit the design.",
        "Give one weight per column; in longitudinal models, one row per contrast.",
    ),
    "model-file": Reason(
        "The model file is no BIDS Stats Models with one node.",
        "Start from `model.json` of an earlier analysis.",
    ),
    "design-missing": Reason(
        "The design has missing values.",
        "Keep complete rows; a logarithm of zero is missing, too.",
    ),
    "design-rank": Reason(
        "A column of the design is a combination of others.",
        "Leave one of them out.",
    ),
    "design-shape": Reason(
        "Maps and design have different numbers of rows.",
        "Functions of Python only: give one row per participant.",
    ),
    "all-points-invalid": Reason(
        "No point has enough values for the model.",
        "Look at the sheets, or use a smaller model.",
    ),
    "logistic-convergence": Reason(
        "The logistic model does not converge.",
        "The groups may be separated, or columns nearly the same; leave one out.",
    ),
    "permutation-model": Reason(
        "This model has no permutation test.",
        "Use `--correction fdr2`, or `--paired`; set `glm.covariance` to `ordinary`.",
    ),
    "permutation-blocks": Reason(
        "The blocks are missing for some, or the contrast does not vary within them.",
        "Leave `--blocks` out, or choose larger ones.",
    ),
    "profile-missing": Reason(
        "Profiles lack too many values for registration.",
        "Leave these hemispheres out.",
    ),
    "profile-constant": Reason(
        "All profiles are the same constant.",
        "Use `--align none`.",
    ),
    "template-mismatch": Reason(
        "The template was made with another way of registration.",
        "Use the same `--align`.",
    ),
    "template-file": Reason(
        "The file is no template, or lacks a hemisphere.",
        "Use `template.json` of another analysis.",
    ),
    "one-session": Reason(
        "Nobody has two sessions, or both that were named.",
        "Use a model without sessions, or name others.",
    ),
    "few-sessions": Reason(
        "Nobody has three sessions, which random slopes need.",
        "Use random intercepts.",
    ),
    "session-choice": Reason(
        "Options that choose sessions exclude each other.",
        "Give `--longitudinal` or `--paired`; w-scores want one visit each.",
    ),
    "session-order": Reason(
        "Two sessions have no positive time between them.",
        "Correct the dates, or the order of `--paired`.",
    ),
    "no-time": Reason(
        "The time of sessions is unknown.",
        "Add a column `time`, `acq_time` or age to `sessions.tsv`.",
    ),
    "bad-date": Reason(
        "`acq_time` is no date and time.",
        "Write it as 2001-02-03T04:05:06.",
    ),
    "longitudinal-covariance": Reason(
        "The longitudinal model assumes equal variances.",
        "Set `glm.covariance` to `ordinary`.",
    ),
    "normative-covariance": Reason(
        "Normative scores assume equal variances.",
        "Set `glm.covariance` to `ordinary`.",
    ),
    "no-maps": Reason("No file matches `--maps`.", "Check pattern and folder."),
    "several-maps": Reason(
        "A file holds several maps.",
        "Give a file with one, or name the map after its column.",
    ),
    "unreadable-map": Reason(
        "A map is no GIFTI file or table of numbers.",
        "Write it again; mark missing cells `n/a`.",
    ),
    "no-surface": Reason(
        "There is no surface to draw a map on, or to find neighbors with.",
        "Name one with `--maps-surface`.",
    ),
    "unreadable-surface": Reason(
        "A surface cannot be read, or has triangles of unknown vertices.",
        "Give a `.surf.gii` file; of results, run the participant level again with `--force`.",
    ),
    "no-volumes": Reason("No file matches `--volumes`.", "Check pattern and folder."),
    "unreadable-volumes": Reason(
        "A table of volumes is of no form that is known.",
        "Those of FreeSurfer, ASHS and HippUnfold are read.",
    ),
}
