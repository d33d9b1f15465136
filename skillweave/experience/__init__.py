"""Collectors, which step environments, and the calls of skills in them."""
