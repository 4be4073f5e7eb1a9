"""Embedded tables; README.md names source, unit and licence of each."""
