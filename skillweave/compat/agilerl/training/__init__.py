"""AgileRL's ``training``."""
