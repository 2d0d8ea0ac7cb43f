"""The demonstrators of Crafter: on handmade maps, against a search in Python, blind to unseen cells."""

from __future__ import annotations

import heapq
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("craftax")

from craftax.craftax_classic.constants import Achievement, Action, BlockType

import envs
from envs.crafter import planning, scenes, searching
from envs.crafter.demonstrators import (
    HABITS,
    NUM_RANDOM,
    Memory,
    crafter_demonstrators,
    disturbed,
    planner,
)
from envs.crafter.env import Crafter, CrafterTask
from envs.crafter.habits import TIERS, Habits, Plan, make_plan
from envs.crafter.searching import DIG, LONGEST, MOVES, SIDE, WADE, Aims, Terrain
from envs.episodes import run_episode
from envs.errors import UsageError
from experiments.demonstrators import find_demonstrator

ENV = Crafter(name="crafter-symbolic", horizon=500)
CENTER = np.array([32, 32], np.int32)


def random_board(rng, share):
    return rng.random((SIDE, SIDE)) < share


def board_of(cells):
    return searching.pack(jnp.asarray(cells))


class TestBoards:
    def test_unpack_undoes_pack(self):
        cells = random_board(np.random.default_rng(0), 0.5)
        assert (searching.unpack(board_of(cells)) == cells).all()

    @pytest.mark.parametrize("corner", [(0, 0), (30, 28), (-3, -4), (61, 60), (20, -40), (-9, 70)])
    def test_a_window_lies_where_it_should(self, corner):
        window = np.random.default_rng(1).random((7, 9)) < 0.5
        wanted = np.zeros((SIDE, SIDE), bool)
        for (row, column), inside in np.ndenumerate(window):
            cell = (corner[0] + row, corner[1] + column)
            if min(cell) >= 0 and max(cell) < SIDE:
                wanted[cell] = inside
        found = searching.pack_window(jnp.asarray(window), jnp.array(corner))
        assert (searching.unpack(found) == wanted).all()

    def test_neighborhoods(self):
        cells = random_board(np.random.default_rng(2), 0.1)
        padded = np.pad(cells, 1)
        shifted = {
            (down, right): padded[1 + down : 65 + down, 1 + right : 65 + right]
            for down in (-1, 0, 1)
            for right in (-1, 0, 1)
        }
        cross = [shifted[tuple(move)] for move in MOVES]
        board = board_of(cells)
        assert (searching.unpack(searching.spread(board)) == np.any([cells, *cross], axis=0)).all()
        everything = np.any(list(shifted.values()), axis=0)
        assert (searching.unpack(searching.around(board)) == everything).all()
        ends = searching.dead_ends(board_of(~cells))
        assert (searching.unpack(ends) == (4 - np.sum(cross, axis=0) - edge() >= 3)).all()

    @pytest.mark.parametrize("cell", [(0, 0), (63, 63), (31, 32), (-1, 5), (5, 64)])
    def test_contains(self, cell):
        cells = random_board(np.random.default_rng(3), 0.5)
        inside = min(cell) >= 0 and max(cell) < SIDE
        found = searching.contains(board_of(cells), jnp.array(cell))
        assert bool(found) == (inside and bool(cells[cell]))


def edge():
    """How many neighbors of each cell lie off the map; they are not barred."""
    off = np.zeros((SIDE, SIDE), int)
    off[[0, -1]] += 1
    off[:, [0, -1]] += 1
    return off


def cheapest(costs, aims, here):
    """The neighbors of ``here`` that begin a cheapest way, by Dijkstra's algorithm from the aims.

    ``costs`` [64, 64] is what entering a cell costs (0: barred), ``aims`` pairs of cells and costs.
    """
    best = np.full((SIDE, SIDE), np.inf)
    queue = []
    for cells, cost in aims:
        for cell in map(tuple, np.argwhere(cells)):
            best[cell] = min(best[cell], cost)
    queue = [(best[cell], cell) for cell in map(tuple, np.argwhere(best < np.inf))]
    heapq.heapify(queue)
    while queue:
        value, cell = heapq.heappop(queue)
        if value > best[cell]:
            continue
        for move in MOVES:
            other = tuple(map(int, cell + move))
            if min(other) < 0 or max(other) >= SIDE or costs[other] == 0:
                continue
            if value + costs[other] < best[other]:
                best[other] = value + costs[other]
                heapq.heappush(queue, (best[other], other))
    beside = [tuple(map(int, here + move)) for move in MOVES]
    on_map = [min(cell) >= 0 and max(cell) < SIDE for cell in beside]
    values = np.array([best[c] if on else np.inf for c, on in zip(beside, on_map, strict=True)])
    return (values == values.min()) & (values < LONGEST)


