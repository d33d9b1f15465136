"""Names and files of AgileRL on Skillweave's algorithms, so that its scripts run.

Begin with ``agilerl/agents``; ``agilerl_files`` converts checkpoints.
"""
