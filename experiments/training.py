"""A pre-training run: dataset, gradient steps, checkpoints, evaluations on the way, and the policy."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray
from tqdm import tqdm

import envs
from envs.base import Demonstrator, Environment, Task
from envs.episodes import run_episode
from envs.errors import UsageError
from envs.registry import World
from experiments.datasets import find_demonstrator, prepare_dataset
from experiments.figures import training_curve
from experiments.store.metrics import METRICS, Metrics, read_metrics
from experiments.store.provenance import provenance
from experiments.store.settings import PretrainConfig, saved_pretraining
from mgpo_jax.checkpoint import checkpoints, restore_state, save_state
from mgpo_jax.dataset import BatchPlan, Dataset
from mgpo_jax.files import read_object, to_json, write_json
from mgpo_jax.policy import transformer_policy
from mgpo_jax.policy_files import save_policy
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.runner import together
from mgpo_jax.sharding import device_mesh, fetch, largest_divisor
from mgpo_jax.tasks import EVAL_SEED, evaluation_tasks
from mgpo_jax.training import Trainer, TrainState, batch_stream
from mgpo_jax.transformer import TransformerConfig, network_config

CONSTANT = 1e-4  # below this standard deviation a component of an observation stays unscaled
PERFECT = 1e-3  # a demonstration whose return is this near to the optimum counts as perfect


def configured_network(
    config: PretrainConfig, env: Environment, dataset: Dataset
) -> TransformerConfig:
    """The network of a run: its settings are those that both configs have."""
    common = {f.name for f in fields(TransformerConfig)} & {f.name for f in fields(PretrainConfig)}
    network = network_config(env.spec, **{name: getattr(config, name) for name in common})
    if not config.standardize_obs:
        return network
    rows = dataset.obs.reshape(len(dataset.obs), -1)
    mean = rows.mean(axis=0, dtype=np.float64)
    std = rows.std(axis=0, dtype=np.float64)
    std = np.where(std < CONSTANT, 1.0, std)
    return replace(network, obs_mean=tuple(mean.tolist()), obs_std=tuple(std.tolist()))


class GreedyEvaluation:
    """Mean greedy returns on tasks of its own, none of them a test task.

    ``initial`` is the return of the prompt (g^M); ``followed`` that of a prompt drawn from a perfect
    demonstration of the task, which says how well the policy does what a good prompt tells it. The latter
    is missing where most demonstrations are not perfect (in mazes the demonstrator goes after goals of its
    own) and where the optimum is unknown.
    """

    def __init__(
        self,
        world: World,
        env: Environment,
        network: TransformerConfig,
        demonstrator: Demonstrator,
        num: int,
    ) -> None:
        self.tasks = evaluation_tasks(env, num, world.num_test_tasks)
        self.optimum = jax.jit(jax.vmap(env.optimal_return))(self.tasks)
        self.keys = jax.random.split(jax.random.key(EVAL_SEED), (3, num))
        num_slots = network.max_prompt_length

        def demonstrated(
            key: PRNGKeyArray, key_prompt: PRNGKeyArray, task: Task, weights: Any
        ) -> tuple[Prompt, Array]:
            episode = run_episode(key, env, demonstrator.agent(weights), task)
            goals = episode.trajectory.goals
            confirmed = goals.goal_reached & (episode.rewards > 0)
            kept = confirmed if env.spec.reward_confirms_goals else None
            prompt = sample_prompt(key_prompt, goals, env.task_goal(task), num_slots, kept=kept)
            return prompt, episode.return_

        def greedy_return(params: Any, key: PRNGKeyArray, task: Task, prompt: Prompt) -> Array:
            policy = transformer_policy(network, params)
            return rollout(key, env, policy, task, Query(prompt, jnp.ones((), bool))).return_

        self._returns = together(env, greedy_return, in_axes=(None, 0, 0, 0))
        self._initial = jax.vmap(lambda task: single_goal(env.task_goal(task), num_slots))(
            self.tasks
        )
        demonstrate = together(env, demonstrated, in_axes=(0, 0, 0, None))
        self._followed, returns = demonstrate(
            self.keys[0], self.keys[1], self.tasks, demonstrator.weights
        )
        self._perfect = np.asarray(returns > self.optimum - PERFECT)

    def __call__(self, params: Any) -> dict[str, float]:
        """The numbers for some weights."""
        initial = self._returns(params, self.keys[2], self.tasks, self._initial)
        found = {"eval/initial_return": float(initial.mean())}
        if np.isfinite(self.optimum).all():
            found["eval/initial_regret"] = float(jnp.mean(self.optimum - initial))
        if self._perfect.mean() > 0.5:
            followed = self._returns(params, self.keys[2], self.tasks, self._followed)
            found["eval/followed_return"] = float(np.asarray(followed)[self._perfect].mean())
        return found


@contextmanager
def stop_request() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C and SIGTERM into a request that is met between two gradient steps."""
    asked: list[int] = []

    def ask(number: int, frame: FrameType | None) -> None:
        if asked:
            raise KeyboardInterrupt  # the second time, at once
        asked.append(number)

    before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def open_run(config: PretrainConfig) -> Path:
    """The run folder: a new one, or with ``--resume`` one made with the same settings.

    Raises:
      UsageError: if there is no run to resume, or it was started with other settings.
    """
    folder = config.folder
    saved = folder / "config.json"
    if not config.resume:
        folder.mkdir(parents=True)
        write_json(saved, config)
        write_json(folder / "meta.json", provenance())
        return folder
    if not saved.is_file():
        raise UsageError(f"no run to resume in {folder}; start it without --resume")
    before = saved_pretraining(read_object(saved), saved)
    now = to_json(replace(config, resume=False, debug=False))
    before = {**to_json(PretrainConfig()), **before, "debug": False}
    changed = [f"{name} {before[name]} -> {now[name]}" for name in now if now[name] != before[name]]
    if changed:
        raise UsageError(f"{folder} was started with other settings: {'; '.join(changed)}")
    return folder


