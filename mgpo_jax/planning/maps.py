"""The plan where goals are states: a map of all episodes, ways on it, and prompts that lead along them.

After the first episode, which evaluates (g^M), an episode goes to one of three things:

- a prompt that is surely better than the best one: its rehearsal (``planning.rehearsal``) arrives sooner;
- a prompt that may be better: its rehearsal leaves what is known, near enough to the goal;
- exploring: actions are sampled under a random prompt of the known way, or under one that leads to a
  frontier, a state from where the task goal could be reached sooner than by the known way.

The first two act greedily. Without rehearsals (an ablation) they are random prompts of the known way.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import EnvSpec, Episode, Goals
from mgpo_jax.adaptation import in_turn
from mgpo_jax.optimizers.arms import (
    Arms,
    empty_arms,
    estimated_returns,
    no_goals,
)
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.planning.proposals import changed, crossed, random_prompts
from mgpo_jax.planning.rehearsal import (
    ARRIVES,
    FAILS,
    LEAVES,
    Ahead,
    Rehearsal,
    Seen,
    any_of,
    rehearse,
)
from mgpo_jax.planning.steering import Lead, deficits, lead_along, steer
from mgpo_jax.planning.table import (
    FAR,
    UNKNOWN,
    Table,
    add_episode,
    empty_table,
    find_state,
    goals_on,
    shortest_way,
    steps_from,
    steps_to,
)
from mgpo_jax.planning.trials import is_tried, with_result
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

NUM_PROMPTS = 32
"""Prompts that are rehearsed together: in each round of changes."""
NUM_KEPT = 20
"""Of these, those that the next search begins with, beside new random ones."""
NUM_PARENTS = 12
"""The best ones, which are changed."""
CROSSED = 0.25
"""Share of changed prompts that have the goals of two parents."""
SLACK = 12
"""A rehearsal is given up when it will take that many steps more than twice the shortest known way."""
OF_EACH_END = (6, 10, 10)
"""How many prompts that arrive, leave what is known, or fail are kept at least, if there are so many."""
# What a frontier costs beside the steps over it: for every time that it was chosen before, for every visit
# (of at most so many), and by chance.
COST_OF_CHOICE, COST_OF_VISIT, MOST_VISITS, CHANCE = 2.0, 0.15, 20, 0.7


NUM_LED = 8
"""Prompts that are steered together."""
LONGEST_LED = 64
"""Steps of the longest way that prompts are steered along."""
MOST_PATIENCE = 16
"""Episodes after which a search is made again at the latest, where those before found nothing."""


class Features(NamedTuple):
    """What the plan makes use of; without one of them it is an ablation."""

    rounds: int = 3
    """Rounds of changed prompts that a search rehearses at most; 0 is no rehearsal at all."""
    steering: int = 20
    """Gradient steps that a search steers prompts by; 0 is none."""
    splice: bool = True
    """Whether ways are made of all episodes, or of the best one alone."""
    frontier: bool = True
    """Whether exploring also heads for frontiers."""


class MapState(NamedTuple):
    """The plan between two episodes."""

    task_goal: Float[Array, "G"]
    table: Table
    start: Int[Array, ""]
    """The state in which the latest episode started."""
    choices: Int[Array, "N"]
    """How often each state was the frontier to head for."""
    prompts: Arms
    """The prompts that were acted with greedily, with their returns."""
    verified: Int[Array, ""]
    """Steps of the shortest greedy episode that arrived; ``FAR`` before."""
    best_return: Float[Array, ""]
    """The best return of any episode."""
    latest: Goals
    """The goals of the latest episode."""
    kept: Prompt
    """The best prompts of the latest search [NUM_KEPT]."""
    led: Prompt
    """The prompts that were steered in the latest search [NUM_LED]."""
    has_kept: Bool[Array, ""]
    patience: Int[Array, ""]
    """Episodes between searches, which doubles when one has found nothing."""
    wait: Int[Array, ""]
    """Episodes until the next search."""
    shortest: Int[Array, ""]
    """Steps of the shortest way that was known at the latest search."""
    num_asked: Int[Array, ""]
    num_rehearsed: Int[Array, ""]
    """Prompts rehearsed so far."""


class Offer(NamedTuple):
    """The best prompt of one kind that a search has found."""

    prompt: Prompt
    steps: Int[Array, ""]
    exists: Bool[Array, ""]


class Found(NamedTuple):
    """What a search for prompts has found."""

    kept: Prompt
    led: Prompt
    sure: Offer
    """Arrives sooner than any greedy episode before."""
    hopeful: Offer
    """Leaves what is known, and may arrive sooner."""
    num_rehearsed: Int[Array, ""]


class Pool(NamedTuple):
    """A search in progress: prompts [NUM_PROMPTS] with their rehearsals, the best first."""

    prompts: Prompt
    rehearsal: Rehearsal


def search_prompts(
    key: PRNGKeyArray,
    state: MapState,
    way: Goals,
    lead: Lead,
    left: Int[Array, "N"],
    known: Int[Array, ""],
    tools: Tools,
) -> Found:
    """Search for prompts by rehearsing them: the kept ones and random ones, then changed and steered ones.

    Args:
      key: random key.
      state: the plan so far.
      way: the goals on a shortest known way.
      lead: the same way, as the policy sees it.
      left: ``table.steps_to`` the task goal.
      known: steps of that way.
      tools: what it is made with.
    """
    limit = jnp.minimum(state.verified - 1, 2 * known + SLACK)
    goal = find_state(state.table, state.task_goal)
    ahead = Ahead(state.table, state.start, goal, left, limit)
    key_random, key_rounds, key_led = jax.random.split(key, 3)
    tried = partial(rehearse, tools.world, tools.policy, ahead)

    space = tools.space
    fresh = random_prompts(
        key_random, way, state.task_goal, space.num_slots, space.longest, NUM_PROMPTS
    )
    keeps = state.has_kept & (jnp.arange(NUM_PROMPTS) < NUM_KEPT)
    first = jax.tree.map(
        lambda old, new: jnp.where(
            jnp.expand_dims(keeps, tuple(range(1, new.ndim))),
            jnp.concatenate([old, new[NUM_KEPT:]]),
            new,
        ),
        state.kept,
        fresh,
    )
    pool = _best(Pool(first, tried(first)))

    def child(key: PRNGKeyArray, pool: Pool) -> Prompt:
        key_parent, key_cross, key_crosses, key_where, key_change = jax.random.split(key, 5)
        first, second = jax.random.randint(key_parent, (2,), 0, NUM_PARENTS)
        parent, mate = (
            jax.tree.map(lambda rows, i=i: rows[i], pool.prompts) for i in (first, second)
        )
        mixed = crossed(key_cross, parent, mate, way, space.longest)
        parent = choose(jax.random.bernoulli(key_crosses, CROSSED), mixed, parent)
        strays, farthest = pool.rehearsal.strays[first], pool.rehearsal.farthest[first]
        around = jnp.where(jax.random.bernoulli(key_where), strays, farthest)
        key_once, key_again, key_more = jax.random.split(key_change, 3)
        once = changed(key_once, parent, way, space.longest, state.table.stride, around)
        twice = changed(key_again, once, way, space.longest, state.table.stride, around)
        return choose(jax.random.bernoulli(key_more), twice, once)

    def lacks_shortest(carry: tuple[Array, Pool]) -> Bool[Array, ""]:
        index, pool = carry
        shortest = (pool.rehearsal.ends[0] == ARRIVES) & (pool.rehearsal.steps[0] <= known)
        return (index < tools.features.rounds) & ~shortest

    def change(carry: tuple[Array, Pool]) -> tuple[Array, Pool]:
        index, pool = carry
        keys = jax.random.split(jax.random.fold_in(key_rounds, index), NUM_PROMPTS)
        children = jax.vmap(lambda key: child(key, pool))(keys)
        return index + 1, _best(_joined(pool, Pool(children, tried(children))))

    num_rounds, pool = jax.lax.while_loop(lacks_shortest, change, (jnp.int32(0), pool))
    num = NUM_PROMPTS * (1 + num_rounds)
    led = state.led

    def steered(pool: Pool) -> tuple[Pool, Prompt, Array]:
        keys = jax.random.split(key_led, NUM_LED)
        own = jax.vmap(
            lambda key, parent: changed(
                key, parent, way, space.longest, state.table.stride, pool.rehearsal.strays[0]
            )
        )(keys, led)
        first = _joined(led, own, _rows(pool.prompts, NUM_LED), _rows(fresh, NUM_LED))
        chosen = jnp.argsort(deficits(tools.policy, lead, first))[:NUM_LED]
        first = jax.tree.map(lambda rows: rows[chosen], first)
        prompts, _ = steer(tools.policy, lead, first, state.table.stride, tools.features.steering)
        return _best(_joined(pool, Pool(prompts, tried(prompts)))), prompts, jnp.int32(NUM_LED)

    if tools.features.steering and tools.policy.score is not None:
        needed = lacks_shortest((jnp.int32(-1), pool)) & lead.complete
        pool, led, more = jax.lax.cond(
            needed, steered, lambda pool: (pool, led, jnp.int32(0)), pool
        )
        num += more
    sooner = pool.rehearsal.steps < state.verified
    if space.deterministic:  # what a prompt did once it would do again
        sooner &= ~jax.vmap(partial(is_tried, state.prompts))(pool.prompts)
    return Found(
        kept=_rows(pool.prompts, NUM_KEPT),
        led=led,
        sure=_offer(pool, sooner & (pool.rehearsal.ends == ARRIVES)),
        hopeful=_offer(pool, sooner & (pool.rehearsal.ends == LEAVES)),
        num_rehearsed=num,
    )


def _joined(*trees: Any) -> Any:
    """The rows of several pytrees one after another."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def _rows(tree: Any, num: int) -> Any:
    """The first rows of a pytree."""
    return jax.tree.map(lambda rows: rows[:num], tree)


