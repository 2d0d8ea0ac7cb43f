"""The Python package ``crafter``: its observations as those of this world, and its episodes.

A policy of this world can act there, since what the program draws is a function of the same 85 numbers. The
two generate different maps from a seed, so episodes of one task cannot be compared (``World.official``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from envs.crafter.view import (
    BLOCKS,
    COLUMNS,
    COUNTS,
    MOBS,
    NUM_BLOCKS,
    NUM_MOBS,
    ROWS,
)
from envs.errors import UsageError
from envs.official import Played, played

_MATERIALS = {"crafting_table": "table", "plant": "grass", "ripe_plant": "grass"}
BLOCK_OF = {_MATERIALS.get(name, name): place for place, name in reversed([*enumerate(BLOCKS)])}
"""The number of the block of each of the package's materials; a plant is an object there, on grass."""
FACINGS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""The steps (x, y) to the west, east, north and south."""


def import_crafter() -> Any:
    """Import the package ``crafter``.

    Raises:
      UsageError: if it is missing.
    """
    try:
        import crafter
    except ImportError as error:
        raise UsageError(f"{error}; pip install crafter==1.8.3 opensimplex") from None
    return crafter


def codes_of(env: Any) -> Int[np.ndarray, "7 9"]:
    """The codes of the cells that a ``crafter.Env`` has in view."""
    objects = import_crafter().objects
    mobs = {getattr(objects, name.title()): place for place, name in enumerate(MOBS) if place}
    world, (x, y) = env._world, env._player.pos
    codes = np.zeros((ROWS, COLUMNS), int)
    for row, column in np.ndindex(ROWS, COLUMNS):
        material, thing = world[x + column - COLUMNS // 2, y + row - ROWS // 2]
        code = BLOCKS.index("out_of_bounds") if material is None else BLOCK_OF[material]
        if isinstance(thing, objects.Plant):
            code = BLOCKS.index("ripe_plant" if thing.ripe else "plant")
        if isinstance(thing, objects.Arrow):
            code += NUM_BLOCKS * NUM_MOBS * (1 + FACINGS.index(tuple(thing.facing)))
        codes[row, column] = code + NUM_BLOCKS * mobs.get(type(thing), 0)
    return codes


def observation_of(env: Any) -> Float[np.ndarray, "85"]:
    """What a ``crafter.Env`` shows, as an observation of this world without places."""
    player = env._player
    counts = [player.inventory[name] for name in COUNTS]
    facing = np.arange(len(FACINGS)) == FACINGS.index(tuple(player.facing))
    rest = [env._world.daylight, player.sleeping]
    return np.concatenate([codes_of(env).ravel(), counts, facing, rest]).astype(np.float32)


class CrafterEpisode:
    """An episode of the package (``envs.official.ByHand``) in the world that it generates from a seed.

    Args:
      seed: the seed of the world and of its mobs.
      horizon: number of steps after which the episode ends.
    """

    def __init__(self, seed: int, horizon: int) -> None:
        self._env = import_crafter().Env(length=horizon, seed=seed)

    def reset(self) -> Float[np.ndarray, "85"]:
        self._env.reset()
        self._length, self._return = 0, 0.0
        self._reached: list[tuple[str, int]] = []
        return observation_of(self._env)

    def step(self, action: np.ndarray) -> tuple[Float[np.ndarray, "85"], bool]:
        _, reward, over, info = self._env.step(int(action))
        self._length += 1
        self._return += float(reward)
        known = {name for name, _ in self._reached}
        new = [name for name, times in info["achievements"].items() if times and name not in known]
        self._reached += [(name, self._length) for name in new]
        return observation_of(self._env), bool(over)

    def played(self) -> Played:
        return played(self._reached, self._return, self._length)
