"""How true the kitchen's physics is: ``python -m experiments.fidelity``.

Three comparisons over random actions: our world on the stock model with gymnasium-robotics' FrankaKitchen,
the reduced model with the stock model, and MJX with C MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.kitchen import SUBTASKS, Kitchen, check_extra
from experiments.configs import positive
from experiments.runtime import Common, run
from mgpo_jax.errors import UsageError

ARM, OBJECTS = slice(0, 7), slice(18, 32)


@dataclass(frozen=True)
class FidelityConfig(Common):
    """Settings of ``experiments.fidelity``."""

    worlds: int = 16
    """Episodes of random actions."""
    steps: int = 40
    """Control steps of each."""
    mjx: bool = True
    """Compare MJX too (compiles for half a minute on a CPU)."""


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


def main(config: FidelityConfig) -> None:
    """Compare the kitchen's models and engines with each other and with FrankaKitchen."""
    positive(config, "worlds", "steps")
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


if __name__ == "__main__":
    run(FidelityConfig, main)
