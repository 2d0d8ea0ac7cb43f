"""The demonstrator's decisions in Crafter: from its knowledge to an errand, and from that to an action.

For each achievement the recipes determine the next errand (``Errand``): go to some kind of place and act
there. Which errand to run is decided anew at every step. A zombie nearby is fought first, then a shelter is
dug at night, then come tiredness, thirst and hunger. Otherwise it is the turn of the first achievement in
the order of the episode, in which achievements whose places are in view come earlier. The agent takes the
cheapest path through known cells. Unknown cells count as a place that is far away, so that one search
decides between known places and exploration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import Achievement, Action, BlockType
from craftax.craftax_classic.envs.craftax_state import EnvState, Inventory, Mobs
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from envs.crafter.rules import FURNACE_STONES, SIDE
from envs.crafter.searching import (
    MOVES,
    Aims,
    Board,
    Cell,
    Terrain,
    around,
    beside,
    contains,
    dead_ends,
    first_steps,
    nowhere,
    pack,
    pack_window,
    rectangle,
    single,
    spread,
    union,
)
from envs.crafter.view import COLUMNS, NUM_ACHIEVEMENTS, NUM_BLOCKS, ROWS

HALF_VIEW = (ROWS // 2, COLUMNS // 2)  # rows and columns to either side of the agent
TABLE_WOOD = 2  # wood for a table, in Craftax and in Crafter 1.8.3
WALKABLE = (BlockType.GRASS, BlockType.SAND, BlockType.PATH)
FAR = 99  # distance of mobs that are not in view
NEVER = 1000.0  # place in the order of an achievement that is impossible at present

# The place of an errand is a number. The first 17 are kinds of blocks, by code, and the next three are
# kinds of mobs: the agent walks next to one of them and faces it. The others are cells that it walks onto.
COW, ZOMBIE, SKELETON = range(NUM_BLOCKS, NUM_BLOCKS + 3)
AT_TABLE, AT_WORKSHOP, DEN = range(NUM_BLOCKS + 3, NUM_BLOCKS + 6)
ANYWHERE = NUM_BLOCKS + 6  # explore
HERE = NUM_BLOCKS + 7  # act at once
FREE, SOIL = NUM_BLOCKS + 8, NUM_BLOCKS + 9  # face a free cell, or grass, and place something

# The usual place of each achievement in an order; the order of an episode adds noise to it.
TIERS: Mapping[Achievement, float] = {
    Achievement.COLLECT_WOOD: 0.0,
    Achievement.COLLECT_SAPLING: 1.0,
    Achievement.PLACE_TABLE: 1.2,
    Achievement.PLACE_PLANT: 1.5,
    Achievement.EAT_COW: 2.0,
    Achievement.COLLECT_DRINK: 2.0,
    Achievement.MAKE_WOOD_PICKAXE: 2.0,
    Achievement.WAKE_UP: 2.0,
    Achievement.MAKE_WOOD_SWORD: 2.2,
    Achievement.DEFEAT_ZOMBIE: 2.5,
    Achievement.COLLECT_STONE: 2.5,
    Achievement.PLACE_STONE: 3.2,
    Achievement.MAKE_STONE_PICKAXE: 3.5,
    Achievement.COLLECT_COAL: 3.5,
    Achievement.MAKE_STONE_SWORD: 3.7,
    Achievement.PLACE_FURNACE: 4.0,
    Achievement.COLLECT_IRON: 4.5,
    Achievement.DEFEAT_SKELETON: 5.0,
    Achievement.MAKE_IRON_PICKAXE: 5.5,
    Achievement.MAKE_IRON_SWORD: 6.0,
    Achievement.COLLECT_DIAMOND: 7.0,
    Achievement.EAT_PLANT: 8.0,
}


RANGES = {
    "drop": (0, 0.5), "shuffle": (0, 100), "opportunism": (0, 1), "shelter": (0, 1), "dusk": (0, 1),
    "detour": (0, 80), "noise": (0, 0.5), "longest_run": (1, 100), "whole_map": (0, 1),
}  # fmt: skip
"""The smallest and the largest value of each habit."""


@dataclass(frozen=True)
class Habits:
    """The behavior of a demonstrator.

    Attributes:
      drop: fraction of the achievements that are omitted in an episode, on average. Each episode draws its
        own fraction between 0 and twice this number.
      shuffle: standard deviation of an achievement's place in the order, in tiers.
      opportunism: how strongly an achievement that is possible nearby is preferred to the order; 0 keeps
        strictly to the order.
      shelter: whether to dig a shelter for the night.
      dusk: the light below which it does so.
      detour: number of steps by which a known place may be farther away than unknown cells.
      noise: probability that a run of random actions starts at a step, on average. Each episode draws its
        own probability between 0 and twice this number.
      longest_run: largest number of random actions in a run.
      whole_map: fraction of the episodes in which it knows the map from the start.
    """

    drop: float = 0.45
    shuffle: float = 2.0
    opportunism: float = 0.6
    shelter: bool = True
    dusk: float = 0.5
    detour: int = 12
    noise: float = 0.05
    longest_run: int = 4
    whole_map: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} must be from {low:g} to {high:g}, found {value:g}")


class Plan(NamedTuple):
    """The plan of an episode: which achievements to pursue, and in which order."""

    places: Float[Array, "22"]
    """The place of each achievement in the order; the smallest comes first."""
    wanted: Bool[Array, "22"]


class Sighting(NamedTuple):
    """The mobs of one kind in view."""

    board: Board
    distance: Int[Array, ""]
    """Rows plus columns to the nearest one; ``FAR`` if there is none."""


class Scene(NamedTuple):
    """The demonstrator's knowledge at one step."""

    blocks: UInt32[Array, "17 2 64"]
    """The board of each kind of block, as it was when last in view."""
    here: Cell
    facing: Int[Array, ""]
    """Direction of the agent, a row of ``MOVES``."""
    bag: Inventory
    health: Int[Array, ""]
    food: Int[Array, ""]
    drink: Int[Array, ""]
    energy: Int[Array, ""]
    asleep: Bool[Array, ""]
    light: Float[Array, ""]
    time: Int[Array, ""]
    done: Bool[Array, "22"]
    """The achievements unlocked so far."""
    cows: Sighting
    zombies: Sighting
    skeletons: Sighting

    def of(self, *kinds: BlockType) -> Board:
        """The known cells with blocks of these kinds."""
        return union(*(self.blocks[kind.value] for kind in kinds))

    @property
    def mobs(self) -> Board:
        return self.cows.board | self.zombies.board | self.skeletons.board

    @property
    def front(self) -> Cell:
        return self.here + jnp.asarray(MOVES)[self.facing]


