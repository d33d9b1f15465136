"""Programs for people who work on Skillweave."""
