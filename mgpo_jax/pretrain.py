"""Pre-training: behavior cloning with hindsight multi-goal prompts (paper, section 3.1, Eq. 2).

A gradient step is accumulated over parts of a batch. Each part holds trajectories of nearly equal
length (little padding), small enough that its activations stay in cache, and divided among the
devices. Every random draw is a function of the seed and the step number, so that a run continued from
a checkpoint equals one that was never interrupted, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Key

from mgpo_jax.dataset import BatchPlan, Dataset, plan_batches
from mgpo_jax.prompts import hindsight_outcome, sample_prompt, single_goal
from mgpo_jax.sharding import AXIS, replicate, split
from mgpo_jax.transformer import GoalTransformer, TransformerConfig
from mgpo_jax.types import PRNGKeyArray, Trajectory


@dataclass(frozen=True)
class TrainConfig:
    """How to train. Values in brackets are the paper's (Table 6) or, marked *, its code's."""

    steps: int = 24_000
    """Gradient steps [50,000* for maze15, 200,000* for maze30]."""
    batch_size: int = 64
    """Trajectories in a gradient step [64]."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """Muon on the matrices of the blocks and AdamW on the rest, or AdamW alone [adamw]."""
    learning_rate: float = 3e-3
    """Peak learning rate [1e-4]."""
    warmup_steps: int = 300
    """Steps of linear warm-up [10,000]."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """Decay after warm-up: to 2 % along a cosine, or none [constant*]."""
    weight_decay: float = 1e-4
    """Weight decay [1e-4]."""
    clip_norm: float = 1.0
    """Largest global norm of the gradient [0.25*]."""
    obs_noise: float = 0.0
    """Largest standard deviation of Gaussian noise on training's observations, in their units [0]."""
    part_size: int = 16
    """Trajectories computed at once, over all devices; changes speed and memory, not the sum."""
    part_steps: int = 1024
    """Parts with more padded steps than this are halved; about what fits into a core's cache."""
    bucket: int = 4
    """Padded lengths are multiples of this many steps."""
    seed: int = 0
    """Seed of initial weights, batches, prompts and dropout."""


HIT = 0.1  # so near to the demonstrated action, in each dimension, a prediction counts as correct
# Root mean square of a typical AdamW update before the learning rate.
ADAMW_RMS = 0.2


class TrainState(NamedTuple):
    """Everything a run carries from one gradient step to the next."""

    params: Any
    opt_state: Any
    step: int


class Stats(NamedTuple):
    """Sums over real steps."""

    nll: Float[Array, "*batch"]
    correct: Float[Array, "*batch"]
    """Actions whose likeliest prediction is the demonstrated one, within ``HIT`` in each dimension."""
    num_steps: Float[Array, "*batch"]


def learning_rate_schedule(config: TrainConfig) -> optax.Schedule:
    rate, warmup = config.learning_rate, min(config.warmup_steps, config.steps - 1)
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(0.0, rate, warmup, config.steps, 0.02 * rate)
    return optax.linear_schedule(0.0, rate, warmup) if warmup else optax.constant_schedule(rate)


def make_optimizer(
    config: TrainConfig, unravel: Callable[[Any], Any]
) -> optax.GradientTransformation:
    """The optimizer, on weights that are one vector.

    Muon (Jordan 2024) makes the update of a matrix orthogonal; its scale is matched to AdamW's (Liu et
    al. 2025), so that one learning rate serves both.

    Args:
      config: settings of the training.
      unravel: gives the vector's parts their shapes and names, which Muon needs.
    """
    rate, decay = learning_rate_schedule(config), config.weight_decay
    clip = optax.clip_by_global_norm(config.clip_norm)
    if config.optimizer == "adamw":
        return optax.chain(clip, optax.adamw(rate, weight_decay=decay))
    muon = optax.contrib.muon(
        rate,
        weight_decay=decay,
        adam_weight_decay=decay,
        consistent_rms=ADAMW_RMS,
        muon_weight_dimension_numbers=_block_matrices,
    )

    def init(weights: Array) -> Any:
        return muon.init(unravel(weights))

    def update(grads: Array, state: Any, weights: Array | None = None) -> tuple[Array, Any]:
        updates, state = muon.update(unravel(grads), state, unravel(weights))
        return ravel_pytree(updates)[0], state

    return optax.chain(clip, optax.GradientTransformation(init, update))


