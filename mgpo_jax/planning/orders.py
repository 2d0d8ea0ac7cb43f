"""``plan`` in worlds whose rewards confirm goals: infers the order of goals that a task requires.

In worlds that reward a sequence part by part (``EnvSpec.reward_confirms_goals``), the longest sequence of
rewarded goals so far is a prefix of the required order, and a goal that followed it without a reward is not
the next one. A prompt names the confirmed goals, then a candidate for the next goal, then the others in a
random order. Once an episode earns the full return, the order is known. Then a prompt is sought under which
the policy follows it: the whole order, the order without one of its goals, or the order with slightly moved
goals.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.base import Episode
from mgpo_jax.optimizers.arms import Arms, empty_arms, estimated_returns
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.planning.table import SAME
from mgpo_jax.planning.trials import is_tried, with_result
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose

MAX_GOALS = 64
"""Capacity of the table of distinct goals; further goals are ignored."""
NUM_ARMS = 64
"""Capacity of the table of prompts that were run greedily."""
NONE = -1
ENOUGH = 1e-4  # tolerance for a return that counts as the largest possible one
MOVED = 0.1
"""Smallest standard deviation of the noise on the goals of a known order; the largest is three times
this."""
# Prior mean of the return of the whole order, and of the order without one of its goals; the weight of the
# prior in episodes; and the standard deviation of returns in stochastic worlds.
PRIOR_WHOLE, PRIOR_WITHOUT, PRIOR_WEIGHT, SPREAD = 0.9, 0.6, 2.0, 0.25


class Order(NamedTuple):
    """What is known about the required order, given the M goals that were reached so far."""

    goals: Float[Array, "M G"]
    reached: Float[Array, "M"]
    """How often each goal was reached."""
    size: Int[Array, ""]
    prefix: Int[Array, "W"]
    """Indices of the confirmed first goals of the order, followed by ``NONE``."""
    excluded: Bool[Array, "M"]
    """Which goals are ruled out as the next one after the prefix."""
    tried: Float[Array, "M"]
    """How often each goal was tried as the next one after the prefix."""
    complete: Bool[Array, ""]
    """Whether an episode with this prefix earned the full return, so that the prefix is the whole order."""

    @property
    def length(self) -> Int[Array, ""]:
        """Number of confirmed goals."""
        return jnp.sum(self.prefix != NONE)

    @property
    def confirmed(self) -> Bool[Array, "M"]:
        """Which of the M goals are in the prefix."""
        numbers = jnp.arange(len(self.goals))
        return jnp.any(self.prefix[:, None] == numbers, axis=0)


def no_order(num_places: int, goal_dim: int) -> Order:
    """The knowledge before the first episode, with room for an order of ``num_places`` goals."""
    nothing = jnp.zeros(MAX_GOALS)
    return Order(
        goals=jnp.zeros((MAX_GOALS, goal_dim)),
        reached=nothing,
        size=jnp.int32(0),
        prefix=jnp.full(num_places, NONE),
        excluded=jnp.zeros(MAX_GOALS, bool),
        tried=nothing,
        complete=jnp.zeros((), bool),
    )


def observe(order: Order, episode: Episode, largest_return: float) -> Order:
    """Update the knowledge about the order with an episode.

    After a reward at a step that reached no goal, such as for undoing a mistake, the rewards of the episode
    no longer tell which goal was right, so only the steps before it are used.
    """
    steps = episode.trajectory
    time = jnp.arange(len(steps.goal_reached))
    real = time < steps.length
    events = steps.goal_reached & real
    odd = real & (episode.rewards > 0) & ~steps.goal_reached
    clean = ~jnp.any(odd)
    until = jnp.where(clean, len(time), jnp.argmax(odd))

    order, numbers = _registered(order, steps.achieved_goals, events)
    certain = events & (time < until)
    rewarded = certain & (episode.rewards > 0)
    num = jnp.sum(rewarded)
    last = jnp.max(jnp.where(rewarded, time, -1))
    later = certain & (time > last)
    wrong = jnp.where(jnp.any(later) & clean, numbers[jnp.argmax(later)], NONE)

    longer = num > order.length
    place = jnp.where(rewarded, jnp.cumsum(rewarded) - 1, len(order.prefix))
    prefix = jnp.full_like(order.prefix, NONE).at[place].set(numbers, mode="drop")
    order = order._replace(
        prefix=jnp.where(longer, prefix, order.prefix),
        excluded=order.excluded & ~longer,
        tried=jnp.where(longer, 0.0, order.tried),
    )
    rules_out = (num == order.length) & (wrong != NONE)
    row = jnp.where(rules_out, wrong, MAX_GOALS)
    return order._replace(
        excluded=order.excluded.at[row].set(True, mode="drop"),
        complete=order.complete | (clean & (episode.return_ > largest_return - ENOUGH)),
    )


def _registered(
    order: Order, goals: Float[Array, "T G"], events: Bool[Array, "T"]
) -> tuple[Order, Int[Array, "T"]]:
    """Add the goals of an episode's T steps to the table; also returns the index of the goal of each step.

    Steps that reach no goal (``events``) have the index ``NONE``.
    """

    def register(order: Order, row: tuple[Array, Array]) -> tuple[Order, Array]:
        goal, happens = row
        same = jnp.max(jnp.abs(order.goals - goal), axis=-1) < SAME
        same &= jnp.arange(MAX_GOALS) < order.size
        is_new = happens & ~jnp.any(same) & (order.size < MAX_GOALS)
        number = jnp.where(jnp.any(same), jnp.argmax(same), jnp.where(is_new, order.size, NONE))
        number = jnp.where(happens, number, NONE)
        at = jnp.where(number == NONE, MAX_GOALS, number)
        order = order._replace(
            goals=order.goals.at[at].set(goal, mode="drop"),
            reached=order.reached.at[at].add(1.0, mode="drop"),
            size=order.size + is_new,
        )
        return order, number

    return jax.lax.scan(register, order, (goals, events))


def next_goal(key: PRNGKeyArray, order: Order) -> Int[Array, ""]:
    """Draw the goal to try after the prefix, with a preference for goals often reached and seldom tried.

    Goals that are ruled out are drawn only if all others are: then the next goal was not seen yet, and
    episodes have to go on until it is.

    Returns its index, or ``NONE`` if no goal is left.
    """
    rest = (jnp.arange(MAX_GOALS) < order.size) & ~order.confirmed
    possible = rest & ~order.excluded
    allowed = jnp.where(jnp.any(possible), possible, rest)
    weight = jnp.sqrt(order.reached) / (1 + order.tried)
    scores = jnp.log(jnp.maximum(weight, 1e-9)) + jax.random.gumbel(key, weight.shape)
    return jnp.where(jnp.any(rest), jnp.argmax(jnp.where(allowed, scores, -jnp.inf)), NONE)


def plan_prompt(
    key: PRNGKeyArray,
    order: Order,
    first: Int[Array, ""],
    task_goal: Float[Array, "G"],
    num_slots: int,
    max_goals: int | Int[Array, ""],
) -> Prompt:
    """The prompt of the confirmed goals, then ``first``, then the others in a random order, then the task
    goal."""
    num_inner = num_slots - 1
    numbers = jnp.arange(MAX_GOALS)
    others = (numbers < order.size) & ~order.confirmed & (numbers != first)
    scores = 0.5 * jnp.log(jnp.maximum(order.reached, 1e-9))
    scores += jax.random.gumbel(key, scores.shape)
    drawn = jnp.argsort(-jnp.where(others, scores, -jnp.inf))
    place, length = jnp.arange(num_inner), order.length
    has_first = first != NONE
    after = jnp.clip(place - length - has_first, 0, MAX_GOALS - 1)
    sequence = jnp.where(
        place < length,
        order.prefix[jnp.minimum(place, len(order.prefix) - 1)],
        jnp.where((place == length) & has_first, first, drawn[after]),
    )
    count = length + has_first + jnp.sum(others)
    return _right_aligned(order, sequence, count, task_goal, max_goals)


def _right_aligned(
    order: Order,
    sequence: Int[Array, "W"],
    count: Int[Array, ""],
    task_goal: Float[Array, "G"],
    max_goals: int | Int[Array, ""],
) -> Prompt:
    """The prompt of the first ``count`` goals of a sequence and the task goal, as far as there is room.

    ``sequence`` holds indices of goals. Empty slots come first.
    """
    num_inner = len(sequence)
    count = jnp.minimum(count, jnp.minimum(num_inner, max_goals - 1))
    place = jnp.arange(num_inner) - (num_inner - count)
    mask = jnp.append(place >= 0, True)
    inner = order.goals[sequence[jnp.maximum(place, 0)]] if num_inner else order.goals[:0]
    goals = jnp.concatenate([inner, task_goal[None]])
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)


def without(prompt: Prompt, slot: Int[Array, ""]) -> Prompt:
    """The prompt without the goal in one of its slots; unchanged if that slot is empty."""
    places = jnp.arange(len(prompt.mask))
    source = jnp.where(places <= slot, places - 1, places)
    mask = prompt.mask[source] & (source >= 0)
    mask = jnp.where(prompt.mask[slot], mask, prompt.mask)
    goals = jnp.where(prompt.mask[slot], prompt.goals[source], prompt.goals)
    return Prompt(jnp.where(mask[:, None], goals, 0.0), mask)


class OrderState(NamedTuple):
    """The state of the optimizer between two episodes."""

    key: PRNGKeyArray
    """Random key of the next plan, since ``tell`` is given none."""
    task_goal: Float[Array, "G"]
    order: Order
    first: Int[Array, ""]
    """Index of the goal that the latest prompt tried as the next one; ``NONE`` for none."""
    planned: Prompt
    """The prompt for the next episode, as long as the order is not complete."""
    planned_first: Int[Array, ""]
    """Index of the goal that ``planned`` tries as the next one."""
    prompts: Arms
    """The prompts that were run greedily, with their returns."""
    variant: Int[Array, ""]
    """The variant of the complete order in the latest prompt; ``NONE`` for none. Variant 0 is the whole
    order, variant i the order without the goal in slot i - 1."""
    pulls: Float[Array, "V"]
    """Number of episodes of each variant."""
    earned: Float[Array, "V"]
    """Sum of the returns of each variant."""
    num_variants: Int[Array, ""]
    """Number of episodes with a variant, including those with moved goals."""


def plan_order(space: SearchSpace) -> PromptOptimizer:
    """The optimizer ``plan`` for a world whose rewards confirm goals."""
    num_slots = space.num_slots

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> OrderState:
        goal_dim = task_goal.shape[-1]
        return OrderState(
            key=key,
            task_goal=task_goal,
            order=no_order(max(num_slots - 1, 1), goal_dim),
            first=jnp.int32(NONE),
            planned=single_goal(task_goal, num_slots),
            planned_first=jnp.int32(NONE),
            prompts=empty_arms(min(NUM_ARMS, space.num_episodes), num_slots, goal_dim),
            variant=jnp.int32(NONE),
            pulls=jnp.zeros(num_slots),
            earned=jnp.zeros(num_slots),
            num_variants=jnp.int32(0),
        )

    def best(state: OrderState) -> Prompt:
        if space.deterministic:
            return choose(state.prompts.size == 0, state.planned, _best_tried(state))
        index = jnp.argmax(_estimates(state, space.longest))
        return choose(state.order.complete, _variant_of(state, index, space.longest), state.planned)

    return PromptOptimizer(init, partial(_ask, space), partial(_tell, space), best)


def _ask(space: SearchSpace, key: PRNGKeyArray, state: OrderState) -> tuple[Query, OrderState]:
    """Return the planned prompt or, once the order is complete, one of its variants."""
    prompt, variant = _next_variant(key, space, state)
    complete = state.order.complete
    prompt = choose(complete, prompt, state.planned)
    again = is_tried(state.prompts, prompt) & space.deterministic
    greedy = complete | ~again  # a repeated greedy episode would be the same as before
    return Query(prompt, greedy), state._replace(
        first=jnp.where(complete, NONE, state.planned_first),
        variant=jnp.where(complete, variant, NONE),
        num_variants=state.num_variants + complete,
    )


def _tell(space: SearchSpace, state: OrderState, query: Query, episode: Episode) -> OrderState:
    """Update the knowledge about the order, and plan the next prompt."""
    order = observe(state.order, episode, space.return_range[1])
    # The goal was tried after the prefix known before this episode; if that grew, the trial does not count.
    same = order.length == state.order.length
    row = jnp.where(same & (state.first != NONE), state.first, MAX_GOALS)
    order = order._replace(tried=order.tried.at[row].add(1.0, mode="drop"))
    variant = jnp.where(state.variant == NONE, len(state.pulls), state.variant)
    key, key_first, key_rest = jax.random.split(state.key, 3)
    first = next_goal(key_first, order)
    planned = plan_prompt(key_rest, order, first, state.task_goal, space.num_slots, space.longest)
    return state._replace(
        key=key,
        order=order,
        planned=planned,
        planned_first=first,
        prompts=with_result(state.prompts, query, episode.return_),
        pulls=state.pulls.at[variant].add(1.0, mode="drop"),
        earned=state.earned.at[variant].add(episode.return_, mode="drop"),
    )


def _whole(state: OrderState, max_goals: int | Int[Array, ""]) -> Prompt:
    """The prompt of the complete order."""
    order = state.order
    sequence = order.prefix[: len(state.pulls) - 1]
    return _right_aligned(order, sequence, order.length, state.task_goal, max_goals)


def _variant_of(
    state: OrderState, index: Int[Array, ""], max_goals: int | Int[Array, ""]
) -> Prompt:
    """The prompt of variant ``index`` of the complete order (``OrderState.variant``)."""
    prompt = _whole(state, max_goals)
    return choose(index == 0, prompt, without(prompt, jnp.maximum(index - 1, 0)))


def _possible(state: OrderState, max_goals: int | Int[Array, ""]) -> Bool[Array, "V"]:
    """Which of the V variants exist: the whole order, and for each of its goals the order without it."""
    return jnp.append(True, _whole(state, max_goals).mask[:-1])


def _estimates(state: OrderState, max_goals: int | Int[Array, ""]) -> Float[Array, "V"]:
    """The estimated return of each variant; -inf for variants that do not exist."""
    prior = jnp.full(len(state.pulls), PRIOR_WITHOUT).at[0].set(PRIOR_WHOLE)
    mean = (state.earned + PRIOR_WEIGHT * prior) / (state.pulls + PRIOR_WEIGHT)
    return jnp.where(_possible(state, max_goals), mean, -jnp.inf)


def _next_variant(
    key: PRNGKeyArray, space: SearchSpace, state: OrderState
) -> tuple[Prompt, Int[Array, ""]]:
    """The variant of the complete order to run next, and its index.

    The index is ``NONE`` in deterministic worlds, where no estimates of variants are needed.
    """
    longest, num_slots = space.longest, space.num_slots
    if not space.deterministic:
        spread = SPREAD / jnp.sqrt(state.pulls + PRIOR_WEIGHT)
        drawn = _estimates(state, longest) + spread * jax.random.normal(key, spread.shape)
        index = jnp.argmax(drawn)
        return _variant_of(state, index, longest), index
    # The greedy episodes of a variant are all the same, so each variant is tried once.
    left = jnp.sort(jnp.where(_possible(state, longest), jnp.arange(num_slots), num_slots))
    index = left[jnp.minimum(state.num_variants, num_slots - 1)]
    is_moved = (index == num_slots) | (state.num_variants >= num_slots)
    moved = moved_goals(key, _whole(state, longest))
    variant = _variant_of(state, jnp.minimum(index, num_slots - 1), longest)
    solved = jnp.max(state.prompts.entry_return) > space.return_range[1] - ENOUGH
    return choose(solved, _best_tried(state), choose(is_moved, moved, variant)), jnp.int32(NONE)


def _best_tried(state: OrderState) -> Prompt:
    """The prompt of the best greedy episode, in deterministic worlds."""
    return state.prompts.prompt(jnp.argmax(estimated_returns(state.prompts, deterministic=True)))


def moved_goals(key: PRNGKeyArray, prompt: Prompt) -> Prompt:
    """The prompt with Gaussian noise on all of its goals but the last."""
    key_size, key_noise = jax.random.split(key)
    size = MOVED * jax.random.randint(key_size, (), 1, 4)
    noise = size * jax.random.normal(key_noise, prompt.goals.shape)
    inner = prompt.mask.at[-1].set(False)
    return prompt._replace(goals=prompt.goals + jnp.where(inner[:, None], noise, 0.0))
