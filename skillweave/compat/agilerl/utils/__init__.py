"""AgileRL's ``utils``."""
