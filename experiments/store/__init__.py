"""What lies on disk: settings, results, policies, tables."""
