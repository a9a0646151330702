"""Who and what is compared: found, read, joined and chosen."""
