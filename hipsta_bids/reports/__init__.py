"""Pages that a person opens: made from the files of an output dataset, and from nothing else."""
