"""Buffers: stores of experience for on-policy learners and for replay."""
