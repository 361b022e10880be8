"""Evaluation: prediction error beside simple baselines and the published figures."""