def _offer(pool: Pool, which: Bool[Array, "C"]) -> Offer:
    index, exists = any_of(which, pool.rehearsal.rank)
    prompt = jax.tree.map(lambda rows: rows[index], pool.prompts)
    return Offer(prompt, pool.rehearsal.steps[index], exists)


def _best(pool: Pool) -> Pool:
    """The ``NUM_PROMPTS`` best of a pool, each once, with some of each end, the best first."""
    rehearsal = pool.rehearsal
    num = len(rehearsal.rank)
    # Prompts of the same rank do the same, as far as it matters.
    again = jnp.any(jnp.tril(rehearsal.rank[:, None] == rehearsal.rank, -1), axis=-1)
    order = jnp.argsort(jnp.where(again, jnp.iinfo(jnp.int32).max, rehearsal.rank))
    pool = jax.tree.map(lambda rows: rows[order], pool)
    ends, again = pool.rehearsal.ends, again[order]
    is_end = ends[:, None] == jnp.array([ARRIVES, LEAVES, FAILS])
    place = jnp.cumsum(is_end, axis=0)[jnp.arange(num), ends]  # among those of its end
    spare = again | (place > jnp.array(OF_EACH_END)[ends])
    # The order among those that stay is kept, since the sort is stable.
    chosen = jnp.sort(jnp.argsort(spare)[:NUM_PROMPTS])
    return jax.tree.map(lambda rows: rows[chosen], pool)


