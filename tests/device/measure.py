"""Measure speed in wall time on what jax finds: ``PYTHONPATH=tests python -m device.measure --help``.

``experiments.bench`` measures CPU time, which says little about a GPU. These are the figures of
docs/speed.md, *On a GPU*; defaults are those of MazeRunner-15 there.

    PYTHONPATH=tests python -m device.measure rates
    PYTHONPATH=tests python -m device.measure adapt maze15
    PYTHONPATH=tests python -m device.measure train maze15
    PYTHONPATH=tests python -m device.measure physics 64 512 4096

Run them one at a time on an otherwise idle machine. Compile times need an empty folder ``MGPO_CACHE``.
``kitchen-native`` needs ``JAX_PLATFORMS=cuda,cpu`` on a GPU.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import envs
import envs.episodes
from envs.kitchen.fidelity import jit_for, kitchen, random_actions
from envs.kitchen.model import SUBSTEPS, load_model
from envs.kitchen.native import Stepper
from envs.kitchen.physics import PhysicsState
from experiments.datasets import collect
from experiments.demonstrators import find_demonstrator
from experiments.measurements import bench_gradient_step
from experiments.networks import configured_network
from experiments.runtime import configure
from experiments.store.presets import pretrain_preset
from mgpo_jax import programs, runner
from mgpo_jax.policy_files import load_policy
from mgpo_jax.tasks import test_tasks

Figures = dict[str, float]
CONTROL_STEPS = 40  # control steps of each world in a measurement of physics


def wall_time() -> Any:
    """A context in which the bench and outcomes measure wall time instead of CPU time."""
    return mock.patch.object(time, "process_time", time.perf_counter)


def seconds(work: Callable[[], Any], repeats: int = 1) -> float:
    """The mean wall time of a run of ``work``."""
    start = time.perf_counter()
    for _ in range(repeats):
        result = work()
    jax.block_until_ready(result)
    return (time.perf_counter() - start) / repeats


def product_rate(size: int, dtype: str, precision: str | None) -> float:
    """TFLOP/s of the product of a square matrix with itself."""
    matrix = jax.random.normal(jax.random.key(0), (size, size)).astype(dtype)
    product = partial(jax.jit(partial(jnp.matmul, precision=precision)), matrix, matrix)
    jax.block_until_ready(product())
    return 2e-12 * size**3 / seconds(product, repeats=20)


def rates(size: int = 2048, large: int = 8192) -> Iterator[Figures]:
    """Rates of a matrix product in float32 and of a larger one in bfloat16, and of an empty loop."""
    yield {"TFLOP/s in float32": product_rate(size, "float32", None)}
    yield {"TFLOP/s in float32, highest precision": product_rate(size, "float32", "highest")}
    yield {"TFLOP/s in bfloat16": product_rate(large, "bfloat16", None)}

    def goes_on(carry: Any) -> Any:
        return (carry[0] < 2000) & (carry[1].sum() > -1e9)

    @jax.jit
    def halve(rows: jax.Array) -> Any:
        return jax.lax.while_loop(goes_on, lambda c: (c[0] + 1, c[1] * 0.5), (0, rows))

    work = partial(halve, jnp.ones((150, 128)))
    jax.block_until_ready(work())
    yield {"us / iteration of a while_loop": 1e6 * seconds(work) / 2000}


def adapt(
    world: tyro.conf.Positional[str],
    tasks: int = 50,
    seeds: int = 3,
    episodes: int = 100,
    eval_every: int = 10,
    segments: int = envs.episodes.MAX_SEGMENTS,
    runs: int = 2,
) -> Iterator[Figures]:
    """Adapt to the test tasks with UCB and the released policy; only the first run compiles."""
    record = envs.find(world)
    policy = load_policy(record)
    some = jax.tree.map(lambda leaf: leaf[:tasks], test_tasks(record))
    compiled: list[float] = []
    compile_program = programs.Program.compile

    def timed(program: programs.Program, *args: Any) -> Any:
        start = time.perf_counter()
        found = compile_program(program, *args)
        compiled.append(time.perf_counter() - start)
        return found

    with (
        mock.patch.object(programs.Program, "compile", timed),
        mock.patch.object(envs.episodes, "MAX_SEGMENTS", segments),
        wall_time(),
    ):
        for _ in range(runs):
            compiled.clear()
            outcome = runner.adapt(
                record, policy, some, seeds=seeds, episodes=episodes, eval_every=eval_every
            )
            final = outcome.eval_returns[:, :, -1].mean(axis=1)
            yield {
                "compile, s": sum(compiled),
                "run, s": outcome.cpu_seconds,
                "episodes / s": outcome.num_episodes / outcome.cpu_seconds,
                "final return": float(final.mean()),
                "std over seeds": float(final.std()),
            }


def train(
    world: tyro.conf.Positional[str],
    trajectories: int = 10_000,
    bucket: int = 64,
    part_size: int = 64,
    part_steps: int = 100_000,
    batch_size: int = 64,
    steps: int = 200,
) -> Iterator[Figures]:
    """Gradient steps of the preset "fast" on demonstrations that are collected first.

    If a part is the whole batch, the trajectories of a batch have nearly the same length, which is good for
    timing only.
    """
    record, env = envs.find(world), envs.make(world)
    recipe = pretrain_preset(world, "fast")
    _, demonstrator = find_demonstrator(record, env, recipe.data.demonstrator)
    data, _ = collect(env, demonstrator, trajectories, 0, record.num_test_tasks)
    config = replace(
        recipe.train, bucket=bucket, part_size=part_size, part_steps=part_steps, batch_size=batch_size
    )  # fmt: skip
    network = configured_network(recipe, env, data)
    with wall_time():
        rows = {row.name: row for row in bench_gradient_step(config, network, env, data, steps)}
    step = rows["gradient step"].value
    yield {"ms / step": 1e3 * step, "steps / s": 1 / step, "trajectories / s": batch_size / step}


def physics_of(num: int) -> Figures:
    """The two engines of the kitchen: MJX on the device, C on the host's cores."""
    env = kitchen("mjx")
    engine, columns = env.physics, np.arange(num) % 64
    actions = jnp.asarray(random_actions(64, CONTROL_STEPS)[columns]).swapaxes(0, 1)
    state = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (num, *np.shape(leaf))), engine.initial
    )

    @jax.vmap
    def advance(state: PhysicsState, action: jax.Array) -> PhysicsState:
        return engine.advance(state, action, jnp.ones((), bool))

    def play(state: PhysicsState, rows: jax.Array) -> PhysicsState:
        return jax.lax.scan(lambda state, row: (advance(state, row), None), state, rows)[0]

    start = time.perf_counter()
    program = partial(jit_for(env)(play).lower(state, actions).compile(), state, actions)
    compilation = time.perf_counter() - start
    jax.block_until_ready(program())
    mjx = seconds(program) / CONTROL_STEPS
    targets = state.qpos[:, :9]  # C is measured at rest
    rows = np.concatenate([*state, targets, np.ones((num, 1))], axis=1).astype(np.float32)
    in_c = partial(Stepper(load_model(env.model), SUBSTEPS[env.model]), rows)
    in_c()
    return {
        "worlds": num,
        "compile, s": compilation,
        "MJX, control steps / s": num / mjx,
        "MJX, ms / step of all": 1e3 * mjx,
        "C, control steps / s": num / seconds(in_c, repeats=10),
    }


def physics(worlds: tyro.conf.Positional[tuple[int, ...]]) -> Iterator[Figures]:
    """Control steps of the kitchen's two engines, with the given numbers of worlds at once."""
    yield from map(physics_of, worlds)


def main() -> None:
    commands: Any = {command.__name__: command for command in (rates, adapt, train, physics)}
    found: Iterator[Figures] = tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
    configure()  # works although jax is imported, since it has not looked for devices yet
    devices = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    print(f"jax {jax.__version__}, {devices}", flush=True)
    for figures in found:
        print("  ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)


if __name__ == "__main__":
    main()
