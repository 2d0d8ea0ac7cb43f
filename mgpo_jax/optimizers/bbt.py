"""BBT: black-box tuning of a continuous prompt by CMA-ES (paper, Algorithm 3, E.3, Eq. 5).

The implementation of CMA-ES is that of evosax. Its default fitness shaping gives tied solutions an averaged
and rounded rank. Returns such as k/n are often tied; then the recombination weights no longer sum to one
and the step size collapses. ``rank_weights`` breaks ties instead, as CMA-ES requires.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from envs.base import Episode
from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.prompts import Prompt, sample_prompt, single_goal
from mgpo_jax.rollout import Query
from mgpo_jax.trees import choose


def rank_weights(population: Any, fitness: Float[Array, "L"], state: Any, params: Any) -> Any:
    """CMA-ES weights by strict rank: tied solutions keep their (random) order in the population."""
    del population, state
    return params.weights[jnp.argsort(jnp.argsort(jnp.where(jnp.isnan(fitness), jnp.inf, fitness)))]


class BbtState(NamedTuple):
    """The state of Algorithm 3 between two episodes."""

    task_goal: Float[Array, "G"]
    start: Prompt
    """p_0."""
    start_key: PRNGKeyArray
    """The key with which p_0 is drawn from the first trajectory."""
    projection: Float[Array, "PG d"]
    """The random matrix A."""
    cma: Any
    """The state of CMA-ES."""
    population: Float[Array, "L d"]
    """The candidates z of the current generation."""
    returns: Float[Array, "L"]
    best_prompt: Prompt
    best_return: Float[Array, ""]
    episode: Int[Array, ""]


# Long because the four functions of an optimizer share its settings and are read together.
def bbt(
    space: SearchSpace,
    population_size: int = 10,
    latent_dim: int = 5,
    std_init: float | Float[Array, ""] = 0.5,
) -> PromptOptimizer:
    """Optimize z in p_0 + A z, where p_0 is drawn from the first trajectory.

    Args:
      space: the search space.
      population_size: lambda [10].
      latent_dim: d, the size of z [not in the paper].
      std_init: sigma(0), the initial step size, in units of goals, since rows of A have unit norm on
        average [not in the paper; chosen in ``docs/ablations.md``].
    """

    def strategy() -> tuple[Any, Any]:
        # Imported late, since evosax creates arrays on import, before a program could choose its devices.
        from evosax.algorithms import CMA_ES

        cma = CMA_ES(population_size, jnp.zeros(latent_dim), fitness_shaping_fn=rank_weights)
        return cma, cma.default_params.replace(std_init=jnp.asarray(std_init, jnp.float32))

    def init(key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> BbtState:
        cma, params = strategy()
        first = single_goal(task_goal, space.num_slots)
        key_projection, key_cma, key_start = jax.random.split(key, 3)
        shape = (first.goals.size, latent_dim)
        projection = jax.random.normal(key_projection, shape) / latent_dim**0.5
        state = jax.tree.map(jnp.asarray, cma.init(key_cma, jnp.zeros(latent_dim), params))
        return BbtState(
            task_goal=task_goal,
            start=first,
            start_key=key_start,
            projection=projection,
            cma=state,
            population=jnp.zeros((population_size, latent_dim)),
            returns=jnp.zeros(population_size),
            best_prompt=first,
            best_return=jnp.float32(-jnp.inf),
            episode=jnp.int32(0),
        )

    def place(state: BbtState) -> Int[Array, ""]:
        """Which member of the population the next episode evaluates."""
        return (state.episode - 1) % population_size

    def ask(key: PRNGKeyArray, state: BbtState) -> tuple[Query, BbtState]:
        cma, params = strategy()

        def breed(state: BbtState) -> BbtState:
            population, evolved = cma.ask(key, state.cma, params)
            return state._replace(cma=evolved, population=population)

        # The predicate is the same for all tasks, so under vmap this remains a branch, not a select.
        starts = (state.episode > 0) & (place(state) == 0)
        state = jax.lax.cond(starts, breed, lambda state: state, state)
        z = state.population[place(state)]
        moved = state.start.goals + (state.projection @ z).reshape(state.start.goals.shape)
        moved = jnp.where(state.start.mask[:, None], moved, 0.0)
        goals = jnp.where(state.episode == 0, state.start.goals, moved)
        return Query(Prompt(goals, state.start.mask), jnp.ones((), bool)), state

    def tell(state: BbtState, query: Query, episode: Episode) -> BbtState:
        cma, params = strategy()
        return_ = episode.return_
        first = state.episode == 0
        drawn = sample_prompt(
            state.start_key, episode.trajectory, state.task_goal, space.num_slots, space.max_goals
        )
        improves = return_ > state.best_return
        state = state._replace(
            start=choose(first, drawn, state.start),
            returns=jnp.where(first, state.returns, state.returns.at[place(state)].set(return_)),
            best_prompt=choose(improves, query.prompt, state.best_prompt),
            best_return=jnp.maximum(return_, state.best_return),
        )

        def evolve(state: BbtState) -> BbtState:
            new, _ = cma.tell(state.start_key, state.population, -state.returns, state.cma, params)
            return state._replace(cma=jax.tree.map(lambda a, b: a.astype(b.dtype), new, state.cma))

        ends = (state.episode > 0) & (place(state) == population_size - 1)
        state = jax.lax.cond(ends, evolve, lambda state: state, state)
        return state._replace(episode=state.episode + 1)

    return PromptOptimizer(init, ask, tell, lambda state: state.best_prompt)
