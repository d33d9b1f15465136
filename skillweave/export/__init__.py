"""A trained policy as ONNX files and a ``policy.json``, for machines without this library.

Begin with ``write``, which writes the folder; ``compile`` makes plain data of the policy.
"""
