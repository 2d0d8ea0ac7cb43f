"""Pre-training runs from the dataset to the trained policy: gradient steps, checkpoints and metrics."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

import envs
from envs.base import Environment
from experiments.demonstrators import find_demonstrator
from experiments.figures import training_curve
from experiments.networks import configured_network, initial_policy
from experiments.runtime import Compiling
from experiments.signals import Stopped, asked_to_stop, farewell
from experiments.store import runs
from experiments.store.metrics import METRICS, Metrics, check_loggers, salvaged_rows
from experiments.store.provenance import provenance
from experiments.store.recipes import schedule
from experiments.store.settings import NO_WORLD, PretrainConfig
from experiments.training_data import own_dataset, prepare_dataset
from experiments.watching import watched
from mgpo_jax import processes
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
from mgpo_jax.kinds import KINDS
from mgpo_jax.manifest import read_facts
from mgpo_jax.network_configs import world_side
from mgpo_jax.policy_files import save_policy
from mgpo_jax.progress import Progress
from mgpo_jax.seen_goals import seen_in
from mgpo_jax.settings import TrainConfig
from mgpo_jax.sharding import device_mesh, devices_for, fetch
from mgpo_jax.training import ASKED, Trainer, TrainState, batch_stream, diverged, finite_metrics
from mgpo_jax.weight_updates import learning_rate_schedule


class Run:
    """A training in progress: its data, its trainer and its evaluation.

    The caller must hold the claim on the run's folder, to which a new run writes its settings.
    """

    def __init__(self, config: PretrainConfig, go_on: str) -> None:
        self.config, self.folder = config, config.folder
        env = None if config.env == NO_WORLD else envs.make(config.env)
        own = config.data.data_folder
        spec = env.spec if env is not None else spec_of(read_facts(own or Path()))
        self.init = init = initial_policy(config, spec)
        world_side(spec, config.head, config.encoder)  # raises for a bad head or encoder
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
            self._compiling.announce()
            self._returns_on_the_way = self._watched(env)
            self._note(meta, begun)
            self.identities = runs.identities(config, sha256, init_sha256)

    @property
    def _compiling(self) -> Compiling:
        """What decides the programs of the run, for the announcement that they are compiled."""
        config, plan = self.config, self.config.train
        sizes = [plan.batch_size, plan.part_size, plan.part_steps, plan.bucket, config.eval_tasks]
        facts = {"env": config.env, "network": to_json(self.network), "sizes": sizes}
        kind = {"command": "pretrain", "method": config.method, "optimizer": plan.optimizer}
        return Compiling(f"{config.method} in {config.env}", {**kind, **facts})

    def _note(self, meta: dict[str, Any], begun: bool) -> None:
        """Write down in the folder what the run is; called after all settings have been checked."""
        config = self.config
        if not begun:
            runs.begin(config, meta)
            return
        runs.keep_initial(config, meta)
        if (trained := runs.prolonged(config)) is not None:
            runs.note_prolonged(config, trained)
            kept = runs.kept_policy(self.folder, trained)
            text = _describe_continuation(config.train, trained)
            print(f"{text}; the policy so far is kept in {kept}", file=sys.stderr)

    def _watched(self, env: Environment | None) -> Callable[[Any], dict[str, float]]:
        """The evaluation in the world during training; without a world it measures nothing."""
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
        """The entry on the initial weights in the files of the run."""
        return {"init_sha256": self.init.sha256} if self.init else {}

    def initial_state(self) -> TrainState:
        """The state before the first step."""
        return self.trainer.init(self.init.params if self.init else None)

    def _validation_parts(self, held_out: Dataset, horizon: int) -> list[BatchPlan]:
        """Batches of one padded length for the validation loss; the same ones every time."""
        plan = replace(
            self.config.train, batch_size=512, part_size=64, part_steps=1 << 30, bucket=horizon
        )
        return next(batch_stream(plan, held_out, self.truncate))

    def measure(self, state: TrainState) -> dict[str, float]:
        """The losses on held-out trajectories, and the returns of the evaluation.

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
        self._compiling.done()
        return found

    def batches(self, first_step: int) -> Iterator[list[BatchPlan]]:
        """The batches of the run, starting at ``first_step``."""
        return batch_stream(
            self.config.train,
            self.fit,
            self.truncate,
            self.mesh.devices.size * processes.count(),
            first_step=first_step,
        )


