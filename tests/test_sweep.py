"""``adapt --sweep``: parsing, a single program for all variants, and the same results as single runs."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_results import ENV, TINY, made_results

from envs.errors import UsageError
from envs.registry import WORLDS
from experiments import adapt
from experiments.parsing import parse
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.result_files import load_results
from experiments.sweeping import variants
from mgpo_jax import runner
from mgpo_jax.network_configs import network_config
from mgpo_jax.policy import LoadedPolicy
from mgpo_jax.policy_files import save_policy
from mgpo_jax.prompts import single_goal
from mgpo_jax.tasks import save_tasks
from mgpo_jax.transformer import GoalTransformer


def config_of(words: str) -> AdaptConfig:
    config: AdaptConfig = parse(AdaptConfig, words.split(), adapt.adapt_default)
    return config


def test_words_are_crossed() -> None:
    config = config_of("--sweep c=0.5,2 max-goals=1,3 --scale 7")
    found = variants(config)
    assert list(found) == [
        "c=0.5,max_goals=1",
        "c=0.5,max_goals=3",
        "c=2,max_goals=1",
        "c=2,max_goals=3",
    ]
    one = found["c=2,max_goals=1"]
    assert (one.hyper.c, one.hyper.max_goals, one.hyper.scale) == (2, 1, 7)
    assert one.folder == Path("runs/adapt/maze15/ucb-seed0-sweep/c=2,max_goals=1")
    assert one.sweep == ()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--sweep c", "needs words such as c=0.1,1,10, found 'c'"),
        ("--sweep c=", "found 'c='"),
        ("--sweep c=1,1.0", "has c=1 twice"),
        ("--sweep c=1 c=2", "names a setting twice"),
        ("--sweep c=1,-1", "--c must be at least 0, found -1"),
        ("--sweep c=1,a", "--c must be a number, found 'a'"),
        ("--sweep max_gaols=1", "did you mean 'max_goals'"),
        ("--method bbt --sweep population_size=4,8", "run adapt once for each value"),
        ("--method gcbc --sweep c=1", "c is not a setting of gcbc"),
    ],
)
def test_what_is_no_sweep_is_refused(words: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        variants(config_of(words))


def test_a_sweep_is_its_single_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(WORLDS._registered, "tiny", TINY)
    network = network_config(ENV.spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=3)
    prompt = single_goal(jnp.zeros(2), 3)
    obs, actions = jnp.zeros((1, *ENV.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(network).init(jax.random.key(0), prompt, obs, actions)
    save_policy(tmp_path / "policy", network, params, {})
    tasks = made_results().task_set
    save_tasks(tmp_path / "tasks.npz", tasks)
    adapt.main(
        config_of(
            f"--env tiny --policy {tmp_path}/policy --tasks {tmp_path}/tasks.npz --seeds 2 --episodes 6 "
            f"--eval-every 6 --sweep c=0,5 --out {tmp_path}/sweep"
        )
    )
    text = capsys.readouterr().out
    for c in (0.0, 5.0):
        found = load_results(tmp_path / "sweep" / f"c={c:g}")
        assert found.config["hyper"]["c"] == c
        assert f"c={c:g} |" in text
        alone = runner.adapt(
            ENV, LoadedPolicy(network, params, {}), tasks, "ucb", {"c": c}, seeds=2, episodes=6,
            eval_every=6,
        )  # fmt: skip
        np.testing.assert_array_equal(found.returns, alone.returns)
        np.testing.assert_array_equal(found.eval_returns, alone.eval_returns)
    picture = tmp_path / "sweep" / "learning_curve.png"
    assert picture.is_file()
    picture.write_bytes(b"drawn by the user")
    # A scheduler may pass --resume again after the sweep has finished.
    words = (
        f"--env tiny --policy {tmp_path}/policy --tasks {tmp_path}/tasks.npz --seeds 2 --episodes 6"
    )
    words += f" --eval-every 6 --out {tmp_path}/sweep --resume --sweep"
    adapt.main(config_of(f"{words} c=0,5"))
    said = capsys.readouterr()
    assert "is already finished" in said.err
    assert said.out == text
    assert f"{picture} is kept: it was changed" in said.err
    assert picture.read_bytes() == b"drawn by the user"
    for values, says in {
        "c=0,1": "holds no results of c=1",
        "c=0,5 --seed 1": "other settings",
    }.items():
        with pytest.raises(UsageError, match=says):
            adapt.main(config_of(f"{words} {values}"))
    with pytest.raises(UsageError, match="already exists"):
        adapt.main(config_of(f"{words.replace(' --resume', '')} c=0,5"))
