"""What every room needs and no user sees: messages, arguments, paths, seeds."""