def train(config: PretrainConfig, go_on: str = "continue with --resume") -> None:
    """Run or continue a training to its end, and write the policy.

    Args:
      config: settings of the run.
      go_on: how to continue after an interruption, for messages.

    Raises:
      Stopped: if it was asked to stop; the state is saved first.
      DataError: if a loss, weight or return is not finite; the last sound checkpoint is kept.
    """
    folder = config.folder
    with (
        claimed(folder) if processes.is_first() else nullcontext(),
        farewell(lambda: f"stopped; {go_on}" if runs.has_begun(folder) else ""),
    ):
        if processes.from_first(lambda: _has_ended(config)):
            print(f"{folder} is already finished", file=sys.stderr)
            return
        run = Run(config, go_on)
        if processes.is_first():
            _train_and_save(run, go_on)
        else:
            _train_along(run, go_on)


def _has_ended(config: PretrainConfig) -> bool:
    """Whether a run needs no more steps; otherwise prepares its folder for them."""
    folder = config.folder
    remove_unfinished(folder)
    if runs.has_begun(folder):
        runs.check_start(config)
        return runs.is_finished(folder) and runs.prolonged(config) is None
    return False


def _train_and_save(run: Run, go_on: str) -> None:
    """Take the steps of a training, and write checkpoints, metrics, the policy and its curve."""
    config, folder = run.config, run.folder
    blank = run.initial_state()
    found = _snapshot_to_resume(run, blank)
    if found is not None:
        print(f"resuming {folder} at step {found.state.step}", file=sys.stderr)
    elif config.data.data_folder is None:  # that of own data was printed with the recipe
        print(schedule(config), file=sys.stderr)
    before = found or Snapshot(blank, [], [])
    rows = before.measured
    if rows is None:  # a checkpoint of an older version
        rows = salvaged_rows(folder / METRICS, before.state.step)
    metrics = Metrics(folder, config, rows)
    before = before._replace(state=state_of_first(before.state, blank))
    state = _train_together(run, before, metrics, go_on)
    made = {"env": config.env, "config": to_json(config), "steps": state.step, **run.origin}
    policy = folder / runs.POLICY
    seen = seen_in(run.fit, run.init.seen_goals if run.init else None)
    save_policy(policy, run.network, state.params, made, seen)
    with written(folder / runs.PICTURE) as picture:
        training_curve(metrics.rows, KINDS.find(config.method).watched).savefig(picture)
    print(f"policy written to {policy}", file=sys.stderr)


def _train_along(run: Run, go_on: str) -> None:
    """Take the steps of a training in a process other than 0, which writes nothing."""
    state = state_of_first(None, run.initial_state())
    _train_together(run, Snapshot(state, [], []), None, go_on)


def _snapshot_to_resume(run: Run, blank: TrainState) -> Snapshot | None:
    """The newest checkpoint of a run that is resumed, read by process 0 alone; None if there is none."""
    if not run.config.resume:
        return None
    with processes.apart(), checkpoints(run.folder / runs.CHECKPOINTS) as manager:
        return restore_state(manager, blank, run.identities)


def _train_together(run: Run, before: Snapshot, metrics: Metrics | None, go_on: str) -> TrainState:
    """Take the remaining steps in each process, until they are done or one of them is asked to stop."""
    with checkpoints(run.folder / runs.CHECKPOINTS) as manager, asked_to_stop() as stopping:
        return _take_steps(run, before, metrics, manager, stopping, go_on)