class Errand(NamedTuple):
    """Go to a kind of place and act there."""

    place: Int[Array, ""]
    act: Int[Array, ""]


def errand(place: int | BlockType, act: Action = Action.DO) -> Errand:
    kind = place.value if isinstance(place, BlockType) else place
    return Errand(jnp.asarray(kind, jnp.int32), jnp.asarray(act.value, jnp.int32))


def either(condition: Array, one: Errand, other: Errand) -> Errand:
    """``one`` if the condition holds, otherwise ``other``."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


# Observing.


def unknown_map() -> UInt32[Array, "17 2 64"]:
    return jnp.zeros((NUM_BLOCKS, 2, 64), jnp.uint32)


def whole_map(world: EnvState) -> UInt32[Array, "17 2 64"]:
    """The boards of all blocks of a world."""
    kinds = jnp.arange(NUM_BLOCKS)[:, None, None]
    return jax.vmap(pack)(world.map == kinds)


def look(blocks: UInt32[Array, "17 2 64"], world: EnvState) -> UInt32[Array, "17 2 64"]:
    """Update the boards of known blocks with what is in view."""
    corner = world.player_position - jnp.array(HALF_VIEW)
    rows, columns = (corner[0] + jnp.arange(ROWS), corner[1] + jnp.arange(COLUMNS))
    view = world.map[jnp.clip(rows, 0, SIDE - 1)[:, None], jnp.clip(columns, 0, SIDE - 1)]
    seen = pack_window(view == jnp.arange(NUM_BLOCKS)[:, None, None], corner)
    return (blocks & ~rectangle(world.player_position, *HALF_VIEW)) | seen


def scene_of(blocks: UInt32[Array, "17 2 64"], world: EnvState) -> Scene:
    """The demonstrator's knowledge: the known ``blocks``, and everything that is on the screen at this
    step."""
    here = world.player_position

    def sighting(mobs: Mobs) -> Sighting:
        away = jnp.abs(mobs.position - here)
        shown = mobs.mask & jnp.all(away <= jnp.array(HALF_VIEW), axis=1)
        board = jax.vmap(single)(mobs.position)
        return Sighting(
            board=jnp.bitwise_or.reduce(jnp.where(shown[:, None, None], board, 0), axis=0),
            distance=jnp.min(jnp.where(shown, jnp.sum(away, axis=1), FAR)),
        )

    return Scene(
        blocks=blocks,
        here=here,
        facing=world.player_direction - 1,
        bag=world.inventory,
        health=world.player_health,
        food=world.player_food,
        drink=world.player_drink,
        energy=world.player_energy,
        asleep=world.is_sleeping,
        light=world.light_level,
        time=world.timestep,
        done=world.achievements,
        cows=sighting(world.cows),
        zombies=sighting(world.zombies),
        skeletons=sighting(world.skeletons),
    )


# Choosing an errand.


def make_plan(key: PRNGKeyArray, habits: Habits) -> Plan:
    """Draw the order of an episode and the achievements that it omits."""
    key_order, key_drop, key_share = jax.random.split(key, 3)
    tiers = jnp.array([TIERS[achievement] for achievement in Achievement])
    share = 2 * habits.drop * jax.random.uniform(key_share)
    return Plan(
        places=tiers + habits.shuffle * jax.random.normal(key_order, (NUM_ACHIEVEMENTS,)),
        wanted=jax.random.uniform(key_drop, (NUM_ACHIEVEMENTS,)) >= share,
    )


class Surroundings(NamedTuple):
    """Facts about the agent's surroundings that several rules need."""

    table: Bool[Array, ""]
    """Whether a table is within reach, so that tools can be made."""
    furnace: Bool[Array, ""]
    table_near: Bool[Array, ""]
    """Whether a table is near enough to walk to it; otherwise placing a new one is better."""
    workshop: Board
    """The cells from which both a table and a furnace are within reach."""
    workshop_near: Bool[Array, ""]


