"""Output for people: progress, captions, videos, reports."""
