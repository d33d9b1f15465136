"""AgileRL's ``components``."""