class TestSearch:
    def test_is_dijkstra(self):
        """On 150 random maps, all in one program; where a search is not needed, others do not mind."""
        rng = np.random.default_rng(4)
        cases = []
        for number in range(150):
            kind = rng.choice([0, 1, DIG, WADE], (SIDE, SIDE), p=[0.4, 0.4, 0.15, 0.05])
            few = rng.random((SIDE, SIDE)) < rng.choice([0.0, 0.001, 0.02])
            late = rng.random((SIDE, SIDE)) < rng.choice([0.0, 0.3])
            here = rng.integers(0, SIDE, 2).astype(np.int32)
            if number < 4:  # in the corners
                here = np.array([(0, 0), (0, 63), (63, 0), (63, 63)][number], np.int32)
            few[tuple(here)] = late[tuple(here)] = False
            cases.append((kind, few, late, int(rng.integers(0, 15)), here))
        kinds, few, late, delays, heres = map(np.array, zip(*cases, strict=True))

        @jax.jit
        @jax.vmap
        def search(kind, few, late, delay, here):
            terrain = Terrain(*(searching.pack(kind == cost) for cost in (1, DIG, WADE)))
            boards = jnp.stack([searching.pack(few), searching.pack(late)])
            aims = Aims(boards, jnp.stack([jnp.zeros_like(delay), delay]))
            return searching.first_steps(here, aims, terrain, jnp.ones((), bool))

        found = np.asarray(search(kinds, few, late, delays.astype(np.int32), heres))
        wanted = [cheapest(k, [(f, 0), (o, d)], h) for k, f, o, d, h in cases]
        assert (found == np.array(wanted)).all()
        assert 0.05 < np.mean(~found.any(axis=1)) < 0.95

    def test_a_search_that_is_not_needed_takes_no_time(self):
        """It does not find what is in reach, so that its loop was not entered."""
        free = Terrain(searching.rectangle(jnp.array(CENTER), 2, 2), *[searching.nowhere()] * 2)
        aims = Aims(searching.single(jnp.array(CENTER) + 1)[None], jnp.zeros(1, jnp.int32))
        for needed in (False, True):
            steps = searching.first_steps(jnp.array(CENTER), aims, free, jnp.array(needed))
            assert steps.any() == needed


# Hand-made maps: '@' is the agent, which faces south; everything around the drawing is water.
KINDS = {
    ".": BlockType.SAND, "~": BlockType.WATER, "g": BlockType.GRASS, "T": BlockType.TREE,
    "#": BlockType.STONE, "c": BlockType.COAL, "i": BlockType.IRON, "d": BlockType.DIAMOND,
    "t": BlockType.CRAFTING_TABLE, "f": BlockType.FURNACE, "_": BlockType.PATH, "L": BlockType.LAVA,
}  # fmt: skip


@cache
def blank():
    return jax.jit(ENV.reset)(jax.random.key(0), CrafterTask(jnp.uint32(0)))


def made(drawing: str, bag=None, **facts):
    """A state on a drawn map, without mobs. Nothing spawns on sand."""
    state, _ = blank()
    lines = drawing.split()
    row, column = next((r, line.index("@")) for r, line in enumerate(lines) if "@" in line)
    world = state.world
    cells = np.full((SIDE, SIDE), BlockType.WATER.value, np.asarray(world.map).dtype)
    for r, line in enumerate(lines):
        for c, letter in enumerate(line):
            kind = KINDS.get(letter, BlockType.SAND)
            cells[32 + r - row, 32 + c - column] = kind.value
    bag = {name: jnp.asarray(number, jnp.int32) for name, number in (bag or {}).items()}
    facts = {name: jnp.asarray(v, getattr(world, name).dtype) for name, v in facts.items()}
    world = world.replace(
        map=jnp.asarray(cells),
        player_position=jnp.asarray(CENTER, world.player_position.dtype),
        inventory=world.inventory.replace(**bag),
        **facts,
    )
    return state._replace(world=world, health=world.player_health)


