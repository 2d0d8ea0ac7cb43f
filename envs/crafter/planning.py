"""The demonstrator's decisions in Crafter: from its knowledge to an errand, and from that to an action.

For each achievement the recipes determine the next errand (``errands.Errand``): go to some kind of place
and act there. Which errand to run is decided anew at every step. A zombie nearby is fought first, then a
shelter is dug at night, then come tiredness, thirst and hunger. Otherwise it is the turn of the first
achievement in the order of the episode, in which achievements whose places are in view come earlier. The
agent takes the cheapest path through known cells. Unknown cells count as a place that is far away, so that
one search decides between known places and exploration.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from craftax.craftax_classic.constants import Action, BlockType
from jaxtyping import Array, Bool, Int, PRNGKeyArray, UInt32

from envs.crafter.errands import (
    ANYWHERE,
    AT_TABLE,
    DEN,
    FREE,
    HERE,
    SOIL,
    ZOMBIE,
    Errand,
    either,
    errand,
    next_errand,
    surroundings,
    with_needs,
)
from envs.crafter.habits import Habits, Plan
from envs.crafter.scenes import WALKABLE, Scene
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
    rectangle,
    single,
    spread,
    union,
)


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
