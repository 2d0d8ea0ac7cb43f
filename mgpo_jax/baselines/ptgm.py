"""PTGM as the paper describes it: DQN chooses goals for a pre-trained low level (appendix F.2, Table 10).

Every k steps the high level chooses one of the world's goals, and the low level (``commanded``) tries to
reach it. The high level is a multilayer perceptron that is trained by deep Q-learning on one task, with
epsilon-greedy choices and a penalty for departing from the goal prior: r' = R - w KL(pi, p), where R is the
undiscounted sum of the k rewards and pi the epsilon-greedy policy that chose. This divergence is the same
for an explored goal. With ``kl_of="goal"`` it is that of always choosing the goal that was chosen, so that
r' = R + w log p(g), which is the same where nothing is explored. The PTGM of its own paper is a different
method: its goals are clusters of observations, and it is trained by PPO (``ptgm_ppo``) or SAC.

The paper does not say what the high level sees, how often it is updated, how many transitions are collected
first, nor how it is judged. Here it sees the embedded observation, and in one variant also the task goal
g^M. It is updated once for every decision, as soon as there are enough transitions for a batch, and it is
judged greedily, without exploration. A decision that is cut short by the end of an episode does not
bootstrap, whether the task was solved or the horizon was reached.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from envs.agents import Agent
from envs.base import Episode, State
from envs.errors import UsageError
from mgpo_jax.adaptation import Adapter
from mgpo_jax.baselines.commanded import (
    CommandConfig,
    View,
    log_prior,
    low_level,
    nearest_command,
    prior_agent,
)
from mgpo_jax.baselines.hierarchy import (
    Mlp,
    Replay,
    Transitions,
    draw,
    empty_replay,
    hierarchical,
    num_decisions,
    reference,
    remember,
    transitions,
)
from mgpo_jax.baselines.methods import HighLevelHyper, PtgmHyper
from mgpo_jax.methods import NoHyper, Setting
from mgpo_jax.trees import choose


class Choice(NamedTuple):
    """How the high level chooses goals in an episode."""

    epsilon: Float[Array, "*batch"]
    """Probability of a random goal."""


class Kept(NamedTuple):
    """The data of a decision that are kept for training."""

    seen: Float[Array, "*batch I"]
    """The input of the high level."""
    goal: Int[Array, "*batch"]
    divergence: Float[Array, "*batch"]
    """KL(pi, p) between the policy that is charged and the prior, in nats."""


class Learner(NamedTuple):
    """The state of the high level on one task."""

    task_goal: Float[Array, "*batch G"]
    params: Any
    target: Any
    opt_state: Any
    replay: Replay
    updates: Int[Array, "*batch"]


def greedy_divergence(
    epsilon: float | Float[Array, ""], best: Int[Array, ""], log_p: Float[Array, "N"]
) -> Float[Array, ""]:
    """KL(pi, p) for the epsilon-greedy policy pi over N goals whose greedy choice is ``best``."""
    num = len(log_p)
    pi = jnp.full(num, epsilon / num).at[best].add(1 - epsilon)
    return jnp.sum(jnp.where(pi > 0, pi * (jnp.log(jnp.maximum(pi, 1e-30)) - log_p), 0.0))


def targets(
    reward: Float[Array, "B"],
    done: Bool[Array, "B"],
    next_values: Float[Array, "B N"],
    discount: float | Float[Array, ""],
) -> Float[Array, "B"]:
    """The targets of Q-learning: R + discount * max Q(next), without the second term if ``done``."""
    return reward + jnp.where(done, 0.0, discount * next_values.max(axis=-1))


def input_width(config: CommandConfig, hyper: HighLevelHyper) -> int:
    """I, the number of numbers that the high level sees."""
    return config.embed_dim + hyper.sees_goal * config.goal_dim


def seen_by(
    hyper: HighLevelHyper, view: View, task_goal: Float[Array, "*batch G"]
) -> Float[Array, "*batch I"]:
    """The input of the high level."""
    read = view.features if hyper.reads == "history" else view.obs
    return jnp.concatenate([read, task_goal], axis=-1) if hyper.sees_goal else read


class Ptgm:
    """PTGM on one task; all methods are pure.

    Args:
      setting: the setting (``methods.Setting``).
      params: the parameters of the low level.
      hyper: the hyper-parameters of the high level.
    """

    def __init__(self, setting: Setting, params: Any, hyper: PtgmHyper) -> None:
        self.setting, self.low_params, self.hyper = setting, params, hyper
        self.config: CommandConfig = setting.network
        self.q: Any = Mlp(len(self.config.commands))
        self.low = low_level(self.config, params, setting.judged)
        self.optimize = optax.adam(hyper.learning_rate)

    def adapter(self) -> Adapter:
        return Adapter(
            init=self.init,
            ask=self.ask,
            agent=self.agent,
            tell=self.tell,
            best=lambda state: Choice(jnp.zeros(())),
            tell_in_turn=True,
        )

    def init(self, key: PRNGKeyArray, task_goal: Float[Array, "G"]) -> Learner:
        width = input_width(self.config, self.hyper)
        params = self.q.init(key, jnp.zeros(width))
        number = jnp.zeros(())
        kept = Kept(jnp.zeros(width), number.astype(jnp.int32), number)
        per_episode = num_decisions(self.config.horizon, self.config.skill_steps)
        return Learner(
            task_goal=task_goal,
            params=params,
            target=params,
            opt_state=self.optimize.init(params),
            replay=empty_replay(kept, per_episode, self.setting.num_episodes),
            updates=jnp.zeros((), jnp.int32),
        )

    def ask(self, key: PRNGKeyArray, state: Learner) -> tuple[Choice, Learner]:
        del key
        return Choice(jnp.float32(self.hyper.epsilon)), state

    def agent(self, state: Learner, choice: Choice) -> Agent:
        def decide(key: PRNGKeyArray, view: View, world: State) -> tuple[Array, Kept]:
            del world
            key_whether, key_which = jax.random.split(key)
            seen = seen_by(self.hyper, view, state.task_goal)
            best = jnp.argmax(self.q.apply(state.params, seen))
            other = jax.random.randint(key_which, (), 0, self.q.num_outputs)
            explores = jax.random.uniform(key_whether) < choice.epsilon
            goal = jnp.where(explores, other, best)
            log_p = log_prior(self.config, self.low_params, view)
            if self.hyper.kl_of == "goal":
                away = greedy_divergence(0.0, goal, log_p)
            else:
                away = greedy_divergence(choice.epsilon, best, log_p)
            return goal, Kept(seen, goal, away)

        return hierarchical(self.low, decide, self.config.skill_steps, self.config.horizon)

    def tell(self, key: PRNGKeyArray, state: Learner, choice: Choice, episodes: Episode) -> Learner:
        """Add an episode to the replay buffer, and update once for every decision in it."""
        del choice
        episode = jax.tree.map(lambda leaf: leaf[0], episodes)
        new = transitions(episode, self.config.skill_steps)
        new = new._replace(reward=new.reward - self.hyper.kl * new.kept.divergence)
        state = state._replace(replay=remember(state.replay, new))
        enough = state.replay.size >= self.hyper.batch_size
        num = jnp.where(enough, new.valid.sum(), 0)
        keys = jax.random.split(key, len(new.valid))
        return jax.lax.fori_loop(0, num, lambda i, state: self._update(keys[i], state), state)

    def _update(self, key: PRNGKeyArray, state: Learner) -> Learner:
        """Take one gradient step on a batch from the replay buffer."""
        return self.improved(state, *draw(key, state.replay, self.hyper.batch_size))

    def improved(self, state: Learner, now: Transitions, after: Transitions) -> Learner:
        """Take one gradient step on transitions (``now``) and their successors (``after``)."""
        next_values = self.q.apply(state.target, after.kept.seen)
        wanted = targets(now.reward, now.done, next_values, self.hyper.discount)

        def loss(params: Any) -> Array:
            values: Any = self.q.apply(params, now.kept.seen)
            chosen = jnp.take_along_axis(values, now.kept.goal[:, None], axis=1)[:, 0]
            return jnp.mean((chosen - wanted) ** 2)

        updates, opt_state = self.optimize.update(jax.grad(loss)(state.params), state.opt_state)
        params: Any = optax.apply_updates(state.params, updates)
        count = state.updates + 1
        target = choose(count % self.hyper.target_interval == 0, params, state.target)
        return state._replace(params=params, target=target, opt_state=opt_state, updates=count)


def make_ptgm(setting: Setting, params: Any, hyper: PtgmHyper) -> Adapter:
    return Ptgm(setting, params, hyper).adapter()


Rule = Callable[[PRNGKeyArray, View, State], Int[Array, ""]]
"""``(key, view, state of the world) -> index`` of a goal."""


def following(setting: Setting, params: Any, rule: Rule) -> Adapter:
    """The adapter of a high level that chooses goals by a fixed rule."""
    config: CommandConfig = setting.network
    agent = hierarchical(
        low_level(config, params, setting.judged),
        lambda key, view, world: (rule(key, view, world), ()),
        config.skill_steps,
        config.horizon,
    )
    return reference(agent, Choice(jnp.zeros(())))


def make_random(setting: Setting, params: Any, hyper: NoHyper) -> Adapter:
    """The high level that chooses goals uniformly at random."""
    del hyper
    num = len(setting.network.commands)
    return following(setting, params, lambda key, view, state: jax.random.randint(key, (), 0, num))


def make_prior(setting: Setting, params: Any, hyper: NoHyper) -> Adapter:
    """The high level that draws goals from the prior."""
    del hyper
    agent = prior_agent(setting.network, params, setting.judged)
    return reference(agent, Choice(jnp.zeros(())))


def make_oracle(setting: Setting, params: Any, hyper: NoHyper) -> Adapter:
    """The high level that chooses the goals of the world's expert: what the low level is good for."""
    del hyper
    config: CommandConfig = setting.network

    def rule(key: PRNGKeyArray, view: View, state: State) -> Int[Array, ""]:
        del key, view
        goal = setting.env.expert_goal(state, config.skill_steps)
        return nearest_command(goal, config.goals)

    return following(setting, params, rule)


def check_ptgm(setting: Setting, hyper: PtgmHyper) -> None:
    """Raise ``UsageError`` if the budget is too small for a single update of the high level."""
    config: CommandConfig = setting.network
    most = setting.num_episodes * num_decisions(config.horizon, config.skill_steps)
    if most < hyper.batch_size:
        raise UsageError(
            f"{setting.num_episodes} episodes hold at most {most} decisions, and the first update needs "
            f"--batch-size {hyper.batch_size}; raise --episodes, or lower --batch-size"
        )


def check_oracle(setting: Setting, hyper: NoHyper) -> None:
    """Raise ``UsageError`` if the world provides no expert goals."""
    del hyper
    env, config = setting.env, setting.network

    def expert_goal(key: PRNGKeyArray) -> Array:
        state, _ = env.reset(key, env.sample_task(key))
        return env.expert_goal(state, config.skill_steps)

    jax.eval_shape(expert_goal, jax.random.key(0))
