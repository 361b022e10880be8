"""What a sweep trains: the config of `mild-viz sweep`, and the cells that it stands for."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from mild_viz.data.load import check_name
from mild_viz.errors import UserError
from mild_viz.settings import VARIANTS, choose
from mild_viz.toml_config import check_keys, converted, read_toml
from mild_viz.training.config import OPTIONS, make_options
from mild_viz.training.options import TrainingOptions, stage_variants

READABLE = 100
"""Characters of a cell's name before its hash: the names of files made from it must fit a file system."""


@dataclass(frozen=True)
class Cell:
    """One training run of a sweep."""

    dataset: str
    stage: str
    variants: tuple[str, ...]
    """Trained together, on one human stage."""
    options: TrainingOptions

    def changed(self) -> dict[str, Any]:
        """The options, but the seed, that are not the default."""
        return {
            key: value
            for key, value in asdict(self.options).items()
            if key != "seed" and value != getattr(TrainingOptions(), key)
        }

    @property
    def name(self) -> str:
        """Folder of the cell: readable, and by its hash the same for the same training and no other."""
        parts = [self.dataset, "+".join(self.variants), *(["hhi"] if self.stage == "hhi" else [])]
        parts += [f"seed{self.options.seed}", *(f"{key}{_short(value)}" for key, value in self.changed().items())]
        record = json.dumps(asdict(self), sort_keys=True)
        return f"{'-'.join(parts)[:READABLE]}-{hashlib.sha256(record.encode()).hexdigest()[:8]}"


def _short(value: Any) -> str:
    text = "x".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "".join(letter if letter.isalnum() or letter in ".+-" else "_" for letter in text)


@dataclass(frozen=True)
class SweepConfig:
    """The keys of the TOML file: datasets x variants x seeds x grid."""

    datasets: tuple[str, ...]
    variants: tuple[tuple[str, ...], ...] = (tuple(VARIANTS),)
    """Groups that are trained together, on one human stage; a plain name is a group of its own."""
    seeds: tuple[int, ...] = (0,)
    """Values of the option `seed`."""
    stage: str = "hri"
    out: Path = Path("runs/sweep")
    """Relative to the folder where the command runs, as every path that is given to a command."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of all cells: fields of `TrainingOptions`."""
    grid: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Options to vary: fields of `TrainingOptions`, each with its values."""

    def cells(self) -> list[Cell]:
        """Every combination, in the order of the file, each once; the seed changes last."""
        combinations = itertools.product(self.datasets, self.variants, itertools.product(*self.grid.values()))
        cells = []
        for dataset, variants, values in combinations:
            options = TrainingOptions(**{**self.options, **dict(zip(self.grid, values, strict=True))})
            trained = stage_variants(self.stage, variants)
            cells += [Cell(dataset, self.stage, trained, replace(options, seed=seed)) for seed in self.seeds]
        return list(dict.fromkeys(cells))


def read_sweep_config(file: Path) -> SweepConfig:
    """Read and check the config of a sweep.

    Raises:
        UserError: naming the file and the key, what was found and what would be valid.
    """
    table = read_toml(file)
    for key in table.keys() & OPTIONS.keys() - {"seeds"}:
        raise UserError(f"{file}: {key} belongs under [options] or, as a list of values, under [grid]")
    check_keys(table, [of.name for of in fields(SweepConfig)], str(file))
    if "datasets" not in table:
        raise UserError(f'{file}: datasets is missing; for example: datasets = ["nuisi"]')
    if isinstance(table.get("variants"), list):
        table["variants"] = [[entry] if isinstance(entry, str) else entry for entry in table["variants"]]
    hints = get_type_hints(SweepConfig)
    sections = {key: _section(table.pop(key, {}), f"{file}: [{key}]") for key in ("options", "grid")}
    values = {key: converted(value, hints[key], f"{file}: {key}") for key, value in table.items()}
    options = {
        key: converted(value, OPTIONS[key], f"{file}: options.{key}") for key, value in sections["options"].items()
    }
    grid = {
        key: converted(value, Sequence[OPTIONS[key]], f"{file}: grid.{key}") for key, value in sections["grid"].items()
    }
    config = SweepConfig(**values, options=options, grid=grid)
    _check(config, str(file))
    return config


def _section(table: Any, where: str) -> dict[str, Any]:
    if type(table) is not dict:
        raise UserError(f"{where} is {table!r}, expected a section of keys")
    if "seed" in table:
        raise UserError(f"{where}: seed is given by the list seeds at the top of the file")
    check_keys(table, OPTIONS.keys() - {"seed"}, where)
    return table


def _check(config: SweepConfig, where: str) -> None:
    lists = {"datasets": config.datasets, "variants": config.variants, "seeds": config.seeds}
    lists |= {f"grid.{key}": values for key, values in config.grid.items()}
    lists |= {"a group of variants": min(config.variants, key=len, default=())}
    for key, values in lists.items():
        if not values:
            raise UserError(f"{where}: {key} is an empty list: nothing would be trained")
    if both := sorted(config.options.keys() & config.grid.keys()):
        raise UserError(f"{where}: {', '.join(both)} is both under [options] and under [grid]; leave one")
    choose(f"{where}: stage", config.stage, ("hhi", "hri"))
    for group in config.variants:
        for name in group:
            choose(f"{where}: variant", name, list(VARIANTS))
    for dataset in config.datasets:
        try:
            check_name(dataset)
        except UserError as error:
            raise UserError(f"{where}: {error}") from None
    for seed in config.seeds:
        make_options({**config.options, "seed": seed}, where)
    for key, values in config.grid.items():
        for value in values:
            make_options({**config.options, key: value}, where)
