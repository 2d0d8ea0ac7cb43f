"""Pre-train a policy: ``python -m experiments.pretrain --env maze15``."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from envs.base import Demonstrator, Environment
from experiments.collect import CollectConfig, dataset_folder, find_demonstrator
from experiments.collect import main as collect_main
from experiments.configs import PretrainConfig, make_env, positive, pretrain_default
from experiments.runtime import jit_with, provenance, refuse_existing, run, to_json, write_json
from experiments.tasks import EVAL_SEED, benchmark_tasks, evaluation_tasks, task_hashes
from mgpo_jax.adapt import evaluate
from mgpo_jax.checkpoint import (
    checkpoints,
    network_config,
    restore_state,
    save_policy,
    save_state,
)
from mgpo_jax.dataset import Dataset, load_dataset
from mgpo_jax.errors import DataError, UsageError
from mgpo_jax.policy import transformer_policy
from mgpo_jax.pretrain import batch_stream, make_trainer
from mgpo_jax.prompts import sample_prompt, single_goal
from mgpo_jax.rollout import run_episode
from mgpo_jax.sharding import device_mesh, largest_divisor
from mgpo_jax.transformer import TransformerConfig
from mgpo_jax.types import Prompt

LANES = "lanes"
CONSTANT = 1e-4  # standard deviation of an observation's component that does not count as varying


class Metrics:
    """Appends rows to ``metrics.jsonl`` and, if asked, to TensorBoard and Weights & Biases."""

    def __init__(self, folder: Path, config: PretrainConfig, first_step: int) -> None:
        self.path = folder / "metrics.jsonl"
        rows = self.path.read_text().splitlines() if self.path.exists() else []
        # A resumed run writes again what came after its checkpoint.
        kept = [row for row in rows if json.loads(row)["step"] <= first_step]
        self.path.write_text("".join(row + "\n" for row in kept))
        self.writers: list[Callable[[dict[str, float], int], Any]] = []
        if config.tb:
            board = _optional("tensorboardX", "tb").SummaryWriter(str(folder / "tensorboard"))
            self.writers.append(
                lambda row, step: [board.add_scalar(k, v, step) for k, v in row.items()]
            )
        if config.wandb:
            wandb = _optional("wandb", "wandb")
            wandb.init(project="mgpo-jax", name=str(folder), config=to_json(config))
            self.writers.append(lambda row, step: wandb.log(row, step=step))

    def write(self, step: int, row: dict[str, float]) -> None:
        with open(self.path, "a") as file:
            file.write(json.dumps({"step": step, **row}) + "\n")
        for writer in self.writers:
            writer(row, step)


def _optional(module: str, extra: str) -> Any:
    try:
        return __import__(module)
    except ImportError:
        raise UsageError(f'{module} is not installed; run `pip install -e ".[{extra}]"`') from None


def configured_network(
    config: PretrainConfig, env: Environment, dataset: Dataset
) -> TransformerConfig:
    """The network of a run: its settings are those that both configs have."""
    common = {f.name for f in fields(TransformerConfig)} & {f.name for f in fields(PretrainConfig)}
    network = network_config(env.spec, **{name: getattr(config, name) for name in common})
    if not config.standardize_obs:
        return network
    mean = dataset.obs.mean(axis=0, dtype=np.float64)
    std = dataset.obs.std(axis=0, dtype=np.float64)
    std = np.where(std < CONSTANT, 1.0, std)
    return replace(network, obs_mean=tuple(mean.tolist()), obs_std=tuple(std.tolist()))


def prepare_dataset(config: PretrainConfig, env: Environment) -> Dataset:
    """The run's dataset, collected first where it is not there yet; no test task is in it."""
    policy, demonstrator = find_demonstrator(env, config.data.demonstrator)
    wanted = CollectConfig(
        env=env.spec.name,
        policy=policy,
        episodes=config.data.episodes,
        seed=config.data.data_seed,
    )
    folder = dataset_folder(wanted, policy)
    if not folder.exists():
        print(f"no dataset in {folder} yet: collecting {wanted.episodes} episodes", file=sys.stderr)
        collect_main(wanted)
    dataset, manifest = load_dataset(folder, env.spec)
    settings, made_with = dict(demonstrator.settings), manifest.get("settings", {})
    if made_with != settings:
        raise DataError(
            f"{folder} was collected by the demonstrator with {made_with or 'no settings'}, which now "
            f"has {settings or 'none'}; remove it, and it is collected again"
        )
    if np.isin(dataset.task_hashes, task_hashes(env, benchmark_tasks(env))).any():
        raise DataError(f"{folder} holds a test task; remove it and collect it again")
    if config.holdout >= len(dataset):
        raise UsageError(
            f"--holdout {config.holdout} leaves nothing of {len(dataset)} trajectories"
        )
    return dataset


