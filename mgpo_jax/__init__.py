"""Pre-trained multi-goal Transformers with prompt optimization.

This is the public interface: load a policy, make or register a world, adapt to tasks, evaluate prompts, act
step by step outside of compiled programs, pre-train on a dataset. Importing the package does not import
jax; every name is loaded when it is first used.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from envs.agents import Agent, Demonstrator
    from envs.base import Environment, Episode, TimeStep, Trajectory
    from envs.episodes import replay, run_episode
    from envs.errors import DataError, UsageError
    from envs.registry import Judgement, World, make
    from envs.registry import names as world_names
    from envs.registry import register as register_world
    from envs.specs import ArraySpec, Box, Discrete, EnvSpec
    from mgpo_jax.acting import Actor
    from mgpo_jax.adaptation import Adapter, AdaptResult, search
    from mgpo_jax.dataset import Dataset, load_dataset, save_dataset
    from mgpo_jax.judging import evaluate, play
    from mgpo_jax.methods import Method, Setting
    from mgpo_jax.methods import names as method_names
    from mgpo_jax.methods import register as register_method
    from mgpo_jax.optimizers import SearchSpace, bbt, bpe, explore, grips, ucb
    from mgpo_jax.optimizers.methods import prompt_adapter
    from mgpo_jax.outcomes import Outcome
    from mgpo_jax.policy import LoadedPolicy, Policy
    from mgpo_jax.policy_files import load_policy, save_policy
    from mgpo_jax.prompts import Prompt, goals_of, prompt_of, sample_prompt, single_goal
    from mgpo_jax.rollout import Query, prompted
    from mgpo_jax.runner import adapt, sweep
    from mgpo_jax.settings import TrainConfig, static
    from mgpo_jax.tasks import load_tasks, sample_tasks, save_tasks, test_tasks
    from mgpo_jax.training import pretrain

_PLACES = {
    "envs.agents": ("Agent", "Demonstrator"),
    "envs.base": ("Environment", "Episode", "TimeStep", "Trajectory"),
    "envs.episodes": ("replay", "run_episode"),
    "envs.errors": ("DataError", "UsageError"),
    "envs.registry": ("Judgement", "World", "make"),
    "envs.specs": ("ArraySpec", "Box", "Discrete", "EnvSpec"),
    "mgpo_jax.acting": ("Actor",),
    "mgpo_jax.adaptation": ("AdaptResult", "Adapter", "search"),
    "mgpo_jax.dataset": ("Dataset", "load_dataset", "save_dataset"),
    "mgpo_jax.judging": ("evaluate", "play"),
    "mgpo_jax.methods": ("Method", "Setting"),
    "mgpo_jax.optimizers": ("SearchSpace", "bbt", "bpe", "explore", "grips", "ucb"),
    "mgpo_jax.optimizers.methods": ("prompt_adapter",),
    "mgpo_jax.outcomes": ("Outcome",),
    "mgpo_jax.policy": ("LoadedPolicy", "Policy"),
    "mgpo_jax.policy_files": ("load_policy", "save_policy"),
    "mgpo_jax.prompts": ("Prompt", "goals_of", "prompt_of", "sample_prompt", "single_goal"),
    "mgpo_jax.rollout": ("Query", "prompted"),
    "mgpo_jax.runner": ("adapt", "sweep"),
    "mgpo_jax.settings": ("TrainConfig", "static"),
    "mgpo_jax.tasks": ("load_tasks", "sample_tasks", "save_tasks", "test_tasks"),
    "mgpo_jax.training": ("pretrain",),
}  # fmt: skip
_RENAMED = {
    "world_names": ("envs.registry", "names"),
    "register_world": ("envs.registry", "register"),
    "method_names": ("mgpo_jax.methods", "names"),
    "register_method": ("mgpo_jax.methods", "register"),
}
_PLACE_OF = {name: (module, name) for module, of in _PLACES.items() for name in of} | _RENAMED

__all__ = [  # noqa: PLE0604
    *sorted(_PLACE_OF)
]


@functools.cache
def _check_neighbor() -> None:
    """Check that ``envs`` is the package beside this one and not a folder of the user's with that name.

    Python searches the current folder first, so such a folder is found even if it has nothing to do with
    this package.

    Raises:
      ImportError: if it is another one.
    """
    try:
        spec = importlib.util.find_spec("envs")
    except ValueError:  # a module was put under that name by hand
        spec = None
    places = list(spec.submodule_search_locations or [spec.origin or ""]) if spec else []
    wanted = os.path.join(os.path.dirname(os.path.dirname(__file__)), "envs")
    if not any(os.path.realpath(place) == os.path.realpath(wanted) for place in places):
        found = os.path.abspath(places[0]) if places else "nothing"
        raise ImportError(
            f"mgpo_jax needs its own package envs in {wanted}, but Python finds {found} under that name; "
            "rename that one, or start Python in another folder"
        )


def __getattr__(name: str) -> Any:
    if name not in _PLACE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    _check_neighbor()
    module, attribute = _PLACE_OF[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
