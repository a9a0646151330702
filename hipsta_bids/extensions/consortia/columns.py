"""Meaning of the columns of a meta-analysis, in part other than of an analysis."""

from hipsta_bids.group.output.tables import read_columns

COLUMNS = read_columns("hipsta_bids.extensions.consortia")
