"""``skillweave demo``: two tasks that are trained, scored and filmed in minutes."""