def surroundings(scene: Scene) -> Surroundings:
    tables, furnaces = scene.of(BlockType.CRAFTING_TABLE), scene.of(BlockType.FURNACE)
    hand, near = rectangle(scene.here, 1, 1), rectangle(scene.here, 9, 9)
    workshop = around(tables) & around(furnaces) & scene.of(*WALKABLE)
    return Surroundings(
        table=jnp.any(tables & hand),
        furnace=jnp.any(furnaces & hand),
        table_near=jnp.any(tables & near),
        workshop=workshop,
        workshop_near=jnp.any(workshop & near),
    )


def plain_errands() -> dict[Achievement, Errand]:
    """The errands that need nothing in the inventory."""
    return {
        Achievement.COLLECT_WOOD: errand(BlockType.TREE),
        Achievement.EAT_COW: errand(COW),
        Achievement.COLLECT_SAPLING: errand(BlockType.GRASS),
        Achievement.COLLECT_DRINK: errand(BlockType.WATER),
        Achievement.DEFEAT_ZOMBIE: errand(ZOMBIE),
        Achievement.EAT_PLANT: errand(BlockType.RIPE_PLANT),
        Achievement.DEFEAT_SKELETON: errand(SKELETON),
        Achievement.WAKE_UP: errand(HERE, Action.SLEEP),
    }


