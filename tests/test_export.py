"""ONNX export: onnxruntime against jax along whole greedy episodes, and policies that are refused."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages_js import halved, played

import envs
from envs.errors import MissingExtraError, UsageError
from experiments.export import ExportConfig, main
from experiments.exporting import KEY, facts_of, prefill_path
from mgpo_jax.policy_files import load_policy

TOLERANCE = 1e-4  # of logits

for package in ("onnx", "onnxruntime"):
    needs_onnx = pytest.mark.skipif(
        importlib.util.find_spec(package) is None,
        reason=f'{package} is not installed: pip install -e ".[dev]"',
    )
    if importlib.util.find_spec(package) is None:
        break


class Exported:
    """The two models in onnxruntime, as docs/export.md runs them."""

    def __init__(self, world: str, policy: Any) -> None:
        import onnxruntime

        from experiments.onnx_graphs import prefill_graph, step_graph

        facts = {KEY: json.dumps(facts_of(envs.find(world), policy))}
        self.slots, self.goal_dim = policy.config.max_prompt_length, policy.config.goal_dim
        self.prefill, self.step = (
            onnxruntime.InferenceSession(
                make(policy, facts).SerializeToString(), providers=["CPUExecutionProvider"]
            )
            for make in (prefill_graph, step_graph)
        )

    def logits(self, goals: np.ndarray, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """At every observation of an episode in which these actions were taken."""
        padded = np.zeros((self.slots, self.goal_dim), np.float32)
        mask = np.arange(self.slots) >= self.slots - len(goals)
        padded[mask] = goals
        given = {"goals": padded, "prompt_mask": mask, "obs": obs[0]}
        names = ("past_keys", "past_values", "past_mask")
        logits, best, *cache = self.prefill.run(None, given)
        rows = [logits]
        for action, seen in zip(actions[:-1], obs[1:], strict=True):
            past = dict(zip(names, cache, strict=True))
            given = {"action": np.array(action, np.int64), "obs": seen, **past}
            logits, best, *cache = self.step.run(None, given)
            assert best == logits.argmax()
            rows.append(logits)
        return np.stack(rows)


@needs_onnx
@pytest.mark.parametrize(
    ("name", "num"),
    [
        ("maze15", 4),
        pytest.param("maze15", 50, marks=pytest.mark.slow),
        pytest.param("gridworld", 10, marks=pytest.mark.slow),
        pytest.param("maze30", 4, marks=pytest.mark.slow),
    ],
)
def test_whole_greedy_episodes_are_those_of_jax(name: str, num: int) -> None:
    world = envs.find(name)
    greedy = played(world, num, prompts=1)
    exported = Exported(name, halved(load_policy(world)))
    largest = 0.0
    for index, case in enumerate(greedy.data["cases"]):
        actions = np.array(case["actions"])
        obs = np.asarray(greedy.episodes.trajectory.obs[index][: len(actions)])
        found = exported.logits(np.array(case["goals"], np.float32), obs, actions)
        wanted = greedy.logits[index][: len(actions)]
        largest = max(largest, float(np.abs(found - wanted).max()))
        assert (found.argmax(axis=1) == wanted.argmax(axis=1)).all()
    steps = int(greedy.episodes.trajectory.length.sum())
    print(f"{name}: {num} episodes, {steps} steps, {largest:.1e}")
    assert largest < TOLERANCE


@needs_onnx
@pytest.mark.parametrize(
    "change", [{"tokens_per_step": 1}, {"num_heads": 2}, {"prompt_order": False}]
)
def test_other_networks_are_those_of_jax(change: dict[str, Any]) -> None:
    """A tiny network with standardized observations, of random weights."""
    import jax
    import jax.numpy as jnp

    from mgpo_jax.network_configs import network_config
    from mgpo_jax.policy import LoadedPolicy
    from mgpo_jax.prompts import Prompt
    from mgpo_jax.transformer import GoalTransformer

    spec = envs.make("maze15").spec
    config = network_config(
        spec,
        embed_dim=8,
        num_layers=2,
        max_prompt_length=3,
        obs_mean=(0.1,) * 6,
        obs_std=(0.3,) * 6,
    )
    config = replace(config, **change)
    rng, network = np.random.default_rng(0), GoalTransformer(config)
    obs, actions = rng.uniform(-2, 2, (5, 6)).astype(np.float32), rng.integers(0, 5, 5)
    goals = rng.uniform(size=(3, 2)).astype(np.float32)
    prompt = Prompt(np.where([[False], [True], [True]], goals, 0), np.array([False, True, True]))
    prompt, seen, taken = jax.tree.map(jnp.asarray, (prompt, obs, actions))
    params = network.init(jax.random.key(1), prompt, seen, taken)
    params = jax.tree.map(
        lambda leaf: leaf + 0.3 * rng.normal(size=leaf.shape).astype(np.float32), params
    )
    wanted = network.apply(params, prompt, seen, taken).logits
    found = Exported("maze15", LoadedPolicy(config, params, {})).logits(goals[1:], obs, actions)
    np.testing.assert_allclose(found, wanted, atol=TOLERANCE)


@needs_onnx
def test_the_command_writes_two_models_that_say_what_they_are(tmp_path: Path) -> None:
    import onnx

    out = tmp_path / "policy.onnx"
    main(ExportConfig(out=out))
    policy = load_policy(envs.find("maze15"))
    for path in (out, prefill_path(out)):
        model = onnx.load(path)
        facts = json.loads({one.key: one.value for one in model.metadata_props}[KEY])
        assert facts["world"] == "maze15"
        assert facts["weights_sha256"] == policy.sha256
        assert facts["spec"]["horizon"] == 64
    with pytest.raises(UsageError, match="already exists"):
        main(ExportConfig(out=out))


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ExportConfig(out=Path("policy.pt")), "must end in .onnx"),
        (ExportConfig(out=Path("no/where.onnx")), "there is no folder no"),
        (ExportConfig(env="maze51"), "did you mean"),
    ],
)
def test_requests_that_cannot_be_met_are_refused(
    config: ExportConfig, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=says):
        main(config)
    assert not list(tmp_path.iterdir())


def test_a_network_without_a_graph_is_refused() -> None:
    from experiments.exporting import check_exportable

    config = load_policy(envs.find("maze15")).config
    with pytest.raises(UsageError, match="head gaussian"):
        check_exportable(replace(config, head="gaussian"), "maze15")


def test_a_missing_package_is_named_with_what_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"onnx: pip install '.*\[onnx\]'$"):
        main(ExportConfig(out=tmp_path / "policy.onnx"))
