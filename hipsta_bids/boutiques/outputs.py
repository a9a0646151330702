"""What a run leaves behind, as output files of a Boutiques descriptor."""

from collections.abc import Sequence

from hipsta_bids.boutiques.inputs import Entry

_ROOT = "[OUTPUT_DIR]"

#: Files of the output dataset: name, description.
_DATASET = {
    "status": ("status.tsv", "one row per hemisphere: status, reason, message, time, memory"),
    "settings": ("desc-settings.json", "all settings of these results, and their hash"),
    "description": ("dataset_description.json", "the dataset's description, as BIDS asks for"),
    "citation": ("CITATION.md", "a methods paragraph with references"),
    "logs": ("logs/*", "one file per run"),
}

#: Files of a hemisphere: what follows the protocol in their names, description, on request only.
_HEMISPHERE = {
    "sheets": ("_desc-sheet_morph.tsv", "thickness, curvatures and subfield per point", False),
    "summaries": ("_desc-summary_morph.tsv", "one row of measures per hemisphere", False),
    "profiles": ("_desc-profile_morph.tsv", "maps averaged along one axis", False),
    "sections": ("_desc-sections_morph.tsv", "one row per cross-section", False),
    "surfaces": ("_midthickness.surf.gii", "surfaces of the sheet, with two walls beside", False),
    "maps": ("_*.shape.gii", "thickness, curvatures and extents per vertex", False),
    "subfields": ("_dseg.label.gii", "subfield per vertex", False),
    "masks": ("_desc-body_mask.nii.gz", "the measured body on the grid of the labels", False),
    "records": ("_desc-qc_metrics.json", "status, flags, inputs, quality metrics", False),
    "layers": ("_desc-layers_morph.tsv", "points of all layers (write_meshes)", True),
    "meshes": ("_desc-tet_mesh.vtu", "tetrahedral meshes (write_meshes)", True),
    "other_maps": ("_desc-*_map.tsv", "other images on the sheet (map)", True),
    "regions": ("_desc-roi_morph.tsv", "maps summed up in regions (roi)", True),
}

#: Files of one model of the group level: name, description, not in every analysis.
_MODEL = {
    "methods": ("methods.md", "what was done and found; to be read first", False),
    "peaks": ("peaks.tsv", "one row per cluster", False),
    "statistics": ("maps.tsv", "one row per map: points tested and found", False),
    "measures": ("measures.tsv", "the model for each summary measure", False),
    "descriptives": ("descriptives.tsv", "means and standard deviations by group", False),
    "classification": ("classification.tsv", "pairs of groups, by logistic regression", True),
    "registration": ("registration.tsv", "variance explained before and after", True),
    "excluded": ("excluded.tsv", "who is not in it, and why", False),
    "covariates": ("covariates.tsv", "the table that was fitted", False),
    "statistical_maps": ("hemi-*_statmap.tsv", "statistics at each point", False),
    "all_maps": ("maps.parquet", "all maps, original and registered", False),
    "template": ("template.json", "the template of registration", True),
    "model_file": ("model.json", "the model, in the form of BIDS Stats Models", False),
    "record": ("analysis.json", "command, settings, seeds, versions", False),
    "figures": ("figures/*", "figures (PNG, SVG), where matplotlib is installed", True),
}


def output_folder() -> Entry:
    """Describe the output dataset as a whole."""
    return _output("dataset", _ROOT, "the output dataset", optional=False)


def participant_outputs() -> list[Entry]:
    """List what the participant level writes.

    Returns
    -------
    list of dict
        Boutiques output files. Those of hemispheres are there twice, with and without sessions,
        since a wildcard stays within one folder.
    """
    outputs = [output_folder()]
    for key, (name, text) in _DATASET.items():
        outputs.append(_output(key, f"{_ROOT}/{name}", text, optional=False))
    for key, (ending, text, _) in _HEMISPHERE.items():
        for suffix, folder, where in (
            ("", "sub-*", "datasets without sessions"),
            ("_of_sessions", "sub-*/ses-*", "datasets with sessions"),
        ):
            path = f"{_ROOT}/{folder}/anat/sub-*_hemi-*_seg-*{ending}"
            entry = _output(f"{key}{suffix}", path, f"{text}; {where}", optional=True)
            outputs.append(entry | {"list": True})
    return outputs


def group_outputs() -> list[Entry]:
    """List what the group level writes.

    Returns
    -------
    list of dict
        Boutiques output files; the folder of a model is named after its formula or by ``--name``.
    """
    models = _output("models", f"{_ROOT}/group/*", "one folder per model", optional=False)
    outputs = [output_folder(), models]
    for key, (name, text, optional) in _MODEL.items():
        entry = _output(key, f"{_ROOT}/group/*/{name}", text, optional=optional)
        outputs.append(entry | ({"list": True} if "*" in name else {}))
    return outputs


def ids_inside(outputs: Sequence[Entry]) -> list[str]:
    """List the outputs that are part of the output dataset, which is the first of them."""
    return [str(entry["id"]) for entry in outputs[1:]]


def _output(key: str, path: str, text: str, *, optional: bool) -> Entry:
    return {
        "id": f"output_{key}",  # or it would meet the options of that name
        "name": key.replace("_", " ").capitalize(),
        "description": text,
        "path-template": path,
        "optional": optional,
    }
