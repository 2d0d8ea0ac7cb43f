"""Crafter against the official Python program: the same worlds, stepped side by side."""

from __future__ import annotations

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("craftax")
crafter = pytest.importorskip("crafter")
from crafter import objects  # noqa: E402

from envs.crafter import fidelity, rules  # noqa: E402
from envs.crafter.env import Crafter, CrafterTask  # noqa: E402
from envs.crafter.official import (  # noqa: E402
    BLOCK_OF,
    FACINGS,
    CrafterEpisode,
    codes_of,
    observation_of,
)
from envs.crafter.tiles import agent_picture  # noqa: E402
from envs.crafter.view import (  # noqa: E402
    ACHIEVEMENTS,
    ACTIONS,
    BLOCKS,
    COUNTS,
    MOBS,
    NUM_CELLS,
    ROWS,
    observe,
)
from envs.official import play as play_by_hand  # noqa: E402

ENV = Crafter(name="crafter-symbolic", horizon=500)
SIDE, CENTER = 64, 32
LETTERS = {
    ".": "sand", "g": "grass", "~": "water", "#": "stone", "T": "tree", "_": "path", "c": "coal",
    "i": "iron", "d": "diamond", "t": "table", "f": "furnace", "L": "lava",
}  # fmt: skip
MOB_CLASSES = (None, objects.Zombie, objects.Cow, objects.Skeleton)
PICTURE = jax.jit(agent_picture)
START, _ = jax.jit(ENV.reset)(jax.random.key(0), CrafterTask(jnp.uint32(0)))


@jax.jit
def step_without_newcomers(state, action):
    """A step in which no mob appears or vanishes: where they do is another rule in both programs."""
    with mock.patch.object(rules, "_balance", lambda key, world: world):
        return ENV.step(state, action)