class Tools(NamedTuple):
    """What the plan is made with. Everything in it is static, but for the policy's weights."""

    space: SearchSpace
    world: Seen
    policy: Policy
    features: Features


# Long because the four functions of an optimizer share its settings and are read together.
def plan_map(
    space: SearchSpace, spec: EnvSpec, policy: Policy, num_states: int, features: Features
) -> PromptOptimizer:
    """The plan in a world whose goals are states.

    Args:
      space: what may be known of the world and of the policy.
      spec: the world.
      policy: who rehearses, as it acts in episodes.
      num_states: room for states in the map.
      features: what the plan makes use of.
    """
    if space.num_slots == 1:  # there is one prompt, and nothing to search
        features = Features(rounds=0, steering=0, splice=features.splice, frontier=False)
    world = Seen(spec, spec.horizon)
    tools = Tools(space, world, policy, features)
    num_arms = min(64, space.num_episodes)

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> MapState:
        del key
        goal_dim = task_goal.shape[-1]
        first = single_goal(task_goal, space.num_slots)
        return MapState(
            task_goal=task_goal,
            table=empty_table(spec, num_states),
            start=jnp.int32(0),
            choices=jnp.zeros(num_states, jnp.int32),
            prompts=empty_arms(num_arms, space.num_slots, goal_dim),
            verified=jnp.int32(FAR),
            best_return=jnp.float32(-jnp.inf),
            latest=no_goals(space.horizon, goal_dim),
            kept=jax.tree.map(lambda leaf: jnp.stack([leaf] * NUM_KEPT), first),
            led=jax.tree.map(lambda leaf: jnp.stack([leaf] * NUM_LED), first),
            has_kept=jnp.zeros((), bool),
            patience=jnp.int32(1),
            wait=jnp.int32(0),
            shortest=jnp.int32(FAR),
            num_asked=jnp.int32(0),
            num_rehearsed=jnp.int32(0),
        )

    def ask(key: PRNGKeyArray, state: MapState) -> tuple[Query, MapState]:
        # One task after another, so that a search is made for those tasks alone that need one.
        return in_turn(partial(_next_query, tools))(key, state)

    def tell(state: MapState, query: Query, episode: Episode) -> MapState:
        return in_turn(partial(_told, tools))(state, query, episode)

    def best(state: MapState) -> Prompt:
        index = jnp.argmax(estimated_returns(state.prompts, space.deterministic))
        first = single_goal(state.task_goal, space.num_slots)
        return choose(state.prompts.size == 0, first, state.prompts.prompt(index))

    return PromptOptimizer(init, ask, tell, best)


