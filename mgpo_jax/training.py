"""Pre-training: gradient steps on a dataset (paper, section 3.1). ``losses`` says what they minimize.

The gradient of a batch is accumulated over its parts (microbatches). Each part holds trajectories of nearly
equal length, so that little padding is needed; it is small enough for its activations to stay in cache, and
is divided among the devices. Every random draw is a function of the seed and the step number, so that a run
resumed from a checkpoint equals an uninterrupted one bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array, Float, Key, PRNGKeyArray

from envs.base import Trajectory
from envs.errors import DataError, UsageError, nearest
from envs.specs import EnvSpec
from mgpo_jax import processes
from mgpo_jax.dataset import BatchPlan, Dataset, check_dataset, plan_batches
from mgpo_jax.kinds import kind_of
from mgpo_jax.losses import Stats, batch_loss
from mgpo_jax.network_configs import (
    NetworkConfig,
    TransformerConfig,
    network_config,
    network_fault,
)
from mgpo_jax.policy import LoadedPolicy, check_fits
from mgpo_jax.progress import Progress
from mgpo_jax.seen_goals import seen_in
from mgpo_jax.settings import RECIPE_NETWORK, TrainConfig, check_contradictions, check_settings
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
from mgpo_jax.trees import taken_over
from mgpo_jax.weight_updates import make_optimizer

# Entries of a step's metrics that are not reported: whether all weights are finite, and how many processes
# had been asked to stop before the step.
FINITE, ASKED = "weights_finite", "asked_to_stop"


class TrainState(NamedTuple):
    """The state of training between two gradient steps."""

    params: Any
    opt_state: Any
    step: int


def _flatten(params: Any) -> Array:
    return ravel_pytree(params)[0]


class _Accumulator:
    """Sums gradients and statistics over the parts of a batch, in one row for each device.

    Weights and gradients are passed between devices as one vector, which takes a few passes over memory
    instead of a few for each of some fifty small arrays.
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
        """Sums of ``(gradient vector, Stats)`` over ``(keys, part)`` pairs, in rows to be added up.

        If several processes train together, the rows also hold whether this one has been asked to stop.
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
    """The jitted update: ``(params, opt_state, rows of sums) -> (params, opt_state, metrics)``."""

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
    """Trains a network on one dataset; holds the jitted functions, while ``TrainState`` holds the state.

    Args:
      config: the training config.
      network_config: the network's config.
      dataset: the trajectories to learn from.
      mesh: the devices of this process, among which each part of a batch is divided. If several processes
        train together, each computes its own share of every part, and all of them take the same step.

    Raises:
      UsageError: if ``config.part_size`` is not divisible by the number of devices, a setting is out of
        bounds, or noise is requested for integer observations.
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
                f"--obs-noise does not apply to --encoder {network_config.encoder}, which rounds the codes "
                "and counts of observations; leave it out"
            )
        learned = kind_of(network_config).load()
        self._key_init, key_steps, self._key_eval = jax.random.split(jax.random.key(config.seed), 3)
        self._dataset = dataset
        self._initial_params = partial(learned.init, self._key_init, network_config)
        shapes = jax.eval_shape(self._initial_params)
        self._structure: Any = jax.tree.structure(shapes)
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
        """The state before the first step, with random parameters or given ones.

        The given ones may be those of another kind of network (``Learned.starts_from``).
        """
        # On a GPU two large programs compile faster than the 160 small ones of eager execution. The two
        # ways round differently, so CPUs, on which the published policies were trained, stay with the eager
        # one.
        compiled = (lambda function: function) if jax.default_backend() == "cpu" else jax.jit
        # Given parameters are copied, since the first step donates the buffers of its parameters.
        make = compiled(self._initial_params)
        if params is None:
            params = make()
        else:
            own = jax.tree.structure(params) == self._structure
            params = jax.tree.map(jnp.array, params if own else taken_over(make(), params))
        return TrainState(params, compiled(self._optimizer.init)(self._flatten(params)), 0)

    def step(
        self, state: TrainState, plans: list[BatchPlan], asked: int = 0
    ) -> tuple[TrainState, dict[str, Array]]:
        """Take one gradient step on the parts of a batch; returns the new state and metrics.

        ``asked`` says whether this process has been asked to stop. If several processes train together, the
        metrics of each hold how many of them have been asked (``ASKED``), so that all stop after the same
        step.
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
        """Mean loss and accuracy of parameters, without dropout and noise.

        ``dataset`` is the dataset that the plans index (default: the training data).
        """
        rows = self._dataset if dataset is None else dataset
        stats = [self._part_stats(params, self._key_eval, rows.gather(*plan)) for plan in plans]
        total = jax.tree.map(lambda *leaves: float(sum(leaves)), *fetch(stats))
        return total.means


def _own_share(num: int) -> slice:
    """The share of a part's ``num`` trajectories that this process computes."""
    own = num // processes.count()
    return slice(processes.index() * own, (processes.index() + 1) * own)


