"""Measurements of wall time on an accelerator."""
