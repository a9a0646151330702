"""Segmentation protocols: one TOML file each."""

#: Regions with the head on the sheet: with the tail or without it. Here, where the command line and
#: names of files find them without loading protocols.
EXPERIMENTAL = ("headbody", "whole")
