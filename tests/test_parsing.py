"""Command lines: one parser decides, no flag may be given twice, and errors are a single line."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_origin

import hypothesis.strategies as st
import pytest
import tyro
from hypothesis import given, settings

from envs.errors import DataError, UsageError
from envs.registry import WORLDS, find
from experiments.adapt import adapt_default
from experiments.evaluate import EvaluateConfig
from experiments.parsing import parse
from experiments.plot import PlotConfig
from experiments.pretrain import main as pretrain
from experiments.release import ReleaseConfig
from experiments.reproduce import main as reproduce
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.presets import pretrain_default, pretrain_preset
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.settings import (
    NO_SETTINGS,
    CollectConfig,
    PretrainConfig,
    pretraining_from,
    saved_pretraining,
    training_settings,
)
from mgpo_jax import methods
from mgpo_jax.files import to_json, write_json
from mgpo_jax.methods import BbtHyper, UcbHyper
from mgpo_jax.settings import Count, TrainConfig, range_of, types_of

ROOT = Path(__file__).parents[1]


def of_adapt(line: str) -> AdaptConfig:
    return parse(AdaptConfig, line.split(), adapt_default, prog="mgpo adapt")


def test_a_world_may_have_defaults_for_a_method(monkeypatch, capsys):
    own = replace(find("gridworld"), name="own", method_defaults={"ucb": {"scale": 3.0}})
    monkeypatch.setitem(WORLDS._registered, "own", own)
    assert of_adapt("--env own --c 2").hyper == UcbHyper(c=2.0, scale=3.0)
    assert of_adapt("--env own --scale 1").hyper == UcbHyper(scale=1.0)
    assert of_adapt("--env own --method bbt").hyper == BbtHyper()
    assert of_adapt("--env gridworld").hyper == UcbHyper()
    with pytest.raises(SystemExit):
        of_adapt("--env own --help")
    assert "default: 3.0" in " ".join(capsys.readouterr().out.split())


def of_pretrain(line: str) -> PretrainConfig:
    return parse(PretrainConfig, line.split(), pretrain_default, prog="mgpo pretrain")


def refused(call: Any, *args: Any) -> str:
    with pytest.raises(UsageError) as error:
        call(*args)
    assert len(str(error.value).splitlines()) == 1
    return str(error.value)


def test_the_flags_that_choose_defaults_may_stand_anywhere():
    for line in (
        "--env gridworld --preset paper --steps 7",
        "--steps=7 --preset=paper --env=gridworld",
        "--steps 7 --env gridworld --no-resume --preset paper",
    ):
        expected = pretrain_preset("gridworld", "paper")
        expected = replace(expected, train=replace(expected.train, steps=7))
        assert of_pretrain(line) == expected
    assert of_adapt("--seeds 2 --bandit bbt --std-init 1").hyper == BbtHyper(std_init=1.0)
    assert of_adapt("--c=2 --no-keep-rewarded").hyper == UcbHyper(c=2.0, keep_rewarded=False)


def test_what_looks_like_a_flag_is_no_value():
    assert of_adapt("--out=--env").out == Path("--env")
    assert (
        refused(of_adapt, "--out --env gridworld") == "--out needs a value; see mgpo adapt --help"
    )
    assert refused(of_adapt, "--method") == "--method needs a value; see mgpo adapt --help"
    assert refused(of_adapt, "-- --method bpe").startswith("unknown flag '--method'")


@pytest.mark.parametrize(
    ("line", "flag"),
    [
        ("--env maze15 --env gridworld", "--env"),
        ("--env=maze15 --steps 3 --env=maze15", "--env"),
        ("--preset smoke --preset paper", "--preset"),
        ("--batch-size 8 --batch_size 8", "--batch-size"),
        ("--policy astar4 --demonstrator astar2", "--demonstrator"),
        ("--episodes 3000 --trajectories 3000", "--trajectories"),
        ("--resume --resume", "--resume"),
        ("--prompt-order --no-prompt-order", "--prompt-order"),
        ("--no_prompt_order --no-prompt-order", "--prompt-order"),
        ("--debug --debug", "--debug"),
    ],
)
def test_nothing_is_given_twice(line: str, flag: str):
    assert refused(of_pretrain, line) == f"{flag} is given twice; leave one of them out"


def test_no_method_is_given_twice():
    for line in ("--method ucb --bandit bpe", "--c 1 --c=2", "--keep-rewarded --no-keep-rewarded"):
        assert "is given twice" in refused(of_adapt, line)
    assert of_adapt("--out=--method --method bpe").method == "bpe"


FLAGS = ["--env", "--method", "--bandit", "--c", "--keep-rewarded", "--no-figures", "--out", "--"]
WORDS = [
    *FLAGS,
    "bpe",
    "2",
    "maze15",
    "--method=grips",
    "--env=kitchen",
    "--num-edits=3",
    "--out=--env",
]


def answer(call: Any, *args: Any) -> Any:
    """What is returned, or the error of a refusal."""
    try:
        return call(*args)
    except UsageError as error:
        return error


@settings(max_examples=300, deadline=None)
@given(st.lists(st.sampled_from(WORDS), max_size=6))
def test_a_recipe_is_never_mixed(words: list[str]):
    """What comes out has the hyper-parameters of the method that it names."""
    config = answer(parse, AdaptConfig, words, adapt_default)
    if isinstance(config, UsageError):
        assert len(str(config).splitlines()) == 1
        return
    assert type(config.hyper) is methods.find(config.method).hyper
    assert sum(word.startswith(("--method", "--bandit")) for word in words) < 2
    if config.method != "ucb":
        assert any(config.method in word for word in words)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("--trajectory 3", "unknown flag '--trajectory'; did you mean --trajectories?"),
        ("--steps abc", "--steps must be an integer, found 'abc'"),
        ("--steps 2.5", "--steps must be an integer, found '2.5'"),
        ("--steps 1e3", "--steps must be an integer, found '1e3'"),
        (f"--steps {'9' * 5000}", "--steps must be an integer, found '99999"),
        ("--learning-rate fast", "--learning-rate must be a number, found 'fast'"),
        ("--learning-rate 1e400", "--learning-rate must be a number, found '1e400'"),
        ("--learning-rate -inf", "--learning-rate must be a finite number, found -inf"),
        ("--learning-rate=nan", "--learning-rate must be a finite number, found nan"),
        ("--learning-rate 1e38", "--learning-rate must be at most 100, found 1e+38"),
        ("--dropout 1", "--dropout must be below 1, found 1.0"),
        ("--embed-dim 0", "--embed-dim must be at least 1, found 0"),
        ("--num-layers 1000000", "--num-layers must be at most 256, found 1000000"),
        ("--seed 4294967296", "--seed must be below 4294967296, found 4294967296"),
        ("--data-seed -1", "--data-seed must be at least 0, found -1"),
        ("--head=", "unknown --head '' (known: categorical, gaussian,"),
        ("--head gausian", "unknown --head 'gausian'; did you mean 'gaussian'?"),
        ("--encoder liner", "unknown --encoder 'liner'; did you mean 'linear'?"),
        ("--tokens-per-step 3", "unknown --tokens-per-step '3' (known: 2, 1)"),
        ("--tokens-per-step one", "unknown --tokens-per-step 'one' (known: 2, 1)"),
        ("--optimizer moun", "unknown --optimizer 'moun'; did you mean 'muon'?"),
        ("--env=", "--env must not be empty, found ''"),
        ("--demonstrator=", "--demonstrator must not be empty, found ''"),
        ("--debug=yes", "--debug takes no value, found 'yes'"),
        ("--debug yes", "unexpected argument 'yes'; see mgpo pretrain --help"),
        ("--tyro-print-completion bash", "unknown flag '--tyro-print-completion'"),
    ],
)
def test_what_is_wrong_is_named(line: str, says: str):
    assert refused(of_pretrain, line).startswith(says)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=20))
def test_any_text_is_a_number_or_refused(text: str):
    config = answer(parse, PretrainConfig, [f"--learning-rate={text}"], pretrain_default)
    if isinstance(config, UsageError):
        assert str(config).startswith("--learning-rate must be ")
        assert str(config).isprintable()
        return
    assert 0 < config.train.learning_rate == float(text) <= 100


@pytest.mark.parametrize(
    ("config_class", "line", "says"),
    [
        (
            EvaluateConfig,
            "x --obs-noise 0.1 -1",
            "--obs-noise must be at least 0, found (0.1, -1.0)",
        ),
        (EvaluateConfig, "x --action-noise nan", "--action-noise must be a finite number"),
        (EvaluateConfig, "x --env=", "--env must not be empty, found ''"),
        (PlotConfig, "x --tasks 0 -1", "--tasks must be at least 0, found (0, -1)"),
        (PlotConfig, "x --seed -1", "--seed must be at least 0, found -1"),
        (CollectConfig, "x", "unexpected argument 'x'"),
        (ReproduceConfig, "table4 table5", "unexpected argument 'table5'"),
        (ReproduceConfig, "--what table4", "unknown flag '--what'"),
    ],
)
def test_other_commands(config_class: type, line: str, says: str):
    assert refused(parse, config_class, line.split()).startswith(says)


def test_positional_words():
    assert parse(PlotConfig, ["a", "b", "--tasks", "1", "2"]) == PlotConfig(
        runs=(Path("a"), Path("b")), tasks=(1, 2)
    )
    assert parse(ReleaseConfig, ["--out", "x", "run"]) == ReleaseConfig(
        source=Path("run"), out=Path("x")
    )
    assert parse(ReproduceConfig, ["--only", "5", "10", "--", "figure8"]).only == ("5", "10")


@dataclass(frozen=True)
class Clash:
    seeds: Count = 1
    hyper: Annotated[Any, tyro.conf.arg(name="")] = None


def test_a_method_must_leave_the_flags_of_the_command_alone():
    with_clash = lambda config, flags: replace(config, hyper=Clash(hyper=UcbHyper()))  # noqa: E731
    says = "two settings have the flag --seeds; rename one of them"
    assert refused(parse, Clash, [], with_clash) == says


def test_every_number_has_a_range():
    for kind in (PretrainConfig, TrainConfig, AdaptConfig, CollectConfig, EvaluateConfig):
        for setting in fields(kind):
            default, known = setting.default, types_of(kind)[setting.name]
            chosen = get_origin(known) is Literal
            if isinstance(default, int | float) and not isinstance(default, bool) and not chosen:
                assert range_of(known), f"{kind.__name__}.{setting.name}"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("--batch-size 10 --part-size 4", "--batch-size 10 is not a multiple of --part-size 4"),
        ("--num-heads 3", "--embed-dim 128 is not a multiple of --num-heads 3"),
        ("--embed-dim 7", "--embed-dim 7 is not a multiple of --num-heads 4"),
        ("--trajectories 40", "--holdout 200 leaves nothing of 40 trajectories to train on"),
        ("--preset smoke --holdout 256", "--holdout 256 leaves nothing of 256 trajectories"),
    ],
)
def test_settings_that_do_not_go_together(line: str, says: str, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert refused(pretrain, of_pretrain(line)).startswith(says)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ReproduceConfig(), "no table given; name one of table1, table2"),
        (ReproduceConfig(what="table4", only=("K1",)), "--only K1 does not apply to table4"),
        (ReproduceConfig(what="table4", steps=3), "--steps 3 does not apply to table4"),
        (ReproduceConfig(what="figure8", trajectories=40), "--trajectories must be above 200"),
    ],
)
def test_reproductions_that_cannot_be_made(config: ReproduceConfig, says: str):
    assert refused(reproduce, config).startswith(says)


def test_a_missing_value_is_named_on_a_terminal_too():
    """There tyro writes in colors."""
    terminal, end = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-m", "experiments.pretrain", "--steps"],
        check=False, cwd=ROOT, stdout=end, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(end)
    os.close(terminal)
    says = "error: --steps needs a value; see python -m experiments.pretrain --help\n"
    assert (done.returncode, done.stderr) == (2, says)


def help_of(name: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"experiments.{name}", "--help"],
        check=True, cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    return " ".join(done.stdout.replace("│", " ").split())


def test_help_names_ranges_and_defaults():
    text = help_of("pretrain")
    assert "Dropout rate [0.1]. (at least 0, below 1; default: 0.0)" in text
    assert "Peak learning rate [1e-4]. (above 0, at most 100; default: 0.003)" in text
    assert "{muon,adamw}" in text
    assert "Population of CMA-ES" not in help_of("adapt")


def test_the_settings_of_a_training():
    config = pretrain_preset("gridworld", "smoke")
    found = training_settings(config)
    assert not NO_SETTINGS & found.keys()
    assert {"env", "steps", "trajectories", "seed", "data_seed", "head"} <= found.keys()
    for changes in ({"out": Path("x")}, {"resume": True}, {"preset": "fast"}, {"save_every": 1}):
        assert training_settings(replace(config, **changes)) == found
    assert training_settings(replace(config, dropout=0.5)) != found


def test_saved_settings_are_read_again(tmp_path):
    config = replace(pretrain_preset("kitchen", "paper"), out=Path("some/where"))
    write_json(tmp_path / "config.json", config)
    assert saved_pretraining(tmp_path / "config.json") == config


def test_settings_of_older_versions_are_read():
    values = to_json(pretrain_preset("maze15", "fast"))
    older = {**values, "data": {"demonstrator": None, "episodes": 100_000, "data_seed": 0}}
    del older["encoder"], older["standardize_obs"]
    assert pretraining_from(older, Path("c")) == pretrain_preset("maze15", "fast")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"data": 3}, "c holds no settings of a pre-training run"),
        ({"rate": 3}, "c has the unknown setting 'rate'"),
        ({"env": None}, "c: env must be text, found None"),
        ({"dropout": True}, "c: dropout must be a number, found True"),
        ({"num_layers": 10**400}, "c: num_layers must be at most 256, found 1000"),
        ({"num_layers": 2.0}, "c: num_layers must be an integer, found 2.0"),
        ({"train": {"seed": -1}}, "c: seed must be at least 0, found -1"),
        ({"train": {"\x1b[31m": 1}}, "c has the unknown setting '\\x1b[31m'"),
        ({"out": ["a"]}, "c: out must be a Path, found"),
    ],
)
def test_saved_settings_that_are_none(changes: dict[str, Any], says: str):
    values = {**to_json(PretrainConfig()), **changes}
    with pytest.raises(DataError) as error:
        pretraining_from(values, Path("c"))
    assert str(error.value).startswith(says)
    assert str(error.value).endswith("restore the file, or start a new run with --out")
