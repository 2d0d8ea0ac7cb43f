"""The rules of Crafter 1.8.3, based on those of Craftax-Classic.

Craftax-Classic (Matthews et al., 2024) re-implements Crafter (Hafner, 2022) in JAX and differs from it in
several rules. Here its functions are called in Crafter's order, the agent before the mobs, and their inputs
and outputs are adjusted where Crafter has another rule. The package itself is not modified. The remaining
differences are listed in ``docs/environments.md``.

Positions are (row, column); north is row - 1. Crafter's x is the column, its y the row.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic import game_logic
from craftax.craftax_classic.constants import Action, BlockType
from craftax.craftax_classic.envs.craftax_state import EnvParams, EnvState, Mobs, StaticEnvParams
from craftax.craftax_classic.world_gen import generate_world
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

SIDE = 64  # cells of the map, in rows and in columns
AGING_DISTANCE = 18  # distance from the agent, in steps, from which on plants do not age
RIPE_AGE = 301  # number of steps after which a plant is ripe
FURNACE_STONES = 4

CHUNK = 12  # side in cells of the squares in which the number of mobs is balanced

_PARAMS = EnvParams()
_STATIC = StaticEnvParams(map_size=(SIDE, SIDE), max_zombies=5, max_cows=3, max_skeletons=2)
_IRON_TOOLS = jnp.array([Action.MAKE_IRON_PICKAXE.value, Action.MAKE_IRON_SWORD.value])
_NEIGHBORS = jnp.array([[0, -1], [0, 1], [-1, 0], [1, 0]])


def new_world(seed: UInt32[Array, ""]) -> EnvState:
    """Generate the world of a seed; the agent stands at its center and faces south, as in Crafter."""
    world = generate_world(jax.random.key(seed), _PARAMS, _STATIC)
    world = world.replace(player_direction=Action.DOWN.value, state_rng=None)
    # Some leaves are Python numbers; as arrays of fixed dtypes they can be carried through a loop.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), world)


def advance(
    key: PRNGKeyArray, world: EnvState, health: Int[Array, ""], action: Int[Array, ""]
) -> tuple[EnvState, Int[Array, ""]]:
    """Take one step.

    Args:
      key: random key, for saplings and mobs.
      world: the world.
      health: the agent's health after its own last move, before the mobs moved.
      action: one of Crafter's 17 actions, in Crafter's order.

    Returns:
      The world, and the agent's health after its own move.
    """
    key_do, key_mobs, key_spawn = jax.random.split(key, 3)
    before = world
    action = jnp.where(world.is_sleeping, Action.NOOP.value, action)
    world = _craft(world, action)
    world = _do(key_do, world, action)
    world = _place(world, action)
    world = _move(world, action)
    world = game_logic.update_player_intrinsics(world, action)
    world = game_logic.update_health(game_logic.cap_inventory(world))
    # The agent wakes up if it was hurt since its last move.
    hurt = world.player_health < health
    world = world.replace(is_sleeping=world.is_sleeping & ~hurt)
    health = world.player_health

    world = _move_mobs(key_mobs, world)
    world = _balance(key_spawn, world)
    world = _grow(world, grown_before=before.growing_plants_mask)
    time = before.timestep + 1
    world = world.replace(
        player_health=jnp.maximum(world.player_health, 0),
        timestep=time,
        light_level=game_logic.calculate_light_level(time, _PARAMS),
    )
    return jax.tree.map(lambda old, new: new.astype(old.dtype), before, world), health


def _craft(world: EnvState, action: Int[Array, ""]) -> EnvState:
    """Make a tool. For iron tools Craftax takes a stone, but Crafter does not, so the stone is given
    back."""
    stone = world.inventory.stone
    is_iron = jnp.any(action == _IRON_TOOLS)
    lent = world.replace(inventory=world.inventory.replace(stone=stone + is_iron))
    made = game_logic.do_crafting(lent, action)
    kept = jnp.where(is_iron, stone, made.inventory.stone)
    return made.replace(inventory=made.inventory.replace(stone=kept))


def _do(key: PRNGKeyArray, world: EnvState, action: Int[Array, ""]) -> EnvState:
    """Act on the cell in front of the agent.

    Three rules of Craftax are not in Crafter, and are undone here: a second sword of a kind hits harder;
    eating a plant also resets the hidden hunger counter; and a mob that has vanished is alive again as soon
    as the agent acts, since only its health is tested.
    """
    bag = world.inventory
    one_each = bag.replace(
        wood_sword=jnp.minimum(bag.wood_sword, 1),
        stone_sword=jnp.minimum(bag.stone_sword, 1),
        iron_sword=jnp.minimum(bag.iron_sword, 1),
    )
    after = game_logic.do_action(key, world.replace(inventory=one_each), action, _STATIC)
    row, column = _in_front(world)
    ate_plant = (world.map[row, column] == BlockType.RIPE_PLANT.value) & (
        after.map[row, column] == BlockType.PLANT.value
    )
    return after.replace(
        inventory=after.inventory.replace(
            wood_sword=bag.wood_sword, stone_sword=bag.stone_sword, iron_sword=bag.iron_sword
        ),
        player_hunger=jnp.where(ate_plant, world.player_hunger, after.player_hunger),
        zombies=_restricted(after.zombies, world.zombies.mask),
        cows=_restricted(after.cows, world.cows.mask),
        skeletons=_restricted(after.skeletons, world.skeletons.mask),
    )


def _restricted(mobs: Mobs, alive: Bool[Array, "M"]) -> Mobs:
    """The mobs without those that were not ``alive`` before."""
    return mobs.replace(mask=mobs.mask & alive)


def _place(world: EnvState, action: Int[Array, ""]) -> EnvState:
    """Place a block or a plant. A furnace takes four stones, and only stones can be placed on lava."""
    row, column = _in_front(world)
    on_lava = world.map[row, column] == BlockType.LAVA.value
    is_table, is_furnace = action == Action.PLACE_TABLE.value, action == Action.PLACE_FURNACE.value
    too_few = is_furnace & (world.inventory.stone < FURNACE_STONES)
    refused = too_few | (on_lava & (is_table | is_furnace))
    after = game_logic.place_block(world, jnp.where(refused, Action.NOOP.value, action), _STATIC)
    paid = after.inventory.stone < world.inventory.stone
    stone = after.inventory.stone - jnp.where(is_furnace & paid, FURNACE_STONES - 1, 0)
    return after.replace(inventory=after.inventory.replace(stone=stone))


def _move(world: EnvState, action: Int[Array, ""]) -> EnvState:
    """Turn and move. In Craftax the agent can leave the map where there is lava at the opposite edge."""
    world = game_logic.move_player(world, action)
    return world.replace(player_position=jnp.clip(world.player_position, 0, SIDE - 1))


def _move_mobs(key: PRNGKeyArray, world: EnvState) -> EnvState:
    """Move the mobs. An agent that they hurt wakes up with its next move, which is not an achievement."""
    after = game_logic.update_mobs(key, world, _PARAMS, _STATIC)
    return after.replace(is_sleeping=world.is_sleeping, achievements=world.achievements)


class _Kept(NamedTuple):
    """The parameters by which Crafter balances the number of mobs of a kind in a chunk."""

    material: int  # code of the block that they appear on
    health: int  # health of a new mob
    least: Float[Array, ""]  # number of mobs, rounded down, below which another one may appear
    most: Float[Array, ""]  # number of mobs, rounded down, above which one may vanish
    room: int  # smallest number of cells of the material for one to appear
    appear: float  # probability that one appears when it is the chunk's turn
    vanish: float  # probability that one vanishes when it is the chunk's turn
    away: int  # smallest distance to the agent, in steps, at which one appears
    gone: int  # smallest distance to the agent, in steps, at which one vanishes


def _balance(key: PRNGKeyArray, world: EnvState) -> EnvState:
    """Let at most one mob of each kind appear or vanish in a chunk near the agent.

    Crafter does so in every chunk of the map in every tenth step. Here each of the nine chunks around the
    agent has its turn with a probability of one tenth in each step. In Crafter the initial world is full of
    cows and skeletons, and few are added; here they appear when the agent comes near, with probability 0.3
    instead of 0.01 and 0.1.
    """
    key_chunk, key_kinds = jax.random.split(key)
    turn = jax.random.randint(key_chunk, (), 0, 10)
    chunk = world.player_position // CHUNK + jnp.stack([turn // 3 - 1, turn % 3 - 1])
    light = world.light_level
    grass, path = BlockType.GRASS.value, BlockType.PATH.value
    dark = 3.5 - 3 * light
    zombies = _Kept(grass, _PARAMS.zombie_health, dark, dark, 50, 0.3, 0.4, 6, 0)
    skeletons = _Kept(
        path, _PARAMS.skeleton_health, jnp.ones(()), 2 * jnp.ones(()), 6, 0.3, 0.1, 7, 7
    )
    cows = _Kept(grass, _PARAMS.cow_health, jnp.ones(()), 1.5 + light, 30, 0.3, 0.1, 5, 5)
    chance = jax.random.uniform(key_kinds, (3, 2))
    for number, (kind, kept) in enumerate(
        {"zombies": zombies, "skeletons": skeletons, "cows": cows}.items()
    ):
        mobs, mob_map = _balance_kind(
            chance[number], world, getattr(world, kind), kept, chunk, turn < 9
        )
        world = world.replace(**{kind: mobs}, mob_map=mob_map)
    return world


def _balance_kind(
    chance: Float[Array, "2"],
    world: EnvState,
    mobs: Mobs,
    kept: _Kept,
    chunk: Int[Array, "2"],
    its_turn: Bool[Array, ""],
) -> tuple[Mobs, Bool[Array, "64 64"]]:
    """Balance one kind of mobs in a chunk; returns these mobs and the map of all mobs."""
    rows, columns = (CHUNK * chunk[:, None] + jnp.arange(CHUNK))[..., None]
    rows, columns = jnp.broadcast_arrays(rows, columns.T)
    on_map = (rows >= 0) & (rows < SIDE) & (columns >= 0) & (columns < SIDE)
    free = (world.map[rows, columns] == kept.material) & on_map
    room = jnp.sum(free)
    here = mobs.mask & jnp.all(mobs.position // CHUNK == chunk, axis=1)
    num = jnp.sum(here)

    cell = jnp.argmax(jnp.cumsum(free) > chance[1] * room)
    place = CHUNK * chunk + jnp.stack([cell // CHUNK, cell % CHUNK])
    far = jnp.abs(place - world.player_position).sum()
    least = jnp.where(room < kept.room, 0, jnp.floor(kept.least))
    appears = (num < least) & (chance[0] < kept.appear) & ~jnp.all(mobs.mask) & (room > 0)
    appears &= (far >= kept.away) & (far < _PARAMS.mob_despawn_distance)
    appears &= its_turn & ~world.mob_map[place[0], place[1]]

    who = jnp.argmax(jnp.cumsum(here) > chance[1] * num)
    gap = jnp.abs(mobs.position[who] - world.player_position).sum()
    vanishes = (num > jnp.floor(kept.most)) & (chance[0] < kept.vanish) & (gap >= kept.gone)
    vanishes &= its_turn

    slot = jnp.where(appears, jnp.argmin(mobs.mask), jnp.where(vanishes, who, len(mobs.mask)))
    where = jnp.where(appears, place, mobs.position[who])
    row = jnp.where(appears | vanishes, where[0], SIDE)  # writes off the map are dropped
    changed = Mobs(
        position=mobs.position.at[slot].set(where, mode="drop"),
        health=mobs.health.at[slot].set(kept.health, mode="drop"),
        mask=mobs.mask.at[slot].set(appears, mode="drop"),
        attack_cooldown=mobs.attack_cooldown.at[slot].set(0, mode="drop"),
    )
    return changed, world.mob_map.at[row, where[1]].set(appears, mode="drop")


def _grow(world: EnvState, grown_before: Bool[Array, "P"]) -> EnvState:
    """Let the plants near the agent age, unless a mob next to one tramples it.

    Args:
      world: the world.
      grown_before: which plants existed before this step; new ones age from the next step on.
    """
    places, planted = world.growing_plants_positions, world.growing_plants_mask
    near = jnp.abs(places - world.player_position).sum(axis=1) < AGING_DISTANCE
    beside = places[:, None] + _NEIGHBORS
    on_map = jnp.all((beside >= 0) & (beside < SIDE), axis=-1)
    mobs = world.mob_map[beside[..., 0], beside[..., 1]] & on_map
    active = planted & grown_before & near
    trampled = active & jnp.any(mobs, axis=1)
    age = jnp.where(active, world.growing_plants_age + 1, world.growing_plants_age)
    plant = jnp.where(age >= RIPE_AGE, BlockType.RIPE_PLANT.value, BlockType.PLANT.value)
    block = jnp.where(trampled, BlockType.GRASS.value, plant)
    rows = jnp.where(planted, places[:, 0], SIDE)  # writes off the map are dropped
    return world.replace(
        map=world.map.at[rows, places[:, 1]].set(block, mode="drop"),
        growing_plants_age=jnp.where(trampled, 0, age),
        growing_plants_mask=planted & ~trampled,
    )


def _in_front(world: EnvState) -> Int[Array, "2"]:
    """The cell that the agent faces, or at the edge of the map the cell it stands on."""
    cell = world.player_position + game_logic.DIRECTIONS[world.player_direction]
    return jnp.clip(cell, 0, SIDE - 1)
