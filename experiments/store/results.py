"""The results of an adaptation, in memory; ``store.result_files`` writes and reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment, Episode, Task
from envs.episodes import replay
from envs.errors import DataError
from envs.registry import WORLDS, World
from envs.wrappers import behind_noise
from experiments.store.layout import CONFIG, TASKS
from mgpo_jax.outcomes import Outcome, Reached
from mgpo_jax.tasks import task_arrays, task_at, tasks_from
from mgpo_jax.trees import named_leaves


@dataclass(frozen=True, kw_only=True)
class Results:
    """The results of one adaptation.

    Axes: S seeds, N tasks, E episodes of the search, R rounds, G goal size, C judgements (evaluations of
    the best choice).
    """

    config: dict[str, Any]
    """Settings of the command that made them."""
    tasks: dict[str, np.ndarray]
    """Arrays of the tasks, each [N, ..]."""
    returns: np.ndarray
    """[S, N, E] returns of the episodes."""
    choices: dict[str, np.ndarray]
    """Parts of the choice that acted in each round, such as its prompt, each [S, N, R, ..]."""
    best: dict[str, np.ndarray]
    """Parts of the best choice after each round, each [S, N, R, ..]."""
    eval_episodes: np.ndarray
    """[C] numbers of episodes after which the best choice was judged."""
    eval_returns: np.ndarray
    """[S, N, C] mean returns of the judging episodes, of which nothing else is kept."""
    optimal_returns: np.ndarray
    """[N] optimal returns; NaN if unknown."""
    eval_achieved: np.ndarray | None = None
    """[S, N, C, M] shares of the judging episodes that achieved each of the world's M named goals; None in
    worlds without any."""
    num_scored: np.ndarray | None = None
    """[S, N, R] prompts rehearsed without an episode until the end of each round; None for methods that
    only learn from episodes."""
    lengths: np.ndarray | None = None
    """[S, N, E] steps of the episodes."""
    keys: np.ndarray | None = None
    """[S, N, E, 2] raw random keys of the episodes, from which their initial states follow
    (``envs.episodes.replay``); None in deterministic worlds."""
    actions: np.ndarray | None = None
    """[S, N, E, T, ..] actions; after the end of an episode, discrete ones are the largest integer of their
    dtype."""
    reached: Reached | None = None
    """The goals that the episodes reached, and the steps in which they did."""
    summary: dict[str, Any] = field(default_factory=dict)
    """The numbers that tables show."""
    folder: Path | None = None
    """The folder that they were read from; None if they were just made."""

    @property
    def env(self) -> str:
        """The world, by name or as module:attribute."""
        return self.config["env"]

    @property
    def method(self) -> str:
        """The method, by name or as module:attribute."""
        return str(self.config.get("method", self.config.get("bandit")))

    @property
    def optimum_known(self) -> bool:
        return bool(np.isfinite(self.optimal_returns).all())

    @cached_property
    def world(self) -> World:
        """The record of the world; nothing is imported for a module:attribute in a file."""
        where = "the results" if self.folder is None else self.folder / CONFIG
        return WORLDS.known(self.env, where, "--env")

    @cached_property
    def environment(self) -> Environment:
        """The environment that the adaptation ran in, with its noise, if any."""
        config = self.config
        return behind_noise(
            self.world.make(), config.get("obs_noise", 0.0), config.get("action_noise", 0.0)
        )

    @cached_property
    def task_set(self) -> Task:
        """The tasks as a batch of the world's task record."""
        where = "the tasks of the results" if self.folder is None else self.folder / TASKS
        trusted = self.folder is None  # tasks of this process were checked when drawn or read
        return tasks_from(self.tasks, self.world.make(), where, trusted)

    @cached_property
    def task_goals(self) -> np.ndarray:
        """[N, G] task goals g^M."""
        return np.asarray(jax.vmap(self.world.make().task_goal)(self.task_set))

    @cached_property
    def num_parts(self) -> np.ndarray:
        """[N] numbers of equally rewarded parts of the tasks (``Environment.num_parts``)."""
        return np.asarray(jax.jit(jax.vmap(self.world.make().num_parts))(self.task_set))

    def task(self, index: int) -> Task:
        """One task, with numpy leaves."""
        return jax.tree.map(np.asarray, task_at(self.task_set, index))

    @property
    def last_judgement(self) -> np.ndarray | None:
        """[S, N] index of the judgement at which each search ended; None without ``--stop-at``.

        That is the first one that reaches ``--stop-at``, or that after the whole budget.
        """
        stop_at = self.config.get("stop_at")
        if stop_at is None:
            return None
        enough = self.eval_returns >= stop_at
        return np.where(enough.any(axis=-1), enough.argmax(axis=-1), enough.shape[-1] - 1)

    @property
    def episodes_used(self) -> np.ndarray | None:
        """[S, N] episodes that each search used; None without ``--stop-at``.

        A search whose initial choice is judged good enough uses none.
        """
        last = self.last_judgement
        return None if last is None else np.where(last == 0, 0, self.eval_episodes[last])

    def best_goals(self, seed: int, task: int, episodes: int | None = None) -> np.ndarray | None:
        """The goals [k, G] of the best prompt after some number of episodes (default: all of them).

        Returns None for a method without prompts.
        """
        if "prompt.goals" not in self.best:
            return None
        rounds, total = self.best["prompt.mask"].shape[2], self.returns.shape[2]
        last = -(-(total if episodes is None else episodes) * rounds // total)
        where = (seed, task, last - 1)
        return self.best["prompt.goals"][where][self.best["prompt.mask"][where]]

    def reached_in(self, seed: int, task: int, episode: int) -> tuple[np.ndarray, np.ndarray]:
        """The steps [n] and goals [n, G] that one episode of the search reached.

        Raises:
          DataError: if the results do not hold them.
        """
        if self.reached is None:
            raise DataError("these results were made before reached goals were kept; adapt again")
        counts = self.reached.counts
        end = int(
            counts.ravel()[: np.ravel_multi_index((seed, task, episode), counts.shape) + 1].sum()
        )
        rows = slice(end - int(counts[seed, task, episode]), end)
        return self.reached.steps[rows], self.reached.goals[rows]

    def replay(self, seed: int, task: int, episode: int) -> Episode:
        """Replay one episode of the search.

        Raises:
          DataError: if the results do not contain its actions.
        """
        if self.actions is None:
            raise DataError(
                "these results hold no actions; adapt again, with --keep-actions where they are continuous"
            )
        where = (seed, task, episode)
        env, actions = self.environment, self.actions[where]
        if self.lengths is not None:
            length = int(self.lengths[where])
        else:  # actions after the end are the largest integer of their dtype
            length = int((actions != np.iinfo(actions.dtype).max).sum())
        raw = np.zeros(2, np.uint32) if self.keys is None else self.keys[where]
        played = jnp.asarray(actions, env.spec.zero_action().dtype)
        one = jax.tree.map(jnp.asarray, self.task(task))
        return replay(
            jax.random.wrap_key_data(jnp.asarray(raw)), env, one, played, jnp.int32(length)
        )

    def most_improved(self, num: int = 4) -> list[int]:
        """The tasks whose return improved most by adaptation, averaged over seeds, best first."""
        gains = (self.eval_returns[:, :, -1] - self.eval_returns[:, :, 0]).mean(axis=0)
        return np.argsort(-gains, kind="stable")[:num].tolist()


def results_of(
    outcome: Outcome, config: Mapping[str, Any], env: Environment, tasks: Task, optimum: np.ndarray
) -> Results:
    """The results of an adaptation that was just run.

    Random keys are only kept in stochastic worlds; in others the actions determine an episode.
    """
    return Results(
        config=dict(config),
        tasks=task_arrays(tasks),
        returns=outcome.returns,
        choices=_parts(outcome.choices),
        best=_parts(outcome.best),
        eval_episodes=outcome.eval_episodes,
        eval_returns=outcome.eval_returns,
        optimal_returns=optimum,
        eval_achieved=outcome.eval_achieved,
        num_scored=outcome.num_scored,
        lengths=outcome.lengths,
        keys=None if env.spec.deterministic else outcome.keys,
        actions=outcome.actions,
        reached=outcome.reached,
    )


def _parts(choice: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(leaf) for name, leaf in named_leaves(choice, "choice").items()}
