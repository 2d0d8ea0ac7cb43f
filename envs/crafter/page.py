"""Crafter's part of HTML pages: maps, and the agent's path on them, without mobs."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from matplotlib.colors import to_hex

from envs.crafter.env import PLACE_UNIT, Crafter, CrafterState, CrafterTask
from envs.crafter.pictures import PROMPT, blocks_of, color_of, kinds, name_of
from envs.crafter.rules import SIDE
from envs.crafter.tiles import tiles
from envs.crafter.view import BLOCKS, NUM_ACHIEVEMENTS, NUM_BLOCKS
from envs.page import Page


def crafter_page(env: Crafter) -> Page:
    """Maps with the paths of agents and their achievements."""
    names = [name_of(goal) for goal in range(NUM_ACHIEVEMENTS)]
    return Page(
        script=Path(__file__).with_name("page.js"),
        facts={
            "side": SIDE,
            "unit": PLACE_UNIT,
            "places": env.places,
            "achievements": names,
            "achievementColors": [color_of(goal) for goal in range(NUM_ACHIEVEMENTS)],
            "kinds": kinds(),
            "promptColor": PROMPT,
            "blocks": [name.replace("_", " ") for name in BLOCKS],
            "blockColors": block_colors(),
        },
        task=map_of,
        track=track,
        describe=lambda task: f"world of seed {int(task.seed)}",
        parts=tuple(names),
    )


def block_colors() -> list[str]:
    """The mean color of the texture of each block."""
    means = tiles().day[:NUM_BLOCKS].reshape(NUM_BLOCKS, -1, 3).mean(axis=1)
    return [to_hex(mean / 255) for mean in means]


def map_of(task: CrafterTask) -> list[str]:
    """The map of a world at its start as rows of letters: ``a`` is the first block."""
    blocks = np.asarray(blocks_of(jnp.asarray(task.seed, jnp.uint32)))
    return ["".join(chr(ord("a") + block) for block in row) for row in blocks]


def track(state: CrafterState) -> Int[Array, "3"]:
    """The agent's row and column, and 1 plus the index of the achievement just unlocked (0 for none)."""
    unlocked = jnp.where(jnp.any(state.unlocked), 1 + jnp.argmax(state.unlocked), 0)
    return jnp.append(state.world.player_position, unlocked)
