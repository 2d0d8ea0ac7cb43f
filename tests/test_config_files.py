"""``--config``, which takes defaults from the settings of a run; ``--quiet`` and ``--json``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from envs.errors import DataError, UsageError
from experiments import table
from experiments.adapt import adapt_default
from experiments.config_files import expanded
from experiments.parsing import parse
from experiments.runtime import run
from experiments.store.adapt_settings import AdaptConfig
from experiments.store.presets import pretrain_default
from experiments.store.reproduce_settings import ReproduceConfig
from experiments.store.settings import PretrainConfig
from experiments.table import TableConfig
from mgpo_jax.files import to_json

ROOT = Path(__file__).parents[1]
UCB = ROOT / "results" / "maze15" / "ucb"


def written(folder: Path, values: object) -> Path:
    path = folder / "config.json"
    path.write_text(json.dumps(to_json(values)))
    return path


def test_settings_survive_the_file(tmp_path: Path) -> None:
    words = "--env gridworld --method bpe --seeds 2 --no-figures --min-std 0.5 --tasks a.npz --stop-at -1"
    first = parse(AdaptConfig, words.split(), adapt_default)
    path = written(tmp_path, first)
    again = parse(AdaptConfig, ["--config", str(path)], adapt_default)
    assert to_json(again) == {**to_json(first), "config": str(path)}


def test_a_hyper_parameter_without_a_value_stays_without_one(tmp_path: Path) -> None:
    first = parse(AdaptConfig, ["--method", "ppo-careful", "--max-kl", "None"], adapt_default)
    assert first.hyper.max_kl is None
    again = parse(AdaptConfig, ["--config", str(written(tmp_path, first))], adapt_default)
    assert again.hyper == first.hyper


def test_what_is_typed_wins(tmp_path: Path) -> None:
    path = written(tmp_path, parse(AdaptConfig, ["--c", "3", "--seeds", "7"], adapt_default))
    typed = ["--config", str(path), "--seeds=1", "--c", "5", "--no-figures"]
    config = parse(AdaptConfig, typed, adapt_default)
    assert (config.seeds, config.hyper.c, config.figures) == (1, 5.0, False)
    other = parse(AdaptConfig, [f"--config={path}", "--bandit", "grips"], adapt_default)
    assert (other.method, other.seeds, other.hyper.num_edits) == ("grips", 7, 5)


def test_published_results_and_trainings_say_their_settings(tmp_path: Path) -> None:
    config = parse(
        AdaptConfig, ["--config", str(UCB / "config.json"), "--episodes", "5"], adapt_default
    )
    assert (config.env, config.episodes, config.out) == ("maze15", 5, None)
    first = parse(PretrainConfig, ["--steps", "77", "--trajectories", "999"], pretrain_default)
    again = parse(PretrainConfig, ["--config", str(written(tmp_path, first))], pretrain_default)
    assert (again.train, again.data) == (first.train, first.data)


@pytest.mark.parametrize(
    ("content", "error", "says"),
    [
        (None, DataError, "config.json"),
        ("{", DataError, "config.json"),
        ('{"env": {"a": 1}}', DataError, "the setting 'env' in the config file must be a single"),
        ('{"sedes": 1}', UsageError, "unknown flag '--sedes'; did you mean --seeds"),
        ('{"seeds": "many"}', UsageError, "--seeds must be"),
    ],
)
def test_damaged_files_are_named(
    tmp_path: Path, content: str | None, error: type[Exception], says: str
) -> None:
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(error, match=says):
        parse(AdaptConfig, ["--config", str(tmp_path / "config.json")], adapt_default)


def test_a_folder_and_a_policy_are_called_so(tmp_path: Path) -> None:
    policy = ROOT / "mgpo_jax/pretrained/maze15/config.json"
    for place, says in (
        (UCB, rf"must be a file, found a folder; give {UCB}/config.json$"),
        (tmp_path, "must be a file, found a folder; give the config.json of a run$"),
        (
            policy,
            "must hold the settings of a run, found those of a policy; give the config.json of a run",
        ),
        (tmp_path / "no.json", "no.json is missing; give the config.json of a run"),
    ):
        with pytest.raises((UsageError, DataError), match=says):
            parse(AdaptConfig, ["--config", str(place)], adapt_default)


def test_a_file_never_decides_what_is_imported(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text('{"env": "evil:WORLD"}')
    with pytest.raises(
        UsageError, match=r"names the code 'evil:WORLD'.* add --env with this value"
    ):
        parse(AdaptConfig, ["--config", str(path)], adapt_default)
    config = parse(AdaptConfig, [f"--config={path}", "--env", "maze15"], adapt_default)
    assert config.env == "maze15"
    path.write_text('{"env": ["maze15", "evil:WORLD"]}')
    with pytest.raises(UsageError, match="names the code 'evil:WORLD'"):
        parse(ReproduceConfig, ["table1", "--config", str(path)])


@pytest.mark.parametrize(
    ("content", "error", "says"),
    [
        ('{"bandit": "evil:METHOD"}', UsageError, "names the code 'evil:METHOD'"),  # an alias
        ('{"data": {"env": "evil:WORLD"}}', UsageError, "names the code 'evil:WORLD'"),
        ('{"hyper": {"method": "evil:METHOD"}}', UsageError, "names the code 'evil:METHOD'"),
        ('{"env=evil:WORLD": true}', DataError, "is not the name of a setting"),
        ('{"seeds": [1, "--env=evil:WORLD"]}', DataError, "which is a flag"),
        ('{"env": 5}', UsageError, "unknown world '5'"),
    ],
)
def test_no_part_of_a_file_is_taken_for_another_flag(
    tmp_path: Path, content: str, error: type[Exception], says: str
) -> None:
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(error, match=says):
        parse(AdaptConfig, ["--config", str(tmp_path / "config.json")], adapt_default)


def test_a_flag_without_its_file() -> None:
    for words in (["--config"], ["--config", "--seeds", "2"]):
        with pytest.raises(UsageError, match="--config needs a value"):
            expanded(words, AdaptConfig)


def test_a_table_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    table.main(TableConfig(runs=(UCB,), json=True))
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["folder"], row["tasks"], row["settings"]) == (str(UCB), "test", {})
    assert row["final_return"] == pytest.approx(-0.205, abs=1e-3)


def test_quiet_commands_say_errors_only(capsys: pytest.CaptureFixture[str]) -> None:
    import sys

    def main(config: TableConfig) -> None:
        print("a note", file=sys.stderr)
        if config.runs:
            raise UsageError("what is wrong")

    for words, says in (([], ""), (["x"], "error: what is wrong\n")):
        with pytest.raises(SystemExit):
            run(TableConfig, main, argv=["--quiet", *words])
        assert capsys.readouterr().err == says
    print("heard", file=sys.stderr)
    assert capsys.readouterr().err == "heard\n"