def greedy_evaluation(
    env: Environment, network: TransformerConfig, demonstrator: Demonstrator, num: int
) -> Callable[[Any], dict[str, float]]:
    """``params -> mean greedy returns`` on ``num`` tasks of its own.

    ``initial`` is that of the prompt (g^M), with its regret; ``followed`` that of a prompt drawn from a
    perfect demonstration of the task, which says how well the policy does what a good prompt tells it. It
    is missing where most are not perfect: in mazes the demonstrator goes after goals of its own.
    """
    tasks = evaluation_tasks(env, num)
    optimum = jax.jit(jax.vmap(env.optimal_return))(tasks)
    keys = jax.random.split(jax.random.key(EVAL_SEED), (3, num))
    num_slots = network.max_prompt_length

    @jit_with(env)
    @partial(jax.vmap, axis_name=LANES)
    def demonstrated(key: jax.Array, key_prompt: jax.Array, task: Any) -> tuple[Prompt, jax.Array]:
        episode = run_episode(key, env, demonstrator.agent, task, LANES)
        trajectory = episode.trajectory
        confirmed = trajectory.goal_reached & (episode.rewards > 0)
        kept = confirmed if env.spec.reward_confirms_goals else None
        prompt = sample_prompt(key_prompt, trajectory, env.task_goal(task), num_slots, kept=kept)
        return prompt, episode.return_

    @jit_with(env)
    @partial(jax.vmap, in_axes=(None, 0, 0, 0), axis_name=LANES)
    def returns(params: Any, key: jax.Array, task: Any, prompt: Prompt) -> jax.Array:
        policy = transformer_policy(network, params)
        return evaluate(key, env, policy, task, prompt, LANES).return_

    initial = jax.vmap(lambda task: single_goal(env.task_goal(task), num_slots))(tasks)
    followed, demonstrated_returns = demonstrated(keys[0], keys[1], tasks)
    perfect = np.asarray(demonstrated_returns > optimum - 1e-3)

    def measure(params: Any) -> dict[str, float]:
        of_initial = returns(params, keys[2], tasks, initial)
        found = {
            "eval/initial_return": float(of_initial.mean()),
            "eval/initial_regret": float(jnp.mean(optimum - of_initial)),
        }
        if perfect.mean() > 0.5:
            of_followed = np.asarray(returns(params, keys[2], tasks, followed))
            found["eval/followed_return"] = float(of_followed[perfect].mean())
        return found

    return measure


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
    """The run folder: a new one, or with ``--resume`` one made with the same settings."""
    folder = config.folder
    saved = folder / "config.json"
    if not config.resume:
        folder.mkdir(parents=True)
        write_json(saved, config)
        write_json(folder / "meta.json", provenance())
        return folder
    if not saved.is_file():
        raise UsageError(f"no run to resume in {folder}; start it without --resume")
    try:
        before = json.loads(saved.read_text())
    except ValueError:
        raise DataError(f"{saved} is not readable JSON") from None
    now = to_json(replace(config, resume=False, debug=False))
    before = {**to_json(PretrainConfig()), **before, "debug": False}
    changed = [f"{name} {before[name]} -> {now[name]}" for name in now if now[name] != before[name]]
    if changed:
        raise UsageError(f"{folder} was started with other settings: {'; '.join(changed)}")
    return folder


