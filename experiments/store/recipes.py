"""The recipe for a user's own dataset: settings of a training chosen by its size. Nothing imports jax.

The numbers extrapolate those of the released policies, which were chosen by hand. The choice is printed,
and each setting can be changed by its flag.
"""

from __future__ import annotations

from typing import Any

from experiments.store.settings import PretrainConfig
from mgpo_jax.manifest import Facts
from mgpo_jax.settings import flag, flag_off

PASSES = 20  # epochs: how often a training sees each trajectory
SMALL, LARGE = (
    20_000,
    5_000_000,
)  # steps in the dataset below and above which the network is smaller and larger
LONG = 200  # mean steps of a trajectory above which each step is one token
STEPS_IN_BATCH = 6_400  # as in the presets of the mazes
MOST_SHAPES = 8  # maximum number of padded lengths to compile
MOST_STANDARDIZED = 100_000  # maximum size of an observation that is standardized


def recipe(facts: Facts) -> dict[str, Any]:
    """The settings of a training on a dataset, by name.

    Larger datasets get wider and deeper networks, the number of steps in a batch depends little on the
    lengths, the maximum prompt length grows with the episodes, and observations are standardized unless
    they are boolean or very large.
    """
    mean, num = facts.mean_length, facts.num_trajectories
    batch = next((size for size in (64, 32) if size * mean <= STEPS_IN_BATCH), 16)
    steps = min(max(round(PASSES * num / batch, -2), 500), 20_000)
    size = 0 if facts.num_steps < SMALL else 2 if facts.num_steps > LARGE else 1
    return {
        "embed_dim": (64, 128, 256)[size],
        "num_layers": (2, 3, 4)[size],
        "num_heads": 4,
        "tokens_per_step": 1 if mean > LONG else 2,
        "head": "categorical" if facts.num_actions is not None else "binned",
        "standardize_obs": facts.obs_dtype != "bool" and facts.obs_size <= MOST_STANDARDIZED,
        "max_prompt_length": max(1, min(max(5, round(mean / 10)), 20, facts.longest)),
        "batch_size": batch,
        "steps": int(steps),
        "warmup_steps": int(min(300, steps // 10)),
        "bucket": 4 * max(1, -(-facts.longest // (4 * MOST_SHAPES))),
        "eval_every": int(max(50, steps // 10)),
        "save_every": int(min(500, max(50, steps // 10))),
        **of_data(facts, 200),
    }


def of_data(facts: Facts, holdout: int) -> dict[str, Any]:
    """How much of a dataset to use and to hold out: all of it, and a tenth, but at most ``holdout``."""
    num = facts.num_trajectories
    return {"trajectories": num, "holdout": min(holdout, max(1, num // 10))}


def told(config: PretrainConfig, facts: Facts) -> str:
    """The dataset of a training and its settings, whether chosen or given, in words."""
    actions = f"{facts.num_actions} actions" if facts.num_actions else f"{facts.action_dim} numbers"
    lines = [
        f"data: {facts.num_trajectories:,} trajectories of {facts.mean_length:.1f} steps on average and "
        f"{facts.longest} at most; observations {facts.obs_dtype}{list(facts.obs_shape)}, goals of "
        f"{facts.goal_dim} numbers, {actions}"
    ]
    values = {name: getattr(config, name, None) for name in recipe(facts)}
    values |= {name: value for name, value in vars(config.train).items() if name in values}
    values["trajectories"] = config.data.trajectories
    chosen = " ".join(_as_flag(name, value) for name, value in values.items())
    return "\n".join([*lines, f"recipe: {chosen}", schedule(config)])


def _as_flag(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return flag(name) if value else flag_off(name)
    return f"{flag(name)} {value}"


def schedule(config: PretrainConfig) -> str:
    """The length and the learning rate schedule of a training, in words."""
    train = config.train
    seen = train.steps * train.batch_size / max(1, config.data.trajectories - config.holdout)
    warmup = min(train.warmup_steps, train.steps - 1)
    falls = (
        f"falls along a cosine to {0.02 * train.learning_rate:.3g} by the last step"
        if train.schedule == "cosine"
        else "then stays constant"
    )
    return (
        f"schedule: {train.steps:,} gradient steps of {train.batch_size} trajectories, which is {seen:.1f} "
        f"epochs; the learning rate rises to {train.learning_rate:.3g} within {warmup:,} steps and {falls}"
    )
