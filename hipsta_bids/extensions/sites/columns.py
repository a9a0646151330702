"""Meaning of the columns of sites, beside those of all analyses."""

from hipsta_bids.group.output.tables import read_columns

COLUMNS = read_columns("hipsta_bids.extensions.sites")
