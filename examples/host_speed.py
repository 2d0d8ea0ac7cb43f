"""Measure a step of the example worlds on one and on two threads: ``python -m examples.host_speed``."""

from __future__ import annotations

import importlib
import time
from dataclasses import replace

import numpy as np

from envs.live import Start

EPISODES, STEPS = 16, 10


def measure(name: str, num_threads: int) -> tuple[float, float]:
    """The wall time and the CPU time of a step in milliseconds, in a batch of ``EPISODES``."""
    described = importlib.import_module(f"examples.{name}").WORLD.make().described
    described = replace(described, threads=num_threads)
    pool, space = described.pool, described.to_program(described.action_space.sample())
    action = np.zeros_like(space, np.int32 if space.ndim == 0 else np.float32)
    before = np.zeros((0, *action.shape), action.dtype)
    starts = [
        Start(seed, tuple(described.drawn_options(seed).values())) for seed in range(EPISODES)
    ]
    standing = [pool.begin(start)[0] for start in starts]
    wall, cpu = time.perf_counter(), time.process_time()

    def advance(index: int) -> bytes:
        identity, _ = pool.advance(starts[index], standing[index], before, action)
        return identity

    for _ in range(STEPS):
        standing[:] = pool.map(advance, EPISODES)
    spent = time.perf_counter() - wall, time.process_time() - cpu
    assert pool.num_replayed == 0
    return spent[0] / (STEPS * EPISODES) * 1e3, spent[1] / (STEPS * EPISODES) * 1e3


if __name__ == "__main__":
    for name in ("doors", "point_maze", "kitchen"):
        for num_threads in (1, 2):
            wall, cpu = measure(name, num_threads)
            print(f"{name}, {num_threads} threads: {wall:.2f} ms, {cpu:.2f} CPU-ms")
