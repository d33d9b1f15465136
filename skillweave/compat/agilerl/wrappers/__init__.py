"""AgileRL's ``wrappers``."""