def with_mob(state, kind, cell):
    """The state with one mob at ``cell``, relative to the agent."""
    world = state.world
    place = CENTER + np.array(cell)
    mobs = getattr(world, kind)
    mobs = mobs.replace(
        position=mobs.position.at[0].set(place),
        mask=mobs.mask.at[0].set(True),
        health=mobs.health.at[0].set(3),
    )
    mob_map = world.mob_map.at[tuple(place)].set(True)
    return state._replace(world=world.replace(mob_map=mob_map, **{kind: mobs}))


def plan_of(*achievements):
    """To strive for these alone, in this order."""
    order = [achievements.index(a) if a in achievements else 50 for a in Achievement]
    return Plan(places=jnp.array(order, jnp.float32), wanted=jnp.array([o < 50 for o in order]))


def memory_of(plan, noise=0.0):
    """What an agent remembers before its first step."""
    nothing = jnp.zeros((), jnp.int32)
    return Memory(scenes.unknown_map(), plan, jnp.asarray(noise), left=nothing, intended=nothing)


@cache
def programs():
    """The agent without noise, and the world; each compiled once."""
    agent = planner(Habits(noise=0.0))
    return jax.jit(agent.proceed), jax.jit(ENV.step)


def acts(state, plan, num_steps):
    """The names of the agent's first actions, and the states after each."""
    proceed, step = programs()
    memory, names, states = memory_of(plan), [], []
    _, timestep = blank()
    for number in range(num_steps):
        action, _, memory = proceed(jax.random.key(number), memory, state, timestep)
        names.append(Action(int(action)).name)
        state, timestep = step(state, action)
        states.append(state)
    return names, states


def has(state, achievement) -> bool:
    return bool(state.world.achievements[achievement.value])


