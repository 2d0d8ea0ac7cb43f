"""How a prompt has to change so that the frozen policy takes a known way.

A policy that is led along a way, its observations and actions given, says at each step which action it
would rather take. By how much it prefers that one, in log probabilities and summed over the way, is the
prompt's *deficit*: it is 0 where the policy takes the way by itself. The goals of a prompt are numbers, so
the deficit has a gradient.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Shaped

from mgpo_jax.planning.table import UNKNOWN, Table
from mgpo_jax.policy import Policy
from mgpo_jax.prompts import Prompt

RATE = 0.15
"""Learning rate of Adam, in units of how far a step changes a goal."""
LIKELIER = 0.05
"""Weight of the way's own log likelihood beside the deficit, which keeps its actions ahead of others."""


class Lead(NamedTuple):
    """A known way of at most L steps as the policy sees it when it takes it."""

    obs: Shaped[Array, "L ..."]
    actions: Int[Array, "L"]
    real: Bool[Array, "L"]
    """Which steps there are."""


def lead_along(table: Table, start: Int[Array, ""], way: Int[Array, "T"], longest: int) -> Lead:
    """A way, given by the states after ``start``, as the policy sees it; cut off after so many steps."""
    missing = jnp.full(max(longest - len(way), 0), UNKNOWN)
    states = jnp.concatenate([start[None], way, missing])
    before, after = states[:longest], states[1 : longest + 1]
    actions = jnp.argmax(table.successors[before] == after[:, None], axis=-1)
    return Lead(table.obs[before], actions, after != UNKNOWN)


def deficit_and_loss(
    policy: Policy, lead: Lead, prompt: Prompt
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The deficit of a prompt, and what its gradient is taken of."""
    if policy.score is None:
        raise ValueError("this policy tells no likelihoods (its field score is None)")
    distribution = policy.score(prompt, lead.obs, lead.actions)
    own = distribution.log_prob(lead.actions)
    preferred = distribution.log_prob(distribution.mode())
    deficit = jnp.sum(jnp.where(lead.real, preferred - own, 0.0))
    likelihood = jnp.sum(jnp.where(lead.real, own, 0.0))
    return deficit, deficit - LIKELIER * likelihood


def deficits(policy: Policy, lead: Lead, prompts: Prompt) -> Float[Array, "C"]:
    """The deficits of prompts [C]."""
    return jax.lax.map(
        lambda prompt: deficit_and_loss(policy, lead, prompt)[0], prompts, batch_size=8
    )


class _Steering(NamedTuple):
    """Gradient steps in progress, for Q prompts."""

    steps: Int[Array, ""]
    goals: Float[Array, "Q P G"]
    moments: Any
    best: Float[Array, "Q P G"]
    """The goals of the smallest deficit so far."""
    deficit: Float[Array, "Q"]
    """That deficit."""


def steer(
    policy: Policy, lead: Lead, prompts: Prompt, stride: Float[Array, ""], num_steps: int
) -> tuple[Prompt, Float[Array, "Q"]]:
    """Move the goals of prompts [Q] down the gradient of their deficits; the last goals stay.

    Args:
      policy: who is to take the way. It must tell all its distributions at once (``Policy.score``).
      lead: the way.
      prompts: where to start.
      stride: how far a step changes a goal.
      num_steps: gradient steps at most. It ends sooner when a prompt has no deficit any more.

    Returns:
      The prompts of the smallest deficits on the way down, and these.
    """
    optimizer = optax.adam(RATE)  # in units of the stride
    movable = prompts.mask.at[:, -1].set(False)[..., None]

    def loss(goals: Array, prompt: Prompt) -> tuple[Array, Array]:
        deficit, value = deficit_and_loss(policy, lead, prompt._replace(goals=goals))
        return value, deficit

    gradient = jax.vmap(jax.value_and_grad(loss, has_aux=True))

    def step(now: _Steering) -> _Steering:
        (_, deficit), slope = gradient(now.goals, prompts)
        better = deficit < now.deficit
        change, moments = optimizer.update(jnp.where(movable, slope, 0.0), now.moments)
        return _Steering(
            steps=now.steps + 1,
            goals=now.goals + jnp.where(movable, stride * change, 0.0),
            moments=moments,
            best=jnp.where(better[:, None, None], now.goals, now.best),
            deficit=jnp.where(better, deficit, now.deficit),
        )

    first = _Steering(
        steps=jnp.int32(0),
        goals=prompts.goals,
        moments=optimizer.init(prompts.goals),
        best=prompts.goals,
        deficit=jnp.full(len(prompts.mask), jnp.inf),
    )
    last = jax.lax.while_loop(
        lambda now: (now.steps < num_steps) & ~jnp.any(now.deficit <= 0), step, first
    )
    return prompts._replace(goals=last.best), last.deficit
