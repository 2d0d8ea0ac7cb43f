"""Settings: bounds are enforced for libraries as for command lines, and messages name the flag."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import pytest

from envs.errors import UsageError
from mgpo_jax.settings import TrainConfig, check_settings, flag, number


@dataclass(frozen=True)
class Inner:
    share: float = number(0.5, above=0)


@dataclass(frozen=True)
class Outer:
    num_things: int = number(1, at_least=1)
    scale: float | None = number(None, above=0)
    plain: float = 0.0
    on: bool = number(False, at_least=1)
    name: str = "x"
    inner: Inner = field(default_factory=Inner)


def test_what_is_within_bounds_passes():
    check_settings(Outer())
    check_settings(Outer(num_things=1, scale=1e-9, plain=-5.0, inner=Inner(1.0)))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"num_things": 0}, "--num-things must be at least 1, found 0"),
        ({"scale": 0}, "--scale must be above 0, found 0"),
        ({"scale": -1.0}, r"--scale must be above 0, found -1\.0"),
        ({"scale": float("inf")}, "--scale must be a finite number, found inf"),
        ({"plain": float("nan")}, "--plain must be a finite number, found nan"),
        ({"inner": Inner(0.0)}, r"--share must be above 0, found 0\.0"),
    ],
)
def test_what_is_out_of_bounds_is_named(changes, says):
    with pytest.raises(UsageError, match=says):
        check_settings(replace(Outer(), **changes))


def test_flags():
    assert flag("max_prompt_length") == "--max-prompt-length"


def test_a_usage_error_is_a_value_error():
    assert issubclass(UsageError, ValueError)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0),
        ("batch_size", 0),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("warmup_steps", -1),
        ("weight_decay", -1e-9),
        ("clip_norm", 0.0),
        ("obs_noise", -0.1),
        ("part_size", 0),
        ("part_steps", 0),
        ("bucket", 0),
    ],
)
def test_bounds_of_training(name, value):
    check_settings(TrainConfig())
    with pytest.raises(UsageError, match=f"{flag(name)} must be"):
        check_settings(replace(TrainConfig(), **{name: value}))
