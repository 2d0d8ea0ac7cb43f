"""The low level of PTGM: a Transformer that is commanded to reach one goal at a time (paper, appendix F.2).

The paper describes it as a slightly modified MGPO without a prompt, in which every observation has a goal
from hindsight relabeling, and adds a goal prior p(g | h_t, o_t), fitted by maximum likelihood. It does not
say which goal is used for relabeling, nor how far ahead.

Here an observation with its goal is an additional token, which attends to the history up to o_t, and whose
output gives pi(a_t | g, h_t, o_t). No other token attends to it. The history therefore does not depend on
earlier commands, and the key-value cache stays valid under every command. The output at o_t itself, without
a goal, gives the prior.
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

from envs.agents import Agent
from envs.base import Environment, Goals, Trajectory
from envs.registry import Judgement
from mgpo_jax.baselines.hierarchy import LowLevel, hierarchical
from mgpo_jax.distributions import Distribution
from mgpo_jax.kinds import MULTI_GOAL, Learned
from mgpo_jax.losses import Stats, blurred, stats_of, transformer_told
from mgpo_jax.network_configs import TransformerConfig
from mgpo_jax.prompts import Prompt
from mgpo_jax.rollout import act, acting_as
from mgpo_jax.schema import STRICT
from mgpo_jax.settings import Count, Share
from mgpo_jax.transformer import GoalTransformer, KVCache, grow_cache

Number = Annotated[float, Ge(-1e18), Le(1e18)]


@dataclass(frozen=True)
class CommandConfig(TransformerConfig):
    """Config of the network. The paper does not give all of these settings; the others are ours."""

    __pydantic_config__ = STRICT

    commands: Annotated[tuple[tuple[Number, ...], ...], MaxLen(65_536)] = ()
    """The goals that can be commanded; the high level chooses among them."""
    every_position: bool = False
    """Whether every step of an episode reaches a goal, as in mazes."""
    ahead: Count = 20
    """Largest number of steps to a relabeled goal in worlds where every step reaches one; in other worlds
    the relabeled goal is the next one that the demonstration reached."""
    arrived: Share = 0.05
    """Fraction of the steps whose command is the goal reached last, so that an agent that reaches its goal
    before the next decision continues as the demonstrators do."""
    skill_steps: Annotated[int, Ge(1), Le(10_000)] = 10
    """Number of steps between two decisions of the high level [10]."""
    joins_obs: bool = False
    """Whether the token of a command is the sum of the goal's embedding and the token of the observation,
    so that it need not find the observation by attention. New networks have it; the released ones of mazes,
    GridWorld and Kitchen are older, and their commands carry the goal and the timestep alone."""

    @property
    def goals(self) -> Float[Array, "N G"]:
        """The commands as an array."""
        return jnp.asarray(np.array(self.commands, np.float32))


class Reading(NamedTuple):
    """The network's outputs for a trajectory of T steps."""

    actions: Distribution
    """pi(a_t | g_t, h_t, o_t) under the commands."""
    prior: Float[Array, "T N"]
    """Logits of p(g | h_t, o_t)."""
    features: Float[Array, "T E"]
    """The outputs at the observations, which do not depend on commands."""


class Read(NamedTuple):
    """What the network has read so far."""

    cache: KVCache
    token: Float[Array, "*batch E"]
    """The token of the last observation."""