class Run:
    """A training under way: the trainer, what measures it, and where its metrics go."""

    def __init__(self, config: PretrainConfig) -> None:
        self.config = config
        world, env = envs.find(config.env), envs.make(config.env)
        network_config(env.spec, config.head, encoder=config.encoder)  # complains about a bad one
        dataset = prepare_dataset(config, world, env)
        self.network = configured_network(config, env, dataset)
        self.folder = open_run(config)
        self.mesh = device_mesh(largest_divisor(config.train.part_size, len(jax.devices())))
        cut = len(dataset) - config.holdout
        self.fit, held_out = dataset.slice(0, cut), dataset.slice(cut, len(dataset))
        self.trainer = Trainer(config.train, self.network, self.fit, self.mesh)
        self._held_out = held_out
        self.truncate = env.spec.truncate_in_hindsight
        self._held_out_parts = self._validation_parts(held_out, env.spec.horizon)
        _, demonstrator = find_demonstrator(world, env, config.data.demonstrator)
        self._greedy = GreedyEvaluation(world, env, self.network, demonstrator, config.eval_tasks)

    def _validation_parts(self, held_out: Dataset, horizon: int) -> list[BatchPlan]:
        """Draws of one padded length; the validation loss is of the same ones every time."""
        plan = replace(
            self.config.train, batch_size=512, part_size=64, part_steps=1 << 30, bucket=horizon
        )
        return next(batch_stream(plan, held_out, self.truncate))

    def measure(self, params: Any) -> dict[str, float]:
        """Losses on held-out trajectories and greedy returns."""
        held = self.trainer.evaluate(params, self._held_out_parts, self._held_out)
        return {**{f"val/{k}": v for k, v in held.items()}, **self._greedy(params)}

    def batches(self, first_step: int) -> Iterator[list[BatchPlan]]:
        """The batches of the run from a step on."""
        return batch_stream(
            self.config.train,
            self.fit,
            self.truncate,
            self.mesh.devices.size,
            first_step=first_step,
        )


def train(config: PretrainConfig) -> None:
    """Run or continue a training to its end and write the policy.

    Raises:
      KeyboardInterrupt: if it was asked to stop; the state is saved.
    """
    run = Run(config)
    with checkpoints(run.folder / "checkpoints") as manager, stop_request() as stopping:
        state = run.trainer.init()
        if config.resume:
            state = restore_state(manager, state) or state
            print(f"resuming {run.folder} at step {state.step}", file=sys.stderr)
        metrics = Metrics(run.folder, config, state.step)
        state = _take_steps(run, state, metrics, manager, stopping)
    made = {"env": config.env, "config": to_json(config), "steps": state.step}
    save_policy(run.folder / "policy", run.network, state.params, made)
    training_curve(read_metrics(run.folder / METRICS)).savefig(run.folder / "training.png")
    print(f"policy written to {run.folder / 'policy'}", file=sys.stderr)


def _take_steps(
    run: Run, state: TrainState, metrics: Metrics, manager: Any, stopping: Callable[[], bool]
) -> TrainState:
    """All gradient steps that are left, with checkpoints and evaluations on the way."""
    config, num_steps = run.config, run.config.train.steps
    batches = run.batches(state.step)
    pending: list[dict[str, Array]] = []
    clock = time.process_time()
    with tqdm(total=num_steps, initial=state.step, unit="step", disable=None) as progress:
        while state.step < num_steps:
            state, row = run.trainer.step(state, next(batches))
            pending.append(row)
            progress.update()
            done = state.step == num_steps
            if stopping() or done or state.step % config.save_every == 0:
                save_state(manager, state)
            if done or state.step % config.eval_every == 0:
                mean = _means(fetch(pending))
                spent = {"cpu_seconds_per_step": (time.process_time() - clock) / len(pending)}
                row_out = {**mean, **run.measure(state.params), **spent}
                metrics.write(state.step, row_out)
                progress.set_postfix(_shown(row_out))
                pending, clock = [], time.process_time()
            if stopping():
                progress.close()
                print(f"stopped at step {state.step}; continue with --resume", file=sys.stderr)
                raise KeyboardInterrupt
    return state


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    return {f"train/{name}": float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _shown(row: dict[str, float]) -> dict[str, str]:
    """What the progress bar shows of a row of metrics."""
    returns = {
        name.removeprefix("eval/").removesuffix("_return"): f"{value:.2f}"
        for name, value in row.items()
        if name.startswith("eval/") and name.endswith("_return")
    }
    return {"loss": f"{row['train/loss']:.3f}", "val": f"{row['val/loss']:.3f}", **returns}
