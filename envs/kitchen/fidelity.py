"""Measures the accuracy and speed of the kitchen's physics: ``python -m envs.kitchen.fidelity``.

Under random actions it compares our world on the stock model with gymnasium-robotics' FrankaKitchen, the
reduced model with the stock model, and MJX with C MuJoCo. For demonstrations it reports what the
demonstrator completes on each model, and whether the actions of those on the stock model have the same
results in FrankaKitchen.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from envs.base import Episode
from envs.episodes import run_episode
from envs.errors import UsageError
from envs.kitchen.demonstrators import in_one_scene
from envs.kitchen.env import POSITIONS, SUBTASKS, VELOCITIES, Kitchen, KitchenTask
from envs.kitchen.extra import import_mujoco
from envs.kitchen.official import franka_kitchen
from envs.kitchen.physics import PhysicsState, position_targets

ARM, OBJECTS = slice(0, 7), slice(18, 32)
NUM_LONGEST = 120  # number of tasks with all five subtasks, which come last in the enumeration
# Iterations of MJX's contact solver and of its line search.
SOLVERS = ((1, 4), (2, 4), (4, 6), (8, 10), (16, 16))
GYMNASIUM, BATCH, STOCK, REDUCED, MJX = (
    "gymnasium-robotics", "MuJoCo's batch stepper", "stock model, C", "reduced model, C",
    "reduced model, MJX",
)  # fmt: skip


@dataclass(frozen=True)
class FidelityConfig:
    """Settings of this command."""

    worlds: int = 32
    """Number of episodes with random actions."""
    steps: int = 40
    """Number of control steps in each of them."""
    mjx: bool = True
    """Compare MJX, too (compiles for half a minute on a CPU)."""
    demonstrations: int = 8
    """Number of demonstrations of all five subtasks on each model."""
    solvers: bool = False
    """Compare settings of MJX's contact solver, too (compiles for some minutes)."""


def kitchen(backend: str, model: str = "reduced", horizon: int = 500) -> Kitchen:
    """Our world with an engine and a model."""
    return Kitchen(name="kitchen", horizon=horizon, backend=backend, model=model)


def jit_for(env: Kitchen) -> Callable[[Callable], Any]:
    """``jax.jit`` for programs that hold steps of a world."""
    return jax.jit(compiler_options=dict(env.engine.compiler_options))


class Recording(NamedTuple):
    """The observations of episodes with given actions, and the speed of running them."""

    obs: Float[np.ndarray, "B T 59"]
    rate: float
    """Control steps per CPU-second, without compilation."""


def record(env: Kitchen, actions: Float[np.ndarray, "B T 9"]) -> Recording:
    """Record our world."""
    state, _ = env.reset(jax.random.key(0), env.task(jnp.array(env.num_tasks - 1)))

    def play(rows: jax.Array) -> jax.Array:
        return jax.lax.scan(env.step, state, rows)[1].obs

    program = jit_for(env)(jax.vmap(play))
    jax.block_until_ready(program(actions))
    start = time.process_time()
    obs = np.asarray(program(actions))
    return Recording(obs=obs, rate=actions[..., 0].size / (time.process_time() - start))


def record_gymnasium(actions: Float[np.ndarray, "B T 9"]) -> Recording:
    """Record FrankaKitchen."""
    theirs = franka_kitchen(actions.shape[1])

    def play(rows: np.ndarray) -> list[np.ndarray]:
        theirs.reset(seed=0)
        return [theirs.step(action)[0]["observation"] for action in rows]

    start = time.process_time()
    obs = np.array([play(rows) for rows in actions], np.float32)
    return Recording(obs=obs, rate=actions[..., 0].size / (time.process_time() - start))


def record_batch(actions: Float[np.ndarray, "B T 9"]) -> Recording:
    """Record MuJoCo's own batch stepper on the full scene, without a world around it."""
    from mujoco.batch import Batch

    from envs.kitchen.model import INITIAL_POSITIONS, SUBSTEPS, full_model
    from envs.kitchen.native import num_threads

    batch = Batch(full_model(), len(actions), num_threads(len(actions)))
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    qpos[:] = INITIAL_POSITIONS
    obs = np.zeros((*actions.shape[:2], len(POSITIONS) + len(VELOCITIES)), np.float32)
    start = time.process_time()
    for step in range(actions.shape[1]):
        ctrl[:] = position_targets(qpos, actions[:, step].astype(np.float64))
        batch.step(nstep=SUBSTEPS["stock"])
        obs[:, step, POSITIONS], obs[:, step, VELOCITIES] = qpos, qvel
    return Recording(obs=obs, rate=actions[..., 0].size / (time.process_time() - start))


