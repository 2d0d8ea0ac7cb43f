"""The low level of PTGM: a Transformer that is commanded to reach one goal at a time (paper, appendix F.2).

The paper calls it a slightly modified MGPO without a prompt, in which every observation has a goal from
hindsight relabeling, and adds a goal prior p(g | h_t, o_t), fitted by maximum likelihood. Which goal is
relabeled, and how far ahead, the paper does not say.

Here a commanded goal is one more token that reads the history up to o_t and gives pi(a_t | g, h_t, o_t). No
other token reads it, so that the history never tells what was commanded before, and what has been cached
stays valid under every command. The output at o_t itself gives the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, MaxLen
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from envs.base import Agent, Environment, Goals, Trajectory
from envs.registry import Judgement
from mgpo_jax.baselines.hierarchy import LowLevel, hierarchical
from mgpo_jax.distributions import Distribution
from mgpo_jax.kinds import Learned
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import act
from mgpo_jax.schema import STRICT
from mgpo_jax.settings import Count, Share
from mgpo_jax.training import Stats, blurred, stats_of, transformer_told
from mgpo_jax.transformer import GoalTransformer, KVCache, TransformerConfig, grow_cache

Number = Annotated[float, Ge(-1e18), Le(1e18)]


@dataclass(frozen=True)
class CommandConfig(TransformerConfig):
    """Sizes of the network. Those that the paper does not give are ours."""

    __pydantic_config__ = STRICT

    commands: Annotated[tuple[tuple[Number, ...], ...], MaxLen(65_536)] = ()
    """The goals that can be commanded, which the high level chooses among."""
    every_position: bool = False
    """Whether every step of an episode reaches a goal, as in mazes."""
    ahead: Count = 20
    """Largest number of steps to a relabeled goal, where every step reaches one; elsewhere it is the next
    goal that the demonstration reached."""
    arrived: Share = 0.05
    """Share of the steps whose command is the goal that was reached last, so that an agent which arrives
    before the next decision goes on as demonstrators do."""
    skill_steps: Annotated[int, Ge(1), Le(10_000)] = 10
    """Steps between two decisions of the high level [10]."""

    @property
    def goals(self) -> Float[Array, "N G"]:
        """The commands as an array."""
        return jnp.asarray(np.array(self.commands, np.float32))


class Reading(NamedTuple):
    """What the network says of a trajectory of T steps."""

    actions: Distribution
    """pi(a_t | g_t, h_t, o_t) under the commands."""
    prior: Float[Array, "T N"]
    """Logits of p(g | h_t, o_t)."""
    features: Float[Array, "T E"]
    """The outputs at the observations, which know no command."""


class CommandedTransformer(GoalTransformer):
    """pi(a_t | g_t, h_t, o_t) and p(g | h_t, o_t)."""

    config: CommandConfig

    def setup(self) -> None:
        super().setup()
        self.prior = nn.Dense(len(self.config.commands))

    def read(
        self,
        commands: Float[Array, "T G"],
        obs: Shaped[Array, "T ..."],
        actions: Array,
        deterministic: bool = True,
    ) -> Reading:
        """Read a trajectory with a commanded goal at every step.

        With ``deterministic=False`` dropout is on and an rng named ``dropout`` is needed.
        """
        slots, stride, time = self.config.max_prompt_length, self.config.tokens_per_step, len(obs)
        times = self.embed_time[:time]
        nothing = self._nothing()
        history = [self._prompt_tokens(nothing), self._step_tokens(obs, actions, times)]
        queries = self.embed_goal(commands) + times
        seen = self._seen(nothing, len(history[1]))
        at_obs = np.arange(slots, len(seen), stride)
        reads = np.concatenate([at_obs, len(seen) + np.arange(time)])
        at = np.concatenate([np.arange(len(seen)), at_obs])
        x = jnp.concatenate([*history, queries])
        out = self._full_pass(x, seen, at, reads, deterministic)
        features, commanded = out[: len(at_obs)], out[len(at_obs) :]
        return Reading(self.read_out(commanded), self.prior(features), features)

    def begin(self, obs: Shaped[Array, "..."]) -> tuple[Float[Array, "E"], KVCache]:
        """Read the first observation; returns the features there and the cache."""
        features, cache = self._first(self._nothing(), obs)
        return features[-1], cache

    def proceed(
        self, cache: KVCache, action: Array, obs: Shaped[Array, "..."]
    ) -> tuple[Float[Array, "E"], KVCache]:
        """Append (a_{t-1}, o_t); returns the features at o_t and the longer cache."""
        features, cache = self._append(cache, action, obs)
        return features[-1], cache

    def command(self, cache: KVCache, goal: Float[Array, "G"]) -> Distribution:
        """pi(a_t | g, h_t, o_t) at the last observation that was read."""
        last = cache.step - 1
        time = jax.lax.dynamic_slice_in_dim(self.embed_time, last, 1)
        query = self.norm_in(self.embed_goal(goal[None]) + time)
        at = self.config.max_prompt_length + self.config.num_step_tokens(last + 1) - 1
        features, _ = self._extend(query, cache, at, keeps=False)
        return self._distribution(features)

    def prior_logits(self, features: Float[Array, "E"]) -> Float[Array, "N"]:
        """Logits of p(g | h_t, o_t) from the features at o_t."""
        logits: Array = self.prior(features)
        return logits

    def embedded(self, obs: Shaped[Array, "..."]) -> Float[Array, "E"]:
        """An observation as the network takes it in, without its history and its time."""
        token: Array = self.embed_obs(self.config.standardized(obs[None]))
        return token[0]

    def _nothing(self) -> Prompt:
        """The prompt of no goals."""
        slots = self.config.max_prompt_length
        return Prompt(jnp.zeros((slots, self.config.goal_dim)), jnp.zeros(slots, bool))


def relabeled(
    key: PRNGKeyArray, goals: Goals | Trajectory, every_position: bool, ahead: int, arrived: float
) -> tuple[Int[Array, "T"], Float[Array, "T G"], Any]:
    """Hindsight goals for all steps of a trajectory: for the prior, and for the action.

    Args:
      key: random key.
      goals: what the trajectory reached.
      every_position: whether every step reaches a goal. A step's goal is then that of a random number of
        steps from 1 to ``ahead`` later, or the last one; else it is the next one that is reached.
      ahead: as said.
      arrived: share of the steps whose action is commanded by the goal that was reached last.

    Returns:
      ``(next, command, counts)``: the step that reaches the next goal, [T]; the goals commanded, [T, G];
      and the steps t that have a next goal, bool [T].
    """
    num_steps = len(goals.goal_reached)
    time = jnp.arange(num_steps)
    real = time < goals.length
    reached = goals.goal_reached & real
    key_ahead, key_arrived = jax.random.split(key)
    if every_position:
        far = time + jax.random.randint(key_ahead, (num_steps,), 0, ahead)
        next_ = jnp.minimum(far, goals.length - 1)
        counts = real
    else:
        # The smallest index of a step that reaches a goal, from each step on.
        next_ = jax.lax.cummin(jnp.where(reached, time, num_steps), reverse=True)
        counts = real & (next_ < num_steps)
        next_ = jnp.minimum(next_, num_steps - 1)
    last = jnp.pad(jax.lax.cummax(jnp.where(reached, time, -1)), (1, 0), constant_values=-1)[:-1]
    is_there = (last >= 0) & (jax.random.uniform(key_arrived, (num_steps,)) < arrived)
    command = goals.achieved_goals[jnp.where(is_there, last, next_)]
    return next_, command, counts


def nearest_command(goals: Float[Array, "*T G"], commands: Float[Array, "N G"]) -> Int[Array, "*T"]:
    """The index of the command that each goal is nearest to."""
    # Squared distances without the goals' own squares, which are the same for all commands.
    return jnp.argmin(jnp.sum(commands**2, axis=-1) - 2 * goals @ commands.T, axis=-1)


def commanded_loss(
    params: Any,
    key: PRNGKeyArray,
    config: CommandConfig,
    trajectory: Trajectory,
    deterministic: bool = False,
    obs_noise: float = 0.0,
) -> tuple[Float[Array, ""], Stats]:
    """-sum_t log pi(a_t | g_t, h_t, o_t) + log p(g_t | h_t, o_t) of one trajectory.

    The prior's goal is the command that is nearest to the relabeled one.
    """
    key_goal, key_dropout, key_noise = jax.random.split(key, 3)
    if obs_noise and not deterministic:
        trajectory = blurred(key_noise, trajectory, obs_noise)
    next_, command, counts = relabeled(
        key_goal, trajectory, config.every_position, config.ahead, config.arrived
    )
    reading: Any = CommandedTransformer(config).apply(
        params,
        command,
        trajectory.obs,
        trajectory.actions,
        deterministic or config.dropout == 0,
        method="read",
        rngs={"dropout": key_dropout},
    )
    label = nearest_command(trajectory.achieved_goals[next_], config.goals)
    log_prior = jnp.take_along_axis(jax.nn.log_softmax(reading.prior), label[:, None], axis=1)
    stats = stats_of(reading.actions, trajectory.labels, counts, prior=-log_prior[:, 0])
    return stats.nll + stats.parts["prior"], stats


class View(NamedTuple):
    """What a high level can decide by."""

    obs: Float[Array, "*batch E"]
    """The embedded observation."""
    features: Float[Array, "*batch E"]
    """The network's output at the observation, which knows the history."""


