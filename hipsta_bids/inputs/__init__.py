"""Find segmentations in a dataset and read them."""
