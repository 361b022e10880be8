"""The evaluation as one web page that is its own file: what `mild-viz report` writes."""

from mild_viz.evaluation.page.render import report

__all__ = ["report"]
