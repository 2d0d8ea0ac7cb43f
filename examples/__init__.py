"""Worlds made of environments that others wrote; docs/guides/own-gymnasium-world.md walks through them."""
