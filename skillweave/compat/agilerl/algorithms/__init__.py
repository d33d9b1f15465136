"""AgileRL's algorithms."""
