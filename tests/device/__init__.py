"""Speed in wall time on an accelerator."""
