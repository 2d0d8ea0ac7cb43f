"""Every code block of the guides runs as printed: files are written, commands are run.

Trainings are slow: without ``--all``, only the files are run, and the method searches with an untrained
policy.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import mgpo_jax
from experiments import runtime
from mgpo_jax.methods import METHODS
from mgpo_jax.network_configs import network_config
from mgpo_jax.prompts import single_goal
from mgpo_jax.transformer import GoalTransformer

FINAL = "final (mean ± std over seeds)"
GUIDES = Path(__file__).parents[1] / "docs" / "guides"
BLOCK = re.compile(r"```python\n# (\w+\.py)\n(.*?)```", flags=re.DOTALL)
COMMAND = re.compile(r"^    python -m experiments\.(\w+) (.*)$", flags=re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The empty folder that the guides begin in."""
    here = tmp_path_factory.mktemp("guide")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.delenv("MGPO_DATA", raising=False)
        patch.setattr(runtime, "configure", lambda: None)
        patch.setattr(sys, "path", list(sys.path))
        yield here


def write_files(guide: str) -> None:
    for name, source in BLOCK.findall((GUIDES / guide).read_text()):
        Path(name).write_text(source)


def follow(guide: str) -> str:
    """Write the files of a guide and run its commands; returns what they print."""
    text = (GUIDES / guide).read_text()
    write_files(guide)
    assert COMMAND.findall(text)
    printed = io.StringIO()
    for name, words in COMMAND.findall(text):
        with pytest.raises(SystemExit) as stop, contextlib.redirect_stdout(printed):
            importlib.import_module(f"experiments.{name}").command(words.split())
        assert not stop.value.code, (name, words)
    return printed.getvalue()


@pytest.fixture(scope="module")
def of_world(folder: Path) -> str:
    """What the commands of the guide to worlds print."""
    return follow("own-world.md")


def lines_of(guide: str) -> list[str]:
    """The lines of a guide's files, without the first one, which is their name."""
    found = BLOCK.findall((GUIDES / guide).read_text())
    return [line for _, source in found for line in source.splitlines()]


def column(printed: str, name: str) -> list[str]:
    """A column of a printed table."""
    rows = [line for line in printed.splitlines() if line.startswith("|")]
    head, _, *rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return [row[head.index(name)] for row in rows]


def test_the_files_are_short_and_run(folder: Path) -> None:
    assert len(lines_of("own-world.md")) < 100
    assert len([line for line in lines_of("own-method.md") if line]) <= 40
    for guide in ("own-world.md", "own-method.md"):
        write_files(guide)
    world, method = envs.find("bells:WORLD"), METHODS.find("climb:METHOD")
    assert envs.check_world(world).faults == ()
    env = world.make()
    config = network_config(env.spec, embed_dim=8, num_layers=1, num_heads=2, max_prompt_length=4)
    prompt = single_goal(jnp.zeros(env.spec.goal_dim), config.max_prompt_length)
    obs, actions = jnp.zeros((1, *env.spec.obs.shape)), jnp.zeros(1, jnp.int32)
    params = GoalTransformer(config).init(jax.random.key(1), prompt, obs, actions)
    policy, tasks = mgpo_jax.LoadedPolicy(config, params, {}), mgpo_jax.sample_tasks(env, 1, 4)
    done = mgpo_jax.adapt(world, policy, tasks, method, seeds=1, episodes=6, eval_every=6)
    assert done.returns.shape == (1, 4, 6)
    # The best prompt is that of an episode with the highest return, the first of them.
    best = done.returns.argmax(axis=2)
    for task in range(4):
        chosen = done.choices.prompt.goals[0, task, best[0, task]]
        np.testing.assert_array_equal(done.best.prompt.goals[0, task, -1], chosen)


@pytest.mark.slow
def test_a_world(of_world: str) -> None:
    assert "bells: no faults" in of_world
    initial, final = (float(column(of_world, name)[0].split()[0]) for name in ("initial", FINAL))
    assert final > initial + 0.2
    assert Path("ucb/learning_curve.png").is_file()
    assert Path("ucb/report.html").is_file()


@pytest.mark.slow
def test_a_method(of_world: str) -> None:
    """On the policy of the guide to worlds, which is followed first."""
    assert column(follow("own-method.md"), "method") == ["ucb", "climb:METHOD"]


def test_our_worlds_are_made_by_gymnasium_as_printed(tmp_path: Path) -> None:
    """The block of the guide and the line of the README, in new processes where nothing is registered."""
    guide = (GUIDES / "own-gymnasium-world.md").read_text()
    section = guide[guide.index("## The other way round") :]
    block = "\n".join(re.findall(r"^    (.*)$", section, flags=re.MULTILINE))
    assert "gymnasium.make" in block
    readme = (GUIDES.parents[1] / "README.md").read_text()
    (line,) = re.findall(r"`(gymnasium\.make\([^`]*\))`", readme)
    assert line in section.replace("\n", " ")
    for code in (f"import gymnasium\n{line}.reset(seed=0)", f"{block}\nassert env.reset(seed=0)"):
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-1000:]


def test_links_lead_somewhere() -> None:
    for guide in GUIDES.glob("*.md"):
        for link in re.findall(r"\]\(([^)#]+)\)", guide.read_text()):
            if not link.startswith("http"):
                assert (guide.parent / link).exists(), (guide, link)
