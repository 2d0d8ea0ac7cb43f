"""Checks that a world fulfills the contract of every world: ``envs.check_world(world)``.

The rules are those of ``envs/base.py``. First the functions of the world are traced (``definitions``).
Then a few episodes are run beyond their horizon (``episodes``) and checked (``rules``): half of them with
the world's first demonstrator, if it has one, and the others with random actions. Each violation becomes a
sentence that names the step which shows it. Rules that depend on a violated one are skipped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax

import envs.registry
from envs.agents import Demonstrator
from envs.base import Environment
from envs.checks import rules
from envs.checks.definitions import draw, record_faults, shape_faults, task_faults, trace_faults
from envs.checks.episodes import run_case
from envs.errors import UsageError
from envs.registry import World


@dataclass(frozen=True)
class Report:
    """The result of a check."""

    name: str
    """The name of the world."""
    faults: tuple[str, ...]
    """The violations of the contract, a sentence each."""
    notes: tuple[str, ...] = ()
    """Remarks on what is allowed but may be unintended, and on what could not be checked, a sentence
    each."""
    facts: Mapping[str, float] = field(default_factory=dict)
    """Measurements: ``steps_per_cpu_second`` in running episodes, ``compile_seconds`` (CPU time) of a
    program with a reset and a step, and the numbers of ``episodes``, ``steps`` and ``tasks`` that were
    checked."""

    def __str__(self) -> str:
        lines = [f"{self.name}: {_count(len(self.faults), 'fault')}"]
        lines += [f"- {text}" for text in self.faults]
        lines += [f"note: {text}" for text in self.notes]
        if self.facts:
            lines.append(
                "checked {episodes:.0f} episodes with {steps:.0f} steps and {tasks:.0f} tasks; "
                "{steps_per_cpu_second:,.0f} steps per CPU-second, compilation took "
                "{compile_seconds:.1f} CPU-seconds".format(**self.facts)
            )
        return "\n".join(lines)


def check_world(world: World | Environment | str, seed: int = 0) -> Report:
    """Check a world of your own before you train on it.

    Args:
      world: its record, its name or place (``my_package.my_world:WORLD``), or its environment.
      seed: random seed of tasks, episodes and random actions.

    Returns:
      The report, which ``print`` shows as text.

    Raises:
      UsageError: if there is no such world, or packages that it needs are not installed.
    """
    record: Any = envs.registry.find(world) if isinstance(world, str) else world
    notes: list[str] = []
    if isinstance(record, World):
        name = record.name
        try:
            env: Any = record.make()
        except ImportError as error:
            raise UsageError(str(error)) from None
    else:
        name, env, record = type(record).__name__, record, None
    faults = [*record_faults(env)]
    if not faults:
        name = name if record else env.spec.name
        faults += trace_faults(env)
    if not faults:
        faults += shape_faults(env)
    if faults:
        return Report(name, tuple(faults), tuple(notes))
    num_test_tasks = record.num_test_tasks if record else 0
    tasks, again = draw(env, seed, max(2 * num_test_tasks, 64))
    faults += task_faults(env, tasks, again, num_test_tasks)
    demonstrator = _first_demonstrator(record, env, notes)
    case, repeated, facts = run_case(env, demonstrator, tasks, seed)
    facts["tasks"] = float(len(jax.tree.leaves(tasks)[0]))
    impure = [*rules.repetition_faults(case, repeated)]
    faults += impure
    if not impure:  # otherwise no other observation would be reliable
        for rule in rules.OF_EPISODES:
            faults += rule(case)
        faults += rules.outcome_faults(case, notes)
        faults += rules.chance_faults(case, notes)
    return Report(name, tuple(faults), tuple(notes), facts)


def _count(num: int, what: str) -> str:
    return f"{num or 'no'} {what}{'' if num == 1 else 's'}"


def _first_demonstrator(
    record: World | None, env: Environment, notes: list[str]
) -> Demonstrator | None:
    """The demonstrator whose episodes are checked; None if there is none."""
    known = record.demonstrators(env) if record else {}
    for name, demonstrator in known.items():
        if demonstrator.env in (None, env):
            return demonstrator
        notes.append(
            f"the demonstrator {name} acts in another world, so its episodes are not checked"
        )
    return None
