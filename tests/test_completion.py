"""Shell completion: the scripts that ``mgpo completion`` prints."""

from __future__ import annotations

import importlib
import shutil
import subprocess
from pathlib import Path

import pytest

from experiments.__main__ import COMMANDS
from experiments.completion import SHELLS, script

bash = pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not here")
ASK = """
source {script}
COMP_WORDS=({words} {word}); COMP_CWORD={place}; COMPREPLY=()
_tyro_mgpo
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def completions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "mgpo.bash"
    path.write_text(script("bash"))
    return path


def completed(completions: Path, words: str, word: str) -> list[str]:
    """What bash offers for a word behind others."""
    text = ASK.format(script=completions, words=words, word=word or "''", place=len(words.split()))
    done = subprocess.run(["bash", "-c", text], check=True, capture_output=True, text=True)
    assert done.stderr == ""
    return done.stdout.split()


@bash
def test_bash_completes_commands_flags_worlds_and_methods(completions: Path) -> None:
    for words, word, expected in (
        ("mgpo", "ad", {"adapt"}),
        ("mgpo", "re", {"report", "reproduce", "release"}),
        ("mgpo adapt", "--meth", {"--method"}),
        ("mgpo adapt --env", "maze", {"maze15", "maze30"}),
        ("mgpo adapt --method", "b", {"bpe", "bbt"}),
        ("mgpo playground --env", "maze", {"maze15", "maze30"}),
        ("mgpo report --env", "grid", {"gridworld"}),
        ("mgpo pretrain", "--learning", {"--learning-rate"}),
        ("mgpo data", "imp", {"import"}),
        ("mgpo data import", "--goal-c", {"--goal-columns"}),
    ):
        assert set(completed(completions, words, word)) == expected, (words, word)


@bash
def test_bash_offers_all_commands(completions: Path) -> None:
    assert set(completed(completions, "mgpo", "")) >= set(COMMANDS)


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_has_a_script_with_all_commands(shell: str) -> None:
    text = script(shell)
    assert all(name in text for name in COMMANDS)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["completion"], 'eval "$(mgpo completion bash)"'),
        (["completion", "bsh"], "unknown shell 'bsh'; did you mean 'bash'?"),
        (["--tyro-print-completion", "bsh"], "unknown shell 'bsh'; did you mean 'bash'?"),
        (["adapt", "--tyro-print-completion", "bsh"], "unknown shell 'bsh'; did you mean 'bash'?"),
    ],
)
def test_what_is_no_shell_is_refused(
    words: list[str],
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["mgpo", *words])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.__main__").main()
    assert stop.value.code == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("words", [["adapt"], ["data", "import"], []])
def test_every_command_has_tyros_flag(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("experiments.completion.script", lambda shell: f"the script for {shell}")
    monkeypatch.setattr("sys.argv", ["mgpo", *words, "--tyro-print-completion", "zsh"])
    with pytest.raises(SystemExit) as stop:
        importlib.import_module("experiments.__main__").main()
    assert (stop.value.code, capsys.readouterr().out) == (0, "the script for zsh\n")
