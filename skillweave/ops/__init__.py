"""Mathematics as free functions on tensors: no classes, files or logging.

Letters in shapes: P members, T time, B batch, A actions, O observation, D parameters.
"""