class TestErrands:
    def test_takes_the_shortest_way(self):
        """The eastern tree is five steps away, the western one behind a wall eight."""
        drawing = """
            ~~~~~~~~~
            ~T~..@..T
            ~..~.~.~~
            ~~....~~~
        """
        names, states = acts(made(drawing), plan_of(Achievement.COLLECT_WOOD), 3)
        assert names == ["RIGHT", "RIGHT", "DO"]
        assert has(states[-1], Achievement.COLLECT_WOOD)

    def test_digs_where_that_is_shorter_than_going_round(self):
        drawing = """
            .........
            .~~~~~~~.
            .@##T~~~.
            ..~~~~~~.
        """
        state = made(drawing, {"wood_pickaxe": 1})
        names, states = acts(state, plan_of(Achievement.COLLECT_WOOD), 6)
        assert names == ["RIGHT", "DO", "RIGHT", "DO", "RIGHT", "DO"]
        assert has(states[-1], Achievement.COLLECT_WOOD)

    def test_a_pickaxe_from_nothing(self):
        """Two wood for the table and one for the pickaxe; what is mined is gone."""
        drawing = """
            ~TTT~
            ~.@.~
            ~~~~~
        """
        names, states = acts(made(drawing), plan_of(Achievement.MAKE_WOOD_PICKAXE), 12)
        wanted = [Achievement.COLLECT_WOOD, Achievement.PLACE_TABLE, Achievement.MAKE_WOOD_PICKAXE]
        assert [has(states[-1], achievement) for achievement in wanted] == [True] * 3
        assert names.count("DO") == 3
        assert names[:2] == ["UP", "DO"]
        assert names.index("PLACE_TABLE") + 1 == names.index("MAKE_WOOD_PICKAXE")
        bag = states[names.index("MAKE_WOOD_PICKAXE")].world.inventory
        assert (int(bag.wood), int(bag.wood_pickaxe)) == (0, 1)

    def test_an_iron_pickaxe_with_all_tools_but_no_furnace(self):
        """Coal and iron lie on the way; four stones make the furnace, which stands by the table."""
        drawing = """
            ~..~~~~
            t.@.ci~
            ~..~~~~
        """
        state = made(drawing, {"wood": 1, "stone": 4, "wood_pickaxe": 1, "stone_pickaxe": 1})
        names, states = acts(state, plan_of(Achievement.MAKE_IRON_PICKAXE), 14)
        assert names[:5] == ["RIGHT", "DO", "RIGHT", "DO", "LEFT"]
        order = [Achievement.COLLECT_COAL, Achievement.COLLECT_IRON, Achievement.PLACE_FURNACE]
        order += [Achievement.MAKE_IRON_PICKAXE]
        assert all(has(states[-1], achievement) for achievement in order)
        when = [next(t for t, s in enumerate(states) if has(s, a)) for a in order]
        assert when == sorted(when)
        bag = states[-1].world.inventory
        assert [int(n) for n in (bag.wood, bag.stone, bag.coal, bag.iron)] == [0, 0, 0, 0]

    def test_a_furnace_where_there_is_little_room(self):
        """Turning to a free cell is a step into it; it does not lead away from the table."""
        drawing = """
            ~~~~~~
            t@...~
            ~.~~~~
            ~.~~~~
        """
        state = made(drawing, {"stone": 4, "wood_pickaxe": 1})
        names, _ = acts(state, plan_of(Achievement.PLACE_FURNACE), 3)
        assert "PLACE_FURNACE" in names

    def test_takes_stones_for_all_that_needs_them(self):
        """One for each tool and four for the furnace, before it goes back to the table."""
        drawing = """
            ~...~####
            t@..#####
            ~...~####
        """
        plan = plan_of(
            Achievement.MAKE_STONE_PICKAXE, Achievement.MAKE_STONE_SWORD, Achievement.PLACE_FURNACE
        )
        _, states = acts(made(drawing, {"wood": 2, "wood_pickaxe": 1}), plan, 40)
        assert all(has(states[-1], Achievement(i)) for i in np.flatnonzero(plan.wanted))
        stones = [int(state.world.inventory.stone) for state in states]
        assert max(stones) == 6

    def test_thirst_comes_before_the_plan(self):
        drawing = """
            TTTTTTT
            TTTT@.~
            TTTTTTT
        """
        names, states = acts(made(drawing, player_drink=2), plan_of(Achievement.COLLECT_WOOD), 2)
        assert names == ["RIGHT", "DO"]
        assert has(states[-1], Achievement.COLLECT_DRINK)

    def test_fights_a_zombie_at_hand(self):
        state = with_mob(made("...\n.@.\n...\n"), "zombies", (0, 1))
        names, _ = acts(state, plan_of(Achievement.WAKE_UP), 1)
        assert names == ["RIGHT"]

    def test_explores_when_nothing_is_known(self):
        """No tree in sight: it walks on to where it has not been, and not to and fro."""
        row = "." * 14
        drawing = f"~{row}\n~@{row[1:]}\n~{row}\n"
        names, _ = acts(made(drawing), plan_of(Achievement.COLLECT_WOOD), 9)
        assert names.count("RIGHT") >= 8

    def test_sleeps_on(self):
        state = made("TT@TT", is_sleeping=True, player_energy=3)
        names, _ = acts(state, plan_of(Achievement.COLLECT_WOOD), 2)
        assert names == ["NOOP", "NOOP"]


NIGHT = {"timestep": 180, "light_level": 0.2, "player_energy": 5}
ROCK = """
    #########
    #########
    #########
    #########
    ....@....
    .........
    .........
"""


class TestNight:
    def night(self):
        state = made(ROCK, {"wood_pickaxe": 1, "stone": 1}, **NIGHT)
        return acts(state, plan_of(Achievement.COLLECT_DIAMOND), 12)

    def test_digs_in_and_sleeps_behind_a_stone(self):
        names, states = self.night()
        assert "PLACE_STONE" in names
        closed = names.index("PLACE_STONE")
        assert names[closed + 1] == "SLEEP"
        assert bool(states[closed + 1].world.is_sleeping)
        assert set(names[closed + 2 :]) == {"NOOP"}

    def test_nothing_can_walk_to_it(self):
        names, states = self.night()
        world = states[names.index("SLEEP")].world
        walkable = np.isin(world.map, [kind.value for kind in scenes.WALKABLE])
        room = {tuple(map(int, world.player_position))}
        for _ in range(SIDE):
            room |= {
                cell
                for known in room
                for move in MOVES
                if walkable[cell := tuple(map(int, np.array(known) + move))]
            }
        assert len(room) == 2

    def test_goes_on_by_day(self):
        state = made(ROCK, {"wood_pickaxe": 1, "stone": 1}, timestep=60, light_level=1.0)
        names, _ = acts(state, plan_of(Achievement.COLLECT_STONE), 2)
        assert names == ["UP", "DO"]

    def test_no_shelter_without_a_pickaxe(self):
        state = made(ROCK, **NIGHT)
        names, _ = acts(state, plan_of(Achievement.COLLECT_DIAMOND), 4)
        assert "SLEEP" not in names


