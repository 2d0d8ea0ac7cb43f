"""What ``adapt`` is told reaches the search: the noise, the tasks, the seed, the budget, the judgement.

No search is run here; instead of running, each records what it was asked for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from made_results import ENV, TINY
from test_runner import MAZE, tasks_of, untrained

from envs.registry import WORLDS, Judgement, World
from envs.wrappers import Noisy
from experiments import adaptation, sweeping
from experiments.adapt import main
from experiments.adaptation import adapt_all, chosen_tasks
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.summary import BEHIND_NOISE, judged_episodes
from mgpo_jax import policy_files
from mgpo_jax.methods import UCB

SAMPLED = Judgement("sample", 0.5, episodes=10)


class AskedError(Exception):
    """Ends a command where its search would begin."""


@pytest.mark.parametrize("swept", [(), ("c=1,2",)])
@pytest.mark.parametrize(
    ("noise", "behind"),
    [
        ({}, ENV),
        ({"action_noise": 0.5}, Noisy(ENV, 0.0, 0.5)),
        ({"obs_noise": 0.25, "action_noise": 0.5}, Noisy(ENV, 0.25, 0.5)),
    ],
    ids=["none", "actions", "both"],
)
def test_the_command_searches_in_the_world_and_on_the_tasks_of_its_flags(
    monkeypatch: pytest.MonkeyPatch, swept: tuple[str, ...], noise: dict[str, float], behind: Any
) -> None:
    def searching(*given: Any) -> None:
        raise AskedError(given[-5:])  # the folder comes first where one search is run

    monkeypatch.setitem(WORLDS._registered, "tiny", TINY)
    monkeypatch.setattr(policy_files, "load_policy", lambda world, *rest: ("policy", world, *rest))
    monkeypatch.setattr(adaptation, "chosen_tasks", lambda *given: ("tasks", *given))
    monkeypatch.setattr(adaptation, "adapt_and_save", searching)
    monkeypatch.setattr(sweeping, "sweep_and_save", searching)
    config = AdaptConfig(
        env="tiny", hyper=UCB.hyper(), validation=True, validation_seed=3, sweep=swept, **noise
    )
    with pytest.raises(AskedError) as asked:
        main(config)
    policy = ("policy", TINY, None, UCB.policy)
    tasks = ("tasks", TINY, behind, None, True, 3)
    assert asked.value.args == ((config, TINY, behind, policy, tasks),)


@pytest.mark.parametrize("seed", [0, 3])
def test_validation_tasks_are_those_of_their_seed(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """As many as there are test tasks, and none of those."""
    asked = []
    monkeypatch.setattr(
        adaptation, "evaluation_tasks", lambda *args, **kw: asked.append((args, kw))
    )
    chosen_tasks(replace(TINY, num_test_tasks=4), ENV, None, True, seed)
    assert asked == [((ENV, 4, 4), {"seed": seed})]


def test_an_adaptation_is_what_its_settings_say(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(name="tiny", make=lambda: MAZE, judged=SAMPLED)
    policy, tasks = untrained(MAZE), tasks_of(MAZE)

    def asked(**changes: Any) -> dict[str, Any]:
        given: dict[str, Any] = {}

        def searching(*args: Any, **options: Any) -> list[Any]:
            given.update(options, args=args)
            return []

        monkeypatch.setattr(adaptation, "sweep", searching)
        configs = [AdaptConfig(env="tiny", hyper=UCB.hyper(c=c), **changes) for c in (1.0, 2.0)]
        adapt_all(world, MAZE, policy, tasks, configs)
        return given

    numbers = {"seed": 3, "seeds": 2, "episodes": 7, "eval_every": 5, "stop_at": 0.5}
    found = asked(**numbers, keep_actions=True, eval_episodes=4)
    assert {name: found[name] for name in numbers} == numbers
    assert found["keep_actions"]
    assert found["judged"] == replace(SAMPLED, episodes=4)
    assert found["args"] == (MAZE, policy, tasks, UCB, [UCB.hyper(c=1.0), UCB.hyper(c=2.0)])
    found = asked()
    assert found["judged"] == SAMPLED
    assert found["seed"] == 0
    assert found["stop_at"] is None


@pytest.mark.parametrize("noise", ["obs_noise", "action_noise"])
def test_behind_noise_a_judgement_averages_ten_episodes(noise: str) -> None:
    once = replace(TINY, judged=Judgement())
    assert judged_episodes({}, once) == 1
    assert judged_episodes({noise: 0.1}, once) == BEHIND_NOISE == 10
    often = replace(TINY, judged=Judgement(episodes=12))
    assert judged_episodes({noise: 0.1}, often) == 12
    assert judged_episodes({noise: 0.1, "eval_episodes": 2}, often) == 2
