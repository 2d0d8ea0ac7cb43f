"""Settings: ranges are enforced in library calls and on command lines, and messages name the flag."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import hypothesis.strategies as st
import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt
from hypothesis import given

from envs.errors import UsageError
from mgpo_jax.distributions import HEADS
from mgpo_jax.methods import METHODS, split_hyper
from mgpo_jax.settings import (
    Count,
    Head,
    Name,
    NotNegative,
    Positive,
    Seed,
    Share,
    TrainConfig,
    check_settings,
    flag,
    range_of,
    static,
    types_of,
)

if TYPE_CHECKING:
    from somewhere_else import Unknown


@dataclass(frozen=True)
class Inner:
    part: Positive = 0.5


class Odd:
    """A type that pydantic does not know."""


@dataclass(frozen=True)
class Outer:
    num_things: Count = 1
    scale: Positive | None = None
    share: Share = 0.0
    plain: float = 0.0
    sizes: tuple[NotNegative, ...] = ()
    on: bool = False
    name: Name = "x"
    kind: Literal["square", "round"] | None = None
    seed: Seed = 0
    out: Path | None = None
    odd: Odd | None = None
    inner: Inner = field(default_factory=Inner)


def test_what_is_within_its_range_passes():
    check_settings(Outer())
    check_settings(Outer(num_things=1, scale=1e-9, plain=-5.0, inner=Inner(1.0), odd=Odd()))
    check_settings(Outer(scale=1, share=0.999, sizes=(0, 1.5), kind="round", out=Path("x")))
    check_settings(Outer(seed=2**32 - 1, plain=np.float64(3.0)))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"num_things": 0}, "--num-things must be at least 1, found 0"),
        ({"num_things": 10**30}, "--num-things must be below 2147483648, found 1000000000000"),
        (
            {"num_things": 10**5000},
            "--num-things must be below .*, found a number that is too long",
        ),
        ({"num_things": 1.5}, r"--num-things must be an integer, found 1\.5"),
        ({"num_things": True}, "--num-things must be an integer, found True"),
        ({"scale": 0}, "--scale must be above 0, found 0"),
        ({"scale": -1.0}, r"--scale must be above 0, found -1\.0"),
        ({"scale": float("inf")}, "--scale must be a finite number, found inf"),
        ({"scale": "much"}, "--scale must be a number, found 'much'"),
        ({"share": 1.0}, r"--share must be below 1, found 1\.0"),
        ({"plain": float("nan")}, "--plain must be a finite number, found nan"),
        ({"sizes": (0.1, -1.0)}, r"--sizes must be at least 0, found \(0\.1, -1\.0\)"),
        ({"sizes": (0.1, float("nan"))}, r"--sizes must be a finite number, found \(0\.1, nan\)"),
        ({"on": 1}, "--on must be true or false, found 1"),
        ({"name": ""}, "--name must not be empty, found ''"),
        ({"kind": "rund"}, "unknown --kind 'rund'; did you mean 'round'"),
        ({"kind": 3}, "--kind must be 'square' or 'round', found 3"),
        ({"seed": -1}, "--seed must be at least 0, found -1"),
        ({"seed": 2**32}, "--seed must be below 4294967296, found 4294967296"),
        ({"inner": Inner(0.0)}, r"--part must be above 0, found 0\.0"),
    ],
)
def test_what_is_out_of_its_range_is_named(changes: dict[str, Any], says: str):
    with pytest.raises(UsageError, match=f"^{says}") as error:
        check_settings(replace(Outer(), **changes))
    assert "\n" not in str(error.value)


@given(st.floats())
def test_every_number_is_in_its_range_or_refused_by_name(value: float):
    for name, fits in (("scale", 0 < value <= 1e9), ("share", 0 <= value < 1)):
        if fits:
            check_settings(replace(Outer(), **{name: value}))
            continue
        with pytest.raises(UsageError) as error:
            check_settings(replace(Outer(), **{name: value}))
        assert str(error.value).startswith(f"--{name} must be ")
        assert str(error.value).endswith(f", found {value!r}")


@given(st.integers())
def test_every_seed_of_32_bits_is_taken(value: int):
    if 0 <= value < 2**32:
        check_settings(Outer(seed=value))
        return
    with pytest.raises(UsageError, match=r"^--seed must be "):
        check_settings(Outer(seed=value))


def test_a_type_that_only_a_type_checker_knows_is_not_checked():
    @dataclass(frozen=True)
    class Mine:
        rate: float = 1.0
        other: Unknown | None = None

    check_settings(Mine())
    with pytest.raises(UsageError, match="--rate must be a finite number, found nan"):
        check_settings(Mine(rate=math.nan))


def test_ranges_in_words():
    assert range_of(Count) == "at least 1, below 2147483648"
    assert range_of(Share) == "at least 0, below 1"
    assert range_of(Annotated[float, Gt(0), Le(1e9)] | None) == "above 0, at most 1000000000"
    assert range_of(tuple[Annotated[int, Ge(0), Lt(3)], ...]) == "at least 0, below 3"
    assert range_of(int) == range_of(Head) == range_of(Any) == ""


def test_flags():
    assert flag("max_prompt_length") == "--max-prompt-length"


def test_a_usage_error_is_a_value_error():
    assert issubclass(UsageError, ValueError)


def test_names_that_need_jax_are_known_without_it():
    assert get_args(Head) == tuple(HEADS)


def test_static_numbers_are_no_data():
    @dataclass(frozen=True)
    class Hyper:
        rate: Positive = 1.0
        size: Count = static(3)

    fixed, numbers = split_hyper([Hyper(), Hyper(rate=2.0)])
    assert numbers == {"rate": [1.0, 2.0]}
    assert fixed.size == 3


@pytest.mark.parametrize("name", METHODS.names())
def test_every_number_of_a_method_has_a_range(name: str):
    hyper = METHODS.find(name).hyper
    for setting in fields(hyper):
        kind = types_of(hyper)[setting.name]
        chosen = kind is bool or get_origin(kind) is Literal
        assert chosen or range_of(kind), f"{name}: {setting.name}"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0),
        ("batch_size", 0),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("learning_rate", 1e38),
        ("warmup_steps", -1),
        ("weight_decay", -1e-9),
        ("clip_norm", 0.0),
        ("obs_noise", -0.1),
        ("part_size", 0),
        ("part_steps", 0),
        ("bucket", 0),
        ("seed", -1),
    ],
)
def test_ranges_of_training(name: str, value: Any):
    check_settings(TrainConfig())
    with pytest.raises(UsageError, match=f"{flag(name)} must be"):
        check_settings(replace(TrainConfig(), **{name: value}))


def test_numbers_of_numpy_are_numbers() -> None:
    """A sweep over an arange is not refused for its types."""

    @dataclass(frozen=True)
    class Swept:
        num: Count = 1
        rate: Positive = 0.1

    numpy: Any = Swept(num=np.int64(64), rate=np.float32(0.5))  # type: ignore[arg-type]
    check_settings(numpy)
    with pytest.raises(UsageError, match="--num must be at least 1, found 0"):
        check_settings(replace(numpy, num=np.int64(0)))
    _, numbers = split_hyper([numpy, replace(numpy, num=np.int64(65))])
    assert numbers == {"num": [64, 65], "rate": [0.5, 0.5]}
    assert all(type(value) in (int, float) for values in numbers.values() for value in values)
