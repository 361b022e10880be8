"""Writes the robots' descriptions: <robot>.urdf and one binary PLY per drawn link, the same bytes every time.

Run it as: python assets/urdf/generate.py [ROBOT ...] [--out FOLDER]
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from modelling.description import ply, urdf

HERE = Path(__file__).resolve().parent
ROBOTS = ("pepper", "panda", "yumi", "kobo")


def write(robot: str, out: Path) -> None:
    """Write one robot's files into the folder `out`."""
    model = import_module(f"{robot}.model")
    drawn = model.links()
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    for name, pieces in drawn.items():
        (out / "meshes" / f"{name}.ply").write_bytes(ply(pieces))
    meshes = {name: name for name in drawn} | model.SHARED
    text = urdf(robot, model.ROOT, model.JOINTS, meshes, getattr(model, "INERTIALS", None))
    (out / f"{robot}.urdf").write_text(text, encoding="utf-8", newline="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help=f"{', '.join(ROBOTS)}; default: all")
    parser.add_argument("--out", type=Path, default=HERE, help="folder that holds one folder a robot")
    options = parser.parse_args()
    for robot in options.robots or ROBOTS:
        if robot not in ROBOTS:
            parser.error(f"robot '{robot}' is unknown; valid: {', '.join(ROBOTS)}")
        write(robot, options.out / robot)


if __name__ == "__main__":
    main()
