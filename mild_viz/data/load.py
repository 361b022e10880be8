"""Find and read a dataset by name."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from mild_viz.data.sources import SOURCES
from mild_viz.errors import UserError
from mild_viz.trial import Dataset

DATASETS = tuple(SOURCES)
"""demo, nuisi, yumi, handover, handover-hands, bimanual, buetepage."""


def data_root() -> Path:
    """The data folder: `MILD_VIZ_DATA`, else the user's cache."""
    folder = os.environ.get("MILD_VIZ_DATA")
    if folder:
        return Path(folder).expanduser()
    import pooch  # only the default needs it, and it costs start-up time

    return Path(pooch.os_cache("mild_viz"))


def check_name(name: str) -> None:
    """Refuse a name that is not in `DATASETS`."""
    if name not in DATASETS:
        raise UserError(f"dataset '{name}' is unknown; valid: {', '.join(DATASETS)}")


def missing_files(name: str, root: Path) -> list[Path]:
    """Those of the files (or folders) that a dataset needs which are not below `root`."""
    needed = [file.path for file in SOURCES[name].files if not file.optional]
    return [path for path in needed if not (root / path).exists()]


def load_dataset(name: str, root: Path | None = None) -> Dataset:
    """The dataset `name`, read from `root` (default: `data_root()`), or generated for 'demo'.

    Read once per process and folder. Raises a `UserError` for an unknown name, for data that is not present
    (naming the command that fetches it) and for files that cannot be used.
    """
    check_name(name)
    return _load(name, (root or data_root()).resolve())


@cache
def _load(name: str, root: Path) -> Dataset:
    # Each reader is imported when it is needed, so that one dataset does not pay for the others.
    if name == "demo":
        from mild_viz.data.demo import make_demo

        return make_demo()
    missing = missing_files(name, root)
    if missing:
        raise UserError(
            f"dataset '{name}' is not present: {root / missing[0]} does not exist. "
            f"Get it with: mild-viz data fetch {name}"
        )
    if name == "nuisi":
        from mild_viz.data.nuisi import read_nuisi

        return read_nuisi(root)
    if name == "yumi":
        from mild_viz.data.yumi import read_yumi

        return read_yumi(root)
    if name == "buetepage":
        from mild_viz.data.buetepage import read_buetepage

        return read_buetepage(root)
    if name == "bimanual":
        from mild_viz.data.bimanual import read_bimanual

        return read_bimanual(root)
    if name == "handover-hands":
        from mild_viz.data.handover import read_handover_hands

        return read_handover_hands(root)
    from mild_viz.data.handover import read_handover

    return read_handover(root)