def errands_of(scene: Scene, nearby: Surroundings) -> Errand:
    """The next errand for each achievement, ``[22]``, according to the recipes."""
    bag = scene.bag
    tree = errand(BlockType.TREE)

    def with_wood(number: int, then: Errand) -> Errand:
        return either(bag.wood >= number, then, tree)

    new_table = with_wood(TABLE_WOOD + 1, errand(FREE, Action.PLACE_TABLE))

    def at_table(then: Errand) -> Errand:
        return either(nearby.table, then, either(nearby.table_near, errand(AT_TABLE), new_table))

    wood_pickaxe = with_wood(1, at_table(errand(HERE, Action.MAKE_WOOD_PICKAXE)))
    wood_sword = with_wood(1, at_table(errand(HERE, Action.MAKE_WOOD_SWORD)))
    stone = either(bag.wood_pickaxe > 0, errand(BlockType.STONE), wood_pickaxe)
    coal = either(bag.wood_pickaxe > 0, errand(BlockType.COAL), wood_pickaxe)

    def with_stone(number: int, then: Errand) -> Errand:
        return either(bag.stone >= number, then, stone)

    def stone_tool(act: Action) -> Errand:
        return with_wood(1, with_stone(1, at_table(errand(HERE, act))))

    stone_pickaxe = stone_tool(Action.MAKE_STONE_PICKAXE)
    iron = either(bag.stone_pickaxe > 0, errand(BlockType.IRON), stone_pickaxe)
    furnace = with_stone(FURNACE_STONES, at_table(errand(FREE, Action.PLACE_FURNACE)))

    def iron_tool(act: Action) -> Errand:
        made = either(nearby.workshop_near, errand(AT_WORKSHOP), furnace)
        made = either(nearby.table & nearby.furnace, errand(HERE, act), made)
        made = either(bag.coal >= 1, either(bag.iron >= 1, made, iron), coal)
        return with_wood(1, made)

    iron_pickaxe = iron_tool(Action.MAKE_IRON_PICKAXE)
    plain = plain_errands()
    sapling = plain[Achievement.COLLECT_SAPLING]
    table: Mapping[Achievement, Errand] = {
        **plain,
        Achievement.PLACE_TABLE: with_wood(TABLE_WOOD + 2, errand(FREE, Action.PLACE_TABLE)),
        Achievement.MAKE_WOOD_PICKAXE: wood_pickaxe,
        Achievement.MAKE_WOOD_SWORD: wood_sword,
        Achievement.PLACE_PLANT: either(
            bag.sapling >= 1, errand(SOIL, Action.PLACE_PLANT), sapling
        ),
        Achievement.COLLECT_STONE: stone,
        Achievement.PLACE_STONE: with_stone(1, errand(FREE, Action.PLACE_STONE)),
        Achievement.MAKE_STONE_PICKAXE: stone_pickaxe,
        Achievement.MAKE_STONE_SWORD: stone_tool(Action.MAKE_STONE_SWORD),
        Achievement.PLACE_FURNACE: furnace,
        Achievement.COLLECT_COAL: coal,
        Achievement.COLLECT_IRON: iron,
        Achievement.COLLECT_DIAMOND: either(
            bag.iron_pickaxe > 0, errand(BlockType.DIAMOND), iron_pickaxe
        ),
        Achievement.MAKE_IRON_PICKAXE: iron_pickaxe,
        Achievement.MAKE_IRON_SWORD: iron_tool(Action.MAKE_IRON_SWORD),
    }
    return jax.tree.map(lambda *column: jnp.stack(column), *(table[a] for a in Achievement))


def in_danger(scene: Scene) -> Bool[Array, ""]:
    """Whether it would be dangerous to fall asleep here."""
    return (scene.zombies.distance < 7) | (scene.skeletons.distance < FAR)


def advances(scene: Scene) -> Float[Array, "22"]:
    """The number of tiers by which each achievement currently comes earlier than in its order.

    An achievement that depends on luck, such as meeting a cow, comes later while its object is not in view.
    """
    view = rectangle(scene.here, *HALF_VIEW)

    def in_view(kind: BlockType) -> Array:
        return jnp.any(scene.of(kind) & view)

    diamond = in_view(BlockType.DIAMOND) & (scene.bag.iron_pickaxe > 0)
    can_sleep = (scene.energy < 9) & ~in_danger(scene)
    table: Mapping[Achievement, Array] = {
        Achievement.COLLECT_WOOD: jnp.where(in_view(BlockType.TREE), 1.0, 0.0),
        Achievement.EAT_COW: jnp.where(scene.cows.distance < FAR, 1.5, -3.0),
        Achievement.COLLECT_DRINK: jnp.where(in_view(BlockType.WATER), 1.5, -3.0),
        Achievement.DEFEAT_ZOMBIE: jnp.where(scene.zombies.distance < FAR, 3.0, -20.0),
        Achievement.DEFEAT_SKELETON: jnp.where(scene.skeletons.distance < FAR, 4.0, -10.0),
        Achievement.COLLECT_COAL: jnp.where(in_view(BlockType.COAL), 2.0, -1.0),
        Achievement.COLLECT_IRON: jnp.where(in_view(BlockType.IRON), 2.0, -1.0),
        Achievement.COLLECT_DIAMOND: jnp.where(diamond, 4.0, 0.0),
        Achievement.EAT_PLANT: jnp.where(jnp.any(scene.of(BlockType.RIPE_PLANT)), 8.0, -NEVER),
        Achievement.WAKE_UP: jnp.where(can_sleep, 1.0, -NEVER),
    }
    return jnp.stack([jnp.asarray(table.get(achievement, 0.0)) for achievement in Achievement])