def _next_query(tools: Tools, key: PRNGKeyArray, state: MapState) -> tuple[Query, MapState]:
    """What to run in the next episode."""
    space, features = tools.space, tools.features
    key_way, key_search, key_explore = jax.random.split(key, 3)
    goal = find_state(state.table, state.task_goal)
    left = steps_to(state.table, goal)
    known = jnp.where(goal == UNKNOWN, FAR, left[state.start])
    states = shortest_way(key_way, state.table, state.start, left, space.horizon)
    way = goals_on(state.table, states)

    def search() -> Found:
        longest = min(space.horizon, LONGEST_LED)
        lead = lead_along(state.table, state.start, states, longest)
        return search_prompts(key_search, state, way, lead, left, known, tools)

    turn = state.num_asked
    may_gain = (known < state.verified) & (known < FAR)
    wanted = may_gain & ((state.wait == 0) | (known < state.shortest))
    found = _nothing_found(state)
    if features.rounds:
        result: Found = jax.lax.cond(wanted, search, lambda: found)
        found = result
    else:
        drawn = sample_prompt(key_search, way, state.task_goal, space.num_slots, space.longest)
        found = found._replace(hopeful=Offer(drawn, known, may_gain))
    explores, frontier = explore(key_explore, tools, state, way, known)
    hopes = found.hopeful.exists & (turn % 2 == 0)
    greedy = (turn == 0) | found.sure.exists | hopes
    prompt = choose(
        turn == 0,
        single_goal(state.task_goal, space.num_slots),
        choose(found.sure.exists, found.sure.prompt, choose(hopes, found.hopeful.prompt, explores)),
    )
    chosen = jnp.where(greedy | (frontier == UNKNOWN), len(state.choices), frontier)
    # A search that finds nothing is made again later and later, until there is something new.
    patience = jnp.minimum(2 * state.patience, MOST_PATIENCE)
    patience = jnp.where(found.sure.exists | (known < state.shortest), 1, patience)
    return Query(prompt, greedy), state._replace(
        patience=jnp.where(wanted, patience, state.patience),
        wait=jnp.where(wanted, patience - 1, jnp.maximum(state.wait - 1, 0)),
        shortest=jnp.where(wanted, known, state.shortest),
        led=found.led,
        choices=state.choices.at[chosen].add(1, mode="drop"),
        kept=found.kept,
        has_kept=state.has_kept | (found.num_rehearsed > 0),
        num_asked=turn + 1,
        num_rehearsed=state.num_rehearsed + found.num_rehearsed,
    )


def _nothing_found(state: MapState) -> Found:
    nothing = Offer(
        jax.tree.map(lambda rows: rows[0], state.kept), jnp.int32(FAR), jnp.zeros((), bool)
    )
    return Found(state.kept, state.led, nothing, nothing, jnp.int32(0))


