"""How true the kitchen's physics is: ``python -m experiments.fidelity``.

Over random actions: our world on the stock model with gymnasium-robotics' FrankaKitchen, the reduced model
with the stock model, and MJX with C MuJoCo. Over demonstrations: what the demonstrator completes on either
model, and whether FrankaKitchen, given the actions of those on the stock model, completes the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.experts import demonstrators
from envs.kitchen import SUBTASKS, Kitchen, check_extra
from experiments.configs import positive
from experiments.runtime import Common, run
from mgpo_jax.errors import UsageError
from mgpo_jax.rollout import run_episode
from mgpo_jax.types import Episode

ARM, OBJECTS = slice(0, 7), slice(18, 32)
NUM_LONGEST = 120  # tasks of all five subtasks, the last in the enumeration
LANES = "lanes"


@dataclass(frozen=True)
class FidelityConfig(Common):
    """Settings of ``experiments.fidelity``."""

    worlds: int = 16
    """Episodes of random actions."""
    steps: int = 40
    """Control steps of each."""
    mjx: bool = True
    """Compare MJX too (compiles for half a minute on a CPU)."""
    demonstrations: int = 8
    """Demonstrations of all five subtasks on each model."""


def gymnasium_kitchen() -> Any:
    """FrankaKitchen without noise; one function of gymnasium-robotics 1.4.2 is replaced.

    Its ``robot_get_obs`` compares joint types in a way that mujoco 3.17 answers with an error.
    """
    from gymnasium_robotics.envs.franka_kitchen import franka_env
    from gymnasium_robotics.envs.franka_kitchen.kitchen_env import KitchenEnv

    def robot_get_obs(model: Any, data: Any, joint_names: Any) -> tuple[np.ndarray, np.ndarray]:
        return data.qpos[:9].copy(), data.qvel[:9].copy()

    franka_env.robot_get_obs = robot_get_obs
    return KitchenEnv(list(SUBTASKS), object_noise_ratio=0.0, robot_noise_ratio=0.0)


def observations(env: Kitchen, actions: Float[np.ndarray, "B T 9"]) -> Float[np.ndarray, "B T 59"]:
    """What episodes with these actions look like."""
    options: dict[str, Any] = {}
    if env.backend == "mjx" and jax.default_backend() == "cpu":
        from envs.kitchen.mjx import CPU_OPTIONS

        options = {"compiler_options": CPU_OPTIONS}
    state, _ = env.reset(jax.random.key(0), env.task(jnp.array(env.num_tasks - 1)))

    def play(rows: jax.Array) -> jax.Array:
        return jax.lax.scan(env.step, state, rows)[1].obs

    return np.asarray(jax.jit(jax.vmap(play), **options)(actions))


def gymnasium_observations(actions: Float[np.ndarray, "B T 9"]) -> Float[np.ndarray, "B T 59"]:
    """The same from FrankaKitchen."""
    kitchen = gymnasium_kitchen()

    def play(rows: np.ndarray) -> list[np.ndarray]:
        kitchen.reset(seed=0)
        return [kitchen.step(action)[0]["observation"] for action in rows]

    return np.array([play(rows) for rows in actions])


def random_actions(num_worlds: int, num_steps: int) -> Float[np.ndarray, "B T 9"]:
    """Uniform in the cube, held for five steps each: the arm gets around."""
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1, 1, (num_worlds, -(-num_steps // 5), 9)).astype(np.float32)
    return np.repeat(targets, 5, axis=1)[:, :num_steps]


def backend_errors(num_worlds: int, num_steps: int) -> Float[np.ndarray, "B T 59"]:
    """MJX against C MuJoCo on the reduced model, absolute."""
    actions = random_actions(num_worlds, num_steps)
    native, mjx = (
        observations(Kitchen("kitchen", num_steps, backend), actions)
        for backend in ("native", "mjx")
    )
    return np.abs(mjx - native)


def comparisons(config: FidelityConfig) -> Iterator[tuple[str, Float[np.ndarray, "B T 59"]]]:
    """Names and absolute differences of observations."""
    actions = random_actions(config.worlds, config.steps)
    stock = observations(Kitchen("stock", config.steps, "native", "stock"), actions)
    yield "stock against gymnasium-robotics", np.abs(stock - gymnasium_observations(actions))
    reduced = observations(Kitchen("kitchen", config.steps, "native"), actions)
    yield "reduced against stock", np.abs(reduced - stock)
    if config.mjx:
        yield "MJX against C, reduced", backend_errors(config.worlds, config.steps)


def demonstrate(env: Kitchen, num: int) -> Episode:
    """Demonstrations of all five subtasks, in as many orders."""
    agent = demonstrators(env)["expert"].agent
    order = np.random.default_rng(0).permutation(NUM_LONGEST)[np.arange(num) % NUM_LONGEST]
    tasks = jax.vmap(env.task)(jnp.asarray(env.num_tasks - 1 - order))

    def episode(key: jax.Array, task: Any) -> Episode:
        return run_episode(key, env, agent, task, LANES)

    keys = jax.random.split(jax.random.key(0), num)
    done = jax.jit(jax.vmap(episode, axis_name=LANES))(keys, tasks)
    return jax.tree.map(np.asarray, done)


def replay(episodes: Episode) -> Iterator[tuple[list[str], list[str], float]]:
    """FrankaKitchen under recorded actions.

    Yields, for each episode, what it completed here and there, in order, and the largest difference of
    a position of arm or objects.
    """
    kitchen = gymnasium_kitchen()
    trajectory = episodes.trajectory
    for index, length in enumerate(trajectory.length):
        goals = trajectory.goals[index][trajectory.goal_reached[index]]
        completed = [SUBTASKS[subtask] for subtask in np.argmax(goals, axis=1)]
        kitchen.reset(seed=0)
        error = 0.0
        for step, action in enumerate(trajectory.actions[index, :length]):
            theirs, _, _, _, info = kitchen.step(action)
            if step + 1 < length:
                ours = trajectory.obs[index, step + 1]
                shift = np.abs(theirs["observation"] - ours)
                error = max(error, float(shift[ARM].max()), float(shift[OBJECTS].max()))
        yield completed, list(info["episode_task_completions"]), error


def main(config: FidelityConfig) -> None:
    """Compare the kitchen's models and engines with each other and with FrankaKitchen."""
    positive(config, "worlds", "steps", "demonstrations")
    try:
        check_extra()
    except ImportError as error:
        raise UsageError(str(error)) from None
    times = [time for time in (1, 5, 10, 20, 40, 80) if time <= config.steps]
    print(f"{config.worlds} episodes, uniform actions held for 5 steps: median and largest error")
    header = "".join(f"{f'step {time}':>20}" for time in times)
    print(f"{'':<34}{'':<9}{header}")
    for name, errors in comparisons(config):
        for part, columns in (("arm", ARM), ("objects", OBJECTS)):
            cells = [errors[:, time - 1, columns] for time in times]
            text = "".join(f"{np.median(cell):>10.1e}{cell.max():>10.1e}" for cell in cells)
            print(f"{name:<34}{part:<9}{text}", flush=True)
    for model in ("reduced", "stock"):
        env = Kitchen("kitchen", 500, "native", model)
        episodes = demonstrate(env, config.demonstrations)
        complete = int((episodes.return_ > 0.99).sum())
        length = episodes.trajectory.length.mean()
        print(
            f"demonstrator on the {model} model: {complete} of {config.demonstrations} complete all "
            f"five in order, {length:.0f} steps on average",
            flush=True,
        )
    outcomes = list(replay(episodes))
    same = sum(ours == theirs for ours, theirs, _ in outcomes)
    error = max(error for _, _, error in outcomes)
    print(
        f"those on the stock model in FrankaKitchen: {same} of {len(outcomes)} complete the same "
        f"subtasks in the same order; largest error of a position {error:.1e}"
    )


if __name__ == "__main__":
    run(FidelityConfig, main)