class Both:
    """One world in both programs.

    Args:
      blocks: ``[64, 64]`` names of materials, Crafter's, by row and column.
      mobs: places (row, column) of a mob of each kind.
      counts: items and needs at the start that differ from Crafter's.
    """

    def __init__(self, blocks, mobs=(), **counts):
        self.theirs = crafter.Env(length=500, seed=0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(crafter.env.worldgen, "generate_world", lambda world, player: None)
            self.theirs.reset()
        self.theirs._balance_chunk = lambda chunk, objs: None
        world, player = self.theirs._world, self.theirs._player
        for thing in world.objects:
            if thing is not player:
                world.remove(thing)
        for row, column in np.ndindex(SIDE, SIDE):
            world[column, row] = blocks[row, column]
        player.inventory.update(counts)
        self.theirs._last_health = player._last_health = player.health

        numbers = np.vectorize(BLOCK_OF.get)(blocks)
        mine = START.world.replace(map=jnp.asarray(numbers, jnp.int32))
        bag = {name: jnp.int32(counts[name]) for name in COUNTS[:12] if name in counts}
        needs = {
            f"player_{name}": jnp.int32(counts[name]) for name in COUNTS[12:] if name in counts
        }
        mine = mine.replace(inventory=mine.inventory.replace(**bag), **needs)
        for kind, (row, column) in mobs:
            official = MOB_CLASSES[MOBS.index(kind)]
            more = () if kind == "cow" else (player,)
            world.add(official(world, (column, row), *more))
            group = getattr(mine, f"{kind}s")
            full = {"zombie": 5, "cow": 3, "skeleton": 3}[kind]
            group = group.replace(
                position=group.position.at[0].set(jnp.array([row, column])),
                health=group.health.at[0].set(full),
                mask=group.mask.at[0].set(True),
            )
            mine = mine.replace(
                **{f"{kind}s": group}, mob_map=mine.mob_map.at[row, column].set(True)
            )
        self.mine = START._replace(world=mine, health=mine.player_health)

    def shoot(self, place, facing):
        """Put an arrow at a place (row, column), which flies to the side that ``facing`` names."""
        row, column = place
        x, y = FACINGS[ACTIONS.index(facing) - 1]
        arrow = objects.Arrow(self.theirs._world, (column, row), (x, y))
        self.theirs._world.add(arrow)
        world = self.mine.world
        arrows = world.arrows.replace(
            position=world.arrows.position.at[0].set(jnp.array([row, column])),
            mask=world.arrows.mask.at[0].set(True),
        )
        directions = world.arrow_directions.at[0].set(jnp.array([y, x]))
        world = world.replace(arrows=arrows, arrow_directions=directions)
        self.mine = self.mine._replace(world=world)

    def disarm(self):
        """Let skeletons wait with their next arrow for longer than any test."""
        for thing in self.theirs._world.objects:
            if isinstance(thing, objects.Skeleton):
                thing.reload = 100
        skeletons = self.mine.world.skeletons
        waiting = skeletons.replace(attack_cooldown=jnp.full_like(skeletons.attack_cooldown, 100))
        self.mine = self.mine._replace(world=self.mine.world.replace(skeletons=waiting))

    def step(self, name):
        """The same action in both; what they then say must be the same. Returns my time step."""
        action = ACTIONS.index(name)
        saplings = int(self.mine.world.inventory.sapling)
        self.mine, timestep = step_without_newcomers(self.mine, jnp.int32(action))
        # Whether grass gives a sapling is chance: Crafter is given the draw that was made here.
        found = int(self.mine.world.inventory.sapling) > saplings
        found |= bool(timestep.achieved_goal[ACHIEVEMENTS.index("collect_sapling")])
        player = self.theirs._player
        player.random = Dice(0.0 if found else 1.0)
        before = dict(player.achievements)
        _, reward, done, info = self.theirs.step(action)
        new = {k for k, v in info["achievements"].items() if v and not before[k]}
        assert {ACHIEVEMENTS[i] for i in np.flatnonzero(timestep.achieved_goal)} == new
        assert bool(timestep.goal_reached) == bool(new)
        np.testing.assert_allclose(float(timestep.reward), reward, atol=1e-6)
        assert bool(timestep.terminated | timestep.truncated) == done
        self.compare(np.asarray(timestep.obs))
        return timestep

    def compare(self, obs):
        """What the program here shows is what there is in Crafter."""
        player = self.theirs._player
        np.testing.assert_array_equal(
            np.asarray(self.mine.world.player_position), [player.pos[1], player.pos[0]]
        )
        np.testing.assert_allclose(obs, observation_of(self.theirs), atol=1e-6)


class Dice:
    """A random state that always draws the same number."""

    def __init__(self, number):
        self._number = number

    def uniform(self):
        return self._number


def drawn(text):
    """A world of sand with a drawn piece of it in its middle; ``@`` is where the agent stands."""
    rows = [list(row) for row in text.split()]
    (at,) = ((r, c) for r, row in enumerate(rows) for c, sign in enumerate(row) if sign == "@")
    blocks = np.full((SIDE, SIDE), "sand", dtype="<U8")
    for r, row in enumerate(rows):
        for c, sign in enumerate(row):
            blocks[CENTER + r - at[0], CENTER + c - at[1]] = LETTERS.get(sign, "sand")
    return blocks


def play(both, *script):
    """Take the actions of a script, such as "do" or "do 3"; returns the unlocked achievements in order."""
    unlocked = []
    for line in script:
        name, _, times = line.partition(" ")
        for _ in range(int(times or 1)):
            goal = np.asarray(both.step(name).achieved_goal)
            unlocked += [ACHIEVEMENTS[place] for place in np.flatnonzero(goal)]
    return unlocked


def test_actions_have_the_same_order():
    assert list(crafter.constants.actions) == [
        name
        if name in ("do", "sleep") or "_" in name
        else {"noop": "noop"}.get(name, f"move_{name}")
        for name in ACTIONS
    ]
    assert sorted(crafter.constants.achievements) == sorted(ACHIEVEMENTS)
    assert set(COUNTS) == set(crafter.constants.items)


def test_from_nothing_to_a_diamond():
    """All recipes after each other, in a world that has everything at hand."""
    both = Both(drawn("TTTTTTTT\n.@......\n#######c\ni......i\nd......c"))
    cut = ["up", "do"]  # a tree gives one piece of wood and is gone
    wood = [*cut, "left", *cut, "right", *["right", *cut] * 6]
    assert play(both, *wood) == ["collect_wood"]
    wooden = ["left 6", "right", "place_table", "make_wood_pickaxe", "make_wood_sword"]
    assert play(both, *wooden) == ["place_table", "make_wood_pickaxe", "make_wood_sword"]
    dig = ["down", "do", "left", "down", "do", "left", "down", "do", "right 2", "down"]
    dig += ["right", "do", "right", "right", "do", "right", "right", "do"]
    stony = [*dig, "make_stone_pickaxe", "make_stone_sword"]
    assert play(both, *stony) == ["collect_stone", "make_stone_pickaxe", "make_stone_sword"]
    coal = ["right", "right", "do", "right", "right", "do"]
    assert play(both, *coal, "left 2", "place_furnace") == ["collect_coal", "place_furnace"]
    iron = ["down", "right 3", "do", "left 2", "up", "make_iron_pickaxe"]
    assert play(both, *iron) == ["collect_iron", "make_iron_pickaxe"]
    diamond = ["down 2", "right 3", "do", "left 6", "do"]
    assert play(both, *diamond) == ["collect_diamond"]
    sword = ["up", "left", "do", "up", "right", "make_iron_sword"]
    assert play(both, *sword) == ["make_iron_sword"]


def test_tools_and_their_costs():
    both = Both(drawn("...\n.@.\n..."), wood=9, stone=9, coal=9, iron=9)
    assert play(both, "make_wood_pickaxe", "place_table", "right", "left") == ["place_table"]
    # Each costs what Crafter says: four stones for a furnace, no stone for tools of iron.
    made = play(
        both, "make_wood_pickaxe", "make_wood_sword", "make_stone_pickaxe", "make_stone_sword",
        "make_iron_pickaxe", "right", "place_furnace", "make_iron_pickaxe", "make_iron_sword",
    )  # fmt: skip
    assert made == [
        "make_wood_pickaxe", "make_wood_sword", "make_stone_pickaxe", "make_stone_sword",
        "place_furnace", "make_iron_pickaxe", "make_iron_sword",
    ]  # fmt: skip
    bag = both.mine.world.inventory
    assert (int(bag.wood), int(bag.stone), int(bag.coal), int(bag.iron)) == (1, 3, 7, 7)


@pytest.mark.parametrize(("stones", "has_furnace"), [(3, False), (4, True)])
def test_a_furnace_takes_four_stones(stones, has_furnace):
    both = Both(drawn("@"), stone=stones)
    assert play(both, "place_furnace") == ["place_furnace"] * has_furnace
    assert int(both.mine.world.inventory.stone) == stones * (not has_furnace)


def test_iron_tools_take_no_stone():
    both = Both(drawn("tf\n.@"), wood=1, coal=1, iron=1)
    assert play(both, "make_iron_sword") == ["make_iron_sword"]
    both = Both(drawn("t.\n.@"), wood=1, coal=1, iron=1, stone=2)
    assert play(both, "make_iron_sword", "make_iron_pickaxe") == []
    assert int(both.mine.world.inventory.stone) == 2


@pytest.mark.parametrize("action", ["place_stone", "place_table", "place_furnace", "place_plant"])
@pytest.mark.parametrize("target", list(LETTERS))
def test_where_things_can_be_placed(action, target):
    both = Both(drawn(f"@\n{target}"), wood=5, stone=5, sapling=5)
    play(both, action, "noop")


@pytest.mark.parametrize("tool", ["none", "wood_pickaxe", "stone_pickaxe", "iron_pickaxe"])
def test_what_can_be_collected(tool):
    for target in LETTERS:
        both = Both(drawn(f"@\n{target}"), **({} if tool == "none" else {tool: 1}), drink=5)
        if target != "L":
            play(both, "do 3", "down", "do")


def test_lava_kills():
    both = Both(drawn("@\nL"))
    timestep = both.step("down")
    assert bool(timestep.terminated)
    np.testing.assert_allclose(float(timestep.reward), -0.9, atol=1e-6)


def test_sleeping_and_waking_up():
    both = Both(drawn("@"), energy=7)
    unlocked = play(both, "sleep", "left", "noop 25")
    assert unlocked == ["wake_up"]
    assert play(both, "left") == []
    # With all energy nobody falls asleep.
    both = Both(drawn("@"))
    assert play(both, "sleep", "left") == []


def test_hunger_wakes_up():
    both = Both(drawn("@"), energy=2, food=0, health=5)
    assert play(both, "sleep", "noop 40") == []
    assert not bool(both.mine.world.is_sleeping)


def test_needs_over_time_until_death():
    both = Both(drawn("@"), food=2, drink=1, energy=3, health=4)
    for _ in range(300):
        if bool(both.step("noop").terminated):
            return
    raise AssertionError("nobody lives so long without food")


def test_a_plant_ripens_and_is_eaten():
    both = Both(drawn("~@\n.g"), sapling=1)
    # Drinking on the way, and eating too early: neither hurts the plant.
    assert play(both, "place_plant", "left", "noop 150", "do 7", "down", "noop 140", "do 2") == [
        "place_plant", "collect_drink",
    ]  # fmt: skip
    assert play(both, "do") == ["eat_plant"]
    assert play(both, "do 5") == []


def test_plants_far_away_do_not_grow():
    both = Both(drawn("@\ng"), sapling=1)
    play(both, "place_plant", "up 20", "noop 30", "down 20", "noop 5")
    age = int(both.mine.world.growing_plants_age[0])
    (plant,) = (o for o in both.theirs._world.objects if isinstance(o, objects.Plant))
    assert age == plant.grown
    assert 30 < age < 60  # of 75 steps


PEN = """
    ~~~
    ~.~
    #@#
    """


@pytest.mark.parametrize("sword", ["none", "wood_sword", "stone_sword", "iron_sword"])
@pytest.mark.parametrize(
    ("mob", "unlocks"),
    [("cow", "eat_cow"), ("zombie", "defeat_zombie"), ("skeleton", "defeat_skeleton")],
)
def test_fights(mob, unlocks, sword):
    """A mob that is penned in, in front of the agent."""
    swords = {} if sword == "none" else {sword: 2}  # a second one does not count
    both = Both(drawn(PEN), [(mob, (CENTER - 1, CENTER))], food=3, **swords)
    both.disarm()  # when skeletons shoot is another rule in both programs
    health = {"cow": 3, "zombie": 5, "skeleton": 3}[mob]
    hits = -(-health // {"none": 1, "wood_sword": 2, "stone_sword": 3, "iron_sword": 5}[sword])
    # The zombie hits first, and again after some steps.
    assert play(both, "up", f"do {hits}") == [unlocks]
    assert play(both, "do 2", "noop 5") == []


@pytest.mark.parametrize("asleep", [False, True])
def test_zombies_hurt(asleep):
    both = Both(drawn(PEN), [("zombie", (CENTER - 1, CENTER))], energy=5)
    # Who sleeps loses 7, and wakes up one step later, which is no achievement.
    assert play(both, "sleep" if asleep else "noop", "noop 3") == []
    assert int(both.mine.world.player_health) == (2 if asleep else 7)
    assert not bool(both.mine.world.is_sleeping)
    if not asleep:  # or the second blow ends it
        play(both, "noop 4")


@pytest.mark.parametrize("asleep", [False, True])
@pytest.mark.parametrize("facing", ["left", "right", "up", "down"])
def test_arrows_hurt(facing, asleep):
    both = Both(np.full((SIDE, SIDE), "sand", dtype="<U8"), energy=5)
    if asleep:
        play(both, "sleep")
    x, y = FACINGS[ACTIONS.index(facing) - 1]
    both.shoot((CENTER - 3 * y, CENTER - 3 * x), facing)
    assert play(both, "noop 2") == []
    assert int(both.mine.world.player_health) == 9
    assert bool(both.mine.world.is_sleeping) == asleep
    # The third step hits, and wakes who sleeps, which is no achievement.
    assert play(both, "noop 4") == []
    assert int(both.mine.world.player_health) == 7
    assert not bool(both.mine.world.is_sleeping)


def test_fidelity_counts_all_kinds_of_mobs(monkeypatch):
    """In the order of their codes, which is that of the rows that it prints."""
    assert fidelity.MOBS_TOLD == ("zombies", "cows", "skeletons")
    beside = [objects.Skeleton, objects.Skeleton, objects.Zombie]

    def peopled(world, player):
        for column, kind in enumerate(beside, start=1):
            world.add(kind(world, (player.pos[0], player.pos[1] + column), player))

    monkeypatch.setattr(crafter.env.worldgen, "generate_world", peopled)
    seen = fidelity.seen_in_crafter(1, 1)
    np.testing.assert_array_equal(seen, [[1, 0, 2]])


@pytest.mark.parametrize("target", list(LETTERS))
def test_what_arrows_do_to_what_they_hit(target):
    """They fly over water and lava, and turn tables and furnaces into paths."""
    both = Both(drawn(f"@...{target}.#"))
    both.shoot((CENTER, CENTER + 2), "right")
    play(both, "noop 7")
    block = BLOCKS[int(both.mine.world.map[CENTER, CENTER + 4])]
    assert (block == "path") == (target in "tf_")


def test_mobs_trample_plants_down():
    pen = """
        ~~@~~
        ~.g.~
        ~~~~~
        """
    both = Both(drawn(pen), [("cow", (CENTER + 1, CENTER - 1))], sapling=1)
    assert play(both, "place_plant") == ["place_plant"]
    play(both, "noop 2")
    assert not both.mine.world.growing_plants_mask.any()


def test_the_edge_of_the_map_stays_closed():
    """In Craftax-Classic it opens where there is lava at the opposite edge."""
    blocks = np.full((SIDE, SIDE), "sand", dtype="<U8")
    blocks[SIDE - 1] = "lava"
    both = Both(blocks)
    play(both, "up 35", "left 3", "up")
    np.testing.assert_array_equal(np.asarray(both.mine.world.player_position), [0, CENTER - 3])


@pytest.mark.parametrize("seed", range(6))
def test_random_play(seed):
    """Random worlds without mobs, random belongings and random actions: all the same to the end."""
    rng = np.random.default_rng(seed)
    names, shares = zip(*{
        "sand": 10, "grass": 6, "path": 4, "water": 2, "stone": 3, "tree": 2, "coal": 1, "iron": 1,
        "diamond": 1, "table": 1, "furnace": 1, "lava": 0.1 * seed,
    }.items(), strict=True)  # fmt: skip
    blocks = rng.choice(names, (SIDE, SIDE), p=np.array(shares) / sum(shares))
    blocks[CENTER, CENTER] = "sand"
    counts = {name: int(rng.integers(0, 10)) for name in COUNTS[:12]}
    counts |= {name: int(rng.integers(3, 10)) for name in COUNTS[12:]}
    both = Both(blocks, **counts)
    names = np.array(ACTIONS)
    for _ in range(250):
        player = both.theirs._player
        # Crafter lets who wakes up act in the same step; here that step passes.
        wakes = player.sleeping and player.inventory["energy"] == 9
        timestep = both.step("noop" if wakes else str(rng.choice(names)))
        if bool(timestep.terminated):
            break
    numbers = np.vectorize(BLOCK_OF.get)(
        np.array([[both.theirs._world[c, r][0] for c in range(SIDE)] for r in range(SIDE)])
    )
    plants = np.isin(np.asarray(both.mine.world.map), (15, 16))
    mine = np.where(plants, BLOCKS.index("grass"), np.asarray(both.mine.world.map))
    np.testing.assert_array_equal(mine, numbers)


class Wanderer:
    """Takes random actions, and keeps what it has seen."""

    def __init__(self):
        self.rng, self.seen = np.random.default_rng(0), []

    def act(self, obs):
        self.seen.append(obs)
        return np.asarray(self.rng.integers(len(ACTIONS)))

    reset = act


def test_an_episode_of_the_package_is_played_by_hand():
    wanderer = Wanderer()
    played = play_by_hand(wanderer, CrafterEpisode(seed=1, horizon=120))
    assert played.length == len(wanderer.seen) == 120
    first, last = wanderer.seen[0], wanderer.seen[-1]
    assert first.shape == ENV.spec.obs.shape
    assert first.dtype == np.float32
    assert first[NUM_CELLS:][COUNTS.index("health")] == 9
    assert (last[:NUM_CELLS] != first[:NUM_CELLS]).any()
    assert set(played.reached) <= set(ACHIEVEMENTS)
    assert len(set(played.reached)) == len(played.reached) > 0
    lost = round(10 * (len(played.reached) - played.return_), 6)
    assert lost == int(lost)  # what is not an achievement is points of health
    assert 0 <= lost < 9


class TestPictures:
    """Crafter's picture is drawn from the codes, up to the rounding of single precision."""

    def same(self, both):
        theirs = both.theirs.render()
        mine = np.asarray(PICTURE(jnp.asarray(both.obs)))
        assert theirs.shape == mine.shape == (64, 64, 3)
        assert abs(mine.astype(int) - theirs).max() <= 1
        assert (mine != theirs).mean() < 0.01

    @pytest.fixture(autouse=True)
    def _no_noise(self, monkeypatch):
        monkeypatch.setattr(crafter.engine.LocalView, "_noise", lambda self, canvas, *_: canvas)

    @pytest.mark.parametrize("steps", [0, 100, 200, 280])
    @pytest.mark.parametrize("facing", ["left", "right", "up", "down"])
    def test_everything_at_any_hour(self, steps, facing):
        text = """
            g~#T_cidt
            fLg......
            ........#
            ....@....
            .........
            #~#~#....
            """
        counts = {name: 1 + place % 9 for place, name in enumerate(COUNTS[:12])}
        mobs = [("zombie", (30, 30)), ("cow", (31, 34)), ("skeleton", (34, 35))]
        both = Both(drawn(text), mobs, **counts, energy=3)
        both.theirs._step = steps
        both.theirs._update_time()
        world = both.mine.world.replace(
            player_direction=jnp.int32(ACTIONS.index(facing)),
            light_level=jnp.float32(both.theirs._world.daylight),
        )
        both.theirs._player.facing = FACINGS[ACTIONS.index(facing) - 1]
        both.obs = np.asarray(jax.jit(observe)(world))
        self.same(both)
        both.theirs._player.sleeping = True
        both.obs = np.asarray(jax.jit(observe)(world.replace(is_sleeping=jnp.array(True))))
        self.same(both)

    def test_plants_arrows_and_the_edge(self):
        both = Both(np.full((SIDE, SIDE), "grass", dtype="<U8"))
        world = both.theirs._world
        for place, grown in (((1, 1), 0), ((2, 1), 400)):
            plant = objects.Plant(world, place)
            plant.grown = grown
            world.add(plant)
        for place, facing in zip([(0, 2), (1, 2), (2, 2)], FACINGS[1:], strict=True):
            world.add(objects.Arrow(world, place, facing))
        world.move(both.theirs._player, (0, 0))
        mine = both.mine.world
        arrows = mine.arrows.replace(
            position=jnp.array([[2, 0], [2, 1], [2, 2]]), mask=jnp.ones(3, bool)
        )
        mine = mine.replace(
            map=mine.map.at[1, 1].set(15).at[1, 2].set(16), player_position=jnp.zeros(2, jnp.int32),
            arrows=arrows, arrow_directions=jnp.array([[0, 1], [-1, 0], [1, 0]]),
        )  # fmt: skip
        both.obs = np.asarray(jax.jit(observe)(mine))
        np.testing.assert_array_equal(both.obs[:NUM_CELLS].reshape(ROWS, -1), codes_of(both.theirs))
        self.same(both)
