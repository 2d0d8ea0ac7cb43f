"""PTGM: the commanded network, hindsight goals, the hierarchy's decisions, and its Q-learning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Episode, Goals, Trajectory
from envs.episodes import run_episode
from envs.errors import NotAvailableError, UsageError
from envs.registry import Judgement
from mgpo_jax import methods
from mgpo_jax.adaptation import search
from mgpo_jax.baselines import commanded, ptgm
from mgpo_jax.baselines.commanded import (
    CommandConfig,
    CommandedTransformer,
    View,
    commanded_loss,
    complete,
    log_prior,
    nearest_command,
    relabeled,
)
from mgpo_jax.baselines.hierarchy import (
    LowLevel,
    Transitions,
    draw,
    empty_replay,
    hierarchical,
    remember,
    transitions,
)
from mgpo_jax.baselines.methods import PtgmGoalHyper, PtgmHyper
from mgpo_jax.baselines.ptgm import Choice, Kept, Ptgm, greedy_divergence, seen_by, targets
from mgpo_jax.methods import Setting
from mgpo_jax.network_configs import world_side
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.transformer import grow_cache

ENV = envs.make("gridworld")
T = 8
SIZES = {"embed_dim": 16, "num_layers": 2, "num_heads": 2, "dropout": 0.0, "skill_steps": 3}
CONFIG = complete(CommandConfig(**world_side(ENV.spec, None, "linear"), **SIZES), ENV, None)
SUMMED = replace(CONFIG, tokens_per_step=1)
SETTING = Setting(ENV, CONFIG, 12, Judgement())


def make_params(config: CommandConfig) -> Any:
    """Random weights, larger than the initial ones, with which little would depend on anything."""
    shapes = jax.eval_shape(lambda: commanded.init(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(0.4 * rng.standard_normal(leaf.shape)), shapes)


@pytest.fixture(scope="module")
def params() -> Any:
    return make_params(CONFIG)


@pytest.fixture(scope="module")
def inputs() -> tuple[jax.Array, jax.Array, jax.Array]:
    """Commands, observations and actions of T steps."""
    rng = np.random.default_rng(1)
    return (
        jnp.asarray(rng.standard_normal((T, CONFIG.goal_dim)), jnp.float32),
        jnp.asarray(rng.standard_normal((T, *CONFIG.obs_shape)), jnp.float32),
        jnp.asarray(rng.integers(0, CONFIG.action_dim, T)),
    )


def read(config, params, commands, obs, actions):
    return CommandedTransformer(config).apply(params, commands, obs, actions, method="read")


@pytest.mark.parametrize(
    "config",
    [CONFIG, SUMMED, replace(CONFIG, joins_obs=False), replace(SUMMED, joins_obs=False)],
    ids=["two tokens", "one token", "two tokens, goals alone", "one token, goals alone"],
)
def test_step_by_step_equals_the_full_pass(config, params, inputs):
    commands, obs, actions = inputs
    full = read(config, params, commands, obs, actions)
    network: Any = CommandedTransformer(config)
    features, seen = network.apply(params, obs[0], method="begin")
    seen = seen._replace(cache=grow_cache(seen.cache, 2 * T))
    for t in range(T):
        if t:
            features, seen = network.apply(params, seen, actions[t - 1], obs[t], method="proceed")
        found = network.apply(params, seen, commands[t], method="command")
        np.testing.assert_allclose(found.logits, full.actions.logits[t], atol=1e-5)
        np.testing.assert_allclose(features, full.features[t], atol=1e-5)
        prior = network.apply(params, features, method="prior_logits")
        np.testing.assert_allclose(prior, full.prior[t], atol=1e-5)


def test_a_command_is_read_at_its_own_step_alone(params, inputs):
    commands, obs, actions = inputs
    before = read(CONFIG, params, commands, obs, actions)
    after = read(CONFIG, params, commands.at[3].add(1.0), obs, actions)
    changed = np.any(np.asarray(before.actions.logits != after.actions.logits), axis=1)
    np.testing.assert_array_equal(changed, np.arange(T) == 3)
    np.testing.assert_array_equal(before.prior, after.prior)


def test_the_future_is_not_seen(params, inputs):
    commands, obs, actions = inputs
    before = read(CONFIG, params, commands, obs, actions)
    after = read(CONFIG, params, commands, obs.at[5].add(1.0), actions.at[5].set(0))
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(old[:5], new[:5])
        assert np.any(np.asarray(old[5:] != new[5:]))


def reached_at(steps: list[int], length: int = 6) -> Goals:
    """Goals of an episode of T steps: the goal at step t is (t, t, ..)."""
    numbers = jnp.broadcast_to(jnp.arange(T, dtype=jnp.float32)[:, None], (T, 2))
    reached = jnp.isin(jnp.arange(T), jnp.asarray(steps))
    return Goals(numbers, reached, numbers, jnp.int32(length))


def test_the_next_goal_is_relabeled_where_goals_are_rare():
    next_, command, counts = relabeled(jax.random.key(0), reached_at([2, 4, 7]), False, 20, 0.0)
    np.testing.assert_array_equal(counts, [True] * 5 + [False] * 3)  # nothing follows step 4
    np.testing.assert_array_equal(next_[:5], [2, 2, 2, 4, 4])
    np.testing.assert_array_equal(command[:5, 0], [2, 2, 2, 4, 4])


def test_goals_lie_a_random_number_of_steps_ahead_where_every_position_is_one():
    goals = reached_at(list(range(T)))
    keys = jax.random.split(jax.random.key(0), 300)
    draw_all = jax.vmap(lambda key: relabeled(key, goals, True, 3, 0.0))
    next_, _, counts = draw_all(keys)
    assert set(np.unique(next_[:, 0])) == {0, 1, 2}
    assert set(np.unique(next_[:, 4])) == {4, 5}  # the last step of the episode
    np.testing.assert_array_equal(counts[0], np.arange(T) < 6)
    share = np.mean(np.asarray(next_[:, 0] == 1))
    assert abs(share - 1 / 3) < 0.1


def test_some_commands_are_of_the_goal_reached_last():
    goals = reached_at([2, 4])
    next_, command, _ = relabeled(jax.random.key(0), goals, False, 20, 1.0)
    np.testing.assert_array_equal(next_[:5], [2, 2, 2, 4, 4])  # the prior's is the next one
    np.testing.assert_array_equal(command[:6, 0], [2, 2, 2, 2, 2, 4])


def test_the_nearest_command():
    commands = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    goals = jnp.array([[0.9, 0.1], [0.1, 1.5], [0.4, 0.0]])
    np.testing.assert_array_equal(nearest_command(goals, commands), [1, 2, 0])


def trajectory_of(inputs, steps: list[int], length: int) -> Trajectory:
    _, obs, actions = inputs
    goals = jnp.eye(CONFIG.goal_dim)[jnp.arange(T) % CONFIG.goal_dim]
    reached = jnp.isin(jnp.arange(T), jnp.asarray(steps))
    return Trajectory(obs, actions, goals, reached, goals, jnp.int32(length))


def test_the_loss_by_hand(params, inputs):
    config = replace(CONFIG, arrived=0.0)
    trajectory = trajectory_of(inputs, [1, 4], length=6)
    loss, stats = commanded_loss(params, jax.random.key(0), config, trajectory, True)
    next_ = [1, 1, 4, 4, 4]  # step 5 has no next goal
    commands = jnp.eye(CONFIG.goal_dim)[jnp.array([*next_, 0, 0, 0])]
    reading = read(config, params, commands, trajectory.obs, trajectory.actions)
    log_pi, log_p = jax.nn.log_softmax(reading.actions.logits), jax.nn.log_softmax(reading.prior)
    nll = -sum(log_pi[t, trajectory.actions[t]] for t in range(5))
    prior = -sum(log_p[t, goal] for t, goal in enumerate(next_))
    np.testing.assert_allclose(stats.nll, nll, rtol=1e-5)
    np.testing.assert_allclose(stats.parts["prior"], prior, rtol=1e-5)
    np.testing.assert_allclose(loss, nll + prior, rtol=1e-5)
    assert stats.num_steps == 5


def test_padding_changes_no_loss(params, inputs):
    trajectory = trajectory_of(inputs, [1, 4], length=6)
    other = trajectory._replace(
        obs=trajectory.obs.at[6:].set(9.0), goal_reached=trajectory.goal_reached.at[6:].set(True)
    )
    losses = [
        commanded_loss(params, jax.random.key(0), CONFIG, one, True)[0]
        for one in (trajectory, other)
    ]
    assert losses[0] == losses[1]


def counting() -> LowLevel:
    """A low level whose view is the number of the observation, and whose orders are decisions."""
    return LowLevel(
        begin=lambda obs: (jnp.int32(0), jnp.int32(0)),
        proceed=lambda carry, action, obs: (carry + 1, carry + 1),
        command=lambda carry, decision: 10 * decision,
        act=lambda key, carry, orders, index: (orders + index) % ENV.spec.action_dim,
    )


def test_decisions_fall_on_every_third_step():
    agent = hierarchical(counting(), lambda key, view, state: (view, view), 3, ENV.spec.horizon)
    task = ENV.sample_task(jax.random.key(0))
    run = jax.jit(jax.vmap(lambda key: run_episode(key, ENV, agent, task)))
    episode = run(jax.random.split(jax.random.key(1), 2))
    time = np.arange(ENV.spec.horizon)
    expected = (10 * (time // 3 * 3) + time % 3) % ENV.spec.action_dim
    for lane in range(2):
        length = int(episode.trajectory.length[lane])
        np.testing.assert_array_equal(episode.trajectory.actions[lane][:length], expected[:length])
        num = -(-length // 3)
        np.testing.assert_array_equal(episode.decisions[lane][:num], 3 * np.arange(num))


def episode_of(rewards: list[float], length: int, kept: Any) -> Episode:
    trajectory: Any = Trajectory(None, None, None, None, None, jnp.int32(length))
    paid = jnp.asarray(rewards)
    return Episode(trajectory, paid, jnp.sum(paid), None, decisions=kept)


def test_transitions_by_hand():
    """Seven steps of at most eight, a decision every third."""
    episode = episode_of([1, 2, 3, 4, 5, 6, 7, 0], 7, jnp.array([5, 6, 7]))
    found = transitions(episode, 3)
    np.testing.assert_array_equal(found.kept, [5, 6, 7])
    np.testing.assert_array_equal(found.reward, [6, 15, 7])
    np.testing.assert_array_equal(found.valid, [True, True, True])
    np.testing.assert_array_equal(found.done, [False, False, True])
    short = transitions(episode_of([1, 2, 3, 0, 0, 0, 0, 0], 3, jnp.array([5, 6, 7])), 3)
    np.testing.assert_array_equal(short.valid, [True, False, False])
    np.testing.assert_array_equal(short.done[:1], [True])


def rows_of(numbers: list[int], valid: list[bool], done: list[bool]) -> Transitions:
    kept = jnp.asarray(numbers)
    return Transitions(kept, kept.astype(jnp.float32), jnp.asarray(done), jnp.asarray(valid))


def test_the_replay_keeps_what_is_valid_in_order():
    replay = empty_replay(jnp.int32(0), num_decisions=3, num_episodes=2)
    replay = remember(replay, rows_of([1, 2, 3], [True, True, False], [False, True, False]))
    replay = remember(replay, rows_of([4, 5, 6], [True, True, True], [False, False, True]))
    assert replay.size == 5
    np.testing.assert_array_equal(replay.rows.kept[:5], [1, 2, 4, 5, 6])
    now, after = draw(jax.random.key(0), replay, 500)
    assert set(np.asarray(now.kept)) == {1, 2, 4, 5, 6}  # never a row that was not written
    follows = {1: 2, 4: 5, 5: 6}
    for first, second, done in zip(now.kept, after.kept, now.done, strict=True):
        assert bool(done) or follows[int(first)] == int(second)


def test_targets_do_not_bootstrap_at_the_end():
    found = targets(
        jnp.array([1.0, 2.0]), jnp.array([False, True]), jnp.array([[3.0, 5.0], [7.0, 9.0]]), 0.9
    )
    np.testing.assert_allclose(found, [1 + 0.9 * 5, 2.0])


@pytest.mark.parametrize("num", [2, 5, 225])
@pytest.mark.parametrize("epsilon", [0.0, 0.1, 1.0])
def test_the_divergence_from_the_prior(num, epsilon):
    log_p = jax.nn.log_softmax(jax.random.normal(jax.random.key(num), (num,)))
    pi = np.full(num, epsilon / num)
    pi[1] += 1 - epsilon
    expected = sum(p * (np.log(p) - log_p[i]) for i, p in enumerate(pi) if p > 0)
    found = greedy_divergence(jnp.float32(epsilon), jnp.int32(1), log_p)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def learner(hyper: PtgmHyper, params: Any, num_episodes: int = 12) -> Ptgm:
    return Ptgm(replace(SETTING, num_episodes=num_episodes), params, hyper)


def test_the_q_function_is_that_of_value_iteration(params):
    """A chain of five states: goal 1 goes right, any other left, and the last step right pays 1."""
    ptgm = learner(PtgmHyper(batch_size=32, kl=0.0, discount=0.9, learning_rate=3e-3), params, 10)
    state = ptgm.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))
    num, width = 4, CONFIG.embed_dim
    rows = []
    for place in range(num):
        for goal in range(CONFIG.goal_dim):
            right = goal == 1
            over = right and place == num - 1
            after = min(place + 1, num - 1) if right else max(place - 1, 0)
            rows += [(place, goal, float(over), over), (after, 0, 0.0, True)]
    places, goals, rewards, done = map(np.array, zip(*rows, strict=True))
    valid = np.ones(len(rows), bool)
    new = Transitions(
        Kept(jnp.eye(width)[places], jnp.asarray(goals), jnp.zeros(len(rows))),
        jnp.asarray(rewards, jnp.float32),
        jnp.asarray(done),
        jnp.asarray(valid),
    )
    replay = remember(empty_replay(jax.tree.map(lambda leaf: leaf[0], new.kept), len(rows), 1), new)
    # The rows of what follows are no decisions of their own: their values would be learned as 0.
    even = np.arange(0, len(rows), 2)

    def update(carry, key):
        index = jnp.asarray(even)[jax.random.randint(key, (32,), 0, len(even))]
        now, after = (jax.tree.map(lambda r, i=i: r[i], replay.rows) for i in (index, index + 1))
        return ptgm.improved(carry, now, after), None

    keys = jax.random.split(jax.random.key(1), 3_000)
    state, _ = jax.jit(lambda state: jax.lax.scan(update, state, keys))(state)
    found = ptgm.q.apply(state.params, jnp.eye(width)[:num])
    best = 0.9 ** np.arange(num - 1, -1, -1)
    np.testing.assert_allclose(found[:, 1], best, atol=0.03)
    left = 0.9 * best[[0, 0, 1, 2]]
    np.testing.assert_allclose(found[:, 0], left, atol=0.03)
    assert state.updates == 3_000


def test_a_weight_of_zero_is_q_learning_without_a_prior(params):
    """What the prior says then changes no bit."""
    hyper = PtgmHyper(batch_size=4, kl=0.0)
    task, goal = ENV.sample_task(jax.random.key(2)), jnp.zeros(CONFIG.goal_dim)
    other = jax.tree.map(jnp.copy, params)
    (name,) = [name for name in other["params"] if "prior" in name]
    other["params"][name] = jax.tree.map(lambda leaf: 3 * leaf + 1, other["params"][name])

    def learned(low: Any, hyper: PtgmHyper) -> Any:
        ptgm = learner(hyper, low)
        state = ptgm.init(jax.random.key(0), goal)
        choice, state = ptgm.ask(jax.random.key(1), state)

        @jax.jit
        def told(state: Any) -> Any:
            episode = run_episode(jax.random.key(1), ENV, ptgm.agent(state, choice), task)
            episodes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], episode)
            return ptgm.tell(jax.random.key(3), state, choice, episodes)

        return told(state).params

    first, *others = (
        jax.tree.leaves(learned(low, replace(hyper, kl_of=kl_of)))
        for low, kl_of in ((params, "policy"), (other, "policy"), (other, "goal"))
    )
    for second in others:
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)
    weighed = jax.tree.leaves(learned(other, replace(hyper, kl=0.5)))
    assert any(np.any(np.asarray(a != b)) for a, b in zip(first, weighed, strict=True))


def test_the_target_is_replaced_every_tenth_update(params):
    ptgm = learner(PtgmHyper(batch_size=4), params)
    state = ptgm.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))
    key, task = jax.random.key(1), ENV.sample_task(jax.random.key(2))
    choice, state = ptgm.ask(key, state)
    episodes = jax.tree.map(
        lambda leaf: jnp.asarray(leaf)[None],
        jax.jit(lambda state: run_episode(key, ENV, ptgm.agent(state, choice), task))(state),
    )
    assert episodes.trajectory.length[0] == ENV.spec.horizon
    after = jax.jit(ptgm.tell)(key, state, choice, episodes)
    assert after.updates == after.replay.size == 30  # one for every decision
    for name in ("params", "target"):  # 30 is a multiple of 10
        for new, old in zip(
            jax.tree.leaves(getattr(after, name)), jax.tree.leaves(state.params), strict=True
        ):
            assert np.any(np.asarray(new != old))
    same = jax.tree.map(np.array_equal, after.params, after.target)
    assert all(jax.tree.leaves(same))
    now, following = draw(key, after.replay, 4)
    later = ptgm.improved(after, now, following)
    assert not all(jax.tree.leaves(jax.tree.map(np.array_equal, later.params, later.target)))


@pytest.fixture(scope="module")
def view() -> View:
    return View(*jax.random.normal(jax.random.key(5), (2, CONFIG.embed_dim)))


def rule_of(module: Any, agent: Any, state: Any, choice: Any) -> Any:
    """``(key, view, state of the world) -> decision, what is kept``: the high level of ``agent`` alone."""
    rules = []

    def noted(low: Any, decide: Any, *sizes: Any) -> Any:
        rules.append(decide)
        return hierarchical(low, decide, *sizes)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "hierarchical", noted)
        agent.agent(state, choice)
    return rules[0]


@pytest.mark.parametrize("epsilon", [0.0, 0.25, 1.0])
def test_goals_are_those_of_the_largest_value_but_for_exploration(params, view, epsilon):
    agent = learner(PtgmHyper(), params)
    state = agent.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))
    decide = rule_of(ptgm, agent, state, Choice(jnp.float32(epsilon)))
    keys, num = jax.random.split(jax.random.key(2), 2_000), CONFIG.goal_dim
    goals, kept = jax.jit(jax.vmap(lambda key: decide(key, view, None)))(keys)
    best = jnp.argmax(agent.q.apply(state.params, view.obs))
    shares = np.bincount(goals, minlength=num) / len(keys)
    wanted = epsilon / num + (1 - epsilon) * (np.arange(num) == best)
    np.testing.assert_allclose(shares, wanted, atol=0.05 if epsilon else 0)
    np.testing.assert_array_equal(kept.goal, goals)
    np.testing.assert_array_equal(kept.seen[0], view.obs)
    log_p = log_prior(CONFIG, params, view)
    divergence = greedy_divergence(jnp.float32(epsilon), best, log_p)
    np.testing.assert_allclose(kept.divergence, divergence, rtol=1e-5)


def test_it_explores_in_the_search_and_is_judged_without(params):
    adapter = learner(PtgmHyper(epsilon=0.25), params).adapter()
    state = adapter.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))
    assert adapter.ask(jax.random.key(1), state)[0].epsilon == 0.25
    assert adapter.best(state).epsilon == 0


def test_the_high_level_sees_what_its_settings_say(view):
    goal = jnp.arange(CONFIG.goal_dim, dtype=jnp.float32)
    for reads, part in (("observation", view.obs), ("history", view.features)):
        alone, beside = (
            seen_by(PtgmHyper(reads=reads, sees_goal=sees), view, goal) for sees in (False, True)
        )
        np.testing.assert_array_equal(alone, part)
        np.testing.assert_array_equal(beside, [*part, *goal])


def test_the_divergence_from_the_prior_is_taken_off_the_rewards(params):
    """Of seven steps that pay 1 each, with a decision every third."""
    agent = learner(PtgmHyper(kl=0.5), params)
    agent._update = lambda key, state: state  # nothing is learned
    state = agent.init(jax.random.key(0), jnp.zeros(CONFIG.goal_dim))
    num = ENV.spec.horizon // 3
    away = jnp.arange(1.0, num + 1)
    kept = Kept(jnp.zeros((num, CONFIG.embed_dim)), jnp.zeros(num, jnp.int32), away)
    rewards = [1.0] * 7 + [0.0] * (ENV.spec.horizon - 7)
    episodes = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], episode_of(rewards, 7, kept))
    choice, _ = agent.ask(jax.random.key(1), state)
    after = agent.tell(jax.random.key(1), state, choice, episodes)
    assert after.replay.size == 3
    np.testing.assert_allclose(after.replay.rows.reward[:3], [3 - 0.5, 3 - 1.0, 1 - 1.5])


def test_lanes_side_by_side_equal_lanes_alone(params):
    ptgm = learner(PtgmHyper(batch_size=16), params)
    tasks = jax.vmap(ENV.sample_task)(jax.random.split(jax.random.key(0), 3))
    keys = jax.random.split(jax.random.key(1), 3)

    def returns(key, task):
        return search(key, ENV, ptgm.adapter(), task, 4).log.returns

    together = jax.jit(jax.vmap(returns))(keys, tasks)
    alone = jax.jit(returns)
    for lane in range(3):
        task = jax.tree.map(lambda leaf, lane=lane: leaf[lane], tasks)
        np.testing.assert_allclose(together[lane], alone(keys[lane], task))


def test_the_task_goal_is_seen_where_it_is_asked_for(params):
    """Of two task goals, the high level of one variant tells the difference."""
    goals = jnp.eye(CONFIG.goal_dim)[:2]
    for hyper, differs in ((PtgmHyper(), False), (PtgmGoalHyper(), True)):
        ptgm = learner(hyper, params)
        task = ENV.sample_task(jax.random.key(0))
        seen = []
        for goal in goals:
            state = ptgm.init(jax.random.key(0), goal)
            choice, state = ptgm.ask(jax.random.key(1), state)
            seen.append(run_episode(jax.random.key(2), ENV, ptgm.agent(state, choice), task))
        kept = [episode.decisions.seen[0] for episode in seen]
        assert np.any(np.asarray(kept[0] != kept[1])) == differs


def test_a_budget_without_an_update_is_refused():
    with pytest.raises(UsageError, match=r"2 episodes hold at most 60 decisions.*raise --episodes"):
        methods.find("ptgm").check_use(replace(SETTING, num_episodes=2), PtgmHyper())


def test_another_kind_of_network_is_refused():
    with pytest.raises(UsageError, match=r"ucb starts from a network of the kind mgpo.*ptgm"):
        methods.find("ucb").check_use(SETTING, methods.find("ucb").hyper())


def test_a_world_without_goals_to_choose_from_is_refused():
    from test_finetune import Chain

    with pytest.raises(NotAvailableError, match="does not define goal_set"):
        complete(CONFIG, Chain(), None)


def test_the_expert_of_the_maze_follows_a_shortest_path():
    maze = envs.make("maze15")
    task = maze.sample_task(jax.random.key(4))
    state, _ = maze.reset(jax.random.key(0), task)
    steps = int(maze._shortest_path(task))
    for num in (1, 5, steps, steps + 7):
        goal = maze.expert_goal(state, num)
        cell = jnp.round(goal * maze.side).astype(jnp.int32)
        there = replace_start(maze, task, cell)
        assert there == max(steps - num, 0)


def replace_start(maze: Any, task: Any, cell: Any) -> int:
    """Steps that are left from a cell to the goal."""
    from envs.maze.bitboard import distances

    return int(distances(task.maze == 0, task.goal)[tuple(cell)])


def test_policies_of_this_kind_are_kept_on_disk(tmp_path, params):
    from mgpo_jax.policy_files import load_policy, save_policy

    save_policy(tmp_path / "low", CONFIG, params, {})
    found = load_policy("gridworld", tmp_path / "low", "ptgm")
    assert found.config == CONFIG
    assert isinstance(found, LoadedPolicy)
    with pytest.raises(UsageError, match="of the kind ptgm, one of the kind mgpo is needed"):
        load_policy("gridworld", tmp_path / "low")
