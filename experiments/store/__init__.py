"""Everything kept on disk: settings, results, policies, tables."""