def _describe_continuation(config: TrainConfig, trained: int) -> str:
    """A message on how a finished run continues with more steps.

    Its learning rate follows the schedule of a run of the new length, so it usually rises at first.
    """
    rate = float(learning_rate_schedule(config)(trained))
    falls = "falls along the same cosine" if config.schedule == "cosine" else "stays there"
    return (
        f"the run has {trained:,} steps and continues to {config.steps:,}: the learning rate is that of a "
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
    """Take the remaining gradient steps, with checkpoints and evaluations in between.

    Without ``metrics`` nothing is measured; process 0 does that, and the others wait until it has. All
    processes save checkpoints together.
    """
    config, num_steps, state = run.config, run.config.train.steps, before.state
    batches = run.batches(state.step)
    # Means are taken in float32, also over values from a checkpoint.
    pending = [{k: np.float32(v) for k, v in row.items()} for row in before.pending]
    newest: list[tuple[int, dict[str, Array]]] = []  # the last step, whose metrics are not read yet
    clock, since = time.process_time(), state.step
    with Progress(num_steps, "step", initial=state.step) as progress:
        while state.step < num_steps:
            asked = (stopping(),) if processes.count() > 1 else ()  # passed on to the others
            state, row = run.trainer.step(state, next(batches), *asked)
            known, newest = newest, [(state.step, row)]
            pending += [finite_metrics(*step) for step in known]  # already computed: no waiting
            progress.update()
            number, done = _stop_signal(stopping(), known), state.step == num_steps
            saves = number or done or state.step % config.save_every == 0
            measures = done or state.step % config.eval_every == 0
            if saves or measures:
                pending += [finite_metrics(*step) for step in newest]
                newest = []
            if measures:
                spent = processes.total(time.process_time() - clock) / (state.step - since)
                _check_same_weights(state)
                if metrics is not None:
                    means = {**_means(pending), **run.measure(state)}
                    metrics.write(state.step, {**means, "cpu_seconds_per_step": spent})
                    progress.show(_progress_fields(means))
                pending, clock, since = [], time.process_time(), state.step
            if saves or measures:
                processes.exchange(b"")  # waits for an evaluation, longer than Orbax and Gloo would
            if saves:
                left = [{k: float(v) for k, v in row.items()} for row in pending]
                rows = [] if metrics is None else metrics.rows
                save_state(manager, Snapshot(state, rows, left), run.identity)
                # The others wait here, where a request to stop cannot end them before all is saved.
                processes.exchange(b"")
            if number and not done:
                progress.close()
                text = f"stopped at step {state.step} of {num_steps}; {go_on}"
                raise Stopped(text, number)
    return state


def _stop_signal(number: int, newest: Sequence[tuple[int, dict[str, Array]]]) -> int:
    """The number of the signal that stops the training after this step, or 0.

    A single process stops at once. Several processes exchange with their gradients whether any of them is
    asked to stop. All read this one step later, when it is computed, and stop after the same step.
    """
    if processes.count() == 1:
        return number
    asked = any(fetch(row[ASKED]) > 0 for _, row in newest)
    return (number or signal.SIGTERM) if asked else 0


def _check_same_weights(state: TrainState) -> None:
    """Raise ``DisagreementError`` if the weights of the processes have drifted apart.

    Different kinds of processors run different programs, whose results differ in the last bits.
    """
    if processes.count() > 1:
        processes.check_agreed(
            {f"the hash of the weights at step {state.step}": hash_state(state)},
            "continue with --resume on processors of one kind; on GPUs, leave --xla_gpu_autotune_level=0 "
            "in XLA_FLAGS, since programs that XLA chooses by timing them compute different last bits",
        )


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    return {f"train/{name}": float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _progress_fields(row: dict[str, float]) -> dict[str, str]:
    """The metrics of a row that the progress line shows."""
    returns = {
        name.removeprefix("eval/").removesuffix("_return"): f"{value:.2f}"
        for name, value in row.items()
        if name.startswith("eval/") and name.endswith("_return")
    }
    return {"loss": f"{row['train/loss']:.3f}", "val": f"{row['val/loss']:.3f}", **returns}
