"""Franka Kitchen: a robot arm opens doors and turns switches in a hidden order.

There are four worlds with the same tasks and one policy. ``kitchen`` is a reduced scene whose physics
engine depends on the machine; ``kitchen-mjx`` and ``kitchen-native`` are the same scene with a fixed
engine; ``kitchen-stock`` is the full scene of gymnasium-robotics. Nothing here imports jax or mujoco.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from envs.kitchen.extra import NoOpenGLError, check_extra, import_mujoco
from envs.registry import World

if TYPE_CHECKING:
    from envs.agents import Demonstrator
    from envs.drawing import Pictures
    from envs.kitchen.env import Kitchen
    from envs.official import Official
    from envs.page import Page

__all__ = [
    "KITCHEN",
    "KITCHEN_MJX",
    "KITCHEN_NATIVE",
    "KITCHEN_STOCK",
    "NoOpenGLError",
    "check_extra",
    "import_mujoco",
]

HORIZON = 500


def make(name: str = "kitchen", backend: str = "auto", model: str = "reduced") -> Kitchen:
    """The kitchen with an engine (``auto``, ``native`` or ``mjx``) and a model (``reduced`` or ``stock``).

    Raises:
      MissingExtraError: if packages are missing or incompatible with each other.
      NoOpenGLError: if the OpenGL backend that ``MUJOCO_GL`` names is missing.
    """
    import_mujoco()  # raises errors now rather than while a program is traced
    from envs.kitchen.env import Kitchen

    return Kitchen(name=name, horizon=HORIZON, backend=backend, model=model)


def make_mjx() -> Kitchen:
    return make(backend="mjx")


def make_native() -> Kitchen:
    return make(backend="native")


def make_stock() -> Kitchen:
    return make(name="kitchen-stock", backend="native", model="stock")


def load_demonstrators(env: Kitchen) -> Mapping[str, Demonstrator]:
    from envs.kitchen.demonstrators import kitchen_demonstrators

    return kitchen_demonstrators(env)


def load_pictures(env: Kitchen) -> Pictures:
    from envs.kitchen.pictures import kitchen_pictures

    return kitchen_pictures(env)


def load_page(env: Kitchen) -> Page:
    from envs.kitchen.page import kitchen_page

    return kitchen_page(env)


def load_official(env: Kitchen) -> Official:
    from envs.kitchen.official import kitchen_official

    return kitchen_official(env)


KITCHEN = World(
    name="kitchen",
    make=make,
    summary="a robot arm completes 1 to 5 subtasks in a kitchen in a hidden order",
    demonstrators=load_demonstrators,
    presets={
        # Trajectories are long, so 32 of them are enough for a gradient step.
        "fast": {
            "steps": 5_000,
            "trajectories": 9_000,
            "max_prompt_length": 6,
            "bucket": 32,
            "batch_size": 32,
            "part_steps": 2048,
            "head": "binned",
            "standardize_obs": True,
            "obs_noise": 0.03,
        },
        "paper": {
            "steps": 200_000,
            "trajectories": 9_000,
            "max_prompt_length": 6,
            "bucket": 32,
            "head": "fixed_gaussian",
        },
        "ablation": {"steps": 1_000, "trajectories": 9_000},
        "smoke": {"demonstrator": "expert-reduced"},
    },
    pictures=load_pictures,
    page=load_page,
    method_defaults={"spirl": {"target_divergence": 5.0}},  # as for the kitchen in SPiRL's own code
    num_test_tasks=25,
    official=load_official,
)

KITCHEN_MJX = replace(
    KITCHEN,
    name="kitchen-mjx",
    make=make_mjx,
    summary="the kitchen, always stepped by MuJoCo in JAX (MJX)",
    policy_of="kitchen",
)

KITCHEN_NATIVE = replace(
    KITCHEN,
    name="kitchen-native",
    make=make_native,
    summary="the kitchen, always stepped by MuJoCo in C",
    policy_of="kitchen",
)

KITCHEN_STOCK = replace(
    KITCHEN,
    name="kitchen-stock",
    make=make_stock,
    summary="the kitchen in the full scene of gymnasium-robotics, with all its collisions",
    policy_of="kitchen",
)
