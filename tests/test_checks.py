"""``check_world`` finds each kind of fault in worlds broken on purpose, and none in sound ones."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_world import WORLD

import envs
from envs import Agent, ArraySpec, Demonstrator, Discrete, Environment, EnvSpec, TimeStep, World
from experiments import check, runtime


def pick(key: jax.Array, num: int) -> jax.Array:
    """1 to ``num`` from the bits of a key, which compiles faster than ``jax.random``."""
    return (1 + jax.random.key_data(key)[-1] % num).astype(jnp.int32)


class Walk(NamedTuple):
    goal: jax.Array
    cell: jax.Array
    steps: jax.Array


@dataclass(frozen=True)
class Track(Environment):
    """Six cells in a row; the episode ends at the goal, which pays 1."""

    spec = EnvSpec(
        name="track", obs=ArraySpec((6,)), goal_dim=1, actions=Discrete(2), horizon=8,
        return_range=(0.0, 1.0),
    )  # fmt: skip

    def sample_task(self, key):
        return pick(key, 5)

    def task_goal(self, task):
        return task[None].astype(jnp.float32)

    def optimal_return(self, task):
        return jnp.ones(())

    def reset(self, key, task):
        walk = Walk(task, jnp.int32(0), jnp.int32(0))
        return walk, self.look(walk, jnp.float32(0))

    def over(self, walk):
        return (walk.cell == walk.goal) | (walk.steps >= 8)

    def step(self, state, action):
        cell = jnp.clip(state.cell + 2 * action - 1, 0, 5)
        after = Walk(state.goal, cell, state.steps + 1)
        after = jax.tree.map(lambda a, b: jnp.where(self.over(state), a, b), state, after)
        paid = (cell == state.goal) & ~self.over(state)
        return after, self.look(after, paid.astype(jnp.float32))

    def look(self, walk, reward):
        here, there = walk.cell[None].astype(jnp.float32), walk.cell == walk.goal
        return TimeStep(
            obs=jax.nn.one_hot(walk.cell, 6),
            achieved_goal=here,
            goal_reached=jnp.ones((), bool),
            outcome=here,
            reward=reward,
            terminated=there,
            truncated=(walk.steps >= 8) & ~there,
        )


def ahead(weights):
    """Walks to the right."""

    def proceed(key, memory, state, timestep):
        return jnp.int32(1), jnp.zeros((), bool), memory

    return Agent(lambda key, task, state, timestep: proceed(key, (), state, timestep), proceed)


def record(env: Environment, shown: bool = True) -> World:
    walker = Demonstrator(lambda key, index: env.sample_task(key), ahead)
    who = {"ahead": walker} if shown else {}
    return World(name="track", make=lambda: env, demonstrators=lambda env: who, num_test_tasks=4)


def told(change: Callable[[Any, TimeStep, Any], dict[str, Any]]) -> type[Track]:
    """A track that tells other things: ``change(state before, time step, action)``."""

    class Changed(Track):
        def step(self, state, action):
            after, timestep = super().step(state, action)
            return after, timestep._replace(**change(state, timestep, action))

    return Changed


def changed(**methods: Any) -> type[Track]:
    """A track with other methods."""
    return type("Changed", (Track,), methods)


TALLY, KEPT, CALLS = count(), [], count()


def leaky(self, state, action):
    KEPT.append(state.cell + 1)
    return Track.step(self, state, action)


def counting(self, state, action):
    after, timestep = Track.step(self, state, action)
    return after, timestep._replace(reward=timestep.reward * (1 + next(TALLY)))


def impure(state, timestep, action):
    def draw(cell):
        return np.float32(next(CALLS))

    seen = jax.pure_callback(draw, jnp.zeros(()), state.cell, vmap_method="sequential")
    return {"obs": timestep.obs.at[3].add(seen)}


def slips(self, state, action):
    """An action that chance turns around; the key is in the task's place of the state."""
    wrong = jax.random.bernoulli(jax.random.key(state.steps + 7 * state.goal[1]))
    walk = Walk(state.goal[0], state.cell, state.steps)
    after, timestep = Track.step(self, walk, jnp.where(wrong, 1 - action, action))
    return after._replace(goal=state.goal), timestep


