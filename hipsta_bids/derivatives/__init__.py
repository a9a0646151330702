"""Names, files and tables of the output dataset."""
