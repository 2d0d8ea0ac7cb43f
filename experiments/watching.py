"""Evaluations on the way of a pre-training run: mean returns in the world, never on test tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from envs.agents import Demonstrator
from envs.base import Environment, Task
from envs.episodes import run_episode
from envs.registry import World
from mgpo_jax.kinds import MULTI_GOAL, kind_of
from mgpo_jax.lanes import together
from mgpo_jax.network_configs import NetworkConfig, TransformerConfig
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.policy import transformer_policy
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import rollout
from mgpo_jax.tasks import EVAL_SEED, evaluation_tasks

PERFECT = 1e-3  # demonstrations whose return is this close to the optimum count as perfect


class ReturnsOnTheWay:
    """Evaluates a policy during training: mean returns on evaluation tasks, none of which is a test task.

    The policy runs one episode per task in the world that the data was collected in. It acts greedily,
    unless the world's record says that policies are judged by sampled actions.

    ``initial_return`` is the return under the prompt (g^M). ``followed_return`` is that under a prompt
    drawn from a perfect demonstration of the task, which shows how well the policy follows a good prompt.
    It is missing if the optimum is unknown, or if most demonstrations are not perfect (in mazes,
    demonstrators pursue goals of their own). If the world has variants, each has its own means as well.
    """

    def __init__(
        self,
        world: World,
        env: Environment,
        network: TransformerConfig,
        demonstrator: Demonstrator | None,
        num: int,
    ) -> None:
        place = (demonstrator.env if demonstrator else None) or env
        self.tasks = evaluation_tasks(place, num, world.num_test_tasks, tested=env)
        self.optimum = jax.jit(jax.vmap(place.optimal_return))(self.tasks)
        self.keys = jax.random.split(jax.random.key(EVAL_SEED), (3, num))
        self._variants = _variants(demonstrator, self.tasks)
        num_slots = network.max_prompt_length

        def demonstrated(
            key: PRNGKeyArray, key_prompt: PRNGKeyArray, task: Task, weights: Any
        ) -> tuple[Prompt, Array]:
            assert demonstrator is not None  # else this is never called
            episode = run_episode(key, place, demonstrator.agent(weights), task)
            goals = episode.trajectory.goals
            confirmed = goals.goal_reached & (episode.rewards > 0)
            kept = confirmed if place.spec.reward_confirms_goals else None
            prompt = sample_prompt(key_prompt, goals, place.task_goal(task), num_slots, kept=kept)
            return prompt, episode.return_

        def judged_return(params: Any, key: PRNGKeyArray, task: Task, prompt: Prompt) -> Array:
            policy = transformer_policy(network, params)
            return rollout(key, place, policy, task, judged_query(prompt, world.judged)).return_

        self._returns = together(place, judged_return, in_axes=(None, 0, 0, 0))
        self._initial = jax.vmap(lambda task: single_goal(place.task_goal(task), num_slots))(
            self.tasks
        )
        self._perfect = np.zeros(num, bool)
        # Otherwise there are no demonstrations, or it is unknown which of them are perfect.
        if demonstrator is not None and np.isfinite(self.optimum).all():
            demonstrate = together(place, demonstrated, in_axes=(0, 0, 0, None))
            self._followed, returns = demonstrate(
                self.keys[0], self.keys[1], self.tasks, demonstrator.weights
            )
            self._perfect = np.asarray(returns > self.optimum - PERFECT)

    def __call__(self, params: Any) -> dict[str, float]:
        """The metrics of some weights."""
        initial = np.asarray(self._returns(params, self.keys[2], self.tasks, self._initial))
        everything = np.ones(len(initial), bool)
        found = self._means("eval/initial_return", initial, everything)
        if np.isfinite(self.optimum).all():
            found["eval/initial_regret"] = float(np.mean(np.asarray(self.optimum) - initial))
        if self._perfect.mean() > 0.5:
            followed = np.asarray(self._returns(params, self.keys[2], self.tasks, self._followed))
            found |= self._means("eval/followed_return", followed, self._perfect)
        return found

    def _means(self, name: str, values: np.ndarray, counts: np.ndarray) -> dict[str, float]:
        """The mean over the tasks that count, and over those of each variant."""
        groups = {"": counts, **{tail: counts & one for tail, one in self._variants.items()}}
        return {name + tail: float(values[one].mean()) for tail, one in groups.items() if one.any()}


def _variants(demonstrator: Demonstrator | None, tasks: Task) -> dict[str, np.ndarray]:
    """Masks of the tasks of each variant of the world, by the suffix of its metrics' names."""
    if demonstrator is None:
        return {}
    variants = np.asarray(jax.vmap(demonstrator.variant)(tasks))
    return {f"_{name}": variants == index for index, name in enumerate(demonstrator.variants)}


class ReturnsByItself:
    """Evaluates a network without prompts during training: its mean return on evaluation tasks."""

    def __init__(self, world: World, env: Environment, network: NetworkConfig, num: int) -> None:
        agent = kind_of(network).load().agent
        assert agent is not None  # ``watched`` makes sure of it
        self._tasks = evaluation_tasks(env, num, world.num_test_tasks)
        self._keys = jax.random.split(jax.random.key(EVAL_SEED), num)

        def return_of(params: Any, key: PRNGKeyArray, task: Task) -> Array:
            acting = agent(network, params, world.judged)
            return run_episode(key, env, acting, task).return_

        self._returns = together(env, return_of, in_axes=(None, 0, 0))

    def __call__(self, params: Any) -> dict[str, float]:
        """The metrics of some weights."""
        returns = self._returns(params, self._keys, self._tasks)
        return {"eval/initial_return": float(np.mean(returns))}


def watched(
    world: World,
    env: Environment,
    network: NetworkConfig,
    demonstrator: Demonstrator | None,
    num: int,
) -> Callable[[Any], dict[str, float]]:
    """``(params) -> metrics``, the evaluation of a training on ``num`` tasks."""
    if isinstance(network, TransformerConfig) and kind_of(network).name == MULTI_GOAL:
        return ReturnsOnTheWay(world, env, network, demonstrator, num)
    return ReturnsByItself(world, env, network, num)