def _block_matrices(params: Any) -> Any:
    """The matrices between hidden layers; embeddings and the head are left to AdamW."""

    def kind(path: Any, leaf: Array) -> Any:
        in_block = any(str(part.key).startswith("blocks") for part in path)
        return optax.contrib.MuonDimensionNumbers() if in_block and leaf.ndim == 2 else None

    return jax.tree_util.tree_map_with_path(kind, params)


def blurred(key: PRNGKeyArray, trajectory: Trajectory, largest: float) -> Trajectory:
    """The trajectory seen through noise of one size, uniform in [0, ``largest``].

    A policy that saw only exact observations trusts their last digits; one that saw a single size of
    noise does less well without any.
    """
    key_size, key_noise = jax.random.split(key)
    size = largest * jax.random.uniform(key_size)
    noise = size * jax.random.normal(key_noise, trajectory.obs.shape)
    return trajectory._replace(obs=trajectory.obs + noise)


def bc_loss(
    params: Any,
    key: PRNGKeyArray,
    network: GoalTransformer,
    trajectory: Trajectory,
    deterministic: bool = False,
    obs_noise: float = 0.0,
) -> tuple[Float[Array, ""], Stats]:
    """-sum_t log pi(a_t | p, h_{t-1}, o_t) of one trajectory, with p ~ P(p | tau) (Eq. 2).

    Args:
      params: weights of the network.
      key: random key.
      network: the policy's network.
      trajectory: a demonstration, arrays of T steps.
      deterministic: no dropout and no noise.
      obs_noise: as in ``TrainConfig`` (static; not in the paper).
    """
    key_prompt, key_dropout, key_noise = jax.random.split(key, 3)
    if obs_noise and not deterministic:
        trajectory = blurred(key_noise, trajectory, obs_noise)
    num_slots = network.config.max_prompt_length
    prompt = sample_prompt(key_prompt, trajectory, hindsight_outcome(trajectory), num_slots)
    distribution: Any = network.apply(
        params,
        prompt,
        trajectory.obs,
        trajectory.actions,
        deterministic or network.config.dropout == 0,
        rngs={"dropout": key_dropout},
    )
    real = jnp.arange(len(trajectory.obs)) < trajectory.length
    nll = -jnp.sum(jnp.where(real, distribution.log_prob(trajectory.actions), 0.0))
    hits = jnp.abs(distribution.mode() - trajectory.actions) <= HIT
    hits = jnp.all(hits.reshape(len(real), -1), axis=1)
    correct = jnp.sum(hits & real).astype(jnp.float32)
    return nll, Stats(nll, correct, trajectory.length.astype(jnp.float32))


class Trainer(NamedTuple):
    """The jitted pieces of a training run."""

    init: Callable[[], TrainState]
    step: Callable[[TrainState, list[BatchPlan]], tuple[TrainState, dict[str, Array]]]
    evaluate: Callable[[Any, list[BatchPlan]], dict[str, float]]