def _own_part(plan: BatchPlan) -> BatchPlan:
    """The share of a part of a batch that this process computes."""
    own = _own_share(len(plan.lengths))
    return BatchPlan(plan.indices[own], plan.lengths[own], plan.num_steps)


def finite_metrics(step: int, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The reported metrics of a gradient step, as numpy scalars.

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
    """The error for a training run in which a metric became NaN or infinite."""
    return DataError(
        f"training stopped at step {step}: {metric} became {value}; start a new run with a lower learning "
        "rate or a lower clip norm"
    )


def batch_stream(
    config: TrainConfig, dataset: Dataset, truncate: bool, num_devices: int = 1, first_step: int = 0
) -> Iterator[list[BatchPlan]]:
    """The batches of a run from ``first_step`` on.

    ``num_devices`` is the number of devices of all processes, among which each part is divided.
    """
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
    """The network config of a training run that starts from the parameters of another network.

    Args:
      config: the config of the other network.
      changes: settings by name. Only ``dropout`` (default: the recipe's) may differ from ``config``.
      where: whose parameters they are, for messages.

    Raises:
      UsageError: if a setting contradicts the parameters.
    """
    dropout = changes.get("dropout", RECIPE_NETWORK["dropout"])
    others = {name: value for name, value in changes.items() if name != "dropout"}
    replace(config, **others)  # raises TypeError for an unknown name
    check_contradictions(others, {name: getattr(config, name) for name in others}, where)
    return replace(config, dropout=dropout)


def pretrain(
    dataset: Dataset,
    spec: EnvSpec,
    config: TrainConfig | None = None,
    init: LoadedPolicy | None = None,
    **network: Any,
) -> LoadedPolicy:
    """Pre-train a policy on a dataset, in memory and without interruption.

    The command ``experiments.pretrain`` does the same with a recipe for each world, and writes checkpoints,
    evaluations and metrics along the way.

    Args:
      dataset: trajectories of the world.
      spec: the world's specification.
      config: the training config (default: ``TrainConfig()``).
      init: a policy whose network and parameters training starts from (default: random parameters). Then
        only ``dropout`` may be changed.
      **network: fields of ``TransformerConfig`` that differ from the recipe
        (``settings.RECIPE_NETWORK``: no dropout and four heads).

    Raises:
      DataError: if the dataset or ``init`` does not fit the world, or a loss or weight becomes NaN or
        infinite.
      UsageError: if a setting is out of bounds or contradicts ``init``.
    """
    config = config or TrainConfig()
    check_dataset(dataset, "dataset", spec)
    known = [field.name for field in fields(TransformerConfig)]
    for name in network.keys() - set(known):
        raise nearest(name, known, "setting of the network")
    if init is None:
        sizes = network_config(spec, **{**RECIPE_NETWORK, **network})
        check_settings(sizes)
        if said := network_fault(sizes):
            raise UsageError(said)
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
            finite_metrics(state.step - 1, before)  # one step late, so that nothing waits for it
            before = metrics
            progress.update()
    finite_metrics(state.step, before)
    made: dict[str, Any] = {"steps": config.steps}
    if init is not None and init.sha256:
        made["init_sha256"] = init.sha256
    seen = seen_in(dataset, init.seen_goals if init else None)
    return LoadedPolicy(sizes, state.params, made, seen_goals=seen)
