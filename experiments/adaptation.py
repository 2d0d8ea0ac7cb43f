"""Many adaptations in one compiled program: every variant, seed and task is a lane of its own.

Lanes are spread over the devices and, on each, run in groups: the lanes of a group share one clock, so
that a group's episode ends with its slowest lane. On a CPU, groups are as large as their key-value caches
fit into the memory near a core, or as a step of the world needs to be worth its call.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int
from tqdm import tqdm

from envs.base import Environment, Task
from experiments.policies import LoadedPolicy
from experiments.runtime import jit_with
from experiments.tasks import num_tasks
from mgpo_jax.adapt import AdaptLog, continue_adaptation, evaluate, start_adaptation
from mgpo_jax.optimizers import PromptOptimizer, SearchSpace
from mgpo_jax.policy import Policy, transformer_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.sharding import AXIS, device_mesh, replicate, split
from mgpo_jax.transformer import TransformerConfig
from mgpo_jax.types import PRNGKeyArray, Prompt

LANES = "lanes"
# Of key-value caches of lanes that share a clock: near a core of a CPU, in the memory of an accelerator.
GROUP_BYTES, GROUP_BYTES_ACCELERATOR = 3 << 20, 4 << 30
NUM_EVAL_EPISODES = 10  # of an evaluation, where starts or worlds are random


class Outcome(NamedTuple):
    """Raw results, axes S seeds, N tasks, E episodes, C evaluations."""

    log: AdaptLog
    """Leaves [S, N, E, ..]."""
    eval_episodes: np.ndarray
    """[C]: after how many episodes the best prompt was evaluated."""
    eval_returns: np.ndarray
    """[S, N, C] greedy returns of the best prompt (means of as many episodes as an evaluation has);
    the first is that of the prompt (g^M)."""
    num_episodes: int
    """All episodes that were run, searches and evaluations."""
    num_failed: int
    """Those that the world ended because it broke down."""
    cpu_seconds: float
    """CPU time of all of them, without compilation."""


def lanes_together(env: Environment, config: TransformerConfig) -> int:
    """How many lanes share a clock."""
    num_tokens = config.max_prompt_length + 2 * config.horizon - 1
    floats = 2 * config.num_layers * config.embed_dim * num_tokens
    limit = GROUP_BYTES if jax.default_backend() == "cpu" else GROUP_BYTES_ACCELERATOR
    return max(env.spec.worlds_together, limit // (4 * floats))


class Layout(NamedTuple):
    """How lanes are spread: over devices, and on each in groups that share a clock."""

    mesh: Mesh
    group: int
    num_lanes: int
    """With those that only fill up the last groups."""


def lay_out(env: Environment, config: TransformerConfig, num_lanes: int) -> Layout:
    """Spread at least ``num_lanes`` lanes evenly."""
    mesh = device_mesh()
    on_each = -(-num_lanes // mesh.devices.size)
    num_groups = -(-on_each // lanes_together(env, config))
    group = -(-on_each // num_groups)
    return Layout(mesh, group, mesh.devices.size * num_groups * group)


def run_lanes(env: Environment, layout: Layout, function: Callable) -> Any:
    """A jitted ``function`` over all lanes; its last argument is shared by them."""
    spec = PartitionSpec(AXIS)

    def on_device(*args: Any) -> Any:
        *own, shared = args
        grouped = jax.tree.map(lambda leaf: leaf.reshape(-1, layout.group, *leaf.shape[1:]), own)
        together = jax.vmap(lambda own: function(*own, shared), axis_name=LANES)
        done = jax.lax.map(together, grouped)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

    def call(*args: Any) -> Any:
        in_specs = (spec,) * (len(args) - 1) + (PartitionSpec(),)
        return jax.shard_map(
            on_device, mesh=layout.mesh, in_specs=in_specs, out_specs=spec, check_vma=False
        )(*args)

    return jit_with(env)(call)


class Measured(NamedTuple):
    """Greedy episodes under a prompt."""

    return_: Float[Array, "*lanes"]
    """Their mean."""
    num_failed: Int[Array, "*lanes"]
    """How many the world ended because it broke down."""


def measure_prompt(
    env: Environment,
    config: TransformerConfig,
    num_episodes: int,
    key: PRNGKeyArray,
    task: Task,
    prompt: Prompt,
    params: Any,
) -> Measured:
    """What a prompt is worth, outside of any search."""
    policy = transformer_policy(config, params)

    def episode(key: PRNGKeyArray) -> tuple[Array, Array]:
        done = evaluate(key, env, policy, task, prompt, LANES)
        return done.return_, jnp.asarray(done.failed)

    returns, failed = jax.lax.map(episode, jax.random.split(key, num_episodes))
    return Measured(returns.mean(), failed.sum())


def evaluate_prompts(
    env: Environment,
    network: LoadedPolicy,
    tasks: Task,
    prompts: Prompt,
    *,
    episodes: int,
    seed: int = 0,
) -> tuple[np.ndarray, int]:
    """Mean greedy returns ``[S, N]`` of prompts ``[S, N, P, ..]``, one for each seed and task.

    The second result is how many episodes a broken world ended.
    """
    seeds, num = prompts.mask.shape[:2]
    layout = lay_out(env, network.config, seeds * num)
    index = np.arange(layout.num_lanes) % (seeds * num)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[index], prompts)
    lane_tasks = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index % num], tasks)
    keys = jax.random.split(jax.random.key(seed), seeds * num)[index]
    measure = run_lanes(env, layout, partial(measure_prompt, env, network.config, episodes))
    lanes = split(layout.mesh, (keys, lane_tasks, flat))
    found = jax.device_get(measure(*lanes, replicate(layout.mesh, network.params)))
    found = jax.tree.map(lambda rows: rows[: seeds * num].reshape(seeds, num), found)
    return found.return_, int(found.num_failed.sum())


def run_adaptation(
    env: Environment,
    network: LoadedPolicy,
    make_optimizer: Callable[..., PromptOptimizer],
    tasks: Task,
    *,
    seeds: int,
    episodes: int,
    seed: int = 0,
    max_goals: int | None = None,
    eval_every: int = 10,
    eval_episodes: int | None = None,
    keep_rewarded: bool = True,
) -> Outcome:
    """Adapt to every task with every seed; ``make_optimizer(space)`` makes the optimizer."""
    variant = {} if max_goals is None else {"max_goals": max_goals}
    (outcome,) = run_variants(
        env,
        network,
        make_optimizer,
        tasks,
        [variant],
        seeds=seeds,
        episodes=episodes,
        seed=seed,
        eval_every=eval_every,
        eval_episodes=eval_episodes,
        keep_rewarded=keep_rewarded,
    )
    return outcome


def run_variants(
    env: Environment,
    network: LoadedPolicy,
    make_optimizer: Callable[..., PromptOptimizer],
    tasks: Task,
    variants: Sequence[Mapping[str, float]],
    *,
    seeds: int,
    episodes: int,
    seed: int = 0,
    eval_every: int = 10,
    eval_episodes: int | None = None,
    keep_rewarded: bool = True,
) -> list[Outcome]:
    """One outcome for each variant of the optimizer; all see the same tasks and random keys.

    Args:
      env: the world.
      network: the policy.
      make_optimizer: ``(space, **variant) -> optimizer``.
      tasks: N tasks, stacked.
      variants: hyper-parameters by name, the same names in each; ``max_goals`` is that of the search
        space (K), the others are the optimizer's. They are traced: a sweep compiles once.
      seeds: independent adaptations to each task.
      episodes: budget of each.
      seed: seed of all of them.
      eval_every: episodes between evaluations of the best prompt.
      eval_episodes: greedy episodes that an evaluation averages (default: 1 in deterministic worlds,
        else ``NUM_EVAL_EPISODES``).
      keep_rewarded: whether bandits keep the rewarded goals of the best trajectory and shuffle those
        after them, where ``EnvSpec.reward_confirms_goals``.
    """
    num = num_tasks(tasks)
    eval_episodes = eval_episodes or (1 if env.spec.deterministic else NUM_EVAL_EPISODES)
    keep_rewarded = keep_rewarded and env.spec.reward_confirms_goals
    lanes = len(variants) * seeds * num
    layout = lay_out(env, network.config, lanes)
    mesh, over_lanes = layout.mesh, partial(run_lanes, env, layout)
    # Lanes beyond the last variant only fill up the last group.
    index = np.arange(layout.num_lanes)
    lane_tasks = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index % num], tasks)
    keys = jax.random.split(jax.random.key(seed), seeds * num)[index % (seeds * num)]
    which = index // (seeds * num) % len(variants)
    hyper = {name: jnp.array([v[name] for v in variants])[which] for name in variants[0]}

    def parts(params: Any, hyper: dict[str, Any]) -> tuple[Policy, PromptOptimizer]:
        policy = transformer_policy(network.config, params)
        space = SearchSpace(
            policy.num_slots,
            env.sample_goal,
            env.spec.return_range,
            episodes,
            hyper.get("max_goals"),
            env.spec.deterministic,
            keep_rewarded,
        )
        options = {name: value for name, value in hyper.items() if name != "max_goals"}
        return policy, make_optimizer(space, **options)

    @over_lanes
    def start(key: Any, task: Task, hyper: Any, params: Any) -> Any:
        return start_adaptation(key, env, *parts(params, hyper), task)

    def search(num_episodes: int) -> Any:
        """The next episodes of the search."""

        @over_lanes
        def advance(state: Any, task: Task, hyper: Any, params: Any) -> Any:
            policy, optimizer = parts(params, hyper)
            state, log = continue_adaptation(
                state, env, policy, optimizer, task, num_episodes, LANES
            )
            return state, log, optimizer.best(state.optimizer)

        return advance

    measure = over_lanes(partial(measure_prompt, env, network.config, eval_episodes))
    lane_tasks, keys, hyper = split(mesh, (lane_tasks, keys, hyper))
    params = replicate(mesh, network.params)
    state = start(keys, lane_tasks, hyper, params)
    num_slots = network.config.max_prompt_length
    best = jax.vmap(lambda task: single_goal(env.task_goal(task), num_slots))(lane_tasks)
    sizes = [eval_every] * (episodes // eval_every)
    sizes += [episodes % eval_every] if episodes % eval_every else []
    searches = {
        size: search(size).lower(state, lane_tasks, hyper, params).compile() for size in set(sizes)
    }
    measured = measure.lower(keys, lane_tasks, best, params).compile()
    logs: list[AdaptLog] = []
    evaluations: list[Measured] = []
    cpu = time.process_time()
    with tqdm(total=episodes * lanes, unit="episode", disable=None) as progress:
        for number, size in enumerate([0, *sizes]):
            if size:
                state, log, best = searches[size](state, lane_tasks, hyper, params)
                logs.append(jax.device_get(log))
            eval_keys = jax.vmap(partial(jax.random.fold_in, data=number))(keys)
            evaluations.append(jax.device_get(measured(eval_keys, lane_tasks, best, params)))
            progress.update(size * lanes)
    cpu = time.process_time() - cpu

    def by_variant(array: np.ndarray) -> np.ndarray:
        return array[:lanes].reshape(len(variants), seeds, num, *array.shape[1:])

    log = jax.tree.map(lambda *leaves: by_variant(np.concatenate(leaves, axis=1)), *logs)
    measurements = jax.tree.map(lambda *rows: by_variant(np.stack(rows, axis=-1)), *evaluations)
    num_failed = [
        int(log.failed[v].sum() + measurements.num_failed[v].sum()) for v in range(len(variants))
    ]
    # The search, too, begins with one evaluation of (g^M).
    after = np.concatenate([[1], np.cumsum(sizes)])
    share = layout.num_lanes / len(variants)
    total = round(share * (episodes + len(evaluations) * eval_episodes))
    return [
        Outcome(
            jax.tree.map(lambda leaf, v=v: leaf[v], log),
            after,
            measurements.return_[v],
            total,
            num_failed[v],
            cpu / len(variants),
        )
        for v in range(len(variants))
    ]
