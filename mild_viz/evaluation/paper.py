"""The figures that the paper prints, for the rows of our tables (its Tables pred-hri and pred-hhi)."""

from __future__ import annotations

from mild_viz.data.checks import LABELS

_ROBOT = {
    "nuisi": {
        "v1": ((0.760, 0.325), (0.225, 0.114), (0.354, 0.238), (0.201, 0.072)),
        "v2.1": ((0.050, 0.084), (0.025, 0.022), (0.077, 0.095), (0.032, 0.038)),
        "v2.2": ((0.060, 0.087), (0.025, 0.020), (0.080, 0.088), (0.028, 0.040)),
        "v3.1": ((0.046, 0.059), (0.021, 0.015), (0.077, 0.067), (0.025, 0.028)),
        "v3.2": ((0.049, 0.059), (0.020, 0.014), (0.079, 0.072), (0.022, 0.027)),
        "Bütepage": ((0.057, 0.093), (0.083, 0.075), (0.101, 0.086), (0.049, 0.040)),
    },
    "yumi": {
        "v1": ((1.705, 0.521), (0.290, 0.148), (0.428, 0.175), (0.425, 0.150)),
        "v2.1": ((1.349, 1.972), (0.073, 0.040), (0.236, 0.167), (0.028, 0.042)),
        "v2.2": ((1.641, 1.968), (0.068, 0.052), (0.183, 0.122), (0.033, 0.034)),
        "v3.1": ((1.033, 1.204), (0.104, 0.056), (0.130, 0.074), (0.028, 0.034)),
        "v3.2": ((1.143, 1.330), (0.123, 0.069), (0.128, 0.071), (0.028, 0.035)),
        "Bütepage": ((0.225, 0.302), (0.133, 0.214), (0.147, 0.119), (0.181, 0.155)),
    },
}

_HUMAN = {
    "nuisi": {
        "v1": ((0.408, 0.538), (0.311, 0.259), (1.142, 1.375), (0.453, 0.578)),
        "Bütepage": ((3.168, 3.392), (1.489, 3.327), (3.576, 3.082), (2.008, 2.024)),
    },
}


def paper_rows(dataset: str, human_human: bool) -> list[tuple[str, str, float, float]]:
    """(model, action, mean, std) of every figure that the paper gives for a dataset; empty where it gives none."""
    table = (_HUMAN if human_human else _ROBOT).get(dataset, {})
    return [
        (f"paper {model}", action, mean, std)
        for model, figures in table.items()
        for action, (mean, std) in zip(LABELS, figures, strict=True)
    ]
