"""Puts the shipped folders (robots, trained models) into a built wheel; everything else is in pyproject.toml.

They live beside the package, where a person who opens the repository finds them. An editable install uses
them in place; a wheel needs its own copy inside the package (`mild_viz.paths` looks in both places).
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithShippedFolders(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for folder in ("assets", "checkpoints"):
                target = Path(self.build_lib, "mild_viz", folder)
                shutil.rmtree(target, ignore_errors=True)
                shutil.copytree(folder, target, ignore=shutil.ignore_patterns("__pycache__", ".*"))


setup(cmdclass={"build_py": BuildWithShippedFolders})
