"""Settings as frozen dataclasses, with the ranges of their values. Nothing here imports jax.

A setting is a dataclass field with a type and a docstring, from which its flag, its help text and its check
are made. The docstring says what it is and in which unit it is measured, and the type holds its range, such
as ``Count`` or ``Annotated[float, Gt(0)]``. ``check_settings`` checks the settings of command lines and of
library calls.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import PydanticUserError

from envs.errors import UsageError, nearest, shown
from envs.registry import ENCODER_PLACES, Encoder, Registry
from mgpo_jax.schema import LIMITS, fault

# Numbers are 32-bit in compiled programs. Sizes have upper bounds beyond which they could only exhaust
# memory.
Count = Annotated[int, Ge(1), Lt(2**31)]
Index = Annotated[int, Ge(0), Lt(2**31)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
Positive = Annotated[float, Gt(0), Le(1e9)]
Finite = Annotated[float, Ge(-1e9), Le(1e9)]
NotNegative = Annotated[float, Ge(0), Le(1e9)]
Share = Annotated[float, Ge(0), Lt(1)]
Name = Annotated[str, MinLen(1)]

NumTrajectories = Annotated[int, Ge(1), Le(10_000_000)]
NumEpisodes = Annotated[int, Ge(1), Le(100_000)]
NumTasks = Annotated[int, Ge(1), Le(10_000)]
NumSeeds = Annotated[int, Ge(1), Le(10_000)]
NumGoals = Annotated[int, Ge(1), Le(4_096)]
BatchSize = Annotated[int, Ge(1), Le(65_536)]
Width = Annotated[int, Ge(1), Le(16_384)]
NumLayers = Annotated[int, Ge(1), Le(256)]

TokensPerStep = Literal[2, 1]
ENCODERS: Registry[Encoder] = Registry(
    "encoder",
    Encoder,
    "mgpo_jax.encoders",
    {
        "linear": "mgpo_jax.encoders:LINEAR",
        "cells": "mgpo_jax.encoders:CELLS",
        **ENCODER_PLACES,
    },
)
"""The encoders by name; their modules need jax and are imported only when they are used."""
if TYPE_CHECKING:
    EncoderName = str
else:
    EncoderName = Literal[tuple(ENCODERS.names())]
Head = Literal["categorical", "gaussian", "fixed_gaussian", "mixture", "binned"]
"""The names in ``distributions.HEADS``, which need jax."""


def static(default: Any) -> Any:
    """A dataclass field whose value determines shapes, so that every value needs its own compiled program.

    Other numbers among the hyper-parameters of a method are traced.
    """
    return dataclasses.field(default=default, metadata={"static": True})


def flag(name: str) -> str:
    """The flag of a setting on the command line."""
    return "--" + name.replace("_", "-")


def flag_off(name: str) -> str:
    """The flag that switches a setting off."""
    return flag(f"no_{name}")


@cache
def types_of(settings_class: type) -> dict[str, Any]:
    """The types of the settings of a dataclass, with their ranges."""
    try:
        return get_type_hints(settings_class, include_extras=True)
    except NameError:  # a user's type that is imported only for type checking
        return {}


def aliases_of(settings_class: type, name: str) -> list[str]:
    """The other flags of a setting, such as older ones."""
    extras = get_args(types_of(settings_class).get(name))[1:]
    return [alias for extra in extras for alias in getattr(extra, "aliases", None) or ()]


def check_settings(settings: Any) -> None:
    """Raise ``UsageError`` for the first field of a dataclass whose value its type does not allow."""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    check_values(type(settings), values)
    for value in values.values():
        if is_settings(value):
            check_settings(value)


def check_positive(**numbers: int) -> None:
    """Raise ``UsageError`` for the first number that is below 1."""
    for name, value in numbers.items():
        if value < 1:
            raise UsageError(f"{name} must be at least 1, found {value}")


def check_values(settings_class: type, values: Mapping[str, Any]) -> None:
    """Raise ``UsageError`` for the first value that is not allowed for a field of a settings dataclass.

    Values that are settings dataclasses themselves are not checked.
    """
    known = types_of(settings_class)
    for name, value in values.items():
        annotation = known.get(name, type(value))
        if is_settings(value) or not (said := setting_fault(annotation, value)):
            continue
        choices = [part for part in get_parts(annotation) if get_origin(part) is Literal]
        if choices and isinstance(value, str):
            raise nearest(value, list(map(str, get_args(choices[0]))), flag(name))
        raise UsageError(f"{flag(name)} {said}")


def is_settings(value: Any) -> bool:
    """Whether a value is an instance of a dataclass."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def setting_fault(annotation: Any, value: Any) -> str | None:
    """What is wrong with the value of a setting, as the end of a sentence; None if nothing is."""
    try:
        return fault(annotation, value)
    except PydanticUserError:  # a user's type that pydantic does not know
        return None


