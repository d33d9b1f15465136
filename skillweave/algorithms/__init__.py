"""Algorithms: one algorithm, one file; settings in ``config``."""
