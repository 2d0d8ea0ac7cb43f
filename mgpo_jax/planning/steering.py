"""Steering: gradient steps on the goals of a prompt so that the frozen policy takes a known path.

The policy is teacher-forced along the path, and at each step its most likely action is compared with the
action of the path. The difference of their log probabilities, summed over the path, is the prompt's
*deficit*. It is 0 if the policy takes the path by itself. The goals of a prompt are continuous, so the
deficit has a gradient with respect to them.
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
"""Learning rate of Adam, in units of the change of the goal in one step (``Table.stride``)."""
LIKELIER = 0.05
"""Weight in the loss of the log-likelihood of the path's actions, which keeps them ahead of other
actions."""


class Lead(NamedTuple):
    """A known path of at most L steps, as the observations and actions of the policy on it."""

    obs: Shaped[Array, "L ..."]
    actions: Int[Array, "L"]
    real: Bool[Array, "L"]
    """Which steps are real, not padding."""


def lead_along(table: Table, start: Int[Array, ""], way: Int[Array, "T"], longest: int) -> Lead:
    """The observations and actions on a path, which is given by the states after ``start``.

    A path of more than ``longest`` (L) steps is cut off.
    """
    missing = jnp.full(max(longest - len(way), 0), UNKNOWN)
    states = jnp.concatenate([start[None], way, missing])
    before, after = states[:longest], states[1 : longest + 1]
    actions = jnp.argmax(table.successors[before] == after[:, None], axis=-1)
    return Lead(table.obs[before], actions, after != UNKNOWN)


def deficit_and_loss(
    policy: Policy, lead: Lead, prompt: Prompt
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The deficit of a prompt, and the loss whose gradient steers it."""
    if policy.score is None:
        raise ValueError("this policy provides no likelihoods (its field score is None)")
    distribution = policy.score(prompt, lead.obs, lead.actions)
    own = distribution.log_prob(lead.actions)
    preferred = distribution.log_prob(distribution.mode())
    deficit = jnp.sum(jnp.where(lead.real, preferred - own, 0.0))
    likelihood = jnp.sum(jnp.where(lead.real, own, 0.0))
    return deficit, deficit - LIKELIER * likelihood


def deficits(policy: Policy, lead: Lead, prompts: Prompt) -> Float[Array, "C"]:
    """The deficits of C prompts."""
    return jax.lax.map(
        lambda prompt: deficit_and_loss(policy, lead, prompt)[0], prompts, batch_size=8
    )


class _Steering(NamedTuple):
    """The state of the optimization of Q prompts."""

    steps: Int[Array, ""]
    goals: Float[Array, "Q P G"]
    moments: Any
    best: Float[Array, "Q P G"]
    """The goals with the smallest deficit so far."""
    deficit: Float[Array, "Q"]
    """The smallest deficit so far."""


def steer(
    policy: Policy, lead: Lead, prompts: Prompt, stride: Float[Array, ""], num_steps: int
) -> tuple[Prompt, Float[Array, "Q"]]:
    """Optimize the goals of Q prompts, except for their last ones, by Adam (``deficit_and_loss``).

    Args:
      policy: the policy that is to take the path. It must provide ``Policy.score``.
      lead: the path.
      prompts: the initial prompts.
      stride: the change of the goal in one step, which scales the learning rate.
      num_steps: largest number of gradient steps. The loop ends sooner once any prompt has no deficit.

    Returns:
      For each prompt the version with the smallest deficit, and that deficit.
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