NUM_CASES = 128


@cache
def cases():
    """Random worlds with the agent and its bag anywhere, seen from three places before."""
    rng = np.random.default_rng(5)
    reset = jax.jit(jax.vmap(lambda seed: ENV.reset(jax.random.key(0), CrafterTask(seed))[0].world))
    worlds = reset(jnp.arange(NUM_CASES, dtype=jnp.uint32))
    number = partial(rng.integers, size=NUM_CASES)
    bag = {name: jnp.asarray(number(0, 4)) for name in ("wood", "stone", "coal", "iron", "sapling")}
    tools = ("wood_pickaxe", "stone_pickaxe", "iron_pickaxe", "wood_sword", "stone_sword")
    bag |= {name: jnp.asarray(number(0, 2)) for name in tools}
    bag = {name: value.astype(jnp.int32) for name, value in bag.items()}
    visited = jnp.asarray(
        rng.integers(4, 60, (NUM_CASES, 1, 2)) + rng.integers(-4, 5, (NUM_CASES, 4, 2))
    )
    mobs = {
        kind: getattr(worlds, kind).replace(
            position=jnp.asarray(rng.integers(0, SIDE, getattr(worlds, kind).position.shape)),
            mask=jnp.asarray(rng.random(getattr(worlds, kind).mask.shape) < 0.7),
        )
        for kind in ("zombies", "cows", "skeletons")
    }
    workshops = rng.choice([0, 11, 12], worlds.map.shape, p=[0.96, 0.02, 0.02])
    return worlds.replace(
        map=jnp.where(workshops > 0, workshops, worlds.map).astype(worlds.map.dtype),
        inventory=worlds.inventory.replace(**bag),
        player_direction=jnp.asarray(number(1, 5)),
        player_energy=jnp.asarray(number(5, 10)),
        timestep=jnp.asarray(number(0, 500)),
        light_level=jnp.asarray(rng.random(NUM_CASES), jnp.float32),
        **mobs,
    ), visited.astype(jnp.int32)


@jax.jit
@jax.vmap
def remembered(world, visited):
    """The known blocks of an agent that was at these places, and which cells it has seen."""
    blocks, seen = scenes.unknown_map(), searching.nowhere()
    for place in visited:
        blocks = scenes.look(blocks, world.replace(player_position=place))
        seen = searching.union(seen, searching.rectangle(place, *scenes.HALF_VIEW))
    return blocks, searching.unpack(seen)


@jax.jit
@jax.vmap
def chosen(key, blocks, world, place):
    """The action at a place with these blocks known."""
    scene = scenes.scene_of(blocks, world.replace(player_position=place))
    return planning.act(key, scene, make_plan(key, Habits()), Habits())


@jax.jit
@jax.vmap
def mixed(world, other, keeps):
    """The world with the map and the mobs of the other one outside of ``keeps``."""

    def mobs(mine, others):
        stay = keeps[mine.position[:, 0], mine.position[:, 1]] & mine.mask
        come = others.mask & ~keeps[others.position[:, 0], others.position[:, 1]]
        position = jnp.where(stay[:, None], mine.position, others.position)
        return mine.replace(position=position, mask=stay | come)

    kinds = ("zombies", "cows", "skeletons")
    return world.replace(
        map=jnp.where(keeps, world.map, other.map),
        **{kind: mobs(getattr(world, kind), getattr(other, kind)) for kind in kinds},
    )


