"""A world around another."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Environment, EnvSpec, State, Task, TimeStep


@dataclass(frozen=True)
class Wrapper:
    """Passes everything on to ``env``; subclasses change what they are about."""

    env: Environment

    @property
    def spec(self) -> EnvSpec:
        return self.env.spec

    def sample_task(self, key: PRNGKeyArray) -> Task:
        return self.env.sample_task(key)

    def sample_goal(self, key: PRNGKeyArray) -> Float[Array, "G"]:
        return self.env.sample_goal(key)

    def task_goal(self, task: Task) -> Float[Array, "G"]:
        return self.env.task_goal(task)

    def optimal_return(self, task: Task) -> Float[Array, ""]:
        return self.env.optimal_return(task)

    def fingerprint(self, task: Task) -> Int[Array, "F"]:
        return self.env.fingerprint(task)

    def check_task(self, task: Task) -> None:
        self.env.check_task(task)

    def reset(self, key: PRNGKeyArray, task: Task) -> tuple[State, TimeStep]:
        return self.env.reset(key, task)

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        return self.env.step(state, action)