class CommandedTransformer(GoalTransformer):
    """The network of pi(a_t | g_t, h_t, o_t) and p(g | h_t, o_t)."""

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
        nothing = self._empty_prompt()
        steps = self._step_tokens(obs, actions, times)
        queries = self.embed_goal(commands) + (steps[::stride] if self.config.joins_obs else times)
        seen = self._seen(nothing, len(steps))
        at_obs = np.arange(slots, len(seen), stride)
        reads = np.concatenate([at_obs, len(seen) + np.arange(time)])
        at = np.concatenate([np.arange(len(seen)), at_obs])
        x = jnp.concatenate([self._prompt_tokens(nothing), steps, queries])
        out = self._full_pass(x, seen, at, reads, deterministic)
        features, commanded = out[: len(at_obs)], out[len(at_obs) :]
        return Reading(self.read_out(commanded), self.prior(features), features)

    def begin(self, obs: Shaped[Array, "..."]) -> tuple[Float[Array, "E"], Read]:
        """Read the first observation; returns the features there and what was read."""
        features, cache = self._first(self._empty_prompt(), obs)
        return features[-1], Read(cache, self._obs_token(obs[None], self.embed_time[:1])[0])

    def proceed(
        self, read: Read, action: Array, obs: Shaped[Array, "..."]
    ) -> tuple[Float[Array, "E"], Read]:
        """Append (a_{t-1}, o_t); returns the features at o_t and what was read with it."""
        tokens = self._new_tokens(read.cache.step, action, obs)
        features, cache = self._append(read.cache, tokens)
        return features[-1], Read(cache, tokens[-1])

    def command(self, read: Read, goal: Float[Array, "G"]) -> Distribution:
        """pi(a_t | g, h_t, o_t) at the last observation that was read."""
        config, last = self.config, read.cache.step - 1
        time = jax.lax.dynamic_slice_in_dim(self.embed_time, last, 1)
        query = self.embed_goal(goal[None]) + (read.token[None] if config.joins_obs else time)
        at = config.max_prompt_length + config.num_step_tokens(last + 1) - 1
        features, _ = self._extend(self.norm_in(query), read.cache, at, keeps=False)
        return self._distribution(features)

    def prior_logits(self, features: Float[Array, "E"]) -> Float[Array, "N"]:
        """Logits of p(g | h_t, o_t) from the features at o_t."""
        logits: Array = self.prior(features)
        return logits

    def embedded(self, obs: Shaped[Array, "..."]) -> Float[Array, "E"]:
        """The embedding of an observation, without history and timestep."""
        token: Array = self.embed_obs(self.config.standardized(obs[None]))
        return token[0]

    def _empty_prompt(self) -> Prompt:
        """The empty prompt."""
        slots = self.config.max_prompt_length
        return Prompt(jnp.zeros((slots, self.config.goal_dim)), jnp.zeros(slots, bool))


def relabeled(
    key: PRNGKeyArray, goals: Goals | Trajectory, every_position: bool, ahead: int, arrived: float
) -> tuple[Int[Array, "T"], Float[Array, "T G"], Any]:
    """Relabel all steps of a trajectory with goals that were reached in hindsight.

    Args:
      key: random key.
      goals: the goals that the trajectory reached.
      every_position: whether every step reaches a goal. If so, the goal of a step is the one reached 1 to
        ``ahead`` steps later (uniformly drawn), at most that of the last step; otherwise it is the next one
        that was reached.
      ahead: the largest number of steps to a goal.
      arrived: fraction of the steps that are commanded to the goal that was reached last instead.

    Returns:
      ``(next, command, counts)``: the step that reaches the relabeled goal of each step, which the prior
      predicts, int [T]; the commanded goals, [T, G]; and whether a step has a relabeled goal, bool [T].
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
        # For each step, the index of the first step from there on that reaches a goal.
        next_ = jax.lax.cummin(jnp.where(reached, time, num_steps), reverse=True)
        counts = real & (next_ < num_steps)
        next_ = jnp.minimum(next_, num_steps - 1)
    last = jnp.pad(jax.lax.cummax(jnp.where(reached, time, -1)), (1, 0), constant_values=-1)[:-1]
    is_there = (last >= 0) & (jax.random.uniform(key_arrived, (num_steps,)) < arrived)
    command = goals.achieved_goals[jnp.where(is_there, last, next_)]
    return next_, command, counts


def nearest_command(goals: Float[Array, "*T G"], commands: Float[Array, "N G"]) -> Int[Array, "*T"]:
    """The index of the command that is nearest to each goal."""
    # Squared distances up to the squared norm of the goal, which is the same for all commands.
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

    The prior is trained on the command that is nearest to the relabeled goal.
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
    """The inputs on which a high level can base its decisions."""

    obs: Float[Array, "*batch E"]
    """The embedded observation."""
    features: Float[Array, "*batch E"]
    """The network's output at the observation, which depends on the history, too."""


