"""Pre-training: behavior cloning with hindsight multi-goal prompts (paper, section 3.1, Eq. 2).

A gradient step is accumulated over parts of a batch (microbatches). Each part holds trajectories of nearly
equal length, which need little padding, is small enough that its activations stay in cache, and is divided
among the devices. Every random draw is a function of the seed and the step number, so that a run continued
from a checkpoint equals one that was never interrupted, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array, Float, Key, PRNGKeyArray

from envs.base import EnvSpec, Trajectory
from envs.errors import DataError, UsageError
from mgpo_jax import processes
from mgpo_jax.dataset import BatchPlan, Dataset, check_dataset, plan_batches
from mgpo_jax.kinds import Learned, kind_of
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.progress import Progress
from mgpo_jax.prompts import hindsight_outcome, sample_prompt, single_goal
from mgpo_jax.seen_goals import seen_in
from mgpo_jax.settings import (
    RECIPE_NETWORK,
    TrainConfig,
    check_contradictions,
    check_settings,
)
from mgpo_jax.sharding import (
    Adding,
    device_mesh,
    devices_for,
    fetch,
    on_devices,
    replicate,
    split,
    spread,
)
from mgpo_jax.transformer import (
    GoalTransformer,
    NetworkConfig,
    TransformerConfig,
    network_config,
)

# Among the metrics of a step, but no figures: a flag, and how many processes were asked to stop before it.
FINITE, ASKED = "weights_finite", "asked_to_stop"
HIT = 0.1  # per-dimension tolerance for counting a predicted action as correct
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
    """Of the actions."""
    correct: Float[Array, "*batch"]
    """Steps whose likeliest action is the demonstrated (intended) one, within ``HIT`` in each dimension."""
    num_steps: Float[Array, "*batch"]
    parts: dict[str, Float[Array, "*batch"]]
    """Other parts of the loss, by name, for kinds of networks that learn more than actions."""

    @property
    def divisor(self) -> Any:
        """The number of steps, or 1 where there are none."""
        return self.num_steps + (self.num_steps == 0)

    @property
    def means(self) -> dict[str, Any]:
        """Means over the steps, by the names of metrics."""
        sums = {"loss": self.nll, "accuracy": self.correct, **self.parts}
        return {name: total / self.divisor for name, total in sums.items()}


def stats_of(distribution: Any, labels: Array, counts: Array, **parts: Array) -> Stats:
    """The statistics of some action distributions.

    Args:
      distribution: of the actions, [*steps].
      labels: the actions demonstrated (intended), [*steps] or [*steps, A].
      counts: which steps count, bool [*steps].
      **parts: other parts of the loss at every step, [*steps].
    """

    def total(values: Array) -> Array:
        return jnp.sum(jnp.where(counts, values, 0.0))

    hits = jnp.abs(distribution.mode() - labels) <= HIT
    hits = jnp.all(hits.reshape(*counts.shape, -1), axis=-1)
    return Stats(
        nll=-total(distribution.log_prob(labels)),
        correct=jnp.sum(hits & counts).astype(jnp.float32),
        num_steps=counts.sum().astype(jnp.float32),
        parts={name: total(values) for name, values in parts.items()},
    )


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
    noise = noise.astype(trajectory.obs.dtype)
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

    The history h holds the executed actions. Where the demonstrator told what it intended, a_t is that.

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
    stats = stats_of(distribution, trajectory.labels, real)
    return stats.nll, stats


def batch_loss(
    params: Any,
    keys: Key[Array, "B"],
    part: Trajectory,
    deterministic: bool,
    learned: Learned,
    network: NetworkConfig,
    obs_noise: float,
) -> tuple[Float[Array, ""], Stats]:
    """The loss and statistics of several trajectories, summed."""

    def one(key: PRNGKeyArray, trajectory: Trajectory) -> tuple[Array, Stats]:
        return learned.loss(params, key, network, trajectory, deterministic, obs_noise)

    loss, stats = jax.vmap(one)(keys, part)
    return loss.sum(), jax.tree.map(jnp.sum, stats)


def initial_params(key: PRNGKeyArray, config: TransformerConfig) -> Any:
    """Random weights of a multi-goal policy."""
    prompt = single_goal(jnp.zeros(config.goal_dim), config.max_prompt_length)
    return GoalTransformer(config).init(key, prompt, *config.blank_episode())


def _prompted_loss(
    params: Any, key: PRNGKeyArray, config: TransformerConfig, *rest: Any
) -> tuple[Float[Array, ""], Stats]:
    return bc_loss(params, key, GoalTransformer(config), *rest)


def transformer_told(config: TransformerConfig) -> str:
    """The sizes of a Transformer in words."""
    return f"{config.num_layers} layers, width {config.embed_dim}, {config.num_heads} head(s)"


def _facts(config: TransformerConfig) -> dict[str, str]:
    order = "with" if config.prompt_order else "without"
    return {
        "network": transformer_told(config),
        "prompts": f"up to {config.max_prompt_length} goals, {order} an order embedding",
    }


PROMPTED = Learned(config=TransformerConfig, init=initial_params, loss=_prompted_loss, facts=_facts)


def _flatten(params: Any) -> Array:
    return ravel_pytree(params)[0]


class _Accumulator:
    """Sums gradients and statistics over the parts of a batch, a row for each device.

    Weights and gradients travel between devices as one vector: a handful of passes over memory instead of
    a handful for each of some fifty small arrays.
    """

    def __init__(
        self,
        mesh: Mesh,
        loss: Callable,
        shapes: Any,
        stats_shapes: Stats,
        unravel: Callable[[Any], Any],
    ) -> None:
        self.mesh = mesh

        def add(params: Any, sums: Any, keys: Key[Array, "B"], part: Trajectory) -> Any:
            added = jax.grad(loss, has_aux=True)(params, keys, part, False)
            return jax.tree.map(lambda row, new: row + new, sums, added)

        def zeros() -> Any:
            num = mesh.devices.size
            return jax.tree.map(lambda leaf: jnp.zeros((num, *leaf.shape)), (shapes, stats_shapes))

        def pack(sums: Any) -> Any:
            return _flatten(sums[0])[None], sums[1]

        self.bring_together = Adding(mesh)
        self.unpack = on_devices(mesh, unravel, [False], False)
        self.pack = on_devices(mesh, pack, [True], True)
        self.add = on_devices(mesh, add, [False, True, True, True], True, donate_argnums=1)
        self.zeros = jax.jit(zeros, out_shardings=spread(mesh))

        def note(asked: Any) -> Float[Array, "D"]:
            return jnp.zeros(mesh.devices.size).at[0].set(asked)

        self.note = jax.jit(note, out_shardings=spread(mesh))

    def sums(
        self, weights: Array, parts: Iterator[tuple[Any, Trajectory]], asked: int
    ) -> list[Any]:
        """Rows of ``(gradient vector, Stats)`` to be added up, over ``(keys, part)`` pairs.

        Where several processes train together, also whether this one is asked to stop.
        """
        params, sums = self.unpack(replicate(self.mesh, weights)), self.zeros()
        for keys, part in parts:
            sums = self.add(params, sums, keys, split(self.mesh, part))
        packed = self.pack(sums)
        if processes.count() > 1:
            packed = (*packed, self.note(bool(asked)))
        return self.bring_together(packed)


def _make_update(
    optimizer: optax.GradientTransformation, unravel: Callable[[Any], Any]
) -> Callable[[Any, Any, list[Any]], tuple[Any, Any, dict[str, Array]]]:
    """``(params, opt_state, rows of sums) -> (params, opt_state, metrics)``."""

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(params: Any, opt_state: Any, rows: list[Any]) -> tuple[Any, Any, dict[str, Array]]:
        flat, stats, *asked = jax.tree.map(lambda *of_devices: sum(of_devices)[0], *rows)
        grads, weights = flat / stats.divisor, _flatten(params)
        updates, opt_state = optimizer.update(grads, opt_state, weights)
        metrics = {
            **stats.means,
            "grad_norm": optax.tree.norm(grads),
            "num_steps": stats.num_steps,
        }
        weights = optax.apply_updates(weights, updates)
        metrics[FINITE] = jnp.isfinite(weights).all()
        if asked:
            metrics[ASKED] = asked[0]
        return unravel(weights), opt_state, metrics

    return update


class Trainer:
    """The compiled pieces of a training run on one dataset.

    Args:
      config: how to train.
      network_config: the network.
      dataset: the trajectories to learn from.
      mesh: the devices of this process to divide the parts of a batch among. Where several processes work
        together, each computes its own share of every part, and all of them take the same step.

    Raises:
      UsageError: if the devices do not divide ``config.part_size``, a setting is out of its bounds, or
        noise is asked for on observations that are integers.
    """

    def __init__(
        self, config: TrainConfig, network_config: NetworkConfig, dataset: Dataset, mesh: Mesh
    ) -> None:
        check_settings(config)
        num_devices = mesh.devices.size * processes.count()
        if config.part_size % num_devices:
            raise UsageError(
                f"part_size {config.part_size} does not divide over {num_devices} devices"
            )
        if config.obs_noise and not np.issubdtype(dataset.obs.dtype, np.floating):
            raise UsageError(
                f"--obs-noise needs floating-point observations, the dataset's are {dataset.obs.dtype}"
            )
        if config.obs_noise and network_config.obs_layout is not None:
            raise UsageError(
                f"--obs-noise has no use where --encoder {network_config.encoder} rounds the codes and "
                "counts of observations; leave it out"
            )
        learned = kind_of(network_config).load()
        self._key_init, key_steps, self._key_eval = jax.random.split(jax.random.key(config.seed), 3)
        self._dataset = dataset
        self._initial_params = partial(learned.init, self._key_init, network_config)
        shapes = jax.eval_shape(self._initial_params)
        blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
        _, unravel = ravel_pytree(blank)
        self._flatten = jax.jit(_flatten)
        self._optimizer = make_optimizer(config, unravel)
        loss = partial(
            batch_loss, learned=learned, network=network_config, obs_noise=config.obs_noise
        )
        first = dataset.gather(np.array([0]), np.array([1]), 1)
        stats = jax.eval_shape(
            partial(loss, deterministic=True), shapes, jax.random.split(self._key_init, 1), first
        )[1]
        self._accumulator = _Accumulator(mesh, loss, shapes, stats, unravel)
        self._update = _make_update(self._optimizer, unravel)

        @partial(jax.jit, static_argnums=2, out_shardings=spread(mesh))
        def part_keys(step: Any, index: Any, num: int) -> Key[Array, "B"]:
            key = jax.random.fold_in(jax.random.fold_in(key_steps, step), index)
            return jax.random.split(key, num)[_own_share(num)]

        @jax.jit
        def part_stats(params: Any, key: PRNGKeyArray, part: Trajectory) -> Stats:
            return loss(params, jax.random.split(key, part.length.shape[0]), part, True)[1]

        self._part_keys, self._part_stats = part_keys, part_stats

    def init(self, params: Any = None) -> TrainState:
        """The state before the first step, with given weights of the network or with random ones."""
        # A GPU would compile 160 small programs one after the other, so it gets two large ones. They round
        # differently: on CPUs, where the published policies were trained, the small ones are kept.
        compiled = (lambda function: function) if jax.default_backend() == "cpu" else jax.jit
        # Given weights are copied, since the first step gives the memory of its weights away.
        make = compiled(self._initial_params)
        params = make() if params is None else jax.tree.map(jnp.array, params)
        return TrainState(params, compiled(self._optimizer.init)(self._flatten(params)), 0)

    def step(
        self, state: TrainState, plans: list[BatchPlan], asked: int = 0
    ) -> tuple[TrainState, dict[str, Array]]:
        """One gradient step on the parts of a batch, and its metrics.

        ``asked`` says whether this process is asked to stop. Where several work together, the metrics of
        all of them say how many are (``ASKED``), so that they can stop after the same step.
        """
        parts = (
            (
                self._part_keys(state.step, index, len(plan.lengths)),
                self._dataset.gather(*_own_part(plan)),
            )
            for index, plan in enumerate(plans)
        )
        rows = self._accumulator.sums(self._flatten(state.params), parts, asked)
        params, opt_state, metrics = self._update(state.params, state.opt_state, rows)
        return TrainState(params, opt_state, state.step + 1), metrics

    def evaluate(
        self, params: Any, plans: list[BatchPlan], dataset: Dataset | None = None
    ) -> dict[str, float]:
        """Mean loss and accuracy of some weights, without dropout and noise.

        ``dataset`` is what the plans are of (default: the one that is trained on).
        """
        rows = self._dataset if dataset is None else dataset
        stats = [self._part_stats(params, self._key_eval, rows.gather(*plan)) for plan in plans]
        total = jax.tree.map(lambda *leaves: float(sum(leaves)), *fetch(stats))
        return total.means


def _own_share(num: int) -> slice:
    """Which of ``num`` trajectories of a part this process computes."""
    own = num // processes.count()
    return slice(processes.index() * own, (processes.index() + 1) * own)


def _own_part(plan: BatchPlan) -> BatchPlan:
    """What this process computes of a part of a batch."""
    own = _own_share(len(plan.lengths))
    return BatchPlan(plan.indices[own], plan.lengths[own], plan.num_steps)


def finite_metrics(step: int, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a gradient step, numpy scalars.

    Raises:
      DataError: if one of them, or a weight after the step, is not finite.
    """
    figures = {name: np.asarray(value) for name, value in fetch(dict(metrics)).items()}
    weights_finite = bool(figures.pop(FINITE, True))
    figures.pop(ASKED, None)
    for name, value in figures.items():
        if not np.isfinite(value):
            raise diverged(step, f"train/{name}", value)
    if not weights_finite:
        raise diverged(step, "weights", "NaN or infinity")
    return figures


