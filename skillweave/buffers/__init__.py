"""Buffers: what was collected, in the form that algorithms learn from."""
