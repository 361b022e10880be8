"""Shape annotations are checked at run time in every test; fixtures for recordings, references and a browser."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from playwright.sync_api import Browser

REPOSITORY = Path(__file__).resolve().parents[1]
CHROMIUM = "/usr/bin/chromium"


def checked_modules() -> list[str]:
    """Every module of the package but the compiled kernels.

    The hook takes a name as a prefix, so that naming a package would name the kernels in it: list the leaves.
    """
    package = REPOSITORY / "mild_viz"
    files = (path.relative_to(REPOSITORY).with_suffix("") for path in sorted(package.rglob("*.py")))
    return [".".join(file.parts) for file in files if file.name not in ("__init__", "kernels")]


install_import_hook(checked_modules(), "beartype.beartype")


def unavailable(reason: str) -> None:
    """Skip the test, or fail it where a skip would hide it (CI=true)."""
    if os.environ.get("CI", "").lower() in ("1", "true"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of recordings, MILD_VIZ_DATA."""
    root = os.environ.get("MILD_VIZ_DATA")
    if not root or not Path(root).is_dir():
        unavailable(f"MILD_VIZ_DATA={root!r} is no folder; set it and run: mild-viz data fetch nuisi")
    return Path(str(root)).resolve()


@pytest.fixture(scope="session")
def dataset(data_root: Path) -> Callable[[str], Any]:
    """`dataset(name)` loads one dataset from the folder of recordings."""

    def load(name: str) -> Any:
        from mild_viz.data.load import load_dataset
        from mild_viz.errors import UserError

        try:
            return load_dataset(name, data_root)
        except UserError as error:
            unavailable(f"dataset {name} is not in {data_root} ({error}); run: mild-viz data fetch {name}")

    return load


@pytest.fixture(scope="session")
def shared(data_root: Path) -> Callable[[str], Path]:
    """`shared(relative)` is a path beside the folder of recordings: reference robots, checkpoints, tables."""

    def find(relative: str) -> Path:
        path = data_root.parent / relative
        if not path.exists():
            unavailable(f"{path} is not at hand (reference material that lies beside the recordings)")
        return path

    return find


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A headless Chromium that draws WebGL in software.

    One a module, not one a session: Playwright's synchronous interface occupies the thread's event loop
    while it is open.
    """
    if not Path(CHROMIUM).exists():
        unavailable(f"{CHROMIUM} is missing; run: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=CHROMIUM_FLAGS)
        yield browser
        browser.close()


CHROMIUM_FLAGS = [
    "--headless=new",
    "--no-sandbox",  # Chromium refuses to run as root with its sandbox
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # Mesa's software renderer: its picture is stable sooner than SwiftShader's
    "--use-gl=angle",
    "--use-angle=gl-egl",
    "--ignore-gpu-blocklist",
]
