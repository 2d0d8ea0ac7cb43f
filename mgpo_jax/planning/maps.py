"""The plan where goals are states: a map of all episodes, ways on it, and prompts that lead along them.

After the first episode, which evaluates (g^M), an episode goes to one of three things:

- a prompt that is surely better than the best one: its rehearsal (``planning.rehearsal``) arrives sooner;
- a prompt that may be better: its rehearsal leaves what is known, near enough to the goal;
- exploring: actions are sampled under a random prompt of the known way, or under one that leads to a
  frontier, a state from where the task goal could be reached sooner than by the known way.

The first two act greedily. Without rehearsals (an ablation) they are random prompts of the known way.

A map that is full knows nothing of the states that it has no room for. Where the best episode arrived
through such states, sooner than any known way does, prompts are drawn from it instead, as in the paper.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import EnvSpec, Episode, Goals
from mgpo_jax.adaptation import in_turn
from mgpo_jax.optimizers.arms import Arms, empty_arms, estimated_returns, no_goals
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.planning.frontiers import choose_frontier, prompt_over
from mgpo_jax.planning.rehearsal import Seen
from mgpo_jax.planning.searching import (
    Features,
    Found,
    Memory,
    Offer,
    Tools,
    no_memory,
    nothing_found,
    search_prompts,
)
from mgpo_jax.planning.table import (
    FAR,
    SAME,
    UNKNOWN,
    Table,
    Way,
    add_episode,
    empty_table,
    find_state,
    forgotten,
    way_to,
)
from mgpo_jax.planning.trials import with_result
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

MOST_PATIENCE = 16
"""Episodes after which a search is made again at the latest, where those before found nothing."""
NUM_ARMS = 64
"""Room for the prompts that were acted with greedily."""


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
    best_goals: Goals
    """Those of the latest of the best episodes."""
    best_steps: Int[Array, ""]
    """How many steps that took to arrive; ``FAR`` if it did not."""
    memory: Memory
    """What the latest search has left."""
    patience: Int[Array, ""]
    """Episodes between searches, which doubles when one has found nothing."""
    wait: Int[Array, ""]
    """Episodes until the next search."""
    shortest: Int[Array, ""]
    """Steps of the shortest way that was known at the latest search."""
    num_asked: Int[Array, ""]
    num_rehearsed: Int[Array, ""]
    """Prompts rehearsed so far."""


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
    num_arms = min(NUM_ARMS, space.num_episodes)

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> MapState:
        del key
        goal_dim = task_goal.shape[-1]
        return MapState(
            task_goal=task_goal,
            table=empty_table(spec, num_states),
            start=jnp.int32(0),
            choices=jnp.zeros(num_states, jnp.int32),
            prompts=empty_arms(num_arms, space.num_slots, goal_dim),
            verified=jnp.int32(FAR),
            best_return=jnp.float32(-jnp.inf),
            latest=no_goals(space.horizon, goal_dim),
            best_goals=no_goals(space.horizon, goal_dim),
            best_steps=jnp.int32(FAR),
            memory=no_memory(task_goal, space.num_slots),
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

    return PromptOptimizer(init, ask, tell, best, lambda state: state.num_rehearsed)


def _next_query(tools: Tools, key: PRNGKeyArray, state: MapState) -> tuple[Query, MapState]:
    """What to run in the next episode."""
    space, features = tools.space, tools.features
    key_way, key_search, key_explore = jax.random.split(key, 3)
    goal = find_state(state.table, state.task_goal)
    way = way_to(key_way, state.table, state.start, goal, space.horizon)
    known = way.steps

    def search() -> Found:
        return search_prompts(
            key_search, tools, state.table, way, state.memory, state.prompts, state.verified
        )

    turn = state.num_asked
    may_gain = (known < state.verified) & (known < FAR)
    wanted = may_gain & ((state.wait == 0) | (known < state.shortest))
    found = nothing_found(state.memory)
    if features.rounds:
        result: Found = jax.lax.cond(wanted, search, lambda: found)
        found = result
    else:
        drawn = sample_prompt(
            key_search, way.goals, state.task_goal, space.num_slots, space.longest
        )
        found = found._replace(hopeful=Offer(drawn, may_gain))
    beyond = lies_beyond(state, way)
    of_best = sample_prompt(
        key_search, state.best_goals, state.task_goal, space.num_slots, space.longest
    )
    hopeful = choose(beyond, Offer(of_best, state.best_steps < state.verified), found.hopeful)
    found = found._replace(hopeful=hopeful)
    explores, frontier = explore(key_explore, tools, state, way)
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
        memory=found.memory,
        choices=state.choices.at[chosen].add(1, mode="drop"),
        num_asked=turn + 1,
        num_rehearsed=state.num_rehearsed + found.num_rehearsed,
    )


def lies_beyond(state: MapState, way: Way) -> Bool[Array, ""]:
    """Whether the best episode arrived sooner than any known way does, since the map has no more room."""
    is_full = state.table.size == len(state.table.goals)
    return is_full & (state.best_steps < way.steps)


def explore(
    key: PRNGKeyArray, tools: Tools, state: MapState, way: Way
) -> tuple[Prompt, Int[Array, ""]]:
    """A prompt to explore with, and the frontier that it leads to (``UNKNOWN`` for none).

    It is a random prompt of the known way, or of the latest episode as long as no way is known; in two of
    four turns it leads to a frontier. Where the best episode lies beyond the map, it is a prompt of that.
    """
    space = tools.space
    key_subset, key_frontier = jax.random.split(key)
    beyond = lies_beyond(state, way)
    source = choose(way.steps < FAR, way.goals, state.latest)
    source = choose(beyond, state.best_goals, source)
    subset = sample_prompt(key_subset, source, state.task_goal, space.num_slots, space.longest)
    if not tools.features.frontier:
        return subset, jnp.int32(UNKNOWN)

    def to_frontier() -> tuple[Prompt, Array]:
        task_goal, choices = state.task_goal, state.choices
        over = choose_frontier(
            key_frontier, state.table, state.start, task_goal, choices, way.steps
        )
        prompt = prompt_over(key_subset, space, state.table, state.start, over, task_goal)
        return prompt, over

    wanted = ((state.num_asked // 2) % 2 == 1) & (space.longest > 1) & ~beyond
    result: tuple[Prompt, Array] = jax.lax.cond(
        wanted, to_frontier, lambda: (subset, jnp.int32(UNKNOWN))
    )
    return result


def _told(tools: Tools, state: MapState, query: Query, episode: Episode) -> MapState:
    """The plan after an episode."""
    improves = episode.return_ >= state.best_return
    table = state.table
    if not tools.features.splice:  # the map is that of the best episode alone
        table = choose(improves, forgotten(table), table)
    added, start = add_episode(table, episode)
    if not tools.features.splice:
        added = choose(improves, added, state.table)
        start = jnp.where(improves, start, state.start)
    steps = episode.trajectory
    last = steps.length - 1
    arrives = jnp.all(jnp.abs(steps.achieved_goals[last] - state.task_goal) < SAME)
    arrived = jnp.where(arrives, steps.length, FAR)
    return state._replace(
        table=added,
        start=start,
        prompts=with_result(state.prompts, query, episode.return_),
        verified=jnp.where(query.greedy, jnp.minimum(state.verified, arrived), state.verified),
        best_goals=choose(improves, steps.goals, state.best_goals),
        best_steps=jnp.where(improves, arrived, state.best_steps),
        best_return=jnp.maximum(state.best_return, episode.return_),
        latest=steps.goals,
    )
