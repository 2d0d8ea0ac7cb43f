"""Worlds made from gymnasium environments of other packages (docs/guides/own-gymnasium-world.md), and small
programs that measure or tabulate what no command does."""
