"""AgileRL's ``hpo``."""
