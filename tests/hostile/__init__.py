"""Suites that try to break the commands: bad input, kills, signals, full disks, concurrent commands."""