def low_level(config: CommandConfig, params: Any, judged: Judgement) -> LowLevel:
    """The network as the low level of a hierarchy; a decision is the index of a command.

    Args:
      config: the network's config.
      params: its parameters.
      judged: how actions are chosen. Training episodes use the same way as judging ones.
    """
    network: Any = CommandedTransformer(config)
    params = config.prepared(params)
    greedy, temperature = acting_as(judged)

    def view(obs: Array, features: Array) -> View:
        return View(network.apply(params, obs, method="embedded"), features)

    def begin(obs: Array) -> tuple[View, Read]:
        features, read = network.apply(params, obs, method="begin")
        return view(obs, features), read

    def proceed(read: Read, action: Array, obs: Array) -> tuple[View, Read]:
        features, read = network.apply(params, read, action, obs, method="proceed")
        return view(obs, features), read

    def command(read: Read, decision: Int[Array, ""]) -> Float[Array, "G"]:
        del read
        return config.goals[decision]

    def act_on(key: PRNGKeyArray, read: Read, goal: Array, index: Int[Array, ""]) -> Array:
        del index
        distribution = network.apply(params, read, goal, method="command")
        return act(key, distribution, greedy, temperature)

    def grow(read: Read, num_steps: int) -> Read:
        return read._replace(cache=grow_cache(read.cache, config.tokens_per_step * num_steps))

    return LowLevel(begin, proceed, command, act_on, grow)


def log_prior(config: CommandConfig, params: Any, view: View) -> Float[Array, "N"]:
    """log p(g | h_t, o_t) of all N commands."""
    network: Any = CommandedTransformer(config)
    return jax.nn.log_softmax(network.apply(params, view.features, method="prior_logits"))


def prior_agent(config: CommandConfig, params: Any, judged: Judgement) -> Agent:
    """The agent that follows goals drawn from the prior, which does not depend on the task."""

    def decide(key: PRNGKeyArray, view: View, state: Any) -> tuple[Array, tuple]:
        del state
        return jax.random.categorical(key, log_prior(config, params, view)), ()

    return hierarchical(
        low_level(config, params, judged), decide, config.skill_steps, config.horizon
    )


def complete(config: CommandConfig, env: Environment, dataset: Any) -> CommandConfig:
    """The config completed with the world's goals as commands."""
    del dataset
    goals = np.asarray(env.goal_set, np.float32)
    return replace(
        config,
        commands=tuple(map(tuple, goals.tolist())),
        every_position=env.spec.truncate_in_hindsight,
        joins_obs=True,
        max_prompt_length=1,  # the prompt stays empty
        prompt_order=False,
    )


def fault(config: CommandConfig) -> str | None:
    """What is wrong with a config; None if nothing is."""
    if not config.commands or {len(goal) for goal in config.commands} != {config.goal_dim}:
        return f"commands must hold goals of {config.goal_dim} numbers"
    return None


def init(key: PRNGKeyArray, config: CommandConfig) -> Any:
    """Randomly initialized parameters."""
    goals = jnp.zeros((1, config.goal_dim))
    network = CommandedTransformer(config)
    return network.init(key, goals, *config.blank_episode(), method="read")


def facts(config: CommandConfig) -> dict[str, str]:
    """The facts about the network for a model card."""
    ahead = f"1 to {config.ahead} steps ahead" if config.every_position else "the next one reached"
    return {
        "network": transformer_told(config),
        "commands": f"{len(config.commands)} possible goals; hindsight goals: {ahead}",
    }


COMMANDED = Learned(
    config=CommandConfig,
    init=init,
    loss=commanded_loss,
    complete=complete,
    agent=prior_agent,
    facts=facts,
    fault=fault,
    starts_from=(MULTI_GOAL,),
)
