"""Worlds made from gymnasium environments of other packages; see docs/guides/own-gymnasium-world.md."""
