"""A user's own method: draws prompts from the last episode, and keeps the luckiest."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from mgpo_jax import Adapter, LoadedPolicy, Method, Query, sample_prompt
from mgpo_jax.prompts import single_goal
from mgpo_jax.rollout import prompted
from mgpo_jax.settings import Count, NotNegative


@dataclass(frozen=True)
class LuckyHyper:
    longest: Count = 3  # Goals of the longest prompt to draw.
    thrift: NotNegative = 0.0  # How much better a prompt must be to be kept.


def make_lucky(setting, params, hyper):
    policy = LoadedPolicy(setting.network, params, {}).policy

    def init(key, goal):
        first = single_goal(goal, policy.num_slots)
        return goal, first, (jnp.float32(-jnp.inf), first)

    def tell(key, state, query, episodes):
        goal, _, kept = state
        goals, found = jax.tree.map(lambda x: x[0], (episodes.trajectory.goals, episodes.return_))
        better = found > kept[0] + hyper.thrift
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (found, query.prompt), kept)
        return goal, sample_prompt(key, goals, goal, policy.num_slots, hyper.longest), kept

    ask = lambda key, state: (Query(state[1], greedy=False), state)  # noqa: E731
    agent = lambda state, query: prompted(policy, query)  # noqa: E731
    return Adapter(init, ask, agent, tell, best=lambda state: Query(state[2][1], greedy=True))


METHOD = Method(name="lucky", make=make_lucky, hyper=LuckyHyper, summary="keeps lucky prompts")