def explore(
    key: PRNGKeyArray, tools: Tools, state: MapState, way: Goals, known: Int[Array, ""]
) -> tuple[Prompt, Int[Array, ""]]:
    """A prompt to explore with, and the frontier that it leads to (``UNKNOWN`` for none).

    It is a random prompt of the known way, or of the latest episode as long as no way is known; in two of
    four turns it leads to a frontier.
    """
    space, table = tools.space, state.table
    key_subset, key_frontier = jax.random.split(key)
    source = choose(known < FAR, way, state.latest)
    subset = sample_prompt(key_subset, source, state.task_goal, space.num_slots, space.longest)
    if not tools.features.frontier:
        return subset, jnp.int32(UNKNOWN)

    def to_frontier() -> tuple[Prompt, Array]:
        state_there = choose_frontier(key_frontier, state, known)
        return _prompt_over(key_subset, space, state, state_there), state_there

    wanted = (state.num_asked // 2) % 2 == 1
    result: tuple[Prompt, Array] = jax.lax.cond(
        wanted & (state.num_asked > 0), to_frontier, lambda: (subset, jnp.int32(UNKNOWN))
    )
    return result


def choose_frontier(key: PRNGKeyArray, state: MapState, known: Int[Array, ""]) -> Int[Array, ""]:
    """The state to head for: one with untried actions over which the task goal could be nearest.

    How far the task goal is from a state is bounded from below by its distance in goals, in units of the
    largest step so far.
    """
    table = state.table
    steps = steps_from(table, state.start)
    away = jnp.sum(jnp.abs(table.goals - state.task_goal), axis=-1)
    at_least = jnp.ceil(away / jnp.maximum(table.stride, 1e-6) - 1e-3)
    over = steps + at_least
    seen = steps < FAR
    open_ = seen & jnp.any(table.successors == UNKNOWN, axis=-1)
    sooner = open_ & (over < known)
    allowed = jnp.where(jnp.any(sooner), sooner, jnp.where(jnp.any(open_), open_, seen))
    cost = (
        over
        + COST_OF_CHOICE * state.choices
        + COST_OF_VISIT * jnp.minimum(table.visits, MOST_VISITS)
        + CHANCE * jax.random.gumbel(key, over.shape)
    )
    return jnp.argmin(jnp.where(allowed, cost, jnp.inf))


def _prompt_over(
    key: PRNGKeyArray, space: SearchSpace, state: MapState, over: Int[Array, ""]
) -> Prompt:
    """A random prompt of the shortest way to a state, the state's goal and the task goal."""
    key_way, key_prompt = jax.random.split(key)
    left = steps_to(state.table, over)
    way = goals_on(
        state.table, shortest_way(key_way, state.table, state.start, left, space.horizon)
    )
    goal = state.table.goals[over]
    to = sample_prompt(key_prompt, way, goal, space.num_slots - 1, space.longest - 1)
    return Prompt(jnp.concatenate([to.goals, state.task_goal[None]]), jnp.append(to.mask, True))


def _told(tools: Tools, state: MapState, query: Query, episode: Episode) -> MapState:
    """The plan after an episode."""
    improves = episode.return_ >= state.best_return
    table = state.table
    if not tools.features.splice:  # the map is that of the best episode alone
        table = choose(improves, empty_table_like(table), table)
    added, start = add_episode(table, episode)
    if not tools.features.splice:
        added = choose(improves, added, state.table)
        start = jnp.where(improves, start, state.start)
    steps = episode.trajectory
    last = steps.length - 1
    arrives = jnp.all(jnp.abs(steps.achieved_goals[last] - state.task_goal) < 1e-4)
    arrived = jnp.where(query.greedy & arrives, steps.length, FAR)
    return state._replace(
        table=added,
        start=start,
        prompts=with_result(state.prompts, query, episode.return_),
        verified=jnp.minimum(state.verified, arrived),
        best_return=jnp.maximum(state.best_return, episode.return_),
        latest=steps.goals,
    )


def empty_table_like(table: Table) -> Table:
    """A table of the same room without states."""
    blank = jax.tree.map(jnp.zeros_like, table)
    return blank._replace(successors=jnp.full_like(table.successors, UNKNOWN))
