"""``plan`` in worlds whose goals are states: a map, paths in it, and prompts to follow them.

The first episode evaluates (g^M). Every later episode is spent on one of three things:

- a prompt that is certainly better than the best one: its rehearsal (``planning.rehearsal``) reaches the
  task goal in fewer steps;
- a prompt that may be better: its rehearsal leaves the map close enough to the task goal;
- exploration, with sampled actions. Until a path to the task goal is known, the prompt names a random goal
  that was not reached yet, and the task goal. Later it is a random prompt of the known path, or one that
  leads to a frontier, a state from which the task goal could be reached sooner than by the known path.

In the first two cases actions are greedy. A prompt of the second kind is never run twice in a row. Without
rehearsals (an ablation) the prompts of these two kinds are random goals of the known path.

In a stochastic world no rehearsal is certain, and the return of one episode is partly luck. There every
second episode repeats one of the prompts that were run before, the one with the highest upper bound on its
mean return, and prompts are compared by their mean numbers of steps.

A full map ignores further states. If the best episode reached the task goal through such states, sooner
than any path in the map does, prompts are drawn from that episode instead, as in the paper.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Episode, Goals
from envs.errors import NotAvailableError
from envs.specs import EnvSpec
from mgpo_jax.adaptation import in_turn
from mgpo_jax.optimizers.arms import Arms, empty_arms, estimated_returns, no_goals
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.planning.frontiers import choose_frontier, prompt_elsewhere, prompt_over
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
from mgpo_jax.planning.trials import mean_steps, most_promising, with_result
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

MOST_PATIENCE = 16
"""Largest number of episodes between two searches, reached when repeated searches find nothing."""
NUM_ARMS = 64
"""Capacity of the table of prompts that were run greedily."""


class MapState(NamedTuple):
    """The state of the optimizer between two episodes."""

    task_goal: Float[Array, "G"]
    table: Table
    start: Int[Array, ""]
    """The state in which the latest episode started."""
    choices: Int[Array, "N"]
    """How often each state was chosen as the frontier to explore."""
    prompts: Arms
    """The prompts that were run greedily, with their returns."""
    steps: Float[Array, "M"]
    """The mean number of steps in which each of them reached the task goal. An episode that did not reach
    it counts as one step more than the longest episode."""
    hoped: Bool[Array, ""]
    """Whether the latest prompt was one that may be better."""
    verified: Int[Array, ""]
    """Steps of the shortest greedy episode that reached the task goal, ``FAR`` if none has; in a stochastic
    world, the mean number of steps of the best prompt, rounded up."""
    best_return: Float[Array, ""]
    """The best return of any episode."""
    latest: Goals
    """The goals of the latest episode."""
    best_goals: Goals
    """The goals of the best episode; of several equal ones, the latest."""
    best_steps: Int[Array, ""]
    """Number of steps in which that episode reached the task goal; ``FAR`` if it did not."""
    memory: Memory
    """The prompts that the latest search passes on to the next one."""
    patience: Int[Array, ""]
    """Number of episodes between searches; it doubles when a search leads to no better prompt."""
    wait: Int[Array, ""]
    """Number of episodes until the next search."""
    shortest: Int[Array, ""]
    """Steps of the shortest path that was known at the latest search."""
    num_asked: Int[Array, ""]
    """Number of episodes so far."""
    num_rehearsed: Int[Array, ""]
    """Number of prompts rehearsed so far."""


# Long because the four functions of an optimizer share its settings and are read together.
def plan_map(
    space: SearchSpace, spec: EnvSpec, policy: Policy, num_states: int, features: Features
) -> PromptOptimizer:
    """The optimizer ``plan`` for a world whose goals are states.

    Args:
      space: the search space.
      spec: the world's specification.
      policy: the policy, which rehearses prompts in the map as it would act in episodes.
      num_states: capacity of the map, in states.
      features: the parts of the method that are used.
    """
    if space.num_slots == 1:  # (g^M) is the only prompt, so there is nothing to search
        features = Features(rounds=0, steering=0, splice=features.splice, frontier=False)
    world = Seen(spec, spec.horizon)
    tools = Tools(space, world, policy, features, draws_goals(space))
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
            steps=jnp.zeros(num_arms),
            hoped=jnp.zeros((), bool),
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
        # One task after another, so that only the tasks that need a search pay for one.
        return in_turn(partial(_next_query, tools))(key, state)

    def tell(state: MapState, query: Query, episode: Episode) -> MapState:
        return in_turn(partial(_update, tools))(state, query, episode)

    def best(state: MapState) -> Prompt:
        index = jnp.argmax(estimated_returns(state.prompts, space.deterministic))
        first = single_goal(state.task_goal, space.num_slots)
        return choose(state.prompts.size == 0, first, state.prompts.prompt(index))

    return PromptOptimizer(init, ask, tell, best, lambda state: state.num_rehearsed)


def _next_query(tools: Tools, key: PRNGKeyArray, state: MapState) -> tuple[Query, MapState]:
    """Choose the prompt of the next episode, after a search if one is due."""
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
    repeats = (not space.deterministic) & (turn % 2 == 0) & (known < FAR)
    may_gain = (known < state.verified) & (known < FAR)
    wanted = may_gain & ~repeats & ((state.wait == 0) | (known < state.shortest))
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
    hopes = found.hopeful.exists & ~state.hoped & ~found.sure.exists & ~repeats
    offer = choose(hopes, found.hopeful, found.sure)
    offer = choose(repeats, Offer(most_promising(state.prompts), repeats), offer)
    first = turn == 0
    greedy = first | offer.exists
    prompt = choose(offer.exists, offer.prompt, explores)
    prompt = choose(first, single_goal(state.task_goal, space.num_slots), prompt)
    chosen = jnp.where(greedy | (frontier == UNKNOWN), len(state.choices), frontier)
    # As long as searches find nothing better, they become rarer; a shorter known path resets that.
    patience = jnp.minimum(2 * state.patience, MOST_PATIENCE)
    surely = found.sure.exists & space.deterministic
    patience = jnp.where(surely | (known < state.shortest), 1, patience)
    return Query(prompt, greedy), state._replace(
        hoped=hopes,
        patience=jnp.where(wanted, patience, state.patience),
        wait=jnp.where(wanted, patience - 1, jnp.maximum(state.wait - 1, 0)),
        shortest=jnp.where(wanted, known, state.shortest),
        memory=found.memory,
        choices=state.choices.at[chosen].add(1, mode="drop"),
        num_asked=turn + 1,
        num_rehearsed=state.num_rehearsed + found.num_rehearsed,
    )


def draws_goals(space: SearchSpace) -> bool:
    """Whether the world draws random goals, which few methods need."""
    try:
        jax.eval_shape(space.sample_goal, jax.random.key(0))
    except NotAvailableError:
        return False
    return True


def lies_beyond(state: MapState, way: Way) -> Bool[Array, ""]:
    """Whether the map is full and the best episode reached the task goal sooner than any path in the
    map."""
    is_full = state.table.size == len(state.table.goals)
    return is_full & (state.best_steps < way.steps)


def explore(
    key: PRNGKeyArray, tools: Tools, state: MapState, way: Way
) -> tuple[Prompt, Int[Array, ""]]:
    """A prompt to explore with, and the frontier that it leads to (``UNKNOWN`` for none).

    If no path is known, the prompt holds a random goal that was not reached yet (``prompt_elsewhere``).
    Otherwise it holds random goals of the known path, and in two of every four turns it leads to a frontier
    instead. If the best episode lies beyond the map, its goals are used in every turn.
    """
    space, table, task_goal = tools.space, state.table, state.task_goal
    key_subset, key_frontier = jax.random.split(key)
    beyond = lies_beyond(state, way)
    source = choose(way.steps < FAR, way.goals, state.latest)
    source = choose(beyond, state.best_goals, source)
    subset = sample_prompt(key_subset, source, task_goal, space.num_slots, space.longest)
    several = (space.longest > 1) & ~beyond
    if space.num_slots > 1 and tools.draws_goals:
        elsewhere = prompt_elsewhere(key_subset, space, table, task_goal)
        lost = several & (way.steps >= FAR)
        subset = choose(lost, elsewhere, subset)
    else:
        lost = jnp.zeros((), bool)
    if not tools.features.frontier:
        return subset, jnp.int32(UNKNOWN)

    def to_frontier() -> tuple[Prompt, Array]:
        over = choose_frontier(
            key_frontier, table, state.start, task_goal, state.choices, way.steps
        )
        return prompt_over(key_subset, space, table, state.start, over, task_goal), over

    wanted = several & ~lost & ((state.num_asked // 2) % 2 == 1)
    result: tuple[Prompt, Array] = jax.lax.cond(
        wanted, to_frontier, lambda: (subset, jnp.int32(UNKNOWN))
    )
    return result


def _update(tools: Tools, state: MapState, query: Query, episode: Episode) -> MapState:
    """The state of the optimizer after an episode."""
    improves = episode.return_ >= state.best_return
    table = state.table
    if not tools.features.splice:  # the map holds the best episode alone
        table = choose(improves, forgotten(table), table)
    added, start = add_episode(table, episode)
    if not tools.features.splice:
        added = choose(improves, added, state.table)
        start = jnp.where(improves, start, state.start)
    steps = episode.trajectory
    last = steps.length - 1
    arrives = jnp.all(jnp.abs(steps.achieved_goals[last] - state.task_goal) < SAME)
    arrived = jnp.where(arrives, steps.length, FAR)
    prompts = with_result(state.prompts, query, episode.return_)
    counted = jnp.minimum(arrived, tools.space.horizon + 1)
    means = jnp.where(
        query.greedy, mean_steps(state.steps, prompts, query.prompt, counted), state.steps
    )
    shortest = jnp.where(query.greedy, jnp.minimum(state.verified, arrived), state.verified)
    if not tools.space.deterministic:
        index = jnp.argmax(estimated_returns(prompts, deterministic=False))
        shortest = jnp.where(prompts.size > 0, jnp.ceil(means[index]).astype(jnp.int32), FAR)
    else:
        gained = shortest < state.verified
        state = state._replace(
            patience=jnp.where(gained, 1, state.patience), wait=jnp.where(gained, 0, state.wait)
        )
    return state._replace(
        table=added,
        start=start,
        prompts=prompts,
        steps=means,
        verified=shortest,
        best_goals=choose(improves, steps.goals, state.best_goals),
        best_steps=jnp.where(improves, arrived, state.best_steps),
        best_return=jnp.maximum(state.best_return, episode.return_),
        latest=steps.goals,
    )
