"""New tasks that are planned on logged calls, beside selectors that learn them."""
