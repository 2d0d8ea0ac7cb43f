"""A pre-training run: dataset, gradient steps, checkpoints, evaluations on the way, and the policy."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import envs
from envs.base import Demonstrator, Environment, EnvSpec, Task
from envs.episodes import run_episode
from envs.errors import DataError, UsageError
from envs.registry import World
from experiments.datasets import find_demonstrator
from experiments.figures import training_curve
from experiments.runtime import expect_compiling
from experiments.signals import Stopped, asked_to_stop, farewell
from experiments.store import runs
from experiments.store.metrics import METRICS, Metrics, check_loggers, salvaged_rows
from experiments.store.provenance import provenance
from experiments.store.settings import (
    NO_WORLD,
    PretrainConfig,
    check_initial,
    initial_folder,
    mend_initial,
)
from experiments.training_data import own_dataset, prepare_dataset
from mgpo_jax import processes
from mgpo_jax.archives import let_go
from mgpo_jax.checkpoint import (
    Snapshot,
    checkpoints,
    hash_state,
    restore_state,
    save_state,
    state_of_first,
)
from mgpo_jax.claims import claimed
from mgpo_jax.dataset import BatchPlan, Dataset, spec_of
from mgpo_jax.files import remove_unfinished, to_json, written
from mgpo_jax.kinds import KINDS, MULTI_GOAL, kind_of
from mgpo_jax.lanes import together
from mgpo_jax.manifest import read_facts
from mgpo_jax.optimizers.methods import judged_query
from mgpo_jax.policy import LoadedPolicy, transformer_policy
from mgpo_jax.policy_files import MEND, read_policy, save_policy
from mgpo_jax.progress import Progress
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import rollout
from mgpo_jax.seen_goals import seen_in
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh, devices_for, fetch
from mgpo_jax.tasks import EVAL_SEED, evaluation_tasks
from mgpo_jax.training import (
    ASKED,
    Trainer,
    TrainState,
    batch_stream,
    diverged,
    finite_metrics,
    learning_rate_schedule,
)
from mgpo_jax.transformer import NetworkConfig, TransformerConfig, world_side

CONSTANT = 1e-4  # below this standard deviation a component of an observation stays unscaled
PERFECT = 1e-3  # a demonstration whose return is this near to the optimum counts as perfect


def initial_policy(config: PretrainConfig, spec: EnvSpec) -> LoadedPolicy | None:
    """The policy that a run starts from; None if it starts from random weights.

    Raises:
      UsageError: if there is none at its place, or the settings contradict its network.
      DataError: if it is damaged, of another world, or not the one that a resumed run started from.
    """
    if config.init is None:
        return None
    try:
        policy = read_policy(initial_folder(config), spec, config.method)
    except DataError as error:
        raise DataError(str(error).replace(MEND, mend_initial(config))) from None
    if (found := kind_of(policy.config).name) != config.method:
        raise UsageError(
            f"--method {config.method} cannot start from {config.init}, a network of the kind {found}"
        )
    runs.check_same_start(config, policy.sha256)
    check_initial(config)
    return policy


def configured_network(
    config: PretrainConfig,
    env: Environment | None,
    dataset: Dataset,
    init: LoadedPolicy | None = None,
    spec: EnvSpec | None = None,
) -> Any:
    """The network of a run: that of the policy it starts from, or one of the settings both configs have.

    Where there is no world, ``spec`` says what the data is like.
    """
    if init is not None:
        return replace(init.config, dropout=config.dropout)
    spec = env.spec if env is not None else spec
    assert spec is not None
    learned = KINDS.find(config.method).load()
    network = learned.complete(sized_network(config, spec), env, dataset)
    if not config.standardize_obs:
        return network
    mean, std = moments(dataset.obs)
    std = np.where(std < CONSTANT, 1.0, std)
    return replace(network, obs_mean=tuple(mean.tolist()), obs_std=tuple(std.tolist()))


def sized_network(config: PretrainConfig, spec: EnvSpec) -> Any:
    """The network of the settings, without what follows from the data."""
    learned = KINDS.find(config.method).load()
    common = {f.name for f in fields(learned.config)} & {f.name for f in fields(PretrainConfig)}
    sizes = {name: getattr(config, name) for name in common}
    return learned.config(**{**sizes, **world_side(spec, config.head, config.encoder)})


def moments(obs: np.ndarray, piece: int = 1 << 24) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of every component of observations, float64 [D].

    They are added up in the order of the rows, ``piece`` numbers at a time: the result has the bits of
    ``numpy.mean`` and ``numpy.std`` where D is above 1, and needs little memory beside a mapped array.

    Args:
      obs: observations [N, ...].
      piece: how many numbers are converted at once.
    """
    size = int(np.prod(obs.shape[1:], dtype=np.int64))
    step = max(1, piece // size)

    def total(of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        found = np.zeros(size)
        for first in range(0, len(obs), step):
            rows = of(np.asarray(obs[first : first + step]).reshape(-1, size).astype(np.float64))
            found = np.add.reduce(np.concatenate([found[None], rows]), axis=0)
            let_go(obs)
        return found

    mean = total(lambda rows: rows) / len(obs)
    return mean, np.sqrt(total(lambda rows: np.square(rows - mean)) / len(obs))


class ReturnsOnTheWay:
    """Mean returns on tasks of its own, none of them a test task, where the data were collected.

    The policy acts as the world judges, greedily unless its record says otherwise, in one episode a task.

    ``initial`` is the return of the prompt (g^M); ``followed`` that of a prompt drawn from a perfect
    demonstration of the task, which says how well the policy does what a good prompt tells it. The latter
    is missing where most demonstrations are not perfect (in mazes the demonstrator goes after goals of its
    own) and where the optimum is unknown. Where the world has variants, each has its own mean as well.
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
            assert demonstrator is not None  # else nothing is demonstrated
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
        # Elsewhere nobody demonstrates, or nobody knows which demonstrations are perfect.
        if demonstrator is not None and np.isfinite(self.optimum).all():
            demonstrate = together(place, demonstrated, in_axes=(0, 0, 0, None))
            self._followed, returns = demonstrate(
                self.keys[0], self.keys[1], self.tasks, demonstrator.weights
            )
            self._perfect = np.asarray(returns > self.optimum - PERFECT)

    def __call__(self, params: Any) -> dict[str, float]:
        """The numbers for some weights."""
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
        """The mean of what counts, of all tasks and of those of each variant."""
        groups = {"": counts, **{tail: counts & one for tail, one in self._variants.items()}}
        return {name + tail: float(values[one].mean()) for tail, one in groups.items() if one.any()}


def _variants(demonstrator: Demonstrator | None, tasks: Task) -> dict[str, np.ndarray]:
    """Which tasks are of which variant of the world, by the ends of the names of metrics."""
    if demonstrator is None:
        return {}
    variants = np.asarray(jax.vmap(demonstrator.variant)(tasks))
    return {f"_{name}": variants == index for index, name in enumerate(demonstrator.variants)}


class ReturnsByItself:
    """Mean returns of a network that follows no prompts, as its kind says, on tasks of its own."""

    def __init__(self, world: World, env: Environment, network: NetworkConfig, num: int) -> None:
        agent = kind_of(network).load().agent
        assert agent is not None  # as ``watched`` sees to
        self._tasks = evaluation_tasks(env, num, world.num_test_tasks)
        self._keys = jax.random.split(jax.random.key(EVAL_SEED), num)

        def return_of(params: Any, key: PRNGKeyArray, task: Task) -> Array:
            acting = agent(network, params, world.judged)
            return run_episode(key, env, acting, task).return_

        self._returns = together(env, return_of, in_axes=(None, 0, 0))

    def __call__(self, params: Any) -> dict[str, float]:
        """The numbers for some weights."""
        returns = self._returns(params, self._keys, self._tasks)
        return {"eval/initial_return": float(np.mean(returns))}


def watched(
    world: World,
    env: Environment,
    network: NetworkConfig,
    demonstrator: Demonstrator | None,
    num: int,
) -> Callable[[Any], dict[str, float]]:
    """``(params) -> returns`` that a training watches on ``num`` tasks."""
    if isinstance(network, TransformerConfig) and kind_of(network).name == MULTI_GOAL:
        return ReturnsOnTheWay(world, env, network, demonstrator, num)
    return ReturnsByItself(world, env, network, num)


class Run:
    """A training under way: its data, its trainer and what measures it.

    Whoever makes it holds the claim on its folder, where it notes the settings of a run that begins.
    """

    def __init__(self, config: PretrainConfig, go_on: str) -> None:
        self.config, self.folder = config, config.folder
        env = None if config.env == NO_WORLD else envs.make(config.env)
        own = config.data.data_folder
        spec = env.spec if env is not None else spec_of(read_facts(own or Path()))
        self.init = init = initial_policy(config, spec)
        world_side(spec, config.head, config.encoder)  # complains about a bad head or encoder
        check_loggers(config)
        meta = provenance()
        dataset, place, sha256 = (
            prepare_dataset(config, envs.find(config.env), env, go_on)
            if own is None and env is not None
            else own_dataset(config, env)
        )
        self.network = configured_network(config, env, dataset, init, spec)
        self.mesh = device_mesh(devices_for(config.train.part_size))
        cut = len(dataset) - config.holdout
        self.fit, held_out = dataset.slice(0, cut), dataset.slice(cut, len(dataset))
        self.trainer = Trainer(config.train, self.network, self.fit, self.mesh)
        self._held_out = held_out
        self.truncate = spec.truncate_in_hindsight
        longest = spec.horizon if own is None else int(dataset.lengths.max())
        self._held_out_parts = self._validation_parts(held_out, longest)
        init_sha256 = init.sha256 if init else ""
        self.identity = runs.identity(config, sha256, init_sha256)
        self.identities = [self.identity]
        self._returns_on_the_way: Callable[[Any], dict[str, float]] = lambda params: {}
        processes.check_agreed({"the dataset's hash": sha256, "the hash of --init": init_sha256})
        if processes.is_first():
            meta = {**meta, "dataset": str(place), "dataset_sha256": sha256, **self.origin}
            if begun := runs.has_begun(self.folder):
                runs.check_same(config, meta)
            expect_compiling()
            self._returns_on_the_way = self._watched(env)
            self._note(meta, begun)
            self.identities = runs.identities(config, sha256, init_sha256)

    def _note(self, meta: dict[str, Any], begun: bool) -> None:
        """Note in the folder what the run is, after everything that could be wrong with the settings."""
        config = self.config
        if not begun:
            runs.begin(config, meta)
            return
        runs.keep_initial(config, meta)
        if (trained := runs.prolonged(config)) is not None:
            runs.note_prolonged(config, trained)
            kept = runs.kept_policy(self.folder, trained)
            text = _how_it_goes_on(config.train, trained)
            print(f"{text}; the policy so far is kept in {kept}", file=sys.stderr)

    def _watched(self, env: Environment | None) -> Callable[[Any], dict[str, float]]:
        """What is measured in the world on the way; nothing where there is none."""
        if env is None:
            return lambda params: {}
        config, world = self.config, envs.find(self.config.env)
        own = config.data.data_folder is not None
        demonstrator = (
            None
            if own and not world.demonstrators(env)
            else find_demonstrator(world, env, config.data.demonstrator)[1]
        )
        return watched(world, env, self.network, demonstrator, config.eval_tasks)

    @property
    def origin(self) -> dict[str, str]:
        """What the files of the run say of the weights that it started from."""
        return {"init_sha256": self.init.sha256} if self.init else {}

    def initial_state(self) -> TrainState:
        """The state before the first step."""
        return self.trainer.init(self.init.params if self.init else None)

    def _validation_parts(self, held_out: Dataset, horizon: int) -> list[BatchPlan]:
        """Draws of one padded length; the validation loss is of the same ones every time."""
        plan = replace(
            self.config.train, batch_size=512, part_size=64, part_steps=1 << 30, bucket=horizon
        )
        return next(batch_stream(plan, held_out, self.truncate))

    def measure(self, state: TrainState) -> dict[str, float]:
        """Losses on held-out trajectories and returns.

        Raises:
          DataError: if one of them is not finite.
        """
        held = self.trainer.evaluate(state.params, self._held_out_parts, self._held_out)
        found = {
            **{f"val/{k}": v for k, v in held.items()},
            **self._returns_on_the_way(state.params),
        }
        for name, value in found.items():
            if not np.isfinite(value):
                raise diverged(state.step, name, value)
        return found

    def batches(self, first_step: int) -> Iterator[list[BatchPlan]]:
        """The batches of the run from a step on."""
        return batch_stream(
            self.config.train,
            self.fit,
            self.truncate,
            self.mesh.devices.size * processes.count(),
            first_step=first_step,
        )


def train(config: PretrainConfig, go_on: str = "continue with --resume") -> None:
    """Run or continue a training to its end and write the policy.

    Args:
      config: settings of the run.
      go_on: what continues it after a stop, for messages.

    Raises:
      Stopped: if it was asked to stop; the state is saved.
      DataError: if a loss, weight or return is not finite; the last sound checkpoint is kept.
    """
    folder = config.folder
    with (
        claimed(folder) if processes.is_first() else nullcontext(),
        farewell(lambda: f"stopped; {go_on}" if runs.has_begun(folder) else ""),
    ):
        if processes.from_first(lambda: _has_ended(config)):
            print(f"{folder} is finished already", file=sys.stderr)
            return
        run = Run(config, go_on)
        if processes.is_first():
            _train_and_save(run, go_on)
        else:
            _train_along(run, go_on)


def _has_ended(config: PretrainConfig) -> bool:
    """Whether a run needs no more steps; its folder is made ready for them otherwise."""
    folder = config.folder
    remove_unfinished(folder)
    if runs.has_begun(folder):
        runs.check_start(config)
        return runs.is_finished(folder) and runs.prolonged(config) is None
    return False


def _train_and_save(run: Run, go_on: str) -> None:
    """The steps of a training, and everything that is written."""
    config, folder = run.config, run.folder
    with checkpoints(folder / runs.CHECKPOINTS) as manager:
        blank = run.initial_state()
        before = restore_state(manager, blank, run.identities) if config.resume else None
        before = before or Snapshot(blank, [], [])
        rows = before.measured
        if rows is None:  # a checkpoint of an older version
            rows = salvaged_rows(folder / METRICS, before.state.step)
        if config.resume:
            print(f"resuming {folder} at step {before.state.step}", file=sys.stderr)
        metrics = Metrics(folder, config, rows)
        before = before._replace(state=state_of_first(before.state, blank))
        with asked_to_stop() as stopping:
            state = _take_steps(run, before, metrics, manager, stopping, go_on)
    made = {"env": config.env, "config": to_json(config), "steps": state.step, **run.origin}
    policy = folder / runs.POLICY
    seen = seen_in(run.fit, run.init.seen_goals if run.init else None)
    save_policy(policy, run.network, state.params, made, seen)
    with written(folder / runs.PICTURE) as picture:
        training_curve(metrics.rows).savefig(picture)
    print(f"policy written to {policy}", file=sys.stderr)


def _train_along(run: Run, go_on: str) -> None:
    """The steps of a training in a process that is not the first: the same ones, and nothing is written."""
    state = state_of_first(None, run.initial_state())
    with asked_to_stop() as stopping:
        _take_steps(run, Snapshot(state, [], []), None, None, stopping, go_on)


def _how_it_goes_on(config: TrainConfig, trained: int) -> str:
    """What a finished run does that takes more steps, in words.

    Its learning rate is that of a run of the new length from the start, so that it usually rises.
    """
    rate = float(learning_rate_schedule(config)(trained))
    falls = "falls along the same cosine" if config.schedule == "cosine" else "stays there"
    return (
        f"the run has {trained:,} steps and goes on to {config.steps:,}: the learning rate is that of a "
        f"training of {config.steps:,} steps, {rate:.3g} at first, and {falls}"
    )


def _take_steps(
    run: Run,
    before: Snapshot,
    metrics: Metrics | None,
    manager: Any,
    stopping: Callable[[], int],
    go_on: str,
) -> TrainState:
    """All gradient steps that are left, with checkpoints and evaluations on the way.

    Without ``metrics`` and ``manager`` nothing is measured or saved: process 0 does it.
    """
    config, num_steps, state = run.config, run.config.train.steps, before.state
    batches = run.batches(state.step)
    # Means are taken in float32, also of what comes from a checkpoint.
    pending = [{k: np.float32(v) for k, v in row.items()} for row in before.pending]
    newest: list[tuple[int, dict[str, Array]]] = []  # the step whose figures are not looked at yet
    clock, since = time.process_time(), state.step
    with Progress(num_steps, "step", initial=state.step) as progress:
        while state.step < num_steps:
            asked = (stopping(),) if processes.count() > 1 else ()  # told to the others
            state, row = run.trainer.step(state, next(batches), *asked)
            known, newest = newest, [(state.step, row)]
            pending += [finite_metrics(*step) for step in known]  # computed by now: no waiting
            progress.update()
            number, done = _agreed(stopping(), known), state.step == num_steps
            saves = number or done or state.step % config.save_every == 0
            measures = done or state.step % config.eval_every == 0
            if saves or measures:
                pending += [finite_metrics(*step) for step in newest]
                newest = []
            if measures:
                spent = processes.total(time.process_time() - clock) / (state.step - since)
                _check_together(state)
                if metrics is not None:
                    means = {**_means(pending), **run.measure(state)}
                    metrics.write(state.step, {**means, "cpu_seconds_per_step": spent})
                    progress.show(_shown(means))
                pending, clock, since = [], time.process_time(), state.step
            if saves and metrics is not None:
                left = [{k: float(v) for k, v in row.items()} for row in pending]
                save_state(manager, Snapshot(state, metrics.rows, left), run.identity)
            if number and not done:
                progress.close()
                text = f"stopped at step {state.step} of {num_steps}; {go_on}"
                raise Stopped(text, number)
    return state


def _agreed(number: int, newest: Sequence[tuple[int, dict[str, Array]]]) -> int:
    """The number of the signal that stops the training after this step, or 0.

    A process by itself stops at once. Of several processes, each tells with its gradient whether it is
    asked to stop; all read this one step later, when it is known, and stop after the same step.
    """
    if processes.count() == 1:
        return number
    asked = any(fetch(row[ASKED]) > 0 for _, row in newest)
    return (number or signal.SIGTERM) if asked else 0


def _check_together(state: TrainState) -> None:
    """Raise ``DisagreementError`` if processes that train together have drifted apart.

    Processors of different kinds run different programs, whose last bits differ.
    """
    if processes.count() > 1:
        processes.check_agreed({f"the hash of the weights at step {state.step}": hash_state(state)})


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    return {f"train/{name}": float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _shown(row: dict[str, float]) -> dict[str, str]:
    """What the progress shows of a row of metrics."""
    returns = {
        name.removeprefix("eval/").removesuffix("_return"): f"{value:.2f}"
        for name, value in row.items()
        if name.startswith("eval/") and name.endswith("_return")
    }
    return {"loss": f"{row['train/loss']:.3f}", "val": f"{row['val/loss']:.3f}", **returns}
