"""Evolution: a population that learns in stacks, is compared, selected and mutated."""
