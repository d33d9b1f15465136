"""Networks as functions: every parameter has a leading member axis P.

Begin with ``net``, which joins encoder, layers and head; ``config`` describes networks as data.
"""
