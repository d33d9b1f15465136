"""Stacked networks: every parameter has a leading member axis P."""