def low_level(config: CommandConfig, params: Any, judged: Judgement) -> LowLevel:
    """The network as the low level; a decision is the index of a command.

    Args:
      config: the network.
      params: its weights.
      judged: how actions are drawn: as the world judges policies, also in episodes that learn.
    """
    network: Any = CommandedTransformer(config)
    temperature = jnp.float32(judged.temperature) if judged.tempered else None

    def view(obs: Array, features: Array) -> View:
        return View(network.apply(params, obs, method="embedded"), features)

    def begin(obs: Array) -> tuple[View, KVCache]:
        features, cache = network.apply(params, obs, method="begin")
        return view(obs, features), cache

    def proceed(cache: KVCache, action: Array, obs: Array) -> tuple[View, KVCache]:
        features, cache = network.apply(params, cache, action, obs, method="proceed")
        return view(obs, features), cache

    def command(cache: KVCache, decision: Int[Array, ""]) -> Float[Array, "G"]:
        del cache
        return config.goals[decision]

    def act_on(key: PRNGKeyArray, cache: KVCache, goal: Array, index: Int[Array, ""]) -> Array:
        del index
        distribution = network.apply(params, cache, goal, method="command")
        return act(key, distribution, jnp.asarray(judged.mode == "greedy"), temperature)

    def grow(cache: KVCache, num_steps: int) -> KVCache:
        return grow_cache(cache, config.tokens_per_step * num_steps)

    return LowLevel(begin, proceed, command, act_on, grow)