def get_parts(annotation: Any) -> Iterator[Any]:
    """A type and all types that it is composed of."""
    yield annotation
    if get_origin(annotation) is not Literal:
        for part in get_args(annotation):
            yield from get_parts(part)


def range_of(annotation: Any) -> str:
    """The range of a setting in words, such as "at least 1"; empty if it has none."""
    limits = [part for part in get_parts(annotation) if isinstance(part, Gt | Ge | Lt | Le)]
    return ", ".join(
        f"{LIMITS[name]} {value:.12g}"
        for limit in limits
        for name, value in dataclasses.asdict(limit).items()
    )


RECIPE_NETWORK: dict[str, Any] = {"dropout": 0.0, "num_heads": 4}
"""The fields in which the network of the general recipe differs from the paper's (Table 6)."""

OF_WEIGHTS = (
    "max_prompt_length", "prompt_order", "embed_dim", "num_layers", "num_heads", "encoder", "head",
    "tokens_per_step",
)  # fmt: skip
"""The settings of a network that its parameters depend on. Dropout is not among them, since it only affects
training."""


def check_contradictions(
    given: Mapping[str, Any],
    network: Mapping[str, Any],
    where: str,
    mend: str = "leave it out",
) -> None:
    """Raise ``UsageError`` for the first setting of a network that contradicts its parameters.

    Args:
      given: settings by name, as the user gave them; None for one that was not given.
      network: the settings of the parameters, by name; other settings are ignored.
      where: whose parameters they are, for the message.
      mend: how to mend the contradiction, the end of the message.
    """
    for name, value in given.items():
        if name in network and value not in (None, network[name]):
            switch = flag(name) if value else flag_off(name)
            wanted = switch if isinstance(value, bool) else f"{flag(name)} {shown(value)}"
            found = f"{name} {shown(network[name])}"
            raise UsageError(f"{wanted} contradicts {where}, whose network has {found}; {mend}")


@dataclass(frozen=True)
class TrainConfig:
    """Settings of training. Values in brackets are the paper's (Table 6) or, marked *, those of its
    code."""

    steps: Count = 24_000
    """Number of gradient steps [50,000* to 200,000*, depending on the world]."""
    batch_size: BatchSize = 64
    """Number of trajectories in a gradient step [64]."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """Muon on the matrices of the blocks and AdamW with Nesterov momentum on the rest, or AdamW alone
    [adamw]."""
    learning_rate: Annotated[float, Gt(0), Le(100)] = 3e-3
    """Peak learning rate [1e-4]."""
    warmup_steps: Index = 300
    """Number of steps of linear warm-up; a shorter run warms up until its last step [10,000]."""
    schedule: Literal["cosine", "constant"] = "cosine"
    """Decay of the learning rate after warm-up: to 2 % of its peak along a cosine, or none [constant*]."""
    weight_decay: Annotated[float, Ge(0), Le(1_000)] = 1e-4
    """Weight decay [1e-4]."""
    clip_norm: Positive = 1.0
    """Largest global norm of the gradient [0.25*]."""
    obs_noise: NotNegative = 0.0
    """Largest standard deviation of the Gaussian noise added to observations in training, in their units
    [0]."""
    part_size: BatchSize = 16
    """Number of trajectories in a part of a batch (a microbatch), over all devices. Those of one part have
    nearly equal lengths."""
    part_steps: Count = 1024
    """Largest number of padded steps in a part; larger parts are halved, so that they fit into the cache of
    a core."""
    bucket: BatchSize = 4
    """Padded lengths are rounded up to multiples of this many steps."""
    seed: Seed = 0
    """Random seed of the initial parameters, batches, prompts and dropout."""
