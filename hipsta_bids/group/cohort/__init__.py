"""Participants and measures that are compared: read, joined and selected."""
