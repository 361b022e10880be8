"""Recordings: one reader per source, windows, download and the built-in demo set."""
