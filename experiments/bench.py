"""Speed of the hot paths, in CPU time: ``python -m experiments.bench``.

CPU time of the process, not wall time, so that a shared machine and the number of cores matter little;
the machine's own matrix-product rate, measured in the same run between the rows, stands beside them.
"""

from __future__ import annotations

import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from envs.base import Environment
from envs.wrapper import Wrapper
from experiments.adaptation import LANES, lanes_together, run_adaptation
from experiments.collect import collect, find_demonstrator
from experiments.configs import make_env, positive, pretrain_preset
from experiments.policies import LoadedPolicy, load_network
from experiments.pretrain import configured_network
from experiments.runtime import Common, jit_with, provenance, run, write_json
from experiments.tasks import benchmark_tasks
from mgpo_jax.adapt import evaluate
from mgpo_jax.dataset import Dataset
from mgpo_jax.errors import UsageError
from mgpo_jax.optimizers import ucb
from mgpo_jax.policy import transformer_policy
from mgpo_jax.pretrain import batch_stream, make_trainer
from mgpo_jax.prompts import single_goal
from mgpo_jax.sharding import device_mesh, largest_divisor
from mgpo_jax.transformer import TransformerConfig


@dataclass(frozen=True)
class BenchConfig(Common):
    """Settings of ``experiments.bench``."""

    env: str = "maze15"
    """The world: maze15, maze30, gridworld or kitchen."""
    demonstrator: Annotated[str | None, tyro.conf.arg(name="policy")] = None
    """Whose demonstrations to collect and train on (default: those of the recipe)."""
    quick: bool = False
    """A tenth of the work: shows that it runs, gives rough numbers."""
    episodes: int | None = None
    """Episodes to collect (default: 5,000; quick: 500)."""
    json: Path | None = None
    """Also write the rows to this file."""


@dataclass(frozen=True)
class Row:
    """One measured figure."""

    name: str
    value: float
    unit: str
    note: str = ""