class TestSight:
    def test_what_was_never_in_view_changes_nothing(self):
        """Neither the map nor the mobs of what was not seen; what was seen does, in many cases."""
        worlds, visited = cases()
        others = jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), worlds)
        keys = jax.random.split(jax.random.key(3), NUM_CASES)
        blocks, seen = remembered(worlds, visited)

        def actions_in(worlds):
            blocks, _ = remembered(worlds, visited)
            return np.asarray(chosen(keys, blocks, worlds, visited[:, -1]))

        actions = actions_in(worlds)
        assert (actions == actions_in(mixed(worlds, others, seen))).all()
        assert len(set(actions.tolist())) > 6
        assert np.mean(actions != actions_in(mixed(worlds, others, ~seen))) > 0.3
        # What is known of the map is all there is to know of it.
        elsewhere = mixed(worlds, others, jnp.zeros_like(seen)).map
        hidden = worlds.replace(map=elsewhere)
        assert (actions == np.asarray(chosen(keys, blocks, hidden, visited[:, -1]))).all()

    def test_a_map_of_the_whole_world_is_used(self):
        worlds, visited = cases()
        keys = jax.random.split(jax.random.key(3), NUM_CASES)
        whole = jax.jit(jax.vmap(scenes.whole_map))(worlds)
        blocks, _ = remembered(worlds, visited)
        known = np.asarray(chosen(keys, whole, worlds, visited[:, -1]))
        assert np.mean(known != np.asarray(chosen(keys, blocks, worlds, visited[:, -1]))) > 0.03

    def test_only_mapped_knows_the_map_from_the_start(self):
        for name, habits in HABITS.items():
            assert habits.whole_map == (name == "mapped")

    def test_where_goals_have_places_the_first_knows_the_map_in_half_of_its_episodes(self):
        env = Crafter(name="crafter-map", horizon=500, places=True)
        name, guide = next(iter(crafter_demonstrators(env).items()))
        assert (name, dict(guide.settings)["whole_map"]) == ("guide", 0.5)
        task = CrafterTask(jnp.uint32(1))
        state, timestep = jax.jit(env.reset)(jax.random.key(1), task)
        agent = guide.agent(None)
        # The map alone, so that nothing is compiled that chooses an action.
        known_map = jax.jit(jax.vmap(lambda key: agent.begin(key, task, state, timestep)[2].blocks))
        boards = known_map(jax.random.split(jax.random.key(0), 64))
        known = np.asarray(jnp.any(boards[:, :, :, 0] > 0, axis=(1, 2)))
        assert 20 < known.sum() < 44

    def test_sees_nine_columns_and_seven_rows(self):
        state = made("@")
        seen = searching.unpack(searching.union(*scenes.look(scenes.unknown_map(), state.world)))
        rows, columns = np.nonzero(seen)
        assert (rows.min(), rows.max()) == (29, 35)
        assert (columns.min(), columns.max()) == (28, 36)
        assert seen.sum() == 63

    def test_remembers_and_corrects(self):
        """What is out of view stays as it was; what is in view is as it is."""
        state = made("T...@...T")
        world = state.world
        blocks = scenes.look(scenes.unknown_map(), world)
        gone = world.map.at[32, 28].set(BlockType.SAND.value).at[32, 36].set(BlockType.SAND.value)
        moved = world.replace(map=gone, player_position=jnp.array([32, 33]))
        trees = scenes.look(blocks, moved)[BlockType.TREE.value]
        assert np.argwhere(np.asarray(searching.unpack(trees))).tolist() == [[32, 28]]


class TestNoise:
    def run(self, habits, num_steps=4000):
        """Executed actions of an agent that always intends to make an iron sword."""
        state = made("~L~\n.@.\n...\n")
        scene = scenes.scene_of(scenes.look(scenes.unknown_map(), state.world), state.world)
        agent = planner(habits)
        intended = jnp.asarray(Action.MAKE_IRON_SWORD.value, jnp.int32)
        memory = memory_of(plan_of(), habits.noise)._replace(intended=intended)

        def step(memory, key):
            action, memory = disturbed(key, scene, memory, habits)
            return memory, (action, agent.intended(memory))

        keys = jax.random.split(jax.random.key(1), num_steps)
        return map(np.asarray, jax.jit(lambda m: jax.lax.scan(step, m, keys)[1])(memory))

    def test_random_actions_come_in_runs_and_the_intended_ones_are_kept(self):
        actions, intended = self.run(Habits(noise=0.02, longest_run=4))
        assert (intended == Action.MAKE_IRON_SWORD.value).all()
        random = actions != intended
        assert set(actions[random]) <= set(range(NUM_RANDOM))
        edges = np.flatnonzero(np.diff(np.concatenate([[0], random, [0]])))
        runs = edges[1::2] - edges[::2]
        counts = np.bincount(runs, minlength=5)
        assert (counts[1:5] > 8).all()
        assert counts[5:].sum() < 0.15 * counts.sum()  # runs that follow each other
        assert 0.03 < random.mean() < 0.07  # 2 % start one of 2.5 on average

    def test_none_leads_into_lava(self):
        actions, _ = self.run(Habits(noise=0.5))
        assert Action.UP.value not in actions
        assert {Action.LEFT.value, Action.RIGHT.value, Action.DOWN.value} < set(actions.tolist())

    def test_without_noise_the_intended_actions_are_executed(self):
        actions, intended = self.run(Habits(noise=0.0), num_steps=200)
        assert (actions == intended).all()


