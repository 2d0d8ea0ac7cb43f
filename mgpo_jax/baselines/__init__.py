"""The baselines of the paper (Tables 1 and 8) as adapters."""
