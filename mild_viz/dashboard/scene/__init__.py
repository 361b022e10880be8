"""Dumb views: each draws fields of one Rollout by assigning handle properties."""
