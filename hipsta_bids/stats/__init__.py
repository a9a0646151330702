"""Design and statistics of arrays: nothing here knows files, folders or the group level."""
