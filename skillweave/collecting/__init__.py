"""Who steps environments: collectors, and the calls of skills in them."""
