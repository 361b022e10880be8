"""The frame of the project: pinned dependencies, README's commands, layers, what CI runs."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[1]
PYPROJECT = (REPOSITORY / "pyproject.toml").read_text()
MODULES = sorted((REPOSITORY / "mild_viz").rglob("*.py"))


def pins() -> dict[str, str]:
    """Package name to exact version, as `constraints.txt` has them for this Python."""
    lines = (line.split("#")[0].strip() for line in (REPOSITORY / "constraints.txt").read_text().splitlines())
    result = {}
    for requirement in (Requirement(line) for line in lines if line):
        if requirement.marker is None or requirement.marker.evaluate():
            (specifier,) = requirement.specifier
            assert specifier.operator == "=="
            result[canonicalize_name(requirement.name)] = specifier.version
    return result


def declared() -> list[Requirement]:
    """The dependencies in pyproject.toml, those of the extras too (Python 3.10 has no TOML reader)."""
    block = PYPROJECT[PYPROJECT.index("dependencies = [") : PYPROJECT.index("[project.scripts]")]
    found = [Requirement(text) for text in re.findall(r'"([^"]+[<>=][^"]+)"', block)]
    return [requirement for requirement in found if requirement.marker is None or requirement.marker.evaluate()]


def test_every_dependency_is_pinned_within_its_range_and_explained() -> None:
    exact, contributing = pins(), (REPOSITORY / "CONTRIBUTING.md").read_text()
    table = contributing[contributing.index("## Dependencies") : contributing.index("## Habits")]
    assert len(declared()) >= 20
    for requirement in declared():
        version = exact[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement} excludes its pin {version}"
        assert re.search(rf"\b{re.escape(requirement.name)}\b", table), (
            f"{requirement.name}: no line in CONTRIBUTING.md"
        )


def test_the_installed_versions_are_the_pinned_ones() -> None:
    for requirement in declared():
        try:
            installed = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that is not installed here
        assert installed.split("+")[0] == pins()[canonicalize_name(requirement.name)], requirement.name


def test_dependencies_of_dependencies_are_pinned() -> None:
    exact, seen, queue = pins(), set(), [requirement.name for requirement in declared()]
    while queue:
        name = canonicalize_name(queue.pop())
        if name in seen:
            continue
        seen.add(name)
        assert name in exact, f"{name} is not in constraints.txt"
        try:
            requirements = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for requirement in map(Requirement, requirements):
            # CUDA libraries come with PyTorch's GPU build only, and it pins them itself.
            unwanted = requirement.name.startswith(("nvidia-", "cuda-", "triton"))
            if not unwanted and (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
                queue.append(requirement.name)


def readme_command(kind: str) -> str:
    found = re.search(
        rf"<!-- command: {kind} -->\n```bash\n(.+?)\n```", (REPOSITORY / "README.md").read_text(), re.DOTALL
    )
    assert found, f"README.md has no {kind} command"
    return found[1]


def test_readme_commands_make_an_environment_and_use_the_constraints() -> None:
    start, test = readme_command("start"), readme_command("test")
    for command in (start, test):
        assert command.startswith("python3 -m venv .venv && . .venv/bin/activate && pip install -e ")
        assert "-c constraints.txt" in command
        assert "\n" not in command
    assert start.endswith("python app.py")
    assert test.endswith("python -m pytest")


@pytest.mark.skipif(shutil.which("bash") is None, reason="CI runs bash")
def test_ci_runs_the_readme_command() -> None:
    result = subprocess.run(
        ["bash", ".ci/run", "--print-command"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == readme_command("test")


def imports(path: Path) -> list[tuple[str, bool]]:
    """Every imported module of a file, and whether it is imported when the file is."""
    tree = ast.parse(path.read_text())
    inner = {
        id(node)
        for scope in ast.walk(tree)
        if isinstance(scope, (ast.FunctionDef, ast.AsyncFunctionDef))
        or (isinstance(scope, ast.If) and "TYPE_CHECKING" in ast.unparse(scope.test))
        for node in ast.walk(scope)
    }
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) not in inner) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append((node.module, id(node) not in inner))
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_module_keeps_the_house_rules(path: Path) -> None:
    folder = path.relative_to(REPOSITORY / "mild_viz").parts[0]
    for name, at_import in imports(path):
        top = name.split(".")[0]
        assert top != "viser" or folder == "dashboard", f"viser belongs under dashboard/: {name}"
        assert top not in ("torch", "pytorch_kinematics") or folder != "dashboard", f"no {top} under dashboard/"
        assert top not in ("torch", "pytorch_kinematics") or folder == "training" or not at_import, (
            f"importing {top} costs seconds of the start: import it where it is used"
        )
    assert path.name != "utils.py"
    assert len(path.read_text().splitlines()) <= 300, "a module over 300 lines wants splitting"


def test_the_viser_contract_covers_every_module() -> None:
    contract = PYPROJECT[PYPROJECT.index("Only the dashboard knows viser") :]
    listed = set(re.findall(r'"mild_viz\.(\w+)"', contract[: contract.index("forbidden_modules")]))
    present = {path.relative_to(REPOSITORY / "mild_viz").parts[0].removesuffix(".py") for path in MODULES}
    assert listed == present - {"__init__", "dashboard"}


def test_importing_the_page_and_the_pipeline_does_not_import_torch() -> None:
    code = "import sys, mild_viz.dashboard.app, mild_viz.pipeline, mild_viz.streaming; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_no_recordings_are_tracked() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True)
    files = listed.stdout.splitlines()  # empty in an export, which holds what is tracked
    files = files or [str(path) for path in REPOSITORY.rglob("*") if ".venv" not in path.parts]
    assert [file for file in files if file.endswith((".npz", ".pth", ".pkl", ".dae", ".bag"))] == []
