"""Playback for several browsers: frames received over the websocket, and the server's CPU time.

The real dashboard runs in a process of its own on the loopback interface and plays the demo set; clients that speak
viser's protocol count the frames that reach them. Target: 30 frames a second for four browsers at under half a core.

python benchmarks/playback.py
"""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from multiprocessing.connection import Connection
from typing import Any

import msgspec
import numpy as np
import tyro
import viser
import viser._messages
import websockets.asyncio.client
import zstandard
from websockets.typing import Subprotocol

HOST = "127.0.0.1"
NODE = "/human/limbs"
"""A node of the scene that every new frame moves: a batch of messages that moves it is one frame."""


def serve(pipe: Connection, dataset: str) -> None:
    """Run the dashboard, playing for ever; answer every message with CPU time, clients and an error, if any."""
    from mild_viz.dashboard.app import open_dashboard
    from mild_viz.dashboard.server import free_port

    port = free_port(HOST, 18_900)
    assert port is not None
    dashboard = open_dashboard(dataset=dataset, host=HOST, port=port)
    dashboard.session.wait_idle()
    dashboard.player.toggle()
    pipe.send(port)
    while pipe.recv():
        playing = dashboard.player.playing and dashboard.player.speed == 1.0
        pipe.send((time.process_time(), len(dashboard.server.get_clients()), playing, dashboard.session.error))
    dashboard.stop()


def camera_message() -> bytes:
    """What a browser sends first; before it the server does not count it as connected."""
    camera: dict[str, Any] = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (3.0, 3.0, 2.0), "fov": 0.7,
        "near": 0.01, "far": 1000.0, "image_height": 430, "image_width": 930, "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, 1.0),
    }  # fmt: skip
    fields = {field.name for field in viser._messages.ViewerCameraMessage.__dataclass_fields__.values()}
    return msgspec.msgpack.encode({key: value for key, value in camera.items() if key == "type" or key in fields})


async def watch(port: int, until: float, arrivals: list[float]) -> None:
    """One browser: note when every frame arrives."""
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    zstd = zstandard.ZstdDecompressor()
    async with websockets.asyncio.client.connect(
        f"ws://{HOST}:{port}", subprotocols=[protocol], max_size=None, compression=None
    ) as connection:
        await connection.send(camera_message())
        while (left := until - time.monotonic()) > 0:
            try:
                data = await asyncio.wait_for(connection.recv(), left)
            except TimeoutError:
                return
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            batch = msgspec.msgpack.decode(zstd.decompress(data[16 : 16 + size]))
            if any(message.get("name") == NODE for message in batch["messages"]):
                arrivals.append(time.monotonic())


def main(browsers: int = 4, seconds: float = 10.0, dataset: str = "demo") -> None:
    """Print frames a second for each browser, and the server's share of a core.

    Args:
        browsers: How many clients watch at once.
        seconds: How long to measure, after two seconds for the clients to join.
        dataset: Recordings to play.
    """
    context = multiprocessing.get_context("spawn")
    pipe, other_end = context.Pipe()
    server = context.Process(target=serve, args=(other_end, dataset), daemon=True)
    server.start()
    try:
        if not pipe.poll(60.0):
            raise SystemExit("the dashboard did not start within 60 s")
        port = pipe.recv()
        arrivals: list[list[float]] = [[] for _ in range(browsers)]
        asyncio.run(measure(port, pipe, seconds, arrivals))
    finally:
        pipe.send(False)
        server.join(timeout=10.0)
        if server.is_alive():
            server.terminate()


async def measure(port: int, pipe: Connection, seconds: float, arrivals: list[list[float]]) -> None:
    """Let all browsers watch, and print what reached them in the time between two looks at the server's clock."""
    until = time.monotonic() + seconds + 3.0
    watching = [asyncio.create_task(watch(port, until, times)) for times in arrivals]
    await asyncio.sleep(2.0)
    start, before = time.monotonic(), ask(pipe)
    await asyncio.sleep(seconds)
    end, after = time.monotonic(), ask(pipe)
    if after[1] != len(arrivals) or not after[2] or after[3]:
        raise SystemExit(f"clients {after[1]} of {len(arrivals)}, playing {after[2]}, error {after[3]}")
    for i, times in enumerate(arrivals):
        inside = np.array([t for t in times if start <= t <= end])
        gaps = np.diff(inside)
        print(
            f"browser {i + 1}: {len(inside) / (end - start):5.1f} frames/s   "
            f"longest gap {1e3 * gaps.max():4.0f} ms, 99 % of gaps below {1e3 * np.quantile(gaps, 0.99):3.0f} ms"
        )
    print(f"target: 30 frames/s for {len(arrivals)} browsers")
    print(f"server: {100 * (after[0] - before[0]) / (end - start):.0f} % of a core   target < 50 %")
    await asyncio.gather(*watching)


def ask(pipe: Connection) -> tuple[float, int, bool, str | None]:
    pipe.send(True)
    return pipe.recv()


if __name__ == "__main__":
    tyro.cli(main)