def cpu_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result and CPU-seconds of ``work``, which is run to the end."""
    start = time.process_time()
    result = jax.block_until_ready(work())
    return result, time.process_time() - start


def matrix_product_rate(size: int = 2048, repeats: int = 4) -> float:
    """GFLOP per CPU-second of a large float32 product."""
    matrix = jnp.ones((size, size))
    product = jax.jit(lambda a: a @ a)
    jax.block_until_ready(product(matrix))
    _, cpu = cpu_time(lambda: [product(matrix) for _ in range(repeats)])
    return repeats * 2 * size**3 / cpu / 1e9


def sequence_flops(
    config: TransformerConfig, num_goals: float, num_steps: np.ndarray
) -> np.ndarray:
    """FLOP of one forward pass over real tokens, what is not read out left aside.

    Counted are the products of the layers as they stand: the last layer computes keys and values of
    all tokens and the rest only where an action is read out, and attention its visible part.
    """
    width, steps = config.embed_dim, num_steps.astype(np.float64)
    tokens = num_goals + 2 * steps - 1
    full_layer = 24 * width**2 * tokens + 2 * width * tokens * (tokens + 1)
    visible = steps * num_goals + steps**2  # keys visible from the observations
    last_layer = 4 * width**2 * tokens + 20 * width**2 * steps + 4 * width * visible
    ends = 2 * width * (config.obs_dim + 2 * config.action_dim) * steps
    return (config.num_layers - 1) * full_layer + last_layer + ends


def bench_collect(env: Environment, name: str | None, episodes: int) -> tuple[Dataset, Row]:
    """Demonstrations of ``name``, or those of the default recipe."""
    recipe = pretrain_preset(env.spec.name, "fast").data
    name, demonstrator = find_demonstrator(env, name or recipe.demonstrator)
    collect(env, demonstrator, 1, seed=1)  # compiles
    (dataset, _), cpu = cpu_time(lambda: collect(env, demonstrator, episodes, seed=0))
    note = f"{name}, {episodes} kept, task generation included"
    return dataset, Row("collection", episodes / cpu, "episodes / CPU-s", note)


def bench_gradient_step(env: Environment, dataset: Dataset, num_steps: int) -> Iterator[Row]:
    """Steps of the default recipe over its own stream of batches."""
    config = pretrain_preset(env.spec.name, "fast")
    network = configured_network(config, env, dataset)
    mesh = device_mesh(largest_divisor(config.train.part_size, len(jax.devices())))
    trainer = make_trainer(config.train, network, dataset, mesh)
    stream = batch_stream(config.train, dataset, env.spec.truncate_in_hindsight, mesh.devices.size)
    batches = list(islice(stream, num_steps))

    def steps(state: Any) -> Any:
        for batch in batches:
            state, metrics = trainer.step(state, batch)
        return state.params, metrics

    jax.block_until_ready(steps(trainer.init()))  # compiles every shape
    state = trainer.init()
    before = matrix_product_rate()
    _, cpu = cpu_time(lambda: steps(state))
    rate = (before + matrix_product_rate()) / 2

    lengths = np.concatenate([part.lengths for batch in batches for part in batch])
    padded = sum(len(part.lengths) * part.num_steps for batch in batches for part in batch)
    goals = np.mean(
        [np.minimum(k, lengths).mean() for k in range(1, network.max_prompt_length + 1)]
    )
    flops = 3 * sequence_flops(network, float(goals), lengths).sum()
    size = config.train.batch_size
    yield Row(
        "gradient step",
        cpu / num_steps,
        "CPU-s",
        f"{size} trajectories, mean {lengths.mean():.1f} steps",
    )
    yield Row("  real steps", lengths.sum() / cpu, "steps / CPU-s", "padding not counted")
    yield Row("  real tokens", flops / cpu / 1e9, "GFLOP / CPU-s", "padding not counted")
    yield Row("  matrix product", rate, "GFLOP / CPU-s", "2048 x 2048, same run, before and after")
    yield Row("  share of it", 100 * flops / cpu / 1e9 / rate, "%")
    yield Row("  padding", 100 * (1 - lengths.sum() / padded), "%", "of the steps computed")
    unit = 1e9 if platform.system() == "Darwin" else 1e6  # bytes there, kilobytes elsewhere
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    yield Row("  peak memory", peak, "GB", "of the whole process so far")


def policy_to_bench(env: Environment, dataset: Dataset) -> tuple[LoadedPolicy, str]:
    """The released policy, or untrained weights where there is none."""
    try:
        return load_network(env, None), "released policy"
    except UsageError:
        fast = pretrain_preset(env.spec.name, "fast")
        config = configured_network(fast, env, dataset)
        params = make_trainer(fast.train, config, dataset, device_mesh(1)).init().params
        return LoadedPolicy(config, params, {}), "untrained policy"


def bench_decode(env: Environment, network: LoadedPolicy, note: str) -> Iterator[Row]:
    """Time of one step of acting against the steps before it, and of a whole episode."""
    horizon, lanes = env.spec.horizon, lanes_together(env, network.config)
    policy = transformer_policy(network.config, network.params)
    keys = jax.random.split(jax.random.key(0), lanes)
    tasks = jax.vmap(env.sample_task)(keys)
    prompts = jax.vmap(lambda task: single_goal(env.task_goal(task), policy.num_slots))(tasks)
    _, first = jax.vmap(env.reset)(keys, tasks)
    _, carry = jax.jit(jax.vmap(policy.prefill))(prompts, first.obs)
    action = jnp.zeros(lanes, jnp.int32)
    if not env.spec.discrete:
        action = jnp.zeros((lanes, env.spec.action_dim))
    for position in (horizon // 8, horizon // 2, horizon):
        room = jax.vmap(lambda cache, n=position - 1: policy.grow(cache, n))(carry)

        num_steps = min(16, position - 1)

        @jax.jit
        def decode(cache: Any, num_steps: int = num_steps) -> Any:
            def step(cache: Any, _: None) -> tuple[Any, Any]:
                distribution, cache = jax.vmap(policy.decode)(cache, action, first.obs)
                return cache, distribution  # what is not returned is not computed either

            return jax.lax.scan(step, cache, length=num_steps)

        jax.block_until_ready(decode(room))
        _, cpu = cpu_time(lambda decode=decode, room=room: decode(room))
        cost = 1e3 * cpu / lanes / num_steps
        yield Row(f"decode at {position}", cost, "CPU-ms / step", f"{lanes} episodes at once")

    endless = Endless(env)

    @jit_with(env)
    def episodes(keys: Any) -> Any:
        run = jax.vmap(
            lambda key, task, prompt: evaluate(key, endless, policy, task, prompt, LANES),
            axis_name=LANES,
        )
        return run(keys, tasks, prompts)

    jax.block_until_ready(episodes(keys))
    done, cpu = cpu_time(lambda: episodes(keys))
    mean = float(done.trajectory.length.mean())
    yield Row("full episode", cpu / lanes, "CPU-s", f"{note}, all {mean:.0f} steps of the horizon")


class Endless(Wrapper):
    """A world whose episodes last to the horizon."""

    def reset(self, key: Any, task: Any) -> Any:
        (state, timestep) = self.env.reset(key, task)
        return (jnp.zeros((), jnp.int32), state), timestep

    def step(self, state: Any, action: Any) -> Any:
        steps, inner = state
        inner, timestep = self.env.step(inner, action)
        ends = steps + 1 >= self.spec.horizon
        ongoing = timestep._replace(terminated=jnp.zeros((), bool), truncated=ends)
        return (steps + 1, inner), ongoing


def bench_adaptation(
    env: Environment, network: LoadedPolicy, note: str, num_tasks: int, episodes: int
) -> Row:
    """UCB on the world's test tasks."""
    tasks = benchmark_tasks(env, num_tasks)
    outcome = run_adaptation(env, network, ucb, tasks, seeds=3, episodes=episodes)
    note = f"{note}, {num_tasks} tasks x 3 seeds x {episodes} episodes"
    return Row("adaptation", outcome.num_episodes / outcome.cpu_seconds, "episodes / CPU-s", note)


def main(config: BenchConfig) -> None:
    """Measure the speed of collection, training and adaptation in CPU time."""
    positive(config, "episodes")
    env = make_env(config.env)
    episodes = config.episodes or (500 if config.quick else 5_000)
    rows: list[Row] = []

    def show(row: Row) -> None:
        rows.append(row)
        print(f"{row.name:<18} {row.value:>10.3f} {row.unit:<18} {row.note}", flush=True)

    show(Row("matrix product", matrix_product_rate(), "GFLOP / CPU-s", "2048 x 2048, float32"))
    dataset, row = bench_collect(env, config.demonstrator, episodes)
    show(row)
    for row in bench_gradient_step(env, dataset, 16 if config.quick else 64):
        show(row)
    network, note = policy_to_bench(env, dataset)
    for row in bench_decode(env, network, note):
        show(row)
    show(bench_adaptation(env, network, note, env.spec.num_test_tasks, 20 if config.quick else 100))
    if config.json:
        write_json(config.json, {"env": config.env, "rows": rows, **provenance()})
        print(f"rows in {config.json}", file=sys.stderr)


if __name__ == "__main__":
    run(BenchConfig, main)
