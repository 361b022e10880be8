"""Latency of `mild-viz live` at 60 Hz: alone, then with its page, recorded, and viewed by a browser.

A process of its own sends a demo trial's whole body 60 times a second by UDP, `mild-viz live` answers by UDP, and a
headless Chromium views the page. Target: median of computing below 1 ms, 99 % of the whole way below 5 ms.

OMP_NUM_THREADS=1 python benchmarks/live.py
"""

from __future__ import annotations

import json
import multiprocessing
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tyro

HOST, RATE = "127.0.0.1", 60.0
CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--use-gl=angle", "--use-angle=gl-egl",
         "--ignore-gpu-blocklist"]  # fmt: skip


def frames(trial: str) -> list[dict[str, Any]]:
    """A trial at 60 Hz with rest before and after, as joints of messages."""
    from mild_viz.live.address import parse
    from mild_viz.live.inputs import INPUTS
    from mild_viz.live.replay import ReplayInput

    source = ReplayInput(parse(f"replay:{trial}?rate={RATE:g}&rest=1.5", "input", INPUTS))
    names, body = source._names, source._frames
    return [
        {name: None if np.isnan(point).any() else point.tolist() for name, point in zip(names, frame, strict=True)}
        for frame in body
    ]


def send(trial: str, port: int, seconds: float) -> None:
    """Send the trial again and again, on time."""
    joints = frames(trial)
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    start = time.perf_counter()
    for sequence in range(round(seconds * RATE)):
        message = {
            "version": 1, "type": "skeleton", "timestamp": time.time(), "sequence": sequence, "coordinates": "person",
            "joints": joints[sequence % len(joints)],
        }  # fmt: skip
        time.sleep(max(start + sequence / RATE - time.perf_counter(), 0.0))
        out.sendto(json.dumps(message).encode(), (HOST, port))


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


@contextmanager
def watching(url: str | None):
    """A headless browser on the page, for as long as the block runs."""
    if url is None:
        yield
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(url)
        page.wait_for_function("() => (window.__viserTestpoints?.rendererInfo?.render?.frame ?? 0) > 3", timeout=60_000)
        yield
        browser.close()


def measure(label: str, seconds: float, page: bool, variant: str, trial: str) -> None:
    """One run; prints what the session's own record says."""
    from mild_viz.live.onset import INTERACTING
    from mild_viz.live.session import read_session

    port, web = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "session.jsonl"
        command = [
            sys.executable, "-c", "from mild_viz.cli import main; import sys; sys.exit(main())", "live",
            "--input", f"udp://{HOST}:{port}", "--output", f"udp://{HOST}:{free_port(socket.SOCK_DGRAM)}",
            "--record", str(record), "--port", str(web), "--variant", variant, "--page" if page else "--no-page",
        ]  # fmt: skip
        live = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert live.stdout is not None
        for line in live.stdout:
            if "stop it with" in line:
                break
        with watching(f"http://{HOST}:{web}" if page else None):
            sender = multiprocessing.get_context("spawn").Process(target=send, args=(trial, port, seconds))
            sender.start()
            sender.join()
        live.send_signal(signal.SIGINT)
        print(live.communicate(timeout=30)[0])
        ticks = [tick for tick in read_session(record).ticks if tick.seen is not None and tick.sent is not None]
        gaps = np.diff([tick.time for tick in ticks])
        for name, chosen in (
            ("all answers", ticks),
            ("while interacting", [tick for tick in ticks if tick.decision and tick.decision.phase == INTERACTING]),
        ):
            computing, whole = (1e3 * np.array([getattr(t, key) for t in chosen]) for key in ("computing", "whole"))
            print(
                f"{label}, {name} ({len(chosen)}): computing median {np.median(computing):.2f} ms, 99 % "
                f"{np.quantile(computing, 0.99):.2f}; whole way median {np.median(whole):.2f} ms, 99 % "
                f"{np.quantile(whole, 0.99):.2f}, longest {whole.max():.2f}"
            )
        print(f"{label}: longest time between two answers {1e3 * gaps.max():.0f} ms")


def report_decoding(trial: str) -> None:
    """What the control thread pays for each frame that arrives, used or not."""
    from mild_viz.live.messages import decode

    message = {"version": 1, "type": "skeleton", "timestamp": 0.0, "coordinates": "person", "joints": frames(trial)[0]}
    payload, times = json.dumps(message).encode(), []
    for _ in range(1000):
        begin = time.perf_counter()
        decode(payload, 0.0, "benchmark")
        times.append(time.perf_counter() - begin)
    print(f"decoding a frame of {len(payload)} bytes: median {1e6 * np.median(times):.0f} µs")


def main(seconds: float = 30.0, variant: str = "v3.1", trial: str = "demo/4") -> None:
    """Print latencies without and with page and browser.

    Args:
        seconds: How long each of the two runs takes.
        variant: Variant of the demo model.
        trial: What the sender plays.
    """
    report_decoding(trial)
    measure("alone", seconds, False, variant, trial)
    measure("viewed by a browser", seconds, True, variant, trial)
    print("target: computing median < 1 ms, whole way 99 % < 5 ms")


if __name__ == "__main__":
    tyro.cli(main)
