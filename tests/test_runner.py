"""Many adaptations in one program: variants and groups only change speed, judgements are averages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.base import Environment, TimeStep
from envs.episodes import replay
from envs.errors import DataError, NotAvailableError, UsageError
from envs.gridworld.env import GridWorld
from envs.maze.env import MazeRunner
from envs.registry import Judgement
from envs.specs import ArraySpec, Box, Engine, EnvSpec
from envs.wrappers import Noisy, Wrapper
from mgpo_jax import judging, lanes, runner
from mgpo_jax.adaptation import Adapter
from mgpo_jax.distributions import Categorical
from mgpo_jax.judging import evaluate, evaluate_fully, play, uncertainty
from mgpo_jax.lanes import cache_bytes, lanes_together, lay_out
from mgpo_jax.methods import GCBC, UCB, Method, NoHyper, UcbHyper
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.programs import judge_key
from mgpo_jax.prompts import Prompt, single_goal
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.runner import adapt, log_bytes, sweep
from mgpo_jax.settings import NotNegative
from mgpo_jax.tasks import sample_tasks, task_at
from mgpo_jax.transformer import GoalTransformer

MAZE = MazeRunner(name="tiny", side=7, horizon=10)
GRID = GridWorld(name="tiny", horizon=20)


@dataclass(frozen=True)
class Point(Environment):
    """Move a point in the unit square to a goal; it slips at random."""

    horizon: int = 6

    @property
    def spec(self):
        return EnvSpec(
            name="point",
            obs=ArraySpec((2,)),
            goal_dim=2,
            actions=Box(2),
            horizon=self.horizon,
            return_range=(-2.0 * self.horizon, 0.0),
            deterministic=False,
        )

    def sample_task(self, key):
        return jax.random.uniform(key, (2,))

    def task_goal(self, task):
        return task

    def reset(self, key, task):
        state = (task, jnp.full(2, 0.5), jnp.int32(0), key)
        return state, self._observe(state, 0.0)

    def step(self, state, action):
        task, place, time, key = state
        key, key_slip = jax.random.split(key)
        slip = 0.1 * jax.random.normal(key_slip, (2,))
        moved = jnp.clip(place + 0.2 * action + slip, 0.0, 1.0)
        over = time >= self.horizon
        state = (task, jnp.where(over, place, moved), time + ~over, key)
        return state, self._observe(state, jnp.where(over, 0.0, -jnp.abs(moved - task).sum()))

    def _observe(self, state, reward):
        _, place, time, _ = state
        return TimeStep(
            obs=place,
            achieved_goal=place,
            goal_reached=jnp.ones((), bool),
            outcome=place,
            reward=jnp.asarray(reward, jnp.float32),
            terminated=jnp.zeros((), bool),
            truncated=time >= self.horizon,
        )


def untrained(env, seed=1):
    """A policy with weights large enough to act differently under different prompts."""
    spec, scale = env.spec, 0.1 if env == GRID else 0.5
    config = network_config(
        spec, max_prompt_length=3, embed_dim=8, num_layers=1, num_heads=1, dropout=0.0
    )
    prompt = Prompt(jnp.zeros((3, spec.goal_dim)), jnp.ones(3, bool))
    actions = jnp.zeros(2, jnp.int32) if spec.discrete else jnp.zeros((2, spec.action_dim))
    inputs = (prompt, jnp.zeros((2, *spec.obs.shape)), actions)
    shapes = jax.eval_shape(GoalTransformer(config).init, jax.random.key(0), *inputs)
    rng = np.random.default_rng(seed)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(scale * rng.standard_normal(leaf.shape), leaf.dtype), shapes
    )
    return LoadedPolicy(config, params, {})


def tasks_of(env):
    """Some where a policy that knows nothing earns something now and then."""
    seed, num, rows = {MAZE: (5, 40, (1, 4, 8)), GRID: (5, 16, (0, 2, 5))}.get(
        env, (5, 3, (0, 1, 2))
    )
    return jax.tree.map(lambda leaf: leaf[jnp.array(rows)], sample_tasks(env, seed, num))


OPTIONS = {"seeds": 2, "episodes": 6, "eval_every": 4}
VARIANTS = [UcbHyper(c=0.0, max_goals=1), UcbHyper(c=10.0, max_goals=3)]
THREE = Judgement(episodes=3)


@cache
def run_of(env, method, judged=None):
    """A run that several tests look at."""
    hyper = {"c": 10.0, "max_goals": 3} if method == "ucb" else None
    options = OPTIONS | {"judged": judged, "keep_actions": True}
    return adapt(env, untrained(env), tasks_of(env), method, hyper, **options)


@pytest.fixture(scope="module")
def tasks():
    return tasks_of(MAZE)


@pytest.fixture(scope="module")
def maze_run(tasks):
    return partial(sweep, MAZE, untrained(MAZE), tasks, UCB, **OPTIONS)


@pytest.fixture(scope="module")
def swept(maze_run):
    return maze_run(VARIANTS)


def assert_same(a, b):
    """Equal but for rounding and for what depends on speed."""
    a, b = a._replace(cpu_seconds=0.0), b._replace(cpu_seconds=0.0)
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), a, b)


def test_a_sweep_equals_single_runs(maze_run, swept):
    for variant, outcome in zip(VARIANTS, swept, strict=True):
        assert_same(maze_run([variant])[0], outcome)


def test_variants_differ(swept):
    goals = [outcome.choices.prompt.mask.sum(axis=-1).max() for outcome in swept]
    assert goals[0] == 1
    assert goals[1] > 1


def test_groups_do_not_matter(maze_run, swept, monkeypatch):
    """Not even when lanes have to be made up to fill the last group."""
    monkeypatch.setattr(lanes, "lanes_together", lambda env, memory_bytes: 4)
    for small, outcome in zip(maze_run(VARIANTS), swept, strict=True):
        assert_same(small, outcome)


@dataclass(frozen=True)
class InGroups(Wrapper):
    """A world that is stepped in groups of ``num``."""

    num: int = 1

    @property
    def engine(self):
        return Engine(worlds_together=self.num)


def test_a_world_may_ask_for_company():
    memory = cache_bytes(untrained(MAZE).config)
    alone = lanes_together(MAZE, memory)
    assert lanes_together(InGroups(MAZE, 1), memory) == alone
    assert lanes_together(InGroups(MAZE, alone + 5), memory) == alone + 5
    assert lay_out(InGroups(MAZE, 1000), 60, memory).group == 60 // jax.device_count()


def test_groups_are_as_large_as_what_their_agents_remember():
    """The cache at the end of an episode, and whatever else an agent carries."""
    policy, tasks = untrained(MAZE), sample_tasks(MAZE, 5, 1)
    setting = runner.Setting(MAZE, policy.config, 6, Judgement())
    adapter = UCB.adapter(setting, policy.params, UcbHyper())
    found = runner._memory_bytes(MAZE, adapter, tasks)
    # Beside the keys and values: the mask of 3 slots, a counter and the last action.
    assert found == cache_bytes(policy.config) + 3 + 4 + 4


def test_a_run_is_a_sweep_of_one(swept, tasks):
    assert_same(run_of(MAZE, "ucb"), swept[1])
    assert_same(adapt(MAZE, untrained(MAZE), tasks, UCB, VARIANTS[1], **OPTIONS), swept[1])


def test_judgements_stand_beside_the_search(swept):
    outcome = swept[1]
    np.testing.assert_array_equal(outcome.eval_episodes, [1, 4, 6])
    assert outcome.eval_returns.shape == (2, 3, 3)
    # In a world without chance the search's own first episode is the first judgement.
    np.testing.assert_allclose(outcome.returns[:, :, 0], outcome.eval_returns[:, :, 0])
    assert outcome.num_episodes == 2 * 3 * (6 + 3)
    assert outcome.num_failed == 0
    assert not outcome.failed.any()


def test_chance_is_averaged_out():
    """Each judgement in a world of random starts is the mean of many episodes, where it is asked for."""
    assert run_of(GRID, "ucb", THREE).num_episodes == 2 * 3 * (6 + 3 * 3)
    assert np.isfinite(run_of(GRID, "ucb", THREE).eval_returns).all()
    assert run_of(MAZE, "ucb").num_episodes == 2 * 3 * (6 + 3)


def test_prompts_evaluated_again_have_the_same_returns(swept, tasks):
    outcome = swept[1]
    best = jax.tree.map(lambda leaf: leaf[:, :, -1], outcome.best)
    again = partial(evaluate, policy=untrained(MAZE), tasks=tasks, queries=best)
    returns, num_failed = again(MAZE, episodes=2)
    assert num_failed == 0
    np.testing.assert_allclose(returns, outcome.eval_returns[:, :, -1], atol=1e-5)
    # Nothing but noise: every action is random, whatever the prompt.
    blind, _ = again(Noisy(MAZE, action_noise=1.0), episodes=40)
    assert blind.shape == returns.shape
    assert not np.allclose(blind, returns)
    np.testing.assert_allclose(blind[0], blind[1], atol=0.4)


@pytest.mark.parametrize(
    ("env", "judged"),
    [(MAZE, None), (GRID, THREE), pytest.param(Point(), THREE, marks=pytest.mark.optimized)],
)
def test_a_policy_that_never_adapts_is_judged_like_a_search_before_it_begins(env, judged):
    """Bit for bit: the same prompt in the same episodes."""
    search, fixed = run_of(env, "ucb", judged), run_of(env, "gcbc", judged)
    np.testing.assert_array_equal(search.eval_returns[:, :, 0], fixed.eval_returns[:, :, 0])
    assert (fixed.choices.prompt.mask.sum(axis=-1) == 1).all()
    assert fixed.choices.greedy.all()
    if env == MAZE:
        for column in range(3):
            np.testing.assert_array_equal(
                fixed.eval_returns[:, :, column], search.eval_returns[:, :, 0]
            )
    if env == Point():
        assert (fixed.eval_returns[:, :, 1] != fixed.eval_returns[:, :, 0]).all()


def played_again(env, tasks, outcome):
    """All episodes of an outcome, from their keys and actions: ``[S, N, E, ..]``."""
    keys = jax.random.wrap_key_data(jnp.asarray(outcome.keys))
    lengths = np.full(keys.shape, env.spec.horizon)
    if env.spec.discrete:
        lengths = (outcome.actions != 255).sum(axis=-1)

    def one(key, task, actions, length):
        return replay(key, env, task, actions, length)

    over_episodes = jax.vmap(one, in_axes=(0, None, 0, 0))
    over_seeds = jax.vmap(jax.vmap(over_episodes), in_axes=(0, None, 0, 0))
    return jax.tree.map(np.asarray, jax.jit(over_seeds)(keys, tasks, outcome.actions, lengths))


@pytest.mark.parametrize(("env", "judged"), [(MAZE, None), (GRID, THREE)])
def test_logged_episodes_can_be_played_again(env, judged):
    tasks, outcome = tasks_of(env), run_of(env, "ucb", judged)
    assert outcome.actions.dtype == np.uint8
    assert outcome.actions.shape == (2, 3, 6, env.spec.horizon)
    assert len(np.unique(outcome.returns)) > 1
    again = played_again(env, tasks, outcome)
    np.testing.assert_allclose(again.return_, outcome.returns, atol=1e-6)
    if env is GRID:
        np.testing.assert_array_equal(again.return_, outcome.returns)
    trajectory = again.trajectory
    real = np.arange(env.spec.horizon) < trajectory.length[..., None]
    np.testing.assert_array_equal(np.where(real, trajectory.actions, 255), outcome.actions)
    # The goals that are kept are those reached, episode by episode.
    reached = trajectory.goal_reached & real
    np.testing.assert_array_equal(outcome.reached.counts, reached.sum(axis=-1))
    np.testing.assert_array_equal(outcome.reached.steps, np.nonzero(reached)[-1])
    np.testing.assert_allclose(outcome.reached.goals, trajectory.achieved_goals[reached], atol=1e-6)
    assert len(outcome.reached.goals) == outcome.reached.counts.sum() > 0


def test_continuous_actions_are_kept_where_asked_for():
    env, tasks = Point(), tasks_of(Point())
    options = {"seeds": 1, "episodes": 1, "eval_every": 1}
    assert adapt(env, untrained(env), tasks, "gcbc", **options).actions is None
    outcome = run_of(env, "ucb", THREE)
    assert outcome.actions.shape == (2, 3, 6, 6, 2)
    assert np.issubdtype(outcome.actions.dtype, np.floating)
    again = played_again(env, tasks, outcome)
    np.testing.assert_allclose(again.return_, outcome.returns, rtol=1e-5)
    np.testing.assert_array_equal(outcome.reached.counts, 6)
    np.testing.assert_array_equal(outcome.reached.steps, np.tile(np.arange(6), 2 * 3 * 6))
    np.testing.assert_allclose(
        outcome.reached.goals, again.trajectory.achieved_goals.reshape(-1, 2), atol=1e-5
    )


@pytest.fixture
def compilations():
    """The names of all programs that are compiled from now on."""
    names = []

    def listen(event, duration, **facts):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(facts.get("fun_name", event))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


def test_a_sweep_compiles_once(tasks, compilations):
    """However many values it tries; other values and another policy of the same sizes compile nothing."""
    options = {"seeds": 1, "episodes": 3, "eval_every": 3}
    run = partial(sweep, MAZE, tasks=tasks, method=UCB, **options)
    first = run(policy=untrained(MAZE), hypers=[UcbHyper(c=c) for c in (0.0, 1.0, 5.0)])
    assert len([name for name in compilations if "on_device" in name]) == 2  # start and advance
    compilations.clear()
    other = run(policy=untrained(MAZE), hypers=[UcbHyper(c=c) for c in (2.0, 0.5, 7.0)])
    trained = run(policy=untrained(MAZE, seed=2), hypers=[UcbHyper(c=c) for c in (0.0, 1.0, 5.0)])
    assert compilations == []
    assert other[0].returns.shape == first[0].returns.shape
    assert (trained[0].returns != first[0].returns).any()


@pytest.mark.parametrize(
    "options", [{"episodes": 0}, {"episodes": 4, "eval_every": 0}, {"episodes": 4, "seeds": 0}]
)
def test_budgets_are_positive(tasks, options):
    with pytest.raises(UsageError, match="at least 1"):
        adapt(MAZE, untrained(MAZE), tasks, "gcbc", **options)


def test_policies_can_be_judged_by_sampling(tasks):
    """At a temperature near 0 as greedily as can be; the search stays the same."""
    greedy = run_of(MAZE, "ucb")
    sampled, cold = (
        run_of(MAZE, "ucb", Judgement("sample", temperature, episodes=4))
        for temperature in (1.0, 1e-6)
    )
    for outcome in (sampled, cold):
        np.testing.assert_allclose(outcome.returns, greedy.returns, atol=1e-6)
        np.testing.assert_array_equal(outcome.actions, greedy.actions)
        assert not outcome.best.greedy.any()
    np.testing.assert_allclose(cold.eval_returns, greedy.eval_returns, atol=1e-6)
    assert np.abs(sampled.eval_returns - greedy.eval_returns).max() > 0.05
    np.testing.assert_array_equal(cold.best.temperature, np.float32(1e-6))
    assert sampled.best.temperature is None
    # A prompt that is judged by sampling is evaluated so, too.
    best = jax.tree.map(lambda leaf: leaf[:, :, -1], cold.best)
    returns, _ = evaluate(MAZE, untrained(MAZE), tasks, best, episodes=2)
    np.testing.assert_allclose(returns, greedy.eval_returns[:, :, -1], atol=1e-6)


def test_the_episodes_that_judge_are_those_of_play(tasks):
    """What is judged is what anyone sees who lets the policy play."""
    policy, env = untrained(GRID), GRID
    grid_tasks = sample_tasks(env, 5, 2)
    judged = Judgement("sample", 0.5, episodes=5)
    outcome = adapt(env, policy, grid_tasks, "gcbc", seeds=1, episodes=1, judged=judged)
    for index in range(2):
        task = task_at(grid_tasks, index)
        prompt = single_goal(env.task_goal(task), 3)
        query = Query(prompt, jnp.zeros((), bool), jnp.float32(0.5))
        lane_key = jax.random.split(jax.random.key(0), 2)[index]
        for when in range(2):
            key = judge_key(lane_key, when)
            episodes = play(key, env, policy, task, query, 5)
            assert isinstance(episodes.return_, np.ndarray)
            np.testing.assert_allclose(
                episodes.return_.mean(), outcome.eval_returns[0, index, when], atol=1e-6
            )


@dataclass(frozen=True)
class Named(Wrapper):
    """A world whose first goals have names."""

    goal_names: tuple[str, ...] = ("one", "two", "three")


def test_named_goals_are_counted_in_judging_episodes():
    """By what the episodes have reached at their ends; everything else stays the same."""
    policy, env, grid_tasks = untrained(GRID), Named(GRID), tasks_of(GRID)
    judged = Judgement("sample", episodes=20)
    options = {"seeds": 1, "episodes": 2, "eval_every": 2, "judged": judged}
    outcome = adapt(env, policy, grid_tasks, "gcbc", **options)
    plain = adapt(GRID, policy, grid_tasks, "gcbc", **options)
    assert plain.eval_achieved is None
    assert_same(outcome._replace(eval_achieved=None), plain)
    assert outcome.eval_achieved.shape == (1, 3, 2, 3)
    for index in range(3):
        task = task_at(grid_tasks, index)
        query = Query(single_goal(env.task_goal(task), 3), jnp.zeros((), bool))
        lane_key = jax.random.split(jax.random.key(0), 3)[index]
        for when in range(2):
            played = play(judge_key(lane_key, when), env, policy, task, query, 20)
            last = played.trajectory.length - 1
            ends = played.trajectory.outcomes[np.arange(20), last, :3]
            np.testing.assert_allclose(
                outcome.eval_achieved[0, index, when], (ends > 0.5).mean(axis=0), atol=1e-6
            )
    assert 0 < outcome.eval_achieved.mean() < 1
    best = jax.tree.map(lambda leaf: leaf[:, :, -1], outcome.best)
    again = evaluate_fully(env, policy, grid_tasks, best, episodes=20)
    assert again.achieved.shape == (1, 3, 3)
    np.testing.assert_allclose(again.achieved, outcome.eval_achieved[:, :, 0], atol=0.4)
    assert evaluate_fully(GRID, policy, grid_tasks, best, episodes=2).achieved is None
    few = jax.tree.map(lambda leaf: leaf[:2], grid_tasks)
    with pytest.raises(UsageError, match="there are 2 tasks, and queries for 3"):
        evaluate_fully(GRID, policy, few, best, episodes=2)


def test_no_judgement_has_the_key_of_the_search():
    """Its splits are the keys of the episodes of the search."""
    key = jax.random.key(7)
    search = jax.random.key_data(jax.random.split(key)[1])
    found = [jax.random.key_data(judge_key(key, number)) for number in range(5)]
    assert not any((data == search).all() for data in found)
    assert len({tuple(data.tolist()) for data in found}) == 5
    assert (found[3] == jax.random.key_data(jax.random.fold_in(key, 3))).all()


def test_the_memory_of_a_log_includes_the_actions_that_it_keeps():
    env = Point(horizon=10)
    goals, actions = env.spec.goal_dim, env.spec.action_dim
    assert log_bytes(env, 2, 3) == 2 * 3 * 10 * (8 * goals + 4)
    assert log_bytes(env, 2, 3, keep_actions=True) == 2 * 3 * 10 * (8 * goals + 4 + 4 * actions)
    assert log_bytes(MAZE, 2, 3, keep_actions=True) == log_bytes(MAZE, 2, 3)


@dataclass(frozen=True)
class LearnerHyper(NoHyper):
    rate: NotNegative = 0.5
    label: str = ""


def make_learner(setting, params, hyper, tell_in_turn=False):
    """Three episodes a round of a policy under (g^M); what it learns is a number."""
    inner = GCBC.adapter(setting, params, NoHyper())

    def tell(key, state, choice, episodes):
        prompt, total = state
        assert episodes.return_.shape == (3,)
        return prompt, total + hyper.rate * episodes.return_.sum()

    return Adapter(
        init=lambda key, goal: (inner.init(key, goal), jnp.zeros(())),
        ask=lambda key, state: ((inner.ask(key, state[0])[0], state[1]), state),
        agent=lambda state, choice: inner.agent(state[0], choice[0]),
        tell=tell,
        best=lambda state: (inner.best(state[0]), state[1]),
        episodes_per_round=3,
        tell_in_turn=tell_in_turn,
    )


LEARNER = Method(name="learner", make=make_learner, hyper=LearnerHyper)
PATIENT = Method(name="patient", make=partial(make_learner, tell_in_turn=True), hyper=LearnerHyper)


@pytest.mark.parametrize("method", [LEARNER, PATIENT])
def test_methods_of_several_episodes_a_round(method):
    """All episodes count; hyper-parameters are data for updates in turn as well."""
    tasks = tasks_of(GRID)
    hypers = [LearnerHyper(rate=rate) for rate in (0.5, 2.0)]
    outcomes = sweep(
        GRID, untrained(GRID), tasks, method, hypers, seeds=2, episodes=9, eval_every=6,
        judged=Judgement(episodes=2),
    )  # fmt: skip
    for hyper, outcome in zip(hypers, outcomes, strict=True):
        assert outcome.returns.shape == (2, 3, 9)
        assert outcome.keys.shape == (2, 3, 9, 2)
        assert outcome.actions.shape == (2, 3, 9, 20)
        np.testing.assert_array_equal(outcome.eval_episodes, [1, 6, 9])
        assert outcome.num_episodes == 2 * 3 * (9 + 3 * 2)
        told = np.cumsum(outcome.returns.reshape(2, 3, 3, 3).sum(axis=-1), axis=-1)
        np.testing.assert_allclose(outcome.best[1], hyper.rate * told, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(
            outcome.choices[1][:, :, 1:], hyper.rate * told[:, :, :-1], rtol=1e-4, atol=1e-5
        )
        again = played_again(GRID, tasks, outcome)
        np.testing.assert_array_equal(again.return_, outcome.returns)
        np.testing.assert_array_equal(
            outcome.reached.counts, again.trajectory.goal_reached.sum(axis=-1)
        )
    # The judging episodes are those of every other method.
    np.testing.assert_array_equal(outcomes[0].eval_returns, nine_fixed().eval_returns)


@cache
def nine_fixed():
    return adapt(
        GRID, untrained(GRID), tasks_of(GRID), "gcbc", seeds=2, episodes=9, eval_every=6,
        judged=Judgement(episodes=2),
    )  # fmt: skip


@pytest.mark.parametrize("changes", [{"episodes": 10}, {"eval_every": 4}])
def test_budgets_and_judgements_fall_between_rounds(changes):
    options = {"seeds": 1, "episodes": 9, "eval_every": 3} | changes
    with pytest.raises(UsageError, match=r"runs 3 episodes in a round: .* multiples of 3"):
        adapt(GRID, untrained(GRID), sample_tasks(GRID, 5, 1), LEARNER, **options)


@dataclass(frozen=True)
class Fragile(Wrapper):
    """Breaks down in the third step of every episode."""

    def reset(self, key, task):
        state, timestep = self.env.reset(key, task)
        whole = jnp.zeros((), bool)
        return (jnp.int32(0), state), timestep._replace(failed=whole)

    def step(self, state, action):
        time, inner = state
        inner, timestep = self.env.step(inner, action)
        broken = time >= 2
        truncated = (timestep.truncated | broken) & ~timestep.terminated
        failed = broken & ~timestep.terminated
        return (time + 1, inner), timestep._replace(truncated=truncated, failed=failed)


def make_diverging(setting, params, hyper):
    """Keeps the prompt (g^M), and learns NaN in the second round."""
    base = GCBC.adapter(setting, params, hyper)
    return Adapter(
        init=lambda key, task_goal: (base.init(key, task_goal), jnp.ones(())),
        ask=lambda key, state: (base.ask(key, state[0])[0], state),
        agent=lambda state, choice: base.agent(state[0], choice),
        tell=lambda key, state, choice, episodes: (state[0], jnp.sqrt(state[1] - 1) / state[1]),
        best=lambda state: base.best(state[0]),
    )


def test_a_search_that_diverges_ends_with_one_line(tasks):
    method = Method(name="diverging", make=make_diverging)
    with pytest.raises(DataError, match=r"task 0 with seed number 0 has diverged.* after 2 rounds"):
        sweep(MAZE, untrained(MAZE), tasks, method, [NoHyper()], episodes=4, eval_every=2)


def test_broken_worlds_are_counted(tasks):
    env = Fragile(GRID)
    grid_tasks = sample_tasks(GRID, 5, 2)
    outcome = adapt(env, untrained(GRID), grid_tasks, "ucb", **OPTIONS)
    assert outcome.failed.shape == outcome.returns.shape
    assert outcome.failed.all()
    assert outcome.num_failed == 2 * 2 * (6 + 3)
    assert (outcome.actions[..., 3:] == 255).all()
    best = jax.tree.map(lambda leaf: leaf[:, :, -1], outcome.best)
    assert evaluate(env, untrained(GRID), grid_tasks, best, episodes=2)[1] == 2 * 2 * 2


def test_methods_say_what_they_cannot_do(tasks):
    run = partial(adapt, MAZE, untrained(MAZE), tasks)
    with pytest.raises(UsageError, match="--max-goals 4 is longer than the policy's prompts"):
        run("ucb", {"max_goals": 4})
    with pytest.raises(UsageError, match="--num-edits is not a setting of ucb"):
        run("ucb", {"num_edits": 4})
    with pytest.raises(UsageError, match="did you mean 'grips'"):
        run("grip")
    with pytest.raises(UsageError, match="point draws no goals at random"):
        adapt(Point(), untrained(Point()), sample_tasks(Point(), 5, 1), "grips")
    with pytest.raises(UsageError, match="scale cannot be swept, because it changes"):
        sweep(MAZE, untrained(MAZE), tasks, UCB, [UcbHyper(), UcbHyper(scale=1.0)])


@pytest.mark.parametrize(
    "changes", [{"episodes": 0}, {"temperature": 0.0}, {"temperature": float("nan")}]
)
def test_judgements_that_say_nothing(changes):
    with pytest.raises(
        UsageError, match="needs a finite temperature above 0 and at least one episode"
    ):
        Judgement("sample", **changes)


def test_judgements_have_one_of_two_modes():
    judged = Judgement()
    object.__setattr__(
        judged, "mode", "sampled"
    )  # tests check types of arguments, users' programs do not
    with pytest.raises(UsageError, match="must be greedy or sample, found 'sampled'"):
        judged.__post_init__()


def test_uncertainty_is_that_of_the_steps_of_the_episode(tasks):
    """Step by step, with the policy's own decoding, along the episodes that the runner plays."""
    policy, num = untrained(MAZE), len(tasks.goal)
    prompts = jax.vmap(lambda task: single_goal(MAZE.task_goal(task), 3))(tasks)
    query = jax.tree.map(lambda leaf: leaf[None], Query(prompts, jnp.zeros(num, bool)))
    found = uncertainty(MAZE, policy, tasks, query, seed=3)
    assert found.entropy.shape == found.return_.shape == found.num_steps.shape == (1, num)
    for index, key in enumerate(jax.random.split(jax.random.key(3), num)):
        own = jax.tree.map(lambda leaf, index=index: leaf[0, index], query)
        task = task_at(tasks, index)
        episode = rollout(key, MAZE, policy.policy, task, own)
        length, entropies = int(episode.trajectory.length), []
        distribution, carry = policy.policy.prefill(own.prompt, episode.trajectory.obs[0])
        carry = policy.policy.grow(carry, MAZE.spec.horizon)
        for time in range(length):
            if time:
                before = episode.trajectory.actions[time - 1]
                distribution, carry = policy.policy.decode(
                    carry, before, episode.trajectory.obs[time]
                )
            entropies.append(float(distribution.entropy()))
        assert found.num_steps[0, index] == length
        assert found.return_[0, index] == pytest.approx(float(episode.return_))
        assert found.entropy[0, index] == pytest.approx(np.mean(entropies), rel=1e-4)


def test_a_head_without_entropy_leaves_it_unknown(monkeypatch, tasks):
    def none(distribution):
        raise NotAvailableError("no closed form")

    monkeypatch.setattr(Categorical, "entropy", none)
    prompts = jax.vmap(lambda task: single_goal(MAZE.task_goal(task), 3))(tasks)
    query = Query(prompts, jnp.zeros(len(tasks.goal), bool))
    judging._uncertainty.cache_clear()
    found = uncertainty(MAZE, untrained(MAZE), tasks, jax.tree.map(lambda leaf: leaf[None], query))
    judging._uncertainty.cache_clear()
    assert np.isnan(found.entropy).all()
    assert np.isfinite(found.return_).all()