class TestPlans:
    def test_orders_and_omissions_vary(self):
        keys = jax.random.split(jax.random.key(0), 500)
        habits = Habits(drop=0.2, shuffle=2.0)
        plans = jax.jit(jax.vmap(lambda key: make_plan(key, habits)))(keys)
        assert abs(1 - np.mean(plans.wanted) - 0.2) < 0.02
        tiers = np.array([TIERS[achievement] for achievement in Achievement])
        assert np.abs(np.mean(plans.places, axis=0) - tiers).max() < 0.4
        assert len({tuple(order) for order in np.argsort(plans.places, axis=1).tolist()}) > 490

    def test_every_achievement_has_a_tier(self):
        assert set(TIERS) == set(Achievement)


class TestDemonstrators:
    def test_settings_tell_them_apart(self):
        demonstrators = crafter_demonstrators(ENV)
        settings = {name: dict(made.settings) for name, made in demonstrators.items()}
        assert next(iter(settings)) == "expert"
        assert len({tuple(values.items()) for values in settings.values()}) == len(settings)
        assert settings["expert"]["noise"] == HABITS["expert"].noise

    def test_settings_can_be_changed(self):
        world = envs.find("crafter-symbolic")
        name, changed = find_demonstrator(world, ENV, "expert,shuffle=1,drop=0.2")
        assert name == "expert,drop=0.2,shuffle=1"
        same = {**dict(crafter_demonstrators(ENV)["expert"].settings), "drop": 0.2, "shuffle": 1.0}
        assert dict(changed.settings) == same

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            (
                "expert,dorp=1",
                "unknown setting of the demonstrator expert 'dorp'; did you mean 'drop'",
            ),
            ("expert,drop=2", "demonstrator expert: drop must be from 0 to 0.5, found 2"),
            ("expert,drop=nan", "demonstrator expert: drop must be from 0 to 0.5, found nan"),
            (
                "expert,drop=0.1,drop=0.3",
                "the setting drop of the demonstrator expert is given twice",
            ),
            (
                "expert,drop",
                "setting drop of the demonstrator expert must be a number, found ''; write",
            ),
            ("expert,longest_run=1.5", "demonstrator expert: longest_run must be a whole number"),
            ("expert,longest_run=inf", "demonstrator expert: longest_run must be a whole number"),
            ("export,drop=0.2", "unknown demonstrator 'export'; did you mean 'expert'"),
        ],
    )
    def test_wrong_settings(self, name, message):
        with pytest.raises(UsageError, match=message):
            find_demonstrator(envs.find("crafter-symbolic"), ENV, name)

    @pytest.mark.slow
    def test_episodes(self):
        """Returns of 64 episodes; compiling takes a minute."""
        demonstrator = crafter_demonstrators(ENV)["expert"]
        agent = demonstrator.agent(demonstrator.weights)
        keys = jax.random.split(jax.random.key(0), (2, 64))
        tasks = jax.vmap(demonstrator.sample_task)(keys[0], jnp.arange(64))
        episode = jax.jit(jax.vmap(lambda key, task: run_episode(key, ENV, agent, task)))
        done = episode(keys[1], tasks)
        assert 12 < np.mean(done.return_) < 17
        real = np.arange(ENV.horizon) < np.asarray(done.trajectory.length)[:, None]
        differs = np.asarray(done.trajectory.intended != done.trajectory.actions)
        assert 0.05 < differs[real].mean() < 0.15
