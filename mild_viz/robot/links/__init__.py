"""Poses of the links that are drawn."""
