"""Collectors elsewhere."""