def next_errand(scene: Scene, plan: Plan, nearby: Surroundings, habits: Habits) -> Errand:
    """The errand of the achievement whose turn it is, or exploration if nothing is left to do."""
    undone = plan.wanted & ~scene.done
    advance = advances(scene)
    # Impossible achievements stay impossible, whatever the habits are.
    advance = jnp.where(advance > -NEVER, habits.opportunism * advance, advance)
    turn = jnp.where(undone, plan.places - advance, NEVER)
    first = jnp.argmin(turn)
    errands = errands_of(scene, nearby)
    chosen = Errand(place=errands.place[first], act=errands.act[first])
    return either(turn[first] < NEVER / 2, stocked_up(scene, plan, chosen), errand(ANYWHERE))


def stocked_up(scene: Scene, plan: Plan, chosen: Errand) -> Errand:
    """Replace the errand by collecting more wood before leaving trees, or more stone before leaving
    rock."""
    bag, missing = scene.bag, (plan.wanted & ~scene.done).astype(jnp.int32)

    def goes_to(*kinds: int) -> Array:
        return jnp.any(chosen.place == jnp.array(kinds))

    tools = [bag.wood_pickaxe, bag.wood_sword, bag.stone_pickaxe, bag.stone_sword]
    tools += [bag.iron_pickaxe, bag.iron_sword]
    wood = jnp.minimum(sum((have == 0).astype(jnp.int32) for have in tools), 5)
    trees = jnp.any(scene.of(BlockType.TREE) & rectangle(scene.here, *HALF_VIEW))
    from_trees = goes_to(BlockType.STONE.value, BlockType.COAL.value, BlockType.IRON.value)
    chosen = either(from_trees & trees & (bag.wood < wood), errand(BlockType.TREE), chosen)

    stone = (
        missing[Achievement.MAKE_STONE_PICKAXE.value] + missing[Achievement.MAKE_STONE_SWORD.value]
    )
    stone += FURNACE_STONES * missing[Achievement.PLACE_FURNACE.value]
    rock = jnp.any(scene.of(BlockType.STONE) & rectangle(scene.here, 2, 2)) & (bag.wood_pickaxe > 0)
    from_rock = goes_to(AT_TABLE, BlockType.TREE.value, FREE)
    return either(from_rock & rock & (bag.stone < stone), errand(BlockType.STONE), chosen)


def with_needs(scene: Scene, chosen: Errand) -> Errand:
    """The errand, or a more urgent one because of hunger, thirst or tiredness."""
    knows_water = jnp.any(scene.of(BlockType.WATER))
    hungry = (scene.food <= 3) & (scene.cows.distance < FAR) | (scene.food <= 1)
    thirsty = (scene.drink <= 3) & knows_water | (scene.drink <= 1)
    tired = (scene.energy <= 1) & ~in_danger(scene)
    chosen = either(hungry, errand(COW), chosen)
    chosen = either(thirsty, errand(BlockType.WATER), chosen)
    return either(tired, errand(HERE, Action.SLEEP), chosen)


class Shelter(NamedTuple):
    """A way for the demonstrator to be safe for a night."""

    errand: Errand
    """The next errand towards sleeping behind closed walls."""
    possible: Bool[Array, ""]
    closed: Bool[Array, ""]
    """Whether nothing can walk to the agent's cell."""
    dens: Board
    """The cells to dig to: rock with at most one open side."""