def slips_reset(self, key, task):
    walk, timestep = Track.reset(self, key, task)
    return walk._replace(goal=jnp.stack([task, jax.random.randint(key, (), 0, 99)])), timestep


def branching(self, state, action):
    return Track.step(self, state, action if state.cell > 0 else action + 1)


def of_batch(state, timestep, action):
    """What a world computes that looks at all lanes of a batch."""

    @jax.custom_batching.custom_vmap
    def size(x):
        return x

    @size.def_vmap
    def rule(num, batched, x):
        return x + num, True

    return {"obs": size(timestep.obs)}


def growing(self, state, action):
    after, timestep = Track.step(self, state, action)
    return after._replace(steps=after.steps.astype(jnp.float32)), timestep


def moving(self, state, action):
    after, timestep = Track.step(self, state, action)
    return after._replace(steps=state.steps + 1), timestep


def forged(**fields: Any) -> EnvSpec:
    """The spec of a track with fields of wrong types, which the type checker of the tests would refuse."""
    spec = replace(Track.spec)
    for name, value in fields.items():
        object.__setattr__(spec, name, value)
    return spec


def sheer(self, state, action):
    """Returns its state as a tuple with fields of no name."""
    after, timestep = Track.step(self, state, action)
    return tuple(after), timestep


def nameless(self, state, action):
    """Returns a dict in place of a time step."""
    after, timestep = Track.step(self, state, action)
    return after, timestep._asdict()


def fickle(self, key):
    """Draws another task at every call, whatever the key."""

    def draw(key):
        return np.int32(1 + next(CALLS) % 5)

    data = jax.random.key_data(key)
    return jax.pure_callback(
        draw, jax.ShapeDtypeStruct((), jnp.int32), data, vmap_method="sequential"
    )


def done_at_once(self, key, task):
    walk, timestep = Track.reset(self, key, task)
    return walk, timestep._replace(terminated=jnp.ones((), bool))


def only_traced(self, state, action):
    if not isinstance(action, jax.core.Tracer):
        raise TypeError("a number is no tracer")
    return Track.step(self, state, action)