def log_prior(config: CommandConfig, params: Any, view: View) -> Float[Array, "N"]:
    """log p(g | h_t, o_t) of all commands."""
    network: Any = CommandedTransformer(config)
    return jax.nn.log_softmax(network.apply(params, view.features, method="prior_logits"))


def prior_agent(config: CommandConfig, params: Any, judged: Judgement) -> Agent:
    """Follows goals drawn from the prior, which knows nothing of the task."""

    def decide(key: PRNGKeyArray, view: View, state: Any) -> tuple[Array, tuple]:
        del state
        return jax.random.categorical(key, log_prior(config, params, view)), ()

    return hierarchical(
        low_level(config, params, judged), decide, config.skill_steps, config.horizon
    )


def complete(config: CommandConfig, env: Environment, dataset: Any) -> CommandConfig:
    """The config with the world's goals as commands."""
    del dataset
    goals = np.asarray(env.goal_set, np.float32)
    return replace(
        config,
        commands=tuple(map(tuple, goals.tolist())),
        every_position=env.spec.truncate_in_hindsight,
        max_prompt_length=1,  # which stays empty
        prompt_order=False,
    )


def fault(config: CommandConfig) -> str | None:
    """What of a config does not fit together."""
    if not config.commands or {len(goal) for goal in config.commands} != {config.goal_dim}:
        return f"commands must hold goals of {config.goal_dim} numbers"
    return None


def init(key: PRNGKeyArray, config: CommandConfig) -> Any:
    """Random weights."""
    goals = jnp.zeros((1, config.goal_dim))
    network = CommandedTransformer(config)
    return network.init(key, goals, *config.blank_episode(), method="read")


def facts(config: CommandConfig) -> dict[str, str]:
    """What a card says of the network."""
    ahead = f"1 to {config.ahead} steps ahead" if config.every_position else "the next one reached"
    return {
        "network": transformer_told(config),
        "commands": f"{len(config.commands)} goals; in hindsight {ahead}",
    }


COMMANDED = Learned(
    config=CommandConfig,
    init=init,
    loss=commanded_loss,
    complete=complete,
    agent=prior_agent,
    facts=facts,
    fault=fault,
)