def shelter(scene: Scene) -> Shelter:
    """A tunnel of two cells, dug into rock, whose entrance is closed with a stone from within."""
    walkable = scene.of(*WALKABLE)
    known = union(*scene.blocks)
    open_ = walkable | ~known
    here = single(scene.here)

    def is_closed(open_: Board) -> Array:
        """Whether only few open cells can be reached from here."""
        room = here
        for _ in range(3):
            room = (spread(room) & open_) | here
        return jnp.all((spread(room) & open_) | here == room)

    def closed_by(cell: Cell) -> Array:
        return is_closed(open_ & ~single(cell))

    moves = jnp.asarray(MOVES)
    # One step back towards the entrance, to face the cell in which a stone must be placed.
    back = beside(open_ & ~scene.mobs, scene.here) & jax.vmap(
        lambda move: closed_by(scene.here + 2 * move)
    )(moves)
    closed = is_closed(open_)
    front_free = contains(walkable & ~scene.mobs, scene.front)
    closes = front_free & closed_by(scene.front)
    has_stone = scene.bag.stone > 0

    rock = scene.of(BlockType.STONE, BlockType.COAL, BlockType.PATH)
    dens = rock & dead_ends(known & ~walkable) & ~here & ~scene.mobs
    may_dig = (scene.bag.wood_pickaxe > 0) & jnp.any(dens & rectangle(scene.here, 15, 15))

    towards = Errand(jnp.asarray(HERE), Action.LEFT.value + jnp.argmax(back))
    step = either(has_stone & jnp.any(back), towards, errand(DEN))
    step = either(has_stone & closes, errand(HERE, Action.PLACE_STONE), step)
    step = either(closed, errand(HERE, Action.SLEEP), step)
    return Shelter(
        errand=step,
        possible=(scene.bag.wood_pickaxe > 0) & closed | may_dig,
        closed=closed,
        dens=dens,
    )


def wants_rest(scene: Scene, habits: Habits) -> Bool[Array, ""]:
    """Whether it is time to dig a shelter: at night, if nothing else is urgent."""
    night = (scene.light < habits.dusk) & (scene.time > 100) & (scene.energy < 8)
    urgent = (scene.drink <= 1) | (scene.food <= 1)
    return (night | (scene.energy <= 2)) & ~urgent


def choose(scene: Scene, plan: Plan, habits: Habits) -> tuple[Errand, UInt32[Array, "P 2 64"]]:
    """The errand of this step, and the board of each kind of place, by number."""
    nearby = surroundings(scene)
    chosen = with_needs(scene, next_errand(scene, plan, nearby, habits))
    zombies = scene.zombies.distance
    fights = (zombies <= 1) | ((zombies <= 3) & (scene.health > 4))
    dens = nowhere()
    if habits.shelter:
        night = shelter(scene)
        rests = wants_rest(scene, habits) & night.possible
        chosen = either(rests, night.errand, chosen)
        fights &= ~(rests & night.closed)
        dens = night.dens
    chosen = either(fights, errand(ZOMBIE), chosen)
    free = scene.of(*WALKABLE)
    stands = around(scene.of(BlockType.CRAFTING_TABLE)) & free
    kinds = scene.blocks & ~single(scene.here) & ~scene.mobs
    others = [scene.cows.board, scene.zombies.board, scene.skeletons.board]
    others += [stands, nearby.workshop, dens, nowhere()]
    return chosen, jnp.concatenate([kinds, jnp.stack(others)])


# Running the errand.


def act(key: PRNGKeyArray, scene: Scene, plan: Plan, habits: Habits) -> Int[Array, ""]:
    """The action that the demonstrator intends; the no-op while it sleeps."""
    key_walk, key_place = jax.random.split(key)
    chosen, places = choose(scene, plan, habits)
    at_once = chosen.place == HERE
    placing = (chosen.place == FREE) | (chosen.place == SOIL)
    walking = walk(
        key_walk, scene, chosen.place, places, ~(at_once | placing | scene.asleep), habits
    )
    placed = put(key_place, scene, chosen)
    action = jnp.select([at_once, placing], [chosen.act, placed], walking)
    return jnp.where(scene.asleep, Action.NOOP.value, action).astype(jnp.int32)