BROKEN = {
    "no spec": (changed(spec="track"), r"spec is a str; it must be an envs.EnvSpec"),
    "actions": (
        changed(spec=forged(actions=2)),
        "spec.actions is 2; it must be envs.Discrete or envs.Box",
    ),
    "horizon": (changed(spec=forged(horizon=0)), "spec.horizon is 0; it must be an integer"),
    "goal_dim": (
        changed(spec=forged(goal_dim=1.5)), r"spec.goal_dim is 1.5; it must be an integer"
    ),
    "no time step": (changed(step=nameless), "step returns a dict in second place"),
    "other fields": (changed(step=sheer), "the state returned by step has different fields from the state"),
    "no array": (
        told(lambda s, t, a: {"obs": (t.obs, t.obs)}), r"obs of step is a tuple; it must be an array"
    ),
    "fickle tasks": (changed(sample_task=fickle), "sample_task is not pure: the same key drew two"),
    "goal is no number": (
        changed(task_goal=lambda self, task: jnp.full((1,), jnp.nan)), "task_goal of sampled task 0 is not"
    ),
    "over at reset": (changed(reset=done_at_once), "reset of episode 0 returns an episode that is over"),
    "seen after the end": (
        told(lambda s, t, a: {"obs": t.obs + Track().over(s)}),
        "has a different obs from that at the end of the episode, step [1-8]; terminal states must stay",
    ),
    "only under jit": (
        changed(step=only_traced),
        "the world works only under jit; without jit it raises TypeError: a number is no tracer",
    ),
    "no class of a world": (object, r"make\(\) returns a object"),
    "unhashable": (changed(__hash__=None), "cannot be hashed"),
    "range": (
        changed(spec=replace(Track.spec, return_range=(1.0, 0.0))), r"return_range is \(1.0, 0.0\)"
    ),
    "undefined": (changed(task_goal=Environment.task_goal), "task_goal is not defined"),
    "python branch": (changed(step=branching), "step cannot be compiled.*Bool"),
    "leak": (changed(step=leaky), "step leaks a tracer"),
    "counter": (changed(step=counting), "step is not pure: tracing it twice"),
    "callback": (told(impure), "keys, tasks and actions played twice, obs differs at step 1"),
    "obs shape": (changed(spec=replace(Track.spec, obs=ArraySpec((7,)))), r"obs of reset is float32\[6\]"),
    "obs dtype": (
        told(lambda s, t, a: {"obs": t.obs.astype(jnp.uint8)}), r"obs of step is uint8\[6\]; it must be"
    ),
    "goal shape": (
        told(lambda s, t, a: {"achieved_goal": t.achieved_goal[0]}), r"achieved_goal of step is float32\[\]"
    ),
    "integer reward": (
        told(lambda s, t, a: {"reward": t.reward.astype(jnp.int32)}), r"reward of step is int32\[\]"
    ),
    "state dtype": (changed(step=growing), r"the state's steps is int32\[\] after reset and float32\[\]"),
    "one task": (changed(sample_task=lambda self, key: jnp.int32(3)), "all of 64 sampled tasks are"),
    "few tasks": (
        changed(sample_task=lambda self, key: pick(key, 3)), "only 3 different tasks"
    ),
    "refused tasks": (
        changed(check_task=lambda self, tasks: (_ for _ in ()).throw(ValueError("no"))),
        r"check_task refuses a task that sample_task drew \(no\)",
    ),
    "chance": (
        changed(step=slips, reset=slips_reset),
        "spec.deterministic is True.*differs at step [1-8] of episode",
    ),
    "paid after the end": (
        told(lambda s, t, a: {"reward": t.terminated.astype(jnp.float32)}),
        "pays a reward of 1 after the end of the episode at step [1-5];",
    ),
    "moves after the end": (changed(step=moving), "changes the state after the end of the episode"),
    "endless": (
        told(lambda s, t, a: {"truncated": jnp.zeros((), bool)}), "last one of the horizon of 8 steps"
    ),
    "early": (
        told(lambda s, t, a: {"truncated": s.steps + 1 >= 3}), "is truncated before the horizon of 8 steps"
    ),
    "both": (told(lambda s, t, a: {"truncated": t.terminated}), "is terminated and truncated at once"),
    "out of range": (
        told(lambda s, t, a: {"reward": 3 * t.reward}), r"outside of the stated range: 3 at the end"
    ),
    "reward is no number": (
        told(lambda s, t, a: {"reward": t.reward + jnp.nan}), "step 1 of episode 0.*pays nan"
    ),
    "obs is no number": (told(lambda s, t, a: {"obs": t.obs + jnp.nan}), "step 1 of episode 0.*not finite"),
    "same goal": (
        told(lambda s, t, a: {"achieved_goal": jnp.ones(1)}), r"achieved_goal is \[1.0\] at each of the"
    ),
    "no goal": (
        told(lambda s, t, a: {"goal_reached": jnp.zeros((), bool)}), "no goal is reached in .* steps"
    ),
    "unconfirmed": (
        type("U", (told(lambda s, t, a: {"goal_reached": t.reward < 1}),), {
            "spec": replace(Track.spec, reward_confirms_goals=True)
        }),
        "gives a positive reward although no goal is reached",
    ),
    "outcome": (
        told(lambda s, t, a: {"outcome": 0 * t.outcome}),
        r"step [1-5] of episode [0-2] \(the demonstrator's actions\) ends the episode with the best "
        r"return, and its outcome is \[0.0\]; it must be the goal of the task, \[[1-5].0\]",
    ),
    "vmap": (told(of_batch), "vmap changes the results"),
    "jit": (
        told(lambda s, t, a: {"obs": t.obs + (0 if isinstance(s.cell, jax.core.Tracer) else 1)}),
        "jit changes the results: compared with running the same episode without jit, obs differs at "
        "step 1 of episode 0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", BROKEN)
def test_faults_are_found(fault: str) -> None:
    world, says = BROKEN[fault]
    report = envs.check_world(record(world(), shown=fault in ("no goal", "outcome")))
    assert any(re.search(says, text) for text in report.faults), report.faults
    assert len(report.faults) <= 3, report.faults
    for text in report.faults:
        assert "\n" not in text


SOUND = [
    record(Track()),
    Track(),
    pytest.param(WORLD, marks=pytest.mark.slow),
    pytest.param("gridworld", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("world", SOUND, ids=["track", "spec", "line", "gridworld"])
def test_sound_worlds_have_no_fault(world: Any) -> None:
    report = envs.check_world(world)
    assert (report.faults, report.notes) == ((), ())
    assert report.facts["steps_per_cpu_second"] > 0
    assert report.facts["steps"] > 0
    assert report.facts["episodes"] == 6
    assert "no faults" in str(report)


class Balance(Track):
    """A track whose best return is unknown, and which pays for every step until the end."""

    spec = replace(Track.spec, return_range=(0.0, 8.0))

    def optimal_return(self, task):
        return jnp.full((), jnp.nan)

    def step(self, state, action):
        after, timestep = super().step(state, action)
        paid = jnp.where(self.over(state), 0.0, 1.0)
        return after, timestep._replace(reward=paid, outcome=-jnp.ones(1))


def test_the_last_of_many_rewards_is_no_solution() -> None:
    report = envs.check_world(record(Balance()))
    assert report.faults == ()
    assert len(report.notes) == 1
    assert (
        "was not checked: optimal_return is unknown, and rewards are paid before" in report.notes[0]
    )


def test_the_only_reward_of_an_unknown_best_return_is_a_solution() -> None:
    lost = told(lambda s, t, a: {"outcome": -jnp.ones(1)})
    unknown = type("Unknown", (lost,), {"optimal_return": Balance.optimal_return})
    (fault,) = envs.check_world(record(unknown())).faults
    assert "ends the episode with a reward, and its outcome is [-1.0]" in fault


def test_chance_that_has_no_part_is_a_note() -> None:
    calm = changed(spec=replace(Track.spec, deterministic=False))
    report = envs.check_world(record(calm()))
    assert report.faults == ()
    assert "spec.deterministic is False" in report.notes[0]


@pytest.fixture
def command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], tuple[int, str, str]]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "configure", lambda: None)

    def call(line: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            check.command(line.split())
        return int(stop.value.code or 0), *capsys.readouterr()

    return call


def test_the_command_checks_worlds(command) -> None:
    code, out, err = command("own_world:WORLD --out new.json")
    assert code == 0
    assert err.endswith("results written to new.json\n")
    assert out.startswith("line: no faults\n")
    found = json.loads(Path("new.json").read_text())["worlds"]["own_world:WORLD"]
    assert found["faults"] == []
    code, out, err = command("test_checks:BAD")
    assert code == 1
    assert "bad-track: 1 fault\n- " in out
    assert "faults found in test_checks:BAD; fix those listed above before any training\n" in err


BAD = World(name="bad-track", make=told(lambda s, t, a: {"reward": 3 * t.reward}), num_test_tasks=4)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no result folder given, and no world"),
        ("nowhere:WORLD", "cannot load the world 'nowhere:WORLD'"),
        ("maze15 . ", "not both at once"),
        ("maze51", "unknown folder or world 'maze51'; did you mean 'maze15'?"),
        ("maze15 maze51", "unknown folder or world 'maze51'"),
        ("maze15 runs/maze51", "not both at once"),
        ("maze15 --env maze30", "leave them out to check a world"),
        ("maze15 --out .", "--out"),
    ],
)
def test_what_cannot_be_checked(command, line: str, says: str) -> None:
    code, _, err = command(line)
    assert code == 2
    assert says in err
    assert len(err.strip().splitlines()) == 1
