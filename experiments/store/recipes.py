"""The general recipe for data of one's own: settings of a training, chosen by sizes. Nothing imports jax.

The numbers continue those of the released policies, which were chosen by hand. What was chosen is printed,
and every flag changes one of them.
"""

from __future__ import annotations

from typing import Any

from experiments.store.settings import PretrainConfig
from mgpo_jax.manifest import Facts
from mgpo_jax.settings import flag

PASSES = 20  # times that a training sees every trajectory
SMALL, LARGE = (
    20_000,
    5_000_000,
)  # steps in the data below and above which the network has other sizes
LONG = 200  # steps of a trajectory from which a step is one token
STEPS_IN_BATCH = 6_400  # as in the released recipes of the mazes
MOST_SHAPES = 8  # padded lengths that are compiled
MOST_STANDARDIZED = 100_000  # components of an observation


def recipe(facts: Facts) -> dict[str, Any]:
    """Settings of a training on a dataset, by the names of their flags.

    Wide and deep networks are for much data; batches hold about as many steps whatever the lengths; the
    longest prompt grows with the episodes; observations are standardized unless they are booleans.
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
    """The settings that say how much of a dataset is trained on: all but a tenth, or ``holdout``."""
    num = facts.num_trajectories
    return {"trajectories": num, "holdout": min(holdout, max(1, num // 10))}


def told(config: PretrainConfig, facts: Facts) -> str:
    """The data of a training and the settings that it has, chosen or given, in words."""
    actions = f"{facts.num_actions} actions" if facts.num_actions else f"{facts.action_dim} numbers"
    lines = [
        f"data: {facts.num_trajectories:,} trajectories of {facts.mean_length:.1f} steps in the mean and "
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
        return flag(name) if value else flag(name).replace("--", "--no-", 1)
    return f"{flag(name)} {value}"


def schedule(config: PretrainConfig) -> str:
    """The learning rate over the steps of a training, in words."""
    train = config.train
    seen = train.steps * train.batch_size / max(1, config.data.trajectories - config.holdout)
    warmup = min(train.warmup_steps, train.steps - 1)
    falls = (
        f"falls along a cosine to {0.02 * train.learning_rate:.3g} at the last"
        if train.schedule == "cosine"
        else "stays there"
    )
    return (
        f"schedule: {train.steps:,} steps of {train.batch_size} trajectories, which sees the data "
        f"{seen:.1f} "
        f"times; the learning rate rises to {train.learning_rate:.3g} in {warmup:,} steps and {falls}"
    )
