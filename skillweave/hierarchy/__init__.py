"""Skills under a selector: calls, ``OptionsEnv``, the policy, training."""
