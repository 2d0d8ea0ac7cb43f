"""Run the pages' JavaScript outside of a browser, and the same episodes in JAX, for comparison."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.base import Episode
from envs.registry import World
from experiments.pages.build import SCRIPTS, Bundle, as_text
from experiments.pages.playground import world_data
from experiments.pages.worlds import page_of
from mgpo_jax.optimizers.base import SearchSpace
from mgpo_jax.optimizers.ucb import ucb
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import load_policy
from mgpo_jax.prompts import Prompt, goals_of, sample_prompt, single_goal
from mgpo_jax.rollout import Query, rollout
from mgpo_jax.tasks import test_tasks
from mgpo_jax.transformer import GoalTransformer

NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="no node on the PATH runs the JavaScript")
Change = Callable[[str], str]


def run_js(world: World, data: dict[str, Any], change: Change = lambda source: source) -> Any:
    """The result of ``check`` in ``parity.js`` on data of a world; ``change`` can damage the source."""
    bundle = Bundle()
    script = page_of(world).script
    assert script is not None
    assert NODE is not None
    name = bundle.add(script)
    check = f"{bundle.add(SCRIPTS / 'parity.js')}.check"
    source = bundle.source
    changed = change(source)
    call = (
        f"{check}([{name}.world], JSON.parse(require('fs').readFileSync(0, 'utf8')))"
        ".then((found) => require('fs').writeFileSync(1, JSON.stringify(found)));"
    )
    done = subprocess.run(
        [NODE, "-e", changed + call],
        input=as_text(data),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def in_node(
    modules: dict[str, Path], body: str, data: Any = None, with_document: bool = False
) -> Any:
    """The value that JavaScript returns under node.

    Args:
      modules: the modules that it uses; each one's exports are in a variable of this name.
      body: the body of an asynchronous function, which returns a JSON value.
      data: a JSON value, the variable ``data`` of the body.
      with_document: whether there is a document, without layout (``pages_dom.js``).
    """
    assert NODE is not None
    bundle = Bundle()
    names = "".join(f"const {name} = {bundle.add(path)};" for name, path in modules.items())
    document = (Path(__file__).parent / "pages_dom.js").read_text() if with_document else ""
    script = (
        f"{document}\n{bundle.source}{names}"
        "const data = JSON.parse(require('fs').readFileSync(0, 'utf8'));"
        f"(async () => {{ {body} }})().then((found) => {{ "
        "require('fs').writeFileSync(1, JSON.stringify(found ?? null)); process.exit(0); });"
    )
    done = subprocess.run(
        [NODE, "-e", script], input=as_text(data), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def halved(policy: LoadedPolicy) -> LoadedPolicy:
    """The policy with the weights of a page: rounded to half precision, but stored as float32."""
    halves = jax.tree.map(lambda leaf: leaf.astype(jnp.float16).astype(jnp.float32), policy.params)
    return policy._replace(params=halves)


@dataclass(frozen=True)
class Greedy:
    """Greedy episodes of a policy in JAX, and the data that the page needs to replay them."""

    data: dict[str, Any]
    episodes: Episode
    """The episodes, leaves ``[N, ..]``."""
    logits: np.ndarray
    """``[N, T, A]`` logits; only the first ``length`` rows of an episode are valid."""


def played(world: World, num: int, prompts: int, stride: int = 1) -> Greedy:
    """Run greedy episodes under ``prompts`` random prompts on each of ``num`` test tasks."""
    env, policy = world.make(), halved(load_policy(world))
    network, config = GoalTransformer(policy.config), policy.config
    tasks = jax.tree.map(lambda leaf: leaf[: num * stride : stride], test_tasks(world))
    keys = jax.random.split(jax.random.key(7), num * prompts).reshape(num, prompts)

    each = jax.tree.map(lambda leaf: jnp.repeat(leaf, prompts, axis=0), tasks)
    key_first, key_prompt, key_run = jax.vmap(lambda key: jax.random.split(key, 3))(keys.ravel()).T
    goals = jax.vmap(env.task_goal)(each)
    slots = config.max_prompt_length
    # One program serves both, since ``greedy`` is data.
    act = jax.jit(jax.vmap(lambda key, task, query: rollout(key, env, policy.policy, task, query)))
    first = jax.vmap(lambda goal: single_goal(goal, slots))(goals)
    explored = act(key_first, each, Query(first, jnp.zeros(len(goals), bool)))
    draw = jax.vmap(lambda key, seen, goal: sample_prompt(key, seen, goal, slots))
    asked = jax.jit(draw)(key_prompt, explored.trajectory, goals)
    acted = act(key_run, each, Query(asked, jnp.ones(len(goals), bool)))

    @jax.jit
    @jax.vmap
    def full_pass(prompt: Prompt, obs: jax.Array, actions: jax.Array) -> jax.Array:
        return network.apply(policy.params, prompt, obs, actions).logits

    found = full_pass(asked, acted.trajectory.obs, acted.trajectory.actions)
    prompts_, episodes, logits = jax.tree.map(np.asarray, (asked, acted, found))
    page = page_of(world)
    cases = []
    for index in range(num * prompts):
        at = partial(jax.tree.map, lambda leaf, index=index: leaf[index])
        episode = at(episodes)
        one_task = jax.tree.map(lambda leaf, i=index // prompts: np.asarray(leaf[i]), tasks)
        length = int(episode.trajectory.length)
        cases.append(
            {
                "task": page.task(one_task),
                "goals": goals_of(at(prompts_)).tolist(),
                "start": page.start(episode.trajectory.obs[0]) if page.start else None,
                "actions": episode.trajectory.actions[:length].tolist(),
            }
        )
    data = {"worlds": [world_data(world, load_policy(world))], "cases": cases}
    return Greedy(data, episodes, logits)


def differences(greedy: Greedy, found: Any) -> tuple[np.ndarray, list[bool]]:
    """The largest difference of logits in each episode, and whether the page's greedy path equals JAX's.

    The paths may part where two actions are tied within 1e-3.
    """
    largest, same = [], []
    lengths = greedy.episodes.trajectory.length
    for length, logits, actions, case in zip(
        lengths, greedy.logits, greedy.episodes.trajectory.actions, found["cases"], strict=True
    ):
        largest.append(np.abs(np.array(case["logits"]) - logits[:length]).max())
        own = case["own"]
        parts = [t for t in range(min(len(own), length)) if own[t] != actions[t]]
        gap = np.sort(logits[parts[0]])[-2:] if parts else None
        same.append(
            len(own) == length and not parts if gap is None else bool(gap[1] - gap[0] < 1e-3)
        )
    return np.array(largest), same


def searches(
    world: World, which: Sequence[int], num_episodes: int
) -> tuple[dict[str, Any], list[Any]]:
    """Run UCB on some test tasks in JAX; returns all its random numbers, and its prompts and returns."""
    env, policy = world.make(), halved(load_policy(world))
    spec, slots = env.spec, policy.config.max_prompt_length
    space = SearchSpace(
        num_slots=slots,
        horizon=spec.horizon,
        return_range=spec.return_range,
        num_episodes=num_episodes,
        sample_goal=env.sample_goal,
        deterministic=spec.deterministic,
        keep_rewarded=spec.reward_confirms_goals,
    )
    optimizer, page = ucb(space), page_of(world)

    @jax.jit
    def round_(key: jax.Array, state: Any, task: Any) -> tuple[Any, Query, Episode, Any]:
        key_ask, key_run = jax.random.split(key)
        query, state = optimizer.ask(key_ask, state)
        episode = rollout(key_run, env, policy.policy, task, query)
        return (
            optimizer.tell(state, query, episode),
            query,
            episode,
            _draws(key_ask, key_run, env, slots),
        )

    drawn, outcomes = [], []
    for index in which:
        task = jax.tree.map(lambda leaf, i=index: jnp.asarray(leaf[i]), test_tasks(world))
        state = optimizer.init(jax.random.key(0), env.task_goal(task))
        rows: dict[str, list[Any]] = {"starts": [], "integers": [], "uniforms": [], "gumbels": []}
        episodes = []
        for key in jax.random.split(jax.random.key(index), num_episodes):
            state, query, episode, draws = round_(key, state, task)
            start = page.start(np.asarray(episode.trajectory.obs[0])) if page.start else None
            rows["starts"].append(start)
            for name, array in draws.items():
                rows[name].append(np.asarray(array).tolist())
            length = int(episode.trajectory.length)
            episodes.append(
                {
                    "goals": goals_of(query.prompt).tolist(),
                    "return_": float(episode.return_),
                    "actions": np.asarray(episode.trajectory.actions)[:length].tolist(),
                }
            )
        drawn.append({"task": page.task(jax.tree.map(np.asarray, task)), **rows})
        outcomes.append({"episodes": episodes, "best": goals_of(optimizer.best(state)).tolist()})
    return {"worlds": [world_data(world, load_policy(world))], "searches": drawn}, outcomes


def _draws(key_ask: jax.Array, key_run: jax.Array, env: Any, slots: int) -> dict[str, jax.Array]:
    """The random numbers that sampling a prompt and running an episode draw from the keys of a round."""
    _, key_prompt = jax.random.split(key_ask)
    key_count, key_index = jax.random.split(key_prompt)
    bound = jnp.arange(slots + 1)
    draw = jax.vmap(
        jax.vmap(lambda low, high: jax.random.randint(key_count, (), low, high), (None, 0)),
        (0, None),
    )
    _, key_begin, key_steps = jax.random.split(key_run, 3)
    num = env.spec.action_dim
    later = jax.vmap(lambda t: jax.random.gumbel(jax.random.fold_in(key_steps, t), (num,)))
    return {
        "integers": draw(bound, bound),
        "uniforms": jax.random.uniform(key_index, (env.spec.horizon,)),
        "gumbels": jnp.concatenate(
            [jax.random.gumbel(key_begin, (num,))[None], later(jnp.arange(1, env.spec.horizon))]
        ),
    }