def make_trainer(
    config: TrainConfig, network_config: TransformerConfig, dataset: Dataset, mesh: Mesh
) -> Trainer:
    """Build the training program for a dataset on a mesh.

    Raises:
      ValueError: if the devices do not divide ``config.part_size``, or ``config.obs_noise`` is negative
        or not finite.
    """
    num_devices = mesh.devices.size
    if not 0 <= config.obs_noise < math.inf:
        raise ValueError(f"obs_noise must be finite and not negative, found {config.obs_noise}")
    if config.part_size % num_devices:
        raise ValueError(f"part_size {config.part_size} does not divide over {num_devices} devices")
    home = mesh.devices.flat[0]
    network = GoalTransformer(network_config)
    key_init, key_steps, key_eval = jax.random.split(jax.random.key(config.seed), 3)
    flatten = jax.jit(lambda params: ravel_pytree(params)[0])

    def init_params() -> Any:
        first = jax.tree.map(jnp.asarray, dataset.gather(np.array([0]), np.array([1]), 1))
        one = jax.tree.map(lambda leaf: leaf[0], first)
        prompt = single_goal(one.outcomes[0], network_config.max_prompt_length)
        return network.init(key_init, prompt, one.obs, one.actions)

    shapes = jax.eval_shape(init_params)
    _, unravel = ravel_pytree(jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes))
    optimizer = make_optimizer(config, unravel)

    def init() -> TrainState:
        params = init_params()
        return TrainState(params, optimizer.init(flatten(params)), 0)

    def batch_loss(
        params: Any, keys: Key[Array, "B"], part: Trajectory, deterministic: bool
    ) -> tuple[Array, Stats]:
        loss = partial(
            bc_loss,
            params,
            network=network,
            deterministic=deterministic,
            obs_noise=config.obs_noise,
        )
        nll, stats = jax.vmap(lambda key, one: loss(key, trajectory=one))(keys, part)
        return nll.sum(), jax.tree.map(jnp.sum, stats)

    spread, copied = PartitionSpec(AXIS), PartitionSpec()

    def on_devices(in_specs: Any, out_specs: Any, **options: Any) -> Callable[[Callable], Any]:
        """A jitted function that runs on every device by itself, without collectives."""

        def wrap(function: Callable) -> Any:
            mapped = jax.shard_map(
                function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
            )
            return jax.jit(mapped, **options)

        return wrap

    # Weights and gradients are one vector on the way between devices and in the optimizer (a
    # handful of passes over memory instead of a handful for each of some fifty small arrays).
    unpack = on_devices(copied, copied)(unravel)
    pack = on_devices(spread, spread)(lambda sums: (ravel_pytree(sums[0])[0][None], sums[1]))

    @on_devices((copied, spread, spread, spread), spread, donate_argnums=1)
    def accumulate(params: Any, sums: Any, keys: Key[Array, "B"], part: Trajectory) -> Any:
        """Add one part's gradient and stats to ``sums``, a row of which belongs to each device."""
        added = jax.grad(batch_loss, has_aux=True)(params, keys, part, False)
        return jax.tree.map(lambda row, new: row + new, sums, added)

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(params: Any, opt_state: Any, rows: list[Any]) -> tuple[Any, Any, dict[str, Array]]:
        flat, stats = jax.tree.map(lambda *of_devices: sum(of_devices)[0], *rows)
        grads, weights = flat / stats.num_steps, flatten(params)
        updates, opt_state = optimizer.update(grads, opt_state, weights)
        metrics = {
            "loss": stats.nll / stats.num_steps,
            "accuracy": stats.correct / stats.num_steps,
            "grad_norm": optax.tree.norm(grads),
            "num_steps": stats.num_steps,
        }
        return unravel(optax.apply_updates(weights, updates)), opt_state, metrics

    @partial(jax.jit, out_shardings=NamedSharding(mesh, spread))
    def zeros() -> Any:
        grads = jax.tree.map(lambda leaf: jnp.zeros((num_devices, *leaf.shape)), shapes)
        return grads, Stats(*jnp.zeros((3, num_devices)))

    @partial(jax.jit, static_argnums=2, out_shardings=NamedSharding(mesh, spread))
    def part_keys(step: Any, index: Any, num: int) -> Key[Array, "B"]:
        key = jax.random.fold_in(jax.random.fold_in(key_steps, step), index)
        return jax.random.split(key, num)

    @jax.jit
    def part_stats(params: Any, key: PRNGKeyArray, part: Trajectory) -> Stats:
        return batch_loss(params, jax.random.split(key, part.length.shape[0]), part, True)[1]

    def step(state: TrainState, plans: list[BatchPlan]) -> tuple[TrainState, dict[str, Array]]:
        params, sums = unpack(replicate(mesh, flatten(state.params))), zeros()
        for index, plan in enumerate(plans):
            part = split(mesh, dataset.gather(*plan))
            keys = part_keys(state.step, index, len(plan.lengths))
            sums = accumulate(params, sums, keys, part)
        # Rows travel by plain copies: a collective can deadlock on a CPU's small thread pool.
        packed = pack(sums)
        rows = [
            jax.tree.map(
                lambda leaf, i=i: jax.device_put(leaf.addressable_shards[i].data, home), packed
            )
            for i in range(num_devices)
        ]
        params, opt_state, metrics = update(state.params, state.opt_state, rows)
        return TrainState(params, opt_state, state.step + 1), metrics

    def evaluate(params: Any, plans: list[BatchPlan]) -> dict[str, float]:
        stats = [part_stats(params, key_eval, dataset.gather(*plan)) for plan in plans]
        total = jax.tree.map(lambda *leaves: float(sum(leaves)), *stats)
        return {"loss": total.nll / total.num_steps, "accuracy": total.correct / total.num_steps}

    return Trainer(init, step, evaluate)


def batch_stream(
    config: TrainConfig, dataset: Dataset, truncate: bool, num_devices: int = 1, first_step: int = 0
) -> Iterator[list[BatchPlan]]:
    """The batches of a run from ``first_step`` on."""
    return plan_batches(
        dataset,
        seed=config.seed,
        batch_size=config.batch_size,
        part_size=config.part_size,
        bucket=config.bucket,
        truncate=truncate,
        part_steps=config.part_steps,
        min_part=num_devices,
        first_step=first_step,
    )
