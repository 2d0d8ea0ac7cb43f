"""Settings as frozen dataclasses, with the bounds of their numbers. Nothing here imports jax.

A setting is a field with a docstring, from which its flag and help text are made. ``number`` adds bounds,
which ``check_settings`` enforces for command lines and library calls alike.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from envs.errors import UsageError


def number(
    default: Any,
    *,
    at_least: int | float | None = None,
    above: int | float | None = None,
    static: bool = False,
) -> Any:
    """A field of a settings dataclass with bounds.

    Args:
      default: its default value; None means that there is a default elsewhere, and is always accepted.
      at_least: smallest value.
      above: largest value that is too small.
      static: whether the value decides about shapes, so that each value needs a program of its own.
        Other numbers enter programs as data.
    """
    return dataclasses.field(
        default=default, metadata={"at_least": at_least, "above": above, "static": static}
    )


def flag(name: str) -> str:
    """The flag of a setting on the command line."""
    return "--" + name.replace("_", "-")


def check_settings(settings: Any) -> None:
    """Raise ``UsageError`` for the first number of a settings dataclass that is out of its bounds."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            check_settings(value)
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        low, above = field.metadata.get("at_least"), field.metadata.get("above")
        if not math.isfinite(value):
            raise UsageError(f"{flag(field.name)} must be a finite number, found {value}")
        if low is not None and value < low:
            raise UsageError(f"{flag(field.name)} must be at least {low}, found {value}")
        if above is not None and value <= above:
            raise UsageError(f"{flag(field.name)} must be above {above}, found {value}")


RECIPE_NETWORK: dict[str, Any] = {"dropout": 0.0, "num_heads": 4}
"""How the network of the general recipe differs from the paper's (Table 6)."""


@dataclass(frozen=True)
class TrainConfig:
    """How to train. Values in brackets are the paper's (Table 6) or, marked *, its code's."""

    steps: int = number(24_000, at_least=1)
    """Gradient steps [50,000* to 200,000*, depending on the world]."""
    batch_size: int = number(64, at_least=1)
    """Trajectories in a gradient step [64]."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """Muon on the matrices of the blocks and AdamW on the rest, or AdamW alone [adamw]."""
    learning_rate: float = number(3e-3, above=0)
    """Peak learning rate [1e-4]."""
    warmup_steps: int = number(300, at_least=0)
    """Steps of linear warm-up [10,000]."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """Decay after warm-up: to 2 % along a cosine, or none [constant*]."""
    weight_decay: float = number(1e-4, at_least=0)
    """Weight decay [1e-4]."""
    clip_norm: float = number(1.0, above=0)
    """Largest global norm of the gradient [0.25*]."""
    obs_noise: float = number(0.0, at_least=0)
    """Largest standard deviation of the Gaussian noise that training adds to observations, in their
    units [0]."""
    part_size: int = number(16, at_least=1)
    """Trajectories computed at once, over all devices. It changes speed and memory, not the sum."""
    part_steps: int = number(1024, at_least=1)
    """Parts with more padded steps than this are halved, so that they fit into a core's cache."""
    bucket: int = number(4, at_least=1)
    """Padded lengths are multiples of this many steps."""
    seed: int = 0
    """Seed of the initial weights, batches, prompts and dropout."""