def terrain_of(scene: Scene) -> Terrain:
    """The terrain that the demonstrator can walk over, dig through or bridge with its inventory."""
    bag, mobs = scene.bag, scene.mobs

    def given(condition: Array, board: Board) -> Board:
        return jnp.where(condition, board, 0)

    dug = scene.of(BlockType.TREE)
    dug |= given(bag.wood_pickaxe > 0, scene.of(BlockType.STONE, BlockType.COAL))
    dug |= given(bag.stone_pickaxe > 0, scene.of(BlockType.IRON))
    slow = mobs | given(bag.stone > 2, scene.of(BlockType.WATER))
    return Terrain(free=scene.of(*WALKABLE) & ~mobs, dug=dug & ~mobs, slow=slow)


def walk(
    key: PRNGKeyArray,
    scene: Scene,
    place: Int[Array, ""],
    places: UInt32[Array, "P 2 64"],
    needed: Bool[Array, ""],
    habits: Habits,
) -> Int[Array, ""]:
    """The action of one step towards a place: move, turn, or remove an obstacle; ``DO`` on arrival."""
    key_tie, key_lost = jax.random.split(key)
    targets = places[jnp.minimum(place, len(places) - 1)]
    terrain = terrain_of(scene)
    unknown = ~union(*scene.blocks)
    ahead = unknown & ahead_of(scene)
    detour = jnp.where(place == ANYWHERE, 0, habits.detour)
    # Cells ahead are explored first, so that the agent does not turn back and forth.
    aims = Aims(
        boards=jnp.stack([targets, ahead, unknown]),
        costs=jnp.stack([jnp.zeros_like(detour), detour, detour + 5]),
    )
    ways = first_steps(scene.here, aims, terrain, needed)

    keeps_on = jnp.arange(4) == scene.facing
    preference = 0.5 * keeps_on + 0.1 * jax.random.uniform(key_tie, (4,))
    way = jnp.argmax(jnp.where(ways, preference, -1.0))
    step = Action.LEFT.value + way
    cell = scene.here + jnp.asarray(MOVES)[way]
    stands_on = (place >= AT_TABLE) & (place <= DEN)
    arrives = contains(targets, cell) & ~stands_on
    barred = arrives | ~contains(terrain.free, cell)
    bridges = contains(scene.of(BlockType.WATER), cell) & ~arrives
    hits = jnp.where(bridges, Action.PLACE_STONE.value, Action.DO.value)
    action = jnp.where(barred & (scene.facing == way), hits, step)
    lost = jax.random.randint(key_lost, (), Action.LEFT.value, Action.DO.value)
    return jnp.where(jnp.any(ways), action, lost)


def ahead_of(scene: Scene) -> Board:
    """The square with a side of 31 cells in front of the agent."""
    return rectangle(scene.here + 16 * jnp.asarray(MOVES)[scene.facing], 15, 15)


def put(key: PRNGKeyArray, scene: Scene, chosen: Errand) -> Int[Array, ""]:
    """The action to place something in front, or to turn towards a cell where it can be placed.

    Turning towards a free cell means stepping into it, which is best if there is another free cell behind
    it, and if it does not lead away from a table.
    """
    soil = scene.of(BlockType.GRASS)
    ground = jnp.where(chosen.place == SOIL, soil, scene.of(*WALKABLE)) & ~scene.mobs
    moves = jnp.asarray(MOVES)
    leads_on = beside(ground, scene.here) & jax.vmap(
        lambda move: contains(ground, scene.here + 2 * move)
    )(moves)
    stays = beside(around(scene.of(BlockType.CRAFTING_TABLE)), scene.here)
    worth = jnp.where(beside(ground, scene.here), 1 + leads_on + 2 * stays, 0)
    lost = jax.random.randint(key, (), Action.LEFT.value, Action.DO.value)
    turn = jnp.where(jnp.any(worth > 0), Action.LEFT.value + jnp.argmax(worth), lost)
    return jnp.where(contains(ground, scene.front), chosen.act, turn)
