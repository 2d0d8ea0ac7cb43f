"""The measurements of the bench: collection, training, acting and adaptation, in CPU time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import envs
from envs.base import Environment, Episode, State, Task, TimeStep
from envs.errors import UsageError
from envs.registry import World
from envs.wrappers import Wrapper
from experiments.datasets import collect
from experiments.demonstrators import find_demonstrator
from experiments.networks import configured_network
from experiments.store.presets import pretrain_preset
from experiments.store.settings import PretrainConfig
from mgpo_jax import methods, processes
from mgpo_jax.dataset import BatchPlan, Dataset
from mgpo_jax.lanes import cache_bytes, lanes_together, together
from mgpo_jax.memory import peak_bytes
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import load_policy
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.runner import adapt
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh, devices_for
from mgpo_jax.tasks import benchmark_tasks
from mgpo_jax.training import Trainer, batch_stream

BASELINES = ("reinforce", "ppo", "ptgm", "spirl")
NUM_BASELINE_TASKS = 4


@dataclass(frozen=True)
class Row:
    """One measurement."""

    name: str
    value: float
    unit: str
    note: str = ""


def measurements(
    env_name: str,
    demonstrator: str | None,
    num_trajectories: int,
    quick: bool,
    rows: str = "all",
) -> Iterator[Row]:
    """Yield the rows of the bench for a world.

    Args:
      env_name: name of the world.
      demonstrator: the demonstrator to collect with (default: that of the world's preset).
      num_trajectories: number of trajectories to collect.
      quick: whether to do less of the work, a tenth to a half depending on the row.
      rows: ``all``, ``shared`` (those whose work several processes share) or ``step`` (those up to the
        gradient step).
    """
    world, env = envs.find(env_name), envs.make(env_name)
    note = "2048 x 2048, float32"
    yield Row("matrix product", matrix_product_rate(), "GFLOP / CPU-s", note)
    recipe = pretrain_preset(env_name, "fast")
    name = demonstrator or recipe.data.demonstrator
    dataset, row = bench_collect(world, env, name, num_trajectories)
    yield row
    network = configured_network(recipe, env, dataset)
    yield from bench_gradient_step(recipe.train, network, env, dataset, 16 if quick else 64)
    if rows == "step":
        return
    policy, note = policy_to_bench(world, env, recipe, dataset)
    if rows == "all":
        yield from bench_acting(env, policy, note)
    yield bench_adaptation(world, env, policy, note, 20 if quick else 100)
    if rows == "all":
        yield from bench_baselines(world, env, env_name, dataset, 20 if quick else 40)


def cpu_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result and the CPU-seconds of ``work``; waits until the result is computed."""
    start = time.process_time()
    result = jax.block_until_ready(work())
    return result, time.process_time() - start


def shared_cpu_time(work: Callable[[], Any]) -> tuple[Any, float]:
    """Like ``cpu_time``, with the CPU-seconds of all processes that share the work."""
    result, cpu = cpu_time(work)
    return result, processes.total(cpu)


def matrix_product_rate(size: int = 2048, repeats: int = 4) -> float:
    """GFLOP per CPU-second of a large float32 matrix product."""
    matrix = jnp.ones((size, size))
    product = jax.jit(lambda a: a @ a)
    jax.block_until_ready(product(matrix))
    _, cpu = cpu_time(lambda: [product(matrix) for _ in range(repeats)])
    return repeats * 2 * size**3 / cpu / 1e9


def sequence_flops(
    config: TransformerConfig, num_goals: float, num_steps: np.ndarray
) -> np.ndarray:
    """FLOP of a forward pass over real tokens, without work whose result is not used.

    This counts the matrix products: the last layer computes keys and values for all tokens, but the rest
    only where an action is predicted, and attention counts for visible keys only.
    """
    width, steps = config.embed_dim, num_steps.astype(np.float64)
    each = config.tokens_per_step
    tokens = num_goals + each * steps - (each - 1)
    full_layer = 24 * width**2 * tokens + 2 * width * tokens * (tokens + 1)
    # Keys visible from the observations: those of the prompt and of the steps so far.
    visible = steps * num_goals + steps * (each * (steps - 1) / 2 + 1)
    last_layer = 4 * width**2 * tokens + 20 * width**2 * steps + 4 * width * visible
    obs_size = np.prod(config.obs_shape)
    ends = 2 * width * (obs_size + 2 * config.action_dim) * steps
    return (config.num_layers - 1) * full_layer + last_layer + ends


def bench_collect(
    world: World, env: Environment, name: str | None, num: int
) -> tuple[Dataset, Row]:
    """Measure collection with the demonstrator ``name``, or the world's first; returns the dataset, too."""
    name, demonstrator = find_demonstrator(world, env, name)
    collecting = partial(collect, env, demonstrator, num_test_tasks=world.num_test_tasks)
    collecting(num=1, seed=1)  # compiles
    (dataset, _), cpu = shared_cpu_time(lambda: collecting(num=num, seed=0))
    note = f"{name}, {num} kept, task generation included"
    return dataset, Row("collection", num / cpu, "episodes / CPU-s", note)


def bench_gradient_step(
    config: TrainConfig,
    network: TransformerConfig,
    env: Environment,
    dataset: Dataset,
    num_steps: int,
) -> Iterator[Row]:
    """Measure gradient steps on the batches of a real training."""
    mesh = device_mesh(devices_for(config.part_size))
    trainer = Trainer(config, network, dataset, mesh)
    num_devices = mesh.devices.size * processes.count()
    stream = batch_stream(config, dataset, env.spec.truncate_in_hindsight, num_devices)
    batches = list(islice(stream, num_steps))

    def steps(state: Any) -> Any:
        for batch in batches:
            state, metrics = trainer.step(state, batch)
        return state.params, metrics

    jax.block_until_ready(steps(trainer.init()))  # compiles every shape
    state = trainer.init()
    before = matrix_product_rate()
    wall = time.perf_counter()
    _, cpu = shared_cpu_time(lambda: steps(state))
    wall = time.perf_counter() - wall
    rate = (before + matrix_product_rate()) / 2
    note = f"{config.batch_size} trajectories"
    yield from _step_rows(network, batches, cpu, rate, note)
    note = f"{processes.count()} processes with {mesh.devices.size} devices each"
    yield Row("  wall time", wall / len(batches), "s", note)


def _step_rows(
    network: TransformerConfig,
    batches: list[list[BatchPlan]],
    cpu: float,
    rate: float,
    note: str,
) -> Iterator[Row]:
    """The rows on the cost of some gradient steps, and how much of it was useful work."""
    parts = [part for batch in batches for part in batch]
    lengths = np.concatenate([part.lengths for part in parts])
    padded = sum(len(part.lengths) * part.num_steps for part in parts)
    longest = range(1, network.max_prompt_length + 1)
    goals = np.mean([np.minimum(k, lengths).mean() for k in longest])
    flops = 3 * sequence_flops(network, float(goals), lengths).sum()
    note = f"{note}, mean {lengths.mean():.1f} steps"
    yield Row("gradient step", cpu / len(batches), "CPU-s", note)
    yield Row("  real steps", lengths.sum() / cpu, "steps / CPU-s", "padding not counted")
    yield Row("  real tokens", flops / cpu / 1e9, "GFLOP / CPU-s", "padding not counted")
    yield Row("  matrix product", rate, "GFLOP / CPU-s", "2048 x 2048, same run, before and after")
    yield Row("  relative speed", 100 * flops / cpu / 1e9 / rate, "%", "of the matrix product")
    yield Row("  padding", 100 * (1 - lengths.sum() / padded), "%", "of the steps computed")
    yield Row("  peak memory", peak_bytes() / 1e9, "GB", "of the whole process so far")


def policy_to_bench(
    world: World, env: Environment, recipe: PretrainConfig, dataset: Dataset
) -> tuple[LoadedPolicy, str]:
    """The released policy of the kind that a recipe trains, or an untrained one if there is none.

    Returns:
      The policy, and a note that says which of both it is.

    Raises:
      UsageError: if the kind of network does not work in the world.
    """
    try:
        return load_policy(world, kind=recipe.method), "released policy"
    except UsageError:
        network = configured_network(recipe, env, dataset)
        params = Trainer(recipe.train, network, dataset, device_mesh(1)).init().params
        return LoadedPolicy(network, params, {}), "untrained policy"


def bench_acting(env: Environment, policy: LoadedPolicy, note: str) -> Iterator[Row]:
    """Measure the CPU time of one step of acting at several positions, and of a whole episode."""
    lanes = lanes_together(env, cache_bytes(policy.config))
    keys = jax.random.split(jax.random.key(0), lanes)
    tasks = jax.vmap(env.sample_task)(keys)
    slots = policy.config.max_prompt_length
    prompts = jax.vmap(lambda task: single_goal(env.task_goal(task), slots))(tasks)
    yield from _bench_decode(env, policy, keys, tasks, prompts)

    endless = Endless(env)

    def episode(key: PRNGKeyArray, task: Task, prompt: Prompt) -> Episode:
        query = Query(prompt, jnp.ones((), bool))
        return rollout(key, endless, policy.policy, task, query)

    program = together(env, episode)
    jax.block_until_ready(program(keys, tasks, prompts))
    done, cpu = cpu_time(lambda: program(keys, tasks, prompts))
    mean = float(done.trajectory.length.mean())
    yield Row("full episode", cpu / lanes, "CPU-s", f"{note}, all {mean:.0f} steps of the horizon")


def _bench_decode(
    env: Environment, policy: LoadedPolicy, keys: PRNGKeyArray, tasks: Task, prompts: Prompt
) -> Iterator[Row]:
    """Measure one step of acting at an eighth, at half and at the end of the horizon."""
    horizon, lanes, functions = env.spec.horizon, len(keys), policy.policy
    _, first = jax.vmap(env.reset)(keys, tasks)
    _, carry = jax.jit(jax.vmap(functions.prefill))(prompts, first.obs)
    action = jax.tree.map(lambda leaf: jnp.stack([leaf] * lanes), env.spec.zero_action())
    for position in sorted({max(2, horizon // part) for part in (8, 2, 1)}):
        room = jax.vmap(lambda cache, n=position - 1: functions.grow(cache, n))(carry)
        num_steps = min(16, position - 1)

        @jax.jit
        def decode(cache: Any, num_steps: int = num_steps) -> Any:
            def step(cache: Any, _: None) -> tuple[Any, Any]:
                distribution, cache = jax.vmap(functions.decode)(cache, action, first.obs)
                return cache, distribution  # XLA would drop what is not returned

            return jax.lax.scan(step, cache, length=num_steps)

        jax.block_until_ready(decode(room))
        _, cpu = cpu_time(lambda decode=decode, room=room: decode(room))
        cost = 1e3 * cpu / lanes / num_steps
        yield Row(f"decode at {position}", cost, "CPU-ms / step", f"{lanes} episodes at once")


class Endless(Wrapper):
    """A wrapper that makes every episode last until the horizon."""

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        state, timestep = self.env.reset(key, task)
        return (jnp.zeros((), jnp.int32), state), timestep

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        steps, inner = state
        inner, timestep = self.env.step(inner, action)
        ends = steps + 1 >= self.spec.horizon
        ongoing = timestep._replace(terminated=jnp.zeros((), bool), truncated=ends)
        return (steps + 1, inner), ongoing


def bench_adaptation(
    world: World, env: Environment, policy: LoadedPolicy, note: str, episodes: int
) -> Row:
    """Measure an adaptation with UCB to the world's test tasks."""
    num = world.num_test_tasks
    tasks = benchmark_tasks(env, num)
    hyper = methods.find("ucb").hyper_in(world)
    outcome = adapt(
        env, policy, tasks, "ucb", hyper, seeds=3, episodes=episodes, judged=world.judged
    )
    note = f"{note}, {num} tasks x 3 seeds x {episodes} episodes"
    return Row("adaptation", outcome.num_episodes / outcome.cpu_seconds, "episodes / CPU-s", note)


def bench_baselines(
    world: World, env: Environment, env_name: str, dataset: Dataset, episodes: int
) -> Iterator[Row]:
    """Measure the cost of an episode of each baseline: acting, and learning from it.

    The cost includes the two evaluation episodes of each search, a few percent, although only search
    episodes are counted. A baseline that cannot be used in the world has no row.
    """
    tasks = benchmark_tasks(env, NUM_BASELINE_TASKS)
    judged = replace(world.judged, episodes=1)
    for name in BASELINES:
        method = methods.find(name)
        try:
            recipe = pretrain_preset(env_name, "fast", method.policy)
            policy, note = policy_to_bench(world, env, recipe, dataset)
            outcome = adapt(
                env, policy, tasks, method, method.hyper_in(world),
                seeds=1, episodes=episodes, eval_every=episodes, judged=judged,
            )  # fmt: skip
        except UsageError:
            continue
        cost = 1e3 * outcome.cpu_seconds / outcome.returns.size
        size = f"{NUM_BASELINE_TASKS} tasks x {episodes} episodes"
        mean = float(outcome.lengths.mean())
        yield Row(f"adapt {name}", cost, "CPU-ms / episode", f"{note}, {size} of {mean:.0f} steps")
