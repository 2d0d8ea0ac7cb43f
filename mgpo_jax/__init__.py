"""Pre-trained multi-goal Transformers with prompt optimization: the method."""
