"""What people see: progress, captions, videos."""
