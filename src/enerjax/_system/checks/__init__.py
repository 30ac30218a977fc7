"""Checks of a system before any step."""
