"""Evolution: a population that learns in stacks, is judged, selected and mutated."""
