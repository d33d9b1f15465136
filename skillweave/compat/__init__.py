"""Other libraries' names for what Skillweave does, so that their scripts run; thin."""
