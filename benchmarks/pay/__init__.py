"""Skills that pay: suites of tasks on which a hierarchy is held against honest baselines."""