def main(config: PretrainConfig) -> None:
    """Pre-train the multi-goal Transformer on hindsight prompts."""
    positive(config.data, "episodes")
    positive(config.train, "steps", "batch_size", "part_size", "part_steps", "bucket")
    positive(config, "max_prompt_length", "eval_tasks", "eval_every", "save_every", "holdout")
    if not 0 <= config.train.obs_noise < math.inf:
        raise UsageError(
            f"--obs-noise must be finite and not negative, found {config.train.obs_noise}"
        )
    if config.train.batch_size % config.train.part_size:
        raise UsageError(
            f"--batch-size {config.train.batch_size} is not a multiple of --part-size "
            f"{config.train.part_size}"
        )
    if not config.resume:
        refuse_existing(config.folder, "continue it with --resume", "choose another with --out")
    env = make_env(config.env)
    network_config(env.spec, config.head)  # complains about a head that does not fit
    dataset = prepare_dataset(config, env)
    network = configured_network(config, env, dataset)
    folder = open_run(config)

    train = config.train
    mesh = device_mesh(largest_divisor(train.part_size, len(jax.devices())))
    fit, held_out = (
        dataset.slice(0, len(dataset) - config.holdout),
        dataset.slice(len(dataset) - config.holdout, len(dataset)),
    )
    trainer = make_trainer(train, network, fit, mesh)
    validate = make_trainer(train, network, held_out, mesh).evaluate
    _, demonstrator = find_demonstrator(env, config.data.demonstrator)
    evaluate_greedily = greedy_evaluation(env, network, demonstrator, config.eval_tasks)
    # Two batches of one padded length: the validation loss is of the same draws every time.
    part = replace(train, batch_size=512, part_size=64, part_steps=1 << 30, bucket=env.spec.horizon)
    truncate = env.spec.truncate_in_hindsight
    held_out_parts = next(batch_stream(part, held_out, truncate))

    with checkpoints(folder / "checkpoints") as manager, stop_request() as stopping:
        state = trainer.init()
        if config.resume:
            state = restore_state(manager, state) or state
            print(f"resuming {folder} at step {state.step}", file=sys.stderr)
        metrics = Metrics(folder, config, state.step)
        batches = batch_stream(train, fit, truncate, mesh.devices.size, first_step=state.step)
        progress = tqdm(total=train.steps, initial=state.step, unit="step", disable=None)
        pending: list[dict[str, jax.Array]] = []
        clock = time.process_time()
        while state.step < train.steps:
            state, row = trainer.step(state, next(batches))
            pending.append(row)
            progress.update()
            done = state.step == train.steps
            if stopping() or done or state.step % config.save_every == 0:
                save_state(manager, state)
            if done or state.step % config.eval_every == 0:
                rows = jax.device_get(pending)
                mean = {f"train/{k}": float(np.mean([r[k] for r in rows])) for k in rows[0]}
                spent = {"cpu_seconds_per_step": (time.process_time() - clock) / len(rows)}
                held = {f"val/{k}": v for k, v in validate(state.params, held_out_parts).items()}
                row_out = {**mean, **held, **evaluate_greedily(state.params), **spent}
                metrics.write(state.step, row_out)
                progress.set_postfix(
                    loss=f"{mean['train/loss']:.3f}",
                    val=f"{held['val/loss']:.3f}",
                    **{
                        name.removeprefix("eval/").removesuffix("_return"): f"{value:.2f}"
                        for name, value in row_out.items()
                        if name.startswith("eval/") and name.endswith("_return")
                    },
                )
                pending, clock = [], time.process_time()
            if stopping():
                progress.close()
                print(f"stopped at step {state.step}; continue with --resume", file=sys.stderr)
                raise KeyboardInterrupt
        progress.close()

    made = {"env": config.env, "config": to_json(config), "steps": state.step}
    save_policy(folder / "policy", network, state.params, made)
    from experiments.figures import training_curve

    training_curve(folder / "metrics.jsonl").savefig(folder / "training.png")
    print(f"policy written to {folder / 'policy'}", file=sys.stderr)


if __name__ == "__main__":
    run(tyro.conf.OmitArgPrefixes[PretrainConfig], main, pretrain_default)