def diverged(step: int, metric: str, value: Any) -> DataError:
    """The error for a training in which a metric is not finite after a step."""
    return DataError(
        f"training stopped at step {step}: {metric} became {value}; start a new run with a lower learning "
        "rate or a lower clip norm"
    )


def batch_stream(
    config: TrainConfig, dataset: Dataset, truncate: bool, num_devices: int = 1, first_step: int = 0
) -> Iterator[list[BatchPlan]]:
    """The batches of a run from ``first_step`` on; ``num_devices`` of all processes divide each part."""
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


def continued_network(
    config: TransformerConfig, changes: Mapping[str, Any], where: str
) -> TransformerConfig:
    """The network of a training that starts from the weights of another one.

    Args:
      config: the network of the weights.
      changes: settings by name; all but ``dropout`` (default: that of the recipe) must be as they are.
      where: whose weights they are, for messages.

    Raises:
      UsageError: if a setting contradicts the weights.
    """
    dropout = changes.get("dropout", RECIPE_NETWORK["dropout"])
    others = {name: value for name, value in changes.items() if name != "dropout"}
    replace(config, **others)  # complains about a name that is none
    check_contradictions(others, {name: getattr(config, name) for name in others}, where)
    return replace(config, dropout=dropout)


def pretrain(
    dataset: Dataset,
    spec: EnvSpec,
    config: TrainConfig | None = None,
    init: LoadedPolicy | None = None,
    **network: Any,
) -> LoadedPolicy:
    """Pre-train a policy on a dataset, in memory and from the first step to the last.

    ``experiments.pretrain`` does the same with a recipe for each world, and with checkpoints, evaluations
    and metrics on the way.

    Args:
      dataset: trajectories of the world.
      spec: the world's facts.
      config: how to train (default: that of ``TrainConfig``).
      init: a policy whose network and weights training starts from (default: random weights). Only
        ``dropout`` can be another one then.
      **network: sizes and options of the network, as in ``TransformerConfig``, that differ from the
        recipe's (``settings.RECIPE_NETWORK``: no dropout and four heads).

    Raises:
      DataError: if the dataset or ``init`` does not fit the world, or a loss or weight is not finite any
        more.
      UsageError: if a setting is out of its bounds, or contradicts ``init``.
    """
    config = config or TrainConfig()
    check_dataset(dataset, "dataset", spec)
    if init is None:
        sizes = network_config(spec, **{**RECIPE_NETWORK, **network})
    else:
        check_fits(init.config, spec, "the policy given as init")
        sizes = continued_network(init.config, network, "the policy given as init")
    mesh = device_mesh(devices_for(config.part_size))
    trainer = Trainer(config, sizes, dataset, mesh)
    state = trainer.init(None if init is None else init.params)
    batches = batch_stream(
        config, dataset, spec.truncate_in_hindsight, mesh.devices.size * processes.count()
    )
    before: dict[str, Any] = {}
    with Progress(config.steps, "step") as progress:
        while state.step < config.steps:
            state, metrics = trainer.step(state, next(batches))
            finite_metrics(state.step - 1, before)  # computed by now, so nothing waits for it
            before = metrics
            progress.update()
    finite_metrics(state.step, before)
    made: dict[str, Any] = {"steps": config.steps}
    if init is not None and init.sha256:
        made["init_sha256"] = init.sha256
    seen = seen_in(dataset, init.seen_goals if init else None)
    return LoadedPolicy(sizes, state.params, made, seen_goals=seen)
