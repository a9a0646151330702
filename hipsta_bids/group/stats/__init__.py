"""Statistics of arrays: nothing here knows files, folders or participants."""