def random_actions(num_worlds: int, num_steps: int) -> Float[np.ndarray, "B T 9"]:
    """Actions drawn uniformly from the cube and held for five steps each, so that the arm moves around."""
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1, 1, (num_worlds, -(-num_steps // 5), 9)).astype(np.float32)
    return np.repeat(targets, 5, axis=1)[:, :num_steps]


def recordings(config: FidelityConfig) -> dict[str, Recording]:
    """Record all models and engines under the same actions."""
    actions = random_actions(config.worlds, config.steps)
    found = {
        GYMNASIUM: record_gymnasium(actions),
        BATCH: record_batch(actions),
        STOCK: record(kitchen("native", "stock", config.steps), actions),
        REDUCED: record(kitchen("native", horizon=config.steps), actions),
    }
    if config.mjx:
        found[MJX] = record(kitchen("mjx", horizon=config.steps), actions)
    return found


def demonstrate(env: Kitchen, num: int) -> Episode:
    """Demonstrations of all five subtasks, in as many orders."""
    expert = in_one_scene(env)
    order = np.random.default_rng(0).permutation(NUM_LONGEST)[np.arange(num) % NUM_LONGEST]
    tasks = jax.vmap(env.task)(jnp.asarray(env.num_tasks - 1 - order))

    def episode(key: jax.Array, task: KitchenTask) -> Episode:
        return run_episode(key, env, expert.agent(expert.weights), task)

    keys = jax.random.split(jax.random.key(0), num)
    done = jit_for(env)(jax.vmap(episode))(keys, tasks)
    return jax.tree.map(np.asarray, done)


def completions(episodes: Episode) -> list[np.ndarray]:
    """The subtasks that each episode completed, in order."""
    trajectory = episodes.trajectory
    pairs = zip(trajectory.achieved_goals, trajectory.goal_reached, strict=True)
    return [goals[reached].argmax(axis=1) for goals, reached in pairs]


def replay_in_gymnasium(episodes: Episode) -> Iterator[tuple[list[str], list[str], float]]:
    """Replay recorded actions in FrankaKitchen.

    Yields for each episode the subtasks completed here and there, in order, and the largest difference
    between components of observations, rounded to float32.
    """
    trajectory = episodes.trajectory
    franka = franka_kitchen(trajectory.actions.shape[1])
    for index, completed in enumerate(completions(episodes)):
        length = trajectory.length[index]
        franka.reset(seed=0)
        seen = [*trajectory.obs[index, 1:length], episodes.last_obs[index]]
        error = 0.0
        for action, ours in zip(trajectory.actions[index, :length], seen, strict=True):
            theirs, _, _, _, info = franka.step(action.astype(np.float64))
            shift = np.abs(theirs["observation"].astype(np.float32) - ours)
            error = max(error, float(shift.max()))
        names = [SUBTASKS[subtask] for subtask in completed]
        yield names, list(info["episode_task_completions"]), error


class Pair(NamedTuple):
    """A physics state and the action of the next control step."""

    physics: PhysicsState
    action: Float[Array, "9"]


def demonstrated_states(env: Kitchen, episodes: Episode) -> Pair:
    """All states of demonstrations except for the first and the last one, ``[N, ..]``."""
    from envs.kitchen.model import joint_addresses

    positions, velocities = joint_addresses(env.model)
    start, _ = env.reset(jax.random.key(0), env.task(jnp.zeros((), jnp.int32)))

    def second(obs: Array, first: Array, then: Array) -> Pair:
        """Step from an observed state to the next one, which then has a warm start, too."""
        physics = PhysicsState(
            qpos=obs[POSITIONS][positions],
            qvel=obs[VELOCITIES][velocities],
            warmstart=start.physics.warmstart,
        )
        physics = env.physics.advance(physics, first, jnp.ones((), bool))
        return Pair(physics=physics, action=then)

    trajectory = episodes.trajectory
    inner = np.arange(trajectory.actions.shape[1] - 1) < trajectory.length[:, None] - 1
    rows = (trajectory.obs[:, :-1], trajectory.actions[:, :-1], trajectory.actions[:, 1:])
    return jax.jit(jax.vmap(second))(*(row[inner] for row in rows))


def compare_solvers(episodes: Episode, together: int) -> Iterator[str]:
    """Compare one control step of MJX from every state of demonstrations with C MuJoCo."""
    from envs.kitchen.mjx import mjx_physics
    from envs.kitchen.model import SUBSTEPS

    env = kitchen("native")
    pairs = demonstrated_states(env, episodes)
    together = min(together, len(pairs.action))
    whole = len(pairs.action) // together * together  # a remainder would be compiled separately
    pairs = jax.tree.map(lambda leaf: leaf[:whole].reshape(-1, together, *leaf.shape[1:]), pairs)
    on = jnp.ones((), bool)
    exact = jax.lax.map(
        jax.vmap(lambda pair: env.physics.advance(pair.physics, pair.action, on)), pairs
    )
    num_substeps = whole * SUBSTEPS["reduced"]
    for iterations, line_search in SOLVERS:
        physics = mjx_physics("reduced", iterations, line_search)
        step = jax.vmap(lambda pair, physics=physics: physics.advance(*pair, on))
        program = jit_for(kitchen("mjx"))(partial(jax.lax.map, step))
        jax.block_until_ready(program(pairs))
        start = time.process_time()
        found = jax.block_until_ready(program(pairs))
        rate = num_substeps / (time.process_time() - start)
        error = np.abs(np.asarray(found.qpos - exact.qpos)).max(axis=-1)
        cells = (np.median(error), *np.percentile(error, [99, 99.9]), error.max())
        text = "".join(f"{cell:>10.0e}" for cell in cells)
        yield f"{iterations:>4} of the solver, {line_search:>2} of its line search {text}{rate:>10.0f}"


def report_random_actions(config: FidelityConfig) -> None:
    """Print the speed of all models and engines, and how far they diverge under random actions."""
    found = recordings(config)
    print(f"{config.worlds} episodes of {config.steps} steps, uniform actions held for 5 steps")
    for name, recording in found.items():
        print(f"{name:<24}{recording.rate:>8.0f} control steps / CPU-s")
    times = [step for step in (1, 5, 10, 20, 40, 80) if step <= config.steps]
    print("\nmedian and largest difference of positions (rad, m) after so many steps")
    print(f"{'':<52}" + "".join(f"{step:>18}" for step in times))
    for first, second in ((STOCK, GYMNASIUM), (STOCK, BATCH), (REDUCED, STOCK), (MJX, REDUCED)):
        if first not in found:
            continue
        errors = np.abs(found[first].obs - found[second].obs)
        for part, columns in (("arm", ARM), ("objects", OBJECTS)):
            cells = [errors[:, step - 1, columns] for step in times]
            text = "".join(f"{np.median(cell):>9.0e}{cell.max():>9.0e}" for cell in cells)
            print(f"{f'{first}, {second}':<44}{part:<8}{text}")
    print(flush=True)


def report_demonstrations(demonstrations: dict[str, Episode]) -> None:
    """Print what the demonstrator completes on each model and engine."""
    reference = completions(demonstrations[REDUCED])
    for name, episodes in demonstrations.items():
        complete = int((episodes.return_ > 0.99).sum())
        same = sum(map(np.array_equal, completions(episodes), reference))
        length = episodes.trajectory.length.mean()
        print(
            f"demonstrator, {name}: {complete} of {len(reference)} complete all five in order, "
            f"{length:.0f} steps on average; {same} complete the same in the same order as with "
            f"the {REDUCED}",
            flush=True,
        )


def report_solvers(episodes: Episode, together: int) -> None:
    """Print how far single steps of MJX are from those of C MuJoCo, for several settings of its solver."""
    head = "".join(f"{name:>10}" for name in ("median", "99 %", "99.9 %", "largest"))
    print(
        "\nMJX against C after one control step: largest difference of a position; substeps / CPU-s"
    )
    print(f"{'iterations':<42} {head}")
    for line in compare_solvers(episodes, together):
        print(line, flush=True)
    print()


def report_gymnasium(episodes: Episode) -> None:
    """Print whether the actions of demonstrations have the same results in FrankaKitchen."""
    outcomes = list(replay_in_gymnasium(episodes))
    same = sum(ours == theirs for ours, theirs, _ in outcomes)
    error = max(error for _, _, error in outcomes)
    print(
        f"their actions in FrankaKitchen: {same} of {len(outcomes)} complete the same subtasks in the "
        f"same order; largest difference of an observation {error:.1e}"
    )


def main(config: FidelityConfig) -> None:
    """Compare the kitchen's models and engines with each other and with FrankaKitchen."""
    for name in ("worlds", "steps", "demonstrations"):
        if getattr(config, name) < 1:
            raise UsageError(f"--{name} must be at least 1, found {getattr(config, name)}")
    import_mujoco()  # raises errors now rather than while a program is traced
    report_random_actions(config)
    worlds = {STOCK: kitchen("native", "stock"), REDUCED: kitchen("native")}
    if config.mjx:
        worlds[MJX] = kitchen("mjx")
    demonstrations = {name: demonstrate(env, config.demonstrations) for name, env in worlds.items()}
    report_demonstrations(demonstrations)
    if config.solvers:
        report_solvers(demonstrations[REDUCED], config.worlds)
    report_gymnasium(demonstrations[STOCK])


if __name__ == "__main__":
    settings = tyro.cli(FidelityConfig, description=main.__doc__)
    try:
        main(settings)
    except (ImportError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
