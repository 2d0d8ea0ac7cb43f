"""Shell completion for ``mgpo``: ``eval "$(mgpo completion bash)"``."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn, Union, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructFieldSpec

import envs
from envs.errors import UsageError, nearest
from experiments.parsing import add_struct_rule
from experiments.runtime import Common, run, say
from mgpo_jax import methods
from mgpo_jax.settings import Name

SHELLS = ("bash", "zsh", "fish")


@dataclass(frozen=True)
class CompletionConfig(Common):
    """Settings of ``experiments.completion``."""

    shell: tyro.conf.Positional[Name | None] = None
    """The shell: bash, zsh or fish."""


def main(config: CompletionConfig) -> None:
    """Print a script that lets a shell complete commands, flags, worlds and methods of `mgpo`."""
    if config.shell is None:
        raise UsageError(f'which shell? One of {", ".join(SHELLS)}: eval "$(mgpo completion bash)"')
    if config.shell not in SHELLS:
        raise nearest(config.shell, SHELLS, "shell")
    say(script(config.shell))


def script(shell: str) -> str:
    """The completion script for a shell, as tyro generates it.

    It has the hyper-parameters of the default method only, since a script cannot know which method a
    command line will name.
    """
    from experiments.__main__ import COMMANDS
    from experiments.store.data_settings import SUBCOMMANDS

    settings = {name: _settings_of(name) for name in COMMANDS} | {"data": _union_of(SUBCOMMANDS)}
    parsed: Any = tyro.conf.OmitArgPrefixes[_union_of(settings)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.cli(
            parsed,
            prog="mgpo",
            args=["--tyro-write-completion", shell, "-"],
            registry=_with_known_names(),
        )
    return printed.getvalue()


def _settings_of(name: str) -> Any:
    """The settings dataclass of a command."""
    module = importlib.import_module(f"experiments.{name}")
    return get_type_hints(module.main)["config"]


def _union_of(settings: Mapping[str, Any]) -> Any:
    """A union type that tyro parses as subcommands, from their settings dataclasses by name."""
    named = [Annotated[kind, tyro.conf.subcommand(name)] for name, kind in settings.items()]
    return Union[tuple(named)]  # noqa: UP007 (made at run time)


def _with_known_names() -> ConstructorRegistry:
    """Rules for tyro that make the names of worlds and methods choices, which scripts complete."""
    registry = ConstructorRegistry()
    add_struct_rule(
        registry,
        lambda kind, spec: dataclasses.replace(spec, fields=tuple(map(_with_choices, spec.fields))),
    )
    return registry


def _with_choices(field: StructFieldSpec) -> StructFieldSpec:
    """The field with its known names as choices, and with its help text on one line, as scripts need it."""
    names: list[str] = {"env": envs.names, "method": methods.names}.get(field.name, list)()
    known: Any = Literal[tuple(names)]
    kind = field.type
    if field.default is None and names:
        kind = known | None
    elif isinstance(field.default, tuple) and names:
        kind = tuple[known, ...]
    elif field.default in names:
        kind = known
    text = field.helptext() if callable(field.helptext) else field.helptext
    return dataclasses.replace(field, type=kind, helptext=" ".join((text or "").split()))


def command(argv: Sequence[str] | None = None) -> NoReturn:
    run(CompletionConfig, main, argv=argv)


if __name__ == "__main__":
    command()
