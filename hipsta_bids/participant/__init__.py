"""One hemisphere from labels to maps, and runs over many."""
