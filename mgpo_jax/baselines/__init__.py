"""What the paper compares prompt optimization with, as adapters (Tables 1 and 8)."""
