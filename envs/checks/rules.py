"""The rules that episodes of a world must keep, each a generator of sentences about violations."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import TimeStep
from envs.checks.episodes import LANES, Case, Played, play
from envs.checks.values import as_numpy, first_of, reason
from envs.errors import shown

EAGER_STEPS = 3
"""Number of steps without ``jit``, which take long in some worlds."""
CLOSE = 1e-5
"""Tolerance between results of the same computation compiled in different ways."""


def end_faults(case: Case) -> Iterator[str]:
    """Episodes that are over at their start, end in two ways at once, or do not end at the horizon."""
    first, steps, horizon = case.played.first, case.played.steps, case.env.spec.horizon
    begun = np.asarray(first.terminated | first.truncated)
    if begun.any():
        yield f"reset of episode {first_of(begun)[0]} returns an episode that is over before any action"
    if (both := steps.terminated & steps.truncated).any():
        yield (
            f"{case.place(*first_of(both))} is terminated and truncated at once; an episode that its task "
            "ends is not truncated"
        )
    for lane, end in enumerate(case.ends.tolist()):
        if not 0 <= end < horizon:
            yield (
                f"{case.place(lane, horizon - 1)} is the last one of the horizon of {horizon} steps, and "
                "the episode is neither terminated nor truncated"
            )
            return
        if steps.truncated[lane, end] and not steps.terminated[lane, end] and end < horizon - 1:
            yield (f"{case.place(lane, end)} is truncated before the horizon of {horizon} steps")
            return


def absorbing_faults(case: Case) -> Iterator[str]:
    """Changes or rewards after the end of an episode."""
    steps = case.played.steps
    for lane, end in enumerate(case.ends.tolist()):
        if end < 0:
            continue
        changed = False
        paid = steps.reward[lane, end + 1 :] != 0
        if paid.any():
            step = end + 1 + first_of(paid)[0]
            yield (
                f"{case.place(lane, step)} pays a reward of {steps.reward[lane, step]:g} after the end of "
                f"the episode at step {end + 1}; terminal states must give reward 0"
            )
        moved = ~case.played.unchanged[lane, end + 1 :]
        if moved.any():
            step = end + 1 + first_of(moved)[0]
            yield (
                f"{case.place(lane, step)} changes the state after the end of the episode at step "
                f"{end + 1}; terminal states must stay as they are"
            )
        # ``goal_reached`` refers to a single step, so it need not stay the same after the end.
        for name in ("obs", "achieved_goal", "outcome", "terminated", "truncated"):
            rows = getattr(steps, name)[lane, end:]
            differs = np.array([not np.array_equal(row, rows[0]) for row in rows])
            if differs.any():
                step = end + first_of(differs)[0]
                yield (
                    f"{case.place(lane, step)} has a different {name} from that at the end of the episode, "
                    f"step {end + 1}; terminal states must stay as they are"
                )
                changed = True
        if changed or paid.any() or moved.any():
            return


def reward_faults(case: Case) -> Iterator[str]:
    """Rewards that are not finite, and returns outside of the stated range."""
    rewards, (low, high) = case.played.steps.reward, case.env.spec.return_range
    if not np.isfinite(rewards).all():
        place = first_of(~np.isfinite(rewards))
        yield f"{case.place(*place)} pays {rewards[place]}; rewards must be finite"
        return
    slack = CLOSE * max(1.0, abs(low), abs(high))
    for lane, end in enumerate(case.ends.tolist()):
        sums = np.cumsum(rewards[lane, : end + 1 or None], dtype=np.float64)
        if not low - slack <= sums[-1] <= high + slack:
            beyond = (sums < low - slack) if sums[-1] < low else (sums > high + slack)
            yield (
                f"{case.place(lane, first_of(beyond)[0])} takes the return outside of the stated range: "
                f"{sums[-1]:g} at the end, spec.return_range is ({low:g}, {high:g})"
            )
            return


def goal_faults(case: Case) -> Iterator[str]:
    """Observations and goals that are not finite or contradict their meaning."""
    steps, lanes = case.played.steps, range(len(case.ends))
    for name in ("obs", "achieved_goal", "outcome"):
        bad = ~np.isfinite(getattr(steps, name)).reshape(*steps.reward.shape, -1).all(axis=2)
        if bad.any():
            yield f"{case.place(*first_of(bad))} has a {name} that is not finite"
    live = [slice(0, end + 1 if end >= 0 else None) for end in case.ends.tolist()]
    reached = np.concatenate([steps.goal_reached[i, live[i]] for i in lanes])
    goals = np.concatenate([steps.achieved_goal[i, live[i]] for i in lanes])
    if not reached.any():
        if case.shown:
            yield (
                f"no goal is reached in {len(reached)} steps, {case.shown} of the episodes being the "
                "demonstrator's; goal_reached says at which steps achieved_goal counts"
            )
    elif reached.sum() > LANES and (goals[reached] == goals[reached][0]).all():
        yield (
            f"achieved_goal is {shown(goals[reached][0].tolist())} at each of the {reached.sum()} steps "
            "at which a goal is reached; it must say which goal that is"
        )
    if case.env.spec.reward_confirms_goals:
        silent = (steps.reward > 0) & ~steps.goal_reached
        if silent.any():
            yield (
                f"{case.place(*first_of(silent))} gives a positive reward although no goal is reached; "
                "with spec.reward_confirms_goals=True, goal_reached must be true there"
            )


def outcome_faults(case: Case, notes: list[str]) -> Iterator[str]:
    """Episodes that solve their task, but whose outcome is not the goal of that task.

    If the best return of a task is unknown, a reward at the end of an episode counts as a solution. Where
    rewards are paid before the end, too, as in CartPole, the last one may say nothing: if then no such
    episode has the goal of its task as outcome, a note tells that this could not be checked.
    """
    steps = case.played.steps
    wanted = np.asarray(jax.vmap(case.env.task_goal)(case.tasks))
    # Continuous goals are met within a tolerance that only the world knows. It is far below the distance
    # between the goals of two different tasks.
    apart = np.linalg.norm(wanted[:, None] - wanted[None], axis=-1)
    apart = apart[apart > 0]
    near = 0.5 * np.median(apart) if apart.size else 1e-3
    best = np.asarray(jax.jit(jax.vmap(case.env.optimal_return))(case.tasks))
    solved: list[tuple[int, int, bool]] = []
    missed: list[tuple[int, int, bool]] = []
    for lane, end in enumerate(case.ends.tolist()):
        if end < 0 or not steps.terminated[lane, end] or steps.failed[lane, end]:
            continue
        return_ = steps.reward[lane, : end + 1].sum()
        known = np.isfinite(best[lane])
        if return_ >= best[lane] - 1e-4 if known else steps.reward[lane, end] > 0:
            met = np.linalg.norm(steps.outcome[lane, end] - wanted[lane]) < near
            (solved if met else missed).append((lane, end, known))
    certain = [place for place in missed if place[2]]
    if missed and not certain and not solved and _pays_on_the_way(case):
        notes.append(
            "whether outcome is the goal of the task in a solved episode was not checked: optimal_return "
            "is unknown, and rewards are paid before the end of an episode, so that a reward at its end "
            "does not show that the task is solved"
        )
    elif certain or (missed and not solved):
        lane, end, known = (certain or missed)[0]
        how = "with the best return" if known else "with a reward"
        yield (
            f"{case.place(lane, end)} ends the episode {how}, and its outcome is "
            f"{shown(steps.outcome[lane, end].tolist())}; it must be the goal of the task, "
            f"{shown(wanted[lane].tolist())}"
        )


def _pays_on_the_way(case: Case) -> bool:
    """Whether an episode has a positive reward before its last step."""
    rewards = case.played.steps.reward
    before = [end if end >= 0 else None for end in case.ends]  # -1 is the end of none
    return any((rewards[lane, :end] > 0).any() for lane, end in enumerate(before))


def _difference(a: Played, b: Played, tolerance: float = 0.0) -> tuple[int, int, str] | None:
    """The episode, step (0 for the reset) and field of the first difference between two runs."""
    found: list[tuple[int, int, str]] = []
    for name in TimeStep._fields:
        for mine, other, offset in ((a.first, b.first, 0), (a.steps, b.steps, 1)):
            x, y = (np.asarray(getattr(told, name)) for told in (mine, other))
            if x.ndim == 0:  # a constant
                continue
            rough = np.issubdtype(x.dtype, np.floating)
            same = np.isclose(x, y, tolerance, tolerance, equal_nan=True) if rough else x == y
            same = same.reshape(*x.shape[: 1 + offset], -1).all(axis=-1)
            if not same.all():
                place = first_of(~same)
                found.append((place[0], place[1] + 1 if offset else 0, name))
    return min(found, key=lambda one: (one[1], one[0])) if found else None


def _at(case: Case, where: tuple[int, int, str]) -> str:
    lane, step, name = where
    place = case.place(lane, step - 1) if step else f"the reset of episode {lane}"
    return f"{name} differs at {place}"


def repetition_faults(case: Case, repeated: Played) -> Iterator[str]:
    """Differences between two runs with the same inputs."""
    if where := _difference(case.played, repeated):
        yield f"the world is not pure: the same keys, tasks and actions played twice, {_at(case, where)}"


def chance_faults(case: Case, notes: list[str]) -> Iterator[str]:
    """Contradictions between ``EnvSpec.deterministic`` and episodes with different keys."""
    others = jax.vmap(lambda key: jax.random.fold_in(key, 1))(case.keys)
    where = _difference(case.played, as_numpy(case.play(others, case.tasks, case.actions)))
    if where and case.env.spec.deterministic:
        yield (
            "spec.deterministic is True, but with a different key and the same task and actions, "
            f"{_at(case, where)}"
        )
    if where is None and not case.env.spec.deterministic:
        notes.append(
            f"spec.deterministic is False, but {LANES} episodes were the same with different keys; set it "
            "to True if nothing in the world is random"
        )


def program_faults(case: Case) -> Iterator[str]:
    """Episodes that differ from those of the batch if they are run alone or without ``jit``."""
    lane = 0
    task = jax.tree.map(lambda leaf: leaf[lane], case.tasks)
    alone = jax.jit(
        partial(play, case.env), compiler_options=dict(case.env.engine.compiler_options)
    )
    one = as_numpy(alone(case.keys[lane], task, case.actions[lane]))
    kept = jax.tree.map(lambda rows: rows[lane : lane + 1], case.played)
    if where := _difference(kept, jax.tree.map(lambda leaf: leaf[None], one), CLOSE):
        yield (
            "vmap changes the results: compared with running the same episode alone, "
            f"{_at(case, where)}"
        )
    try:
        state, first = case.env.reset(case.keys[lane], task)
        told = []
        for action in case.actions[lane][:EAGER_STEPS]:
            state, timestep = case.env.step(state, action)
            told.append(timestep._replace(failed=jnp.asarray(timestep.failed)))
    except Exception as error:
        yield f"the world works only under jit; without jit it raises {reason(error)}"
        return
    steps = jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows])[None], *told)
    eager = Played(jax.tree.map(lambda leaf: np.asarray(leaf)[None], first), steps, None)
    short = jax.tree.map(lambda rows: rows[:, :EAGER_STEPS], kept.steps)
    if where := _difference(Played(kept.first, short, None), eager, CLOSE):
        yield (
            "jit changes the results: compared with running the same episode without jit, "
            f"{_at(case, where)}"
        )


OF_EPISODES = (end_faults, absorbing_faults, reward_faults, goal_faults, program_faults)
"""The rules that hold in every pure world, in the order in which their violations are reported."""
