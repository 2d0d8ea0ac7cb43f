"""Figure 9 in numbers: the entropy of the policy's actions and its return, by the length of the prompt.

Prompts of 1, 2, .. K goals are drawn from the best trajectory of each search, with the same sampler that
the search uses, and the policy runs one episode with sampled actions under each.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

import envs
from envs.base import Goals
from experiments.figures import draw_longest
from experiments.store.policies import load_policy_of
from experiments.store.results import Results
from experiments.store.statistics import SeedSpread, seed_spread
from experiments.store.tables import number, table
from mgpo_jax.judging import uncertainty
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import Query

DRAWS = 2  # prompts per length and trajectory
HEAD = (
    "goals", "prompts", "entropy of an action (mean ± std over seeds)", "return", "steps",
)  # fmt: skip


class Length(NamedTuple):
    """The behavior of the policy under prompts of one length."""

    num_goals: int
    num_prompts: int
    entropy: SeedSpread | None
    """Entropy of the action distribution, in nats; None where it has no closed form."""
    return_: float
    """Mean return of the episodes."""
    num_steps: float
    """Mean length of the episodes."""


def best_goals(results: Results) -> Goals:
    """The goals that the best episode of each search reached, leaves ``[S, N, T, ..]``.

    Results only store the steps that reached a goal, so the last of these counts as the end of the
    episode. The outcome is set to the task goal, which keeps the sampler from drawing that goal: every
    prompt ends with it anyway.

    Raises:
      DataError: if the results are from an older version, which did not store reached goals.
    """
    seeds, num, _ = results.returns.shape
    horizon = results.world.make().spec.horizon
    goals = np.zeros((seeds, num, horizon, results.task_goals.shape[1]), np.float32)
    reached = np.zeros((seeds, num, horizon), bool)
    for seed, task in np.ndindex(seeds, num):
        best = int(np.argmax(results.returns[seed, task]))
        steps, which = results.reached_in(seed, task, best)
        goals[seed, task, steps], reached[seed, task, steps] = which, True
    last = np.where(reached, np.arange(horizon), 0).max(axis=2)
    outcomes = np.broadcast_to(results.task_goals[:, None], goals.shape)
    return Goals(*map(jnp.asarray, (goals, reached, outcomes, (last + 1).astype(np.int32))))


def draw_prompts(
    key: PRNGKeyArray,
    reached: Goals,
    final_goals: Float[Array, "N G"],
    num_slots: int,
    lengths: Int[Array, "L"],
    num_draws: int,
) -> Prompt:
    """Draw D prompts of each length from each trajectory, leaves ``[L, D, S, N, ..]``.

    If a trajectory reached too few goals, its prompts are shorter than asked for.

    Args:
      key: random key.
      reached: the goals that each trajectory reached, leaves ``[S, N, T, ..]``.
      final_goals: the last goal of each prompt.
      num_slots: P, the number of slots in a prompt.
      lengths: the lengths of the prompts, in goals.
      num_draws: D, the number of prompts per length and trajectory.
    """
    shape = (len(lengths), num_draws, *reached.length.shape)
    keys = jax.random.split(key, shape)
    draw = partial(draw_longest, num_slots=num_slots)
    over_tasks = jax.vmap(draw, in_axes=(0, 0, 0, None))
    over_seeds = jax.vmap(over_tasks, in_axes=(0, 0, None, None))
    over_draws = jax.vmap(over_seeds, in_axes=(0, None, None, None))
    over_lengths = jax.vmap(over_draws, in_axes=(0, None, None, 0))
    return jax.jit(over_lengths)(keys, reached, final_goals, lengths)


def by_length(results: Results, seed: int = 0, num_draws: int = DRAWS) -> list[Length]:
    """Run the policy under prompts of 1 to K goals, the longest prompt of its training.

    Lengths for which every trajectory reached too few goals are left out.

    Raises:
      UsageError: if the policy of the results has been moved.
      DataError: if the results are from an older version or other weights, or a return is not finite.
    """
    world, env = envs.find(results.env), envs.make(results.env)
    policy = load_policy_of(results, world, None)
    slots = policy.config.max_prompt_length
    lengths = np.arange(1, slots + 1)
    reached = best_goals(results)
    # Other random numbers than those of the episodes, which ``uncertainty`` draws from ``seed``.
    key, goals = jax.random.fold_in(jax.random.key(seed), 1), jnp.asarray(results.task_goals)
    prompts = draw_prompts(key, reached, goals, slots, jnp.asarray(lengths), num_draws)
    shape = prompts.mask.shape[:-1]  # [L, D, S, N]
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), prompts)
    query = Query(flat, jnp.zeros(flat.mask.shape[:-1], bool))
    found = uncertainty(env, policy, results.task_set, query, seed=seed)
    found = jax.tree.map(lambda rows: np.asarray(rows).reshape(shape), found)
    whole = np.asarray(prompts.mask).sum(axis=-1) == lengths[:, None, None, None]
    return [
        _average(length, which, jax.tree.map(lambda rows, i=index: rows[i], found))
        for index, (length, which) in enumerate(zip(lengths.tolist(), whole, strict=True))
        if which.any()
    ]


def _average(num_goals: int, which: np.ndarray, found: Any) -> Length:
    """Average over the prompts ``[D, S, N]`` that have the full length."""
    by_seed = [
        found.entropy[:, seed][which[:, seed]].mean()
        for seed in range(which.shape[1])
        if which[:, seed].any()
    ]
    known = bool(np.isfinite(by_seed).all())
    return Length(
        num_goals=num_goals,
        num_prompts=int(which.sum()),
        entropy=seed_spread(np.array(by_seed)[:, None]) if known else None,
        return_=float(found.return_[which].mean()),
        num_steps=float(found.num_steps[which].mean()),
    )


def as_table(world: str, head: str, lengths: list[Length]) -> str:
    """The table in Markdown; ``head`` is the name of the policy's action distribution."""
    rows = [
        [
            str(row.num_goals),
            str(row.num_prompts),
            "-" if row.entropy is None else str(row.entropy),
            number(row.return_),
            f"{row.num_steps:.1f}",
        ]
        for row in lengths
    ]
    text = (
        f"{world}: the policy under prompts drawn from the best trajectory of each search, one episode of "
        "sampled actions each.\n"
        "The entropy is that of the distribution of an action in nats, mean over the steps of each "
        "episode.\n\n"
        f"{table(HEAD, rows)}\n"
    )
    if any(row.entropy is None for row in lengths):
        text += f"\n- The entropy of the head {head} has no closed form.\n"
    return text


def entropy_table(results: Results) -> str:
    """The table for the policy of an adaptation, in Markdown."""
    head = load_policy_of(results, envs.find(results.env), None).config.head
    return as_table(results.env, head, by_length(results))
