"""Time from the command `python app.py` to a page that answers over HTTP. Target: at most 8 s warm.

python benchmarks/startup.py
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import tyro

REPOSITORY = Path(__file__).resolve().parents[1]


def main(rounds: int = 5, dataset: str = "demo", limit: float = 60.0) -> None:
    """Print the time of every start, and the median of the warm ones.

    Args:
        rounds: Starts; the first one warms caches (compiled kernels, disk) and is not counted.
        dataset: Recordings to open.
        limit: Give up after this time [s].
    """
    times = [start_once(dataset, limit) for _ in range(rounds + 1)]
    print("first start " + f"{times[0]:.2f} s; then " + ", ".join(f"{value:.2f}" for value in times[1:]) + " s")
    print(f"warm start, median of {rounds}: {np.median(times[1:]):.2f} s   target <= 8 s")


def start_once(dataset: str, limit: float) -> float:
    """Start the dashboard on a free port, wait until its page answers, stop it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    start = time.perf_counter()
    server = subprocess.Popen(
        [sys.executable, "app.py", "--dataset", dataset, "--port", str(port)],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        while True:
            elapsed = time.perf_counter() - start
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1) as answer:
                    if answer.status == 200 and answer.read():
                        return elapsed
            except (urllib.error.URLError, TimeoutError, ConnectionError):
                pass
            if server.poll() is not None:
                assert server.stderr is not None
                raise SystemExit(f"app.py ended with {server.returncode}: {server.stderr.read().decode()}")
            if elapsed > limit:
                raise SystemExit(f"no page after {limit} s")
            time.sleep(0.02)
    finally:
        server.terminate()
        server.wait(timeout=20)


if __name__ == "__main__":
    tyro.cli(main)
