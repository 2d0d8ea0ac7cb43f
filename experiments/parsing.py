"""Parse command lines into checked settings. tyro alone decides what the words mean.

Defaults may depend on other flags, as those of ``pretrain`` depend on ``--env``. So a command line is
parsed twice by the same parser: first with the general defaults, to find out which defaults apply, and then
with those. No flag may be given twice, so both passes read the same values.

Invalid numbers and choices pass through tyro as text. Before settings are made of them, they go through the
same check as those of library calls, which says what is wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import itertools
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, Literal, NoReturn, get_args

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from envs.errors import UsageError, shown
from experiments.config_files import expanded
from mgpo_jax.settings import (
    aliases_of,
    check_values,
    flag,
    flag_off,
    is_settings,
    range_of,
    types_of,
)

Defaults = Callable[[Any, Sequence[str]], Any]
"""``(config, flags) -> default config``. The config has the values that were typed and general defaults
elsewhere; ``flags`` are those on the command line that it does not know."""


def parse(
    config_class: type,
    argv: Sequence[str],
    default: Defaults | None = None,
    description: str = "",
    prog: str = "",
) -> Any:
    """The checked settings of a command line.

    Args:
      config_class: a frozen dataclass of settings.
      argv: the words of the command line.
      default: chooses the defaults, where they depend on other flags.
      description: what the command does, for ``--help``.
      prog: name of the program, for messages.

    Raises:
      UsageError: for the first mistake on the command line.
      SystemExit: after the help was printed.
    """
    words = list(argv)
    if words and words[0].replace("_", "-").startswith("--tyro-"):  # tyro would write a file
        _refuse_unknown(words, [], prog)
    words = expanded(words, config_class)
    options: dict[str, Any] = {"description": description}
    if default is not None:
        first, unknown = _read(words, config_class, prog, add_help=False)
        _check_flags(words, _flags(first))
        chosen = default(first, [_flag_of(word) for word in unknown if word.startswith("--")])
        _check_flags(words, _flags(chosen))
        options["default"] = chosen
    config, unknown = _read(words, config_class, prog, **options)
    known = _flags(config)
    _check_flags(words, known)
    flags = itertools.takewhile(lambda word: word != "--", words)
    # tyro takes a flag with odd characters for a positional word.
    strange = [word for word in flags if word.startswith("--") and _flag_of(word) not in known]
    if unknown or strange:
        _refuse_unknown(unknown or strange, list(known), prog)
    return config


class _Refused(Exception):
    """An invalid value. (``UsageError`` is a ``ValueError``, which tyro would catch and reword.)"""


def _read(words: list[str], config_class: type, prog: str, **options: Any) -> tuple[Any, list[str]]:
    """The settings that tyro parses from a command line, and the words that it does not know."""
    parsed: Any = tyro.conf.OmitArgPrefixes[config_class]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                parsed,
                prog=prog or None,
                args=words,
                return_unknown_args=True,
                registry=_registry(),
                **options,
            )
    except _Refused as refused:
        raise UsageError(str(refused)) from None
    except SystemExit as stop:
        if not stop.code:
            raise  # the help was asked for
        raise UsageError(_condensed(said.getvalue(), prog)) from None


def _condensed(text: str, prog: str) -> str:
    """A boxed error message of tyro as one line without colors."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [line.strip("│ ") for line in plain.splitlines() if line.startswith("│")]
    body = [line for line in lines if not line.startswith("─")]
    message = " ".join(body).split(". ")[0].rstrip(".")
    if missing := re.match(r"Missing value for argument '([^']+)'", message):
        message = f"{missing[1].split('/')[-1]} needs a value"  # aliases stand before it
    return f"{message[:1].lower()}{message[1:]}; {_way_out(prog)}"


def _way_out(prog: str) -> str:
    return f"see {prog} --help".replace("  ", " ")


def _flag_of(word: str) -> str:
    """The flag that a word of a command line gives, in its usual spelling."""
    return flag(word.partition("=")[0].removeprefix("--"))


def _flags(config: Any) -> dict[str, str]:
    """Every flag of a config, aliases and ``--no-`` included, mapped to the main flag of its setting.

    Raises:
      UsageError: if two settings have the same flag, as a user's own method can cause.
    """
    found: dict[str, str] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if is_settings(value):
            more = _flags(value)
        else:
            kind = types_of(config.__class__).get(field.name, field.type)
            if tyro.conf.Positional in get_args(kind)[1:]:
                continue
            own = flag(field.name)
            more = dict.fromkeys([own, *aliases_of(config.__class__, field.name)], own)
            if isinstance(value, bool):
                more[flag_off(field.name)] = own
        if twice := found.keys() & more.keys():
            raise UsageError(f"two settings have the flag {min(twice)}; rename one of them")
        found |= more
    return found


def _check_flags(words: Sequence[str], known: dict[str, str]) -> None:
    """Raise ``UsageError`` for a setting that is given twice, or a switch that is given a value.

    As for tyro, a word that is a flag is never the value of the flag before it, and ``--`` ends the flags.
    """
    seen = set()
    for word in itertools.takewhile(lambda word: word != "--", words):
        own = known.get(_flag_of(word)) if word.startswith("--") else None
        if own is None:
            continue
        if own in seen:
            raise UsageError(f"{own} is given twice; leave one of them out")
        if "=" in word and flag_off(own.removeprefix("--")) in known:
            raise UsageError(f"{own} takes no value, found {shown(word.partition('=')[2])}")
        seen.add(own)


def _refuse_unknown(unknown: Sequence[str], known: Sequence[str], prog: str) -> NoReturn:
    """Raise ``UsageError`` for words that belong to no setting."""
    for word in unknown:
        if word.startswith("--"):
            name = word.partition("=")[0]
            near = difflib.get_close_matches(_flag_of(word), known, n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise UsageError(f"unknown flag {shown(name)}{hint}; {_way_out(prog)}")
    raise UsageError(f"unexpected argument {shown(unknown[0])}; {_way_out(prog)}")


def add_struct_rule(
    registry: ConstructorRegistry,
    change: Callable[[type, StructConstructorSpec], StructConstructorSpec],
) -> None:
    """Add a rule to tyro's: what it makes of a dataclass of settings goes through ``change``.

    Args:
      registry: the rules.
      change: ``(dataclass, tyro's specification) -> specification``.
    """
    under_way: set[type] = set()  # classes that tyro's own rule is just being asked about

    @registry.struct_rule
    def settings(info: StructTypeInfo) -> StructConstructorSpec | None:
        if info.type in under_way or not dataclasses.is_dataclass(info.type):
            return None
        under_way.add(info.type)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)  # tyro's own rule for dataclasses
        finally:
            under_way.discard(info.type)
        return change(info.type, spec) if isinstance(spec, StructConstructorSpec) else None


def _with_checks(kind: type, spec: StructConstructorSpec) -> StructConstructorSpec:
    """Settings that are checked when they are made, and whose help shows ranges."""
    return StructConstructorSpec(
        instantiate=partial(_checked, kind, spec.instantiate),
        fields=tuple(map(_with_range, spec.fields)),
    )


def _registry() -> ConstructorRegistry:
    """Our rules for tyro: how values are read and checked, and how the help shows their ranges."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_number)
    registry.primitive_rule(_choice)
    add_struct_rule(registry, _with_checks)
    return registry


def _checked(settings_class: type, make: Callable[..., Any], **values: Any) -> Any:
    """The settings that ``make`` builds from the values; raises ``_Refused`` if one is invalid."""
    try:
        check_values(settings_class, values)
    except UsageError as error:
        raise _Refused(str(error)) from None
    return make(**values)


def _with_range(field: StructFieldSpec) -> StructFieldSpec:
    """The field with its range beside its default in the help."""
    text = range_of(field.type)
    if not text:
        return field
    hint = tyro.conf.arg(help_behavior_hint=lambda default: f"({text}; default: {default})")
    with_hint: Any = Annotated[field.type, hint]
    return dataclasses.replace(field, type=with_hint)


def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """tyro's rule for numbers. Text that is not a number stays text, for the check to refuse."""
    if info.type not in (int, float):
        return None
    kind = info.type

    def read(words: list[str]) -> Any:
        try:
            value = kind(words[0])
        except ValueError:
            return words[0]
        too_large = value in (math.inf, -math.inf) and "inf" not in words[0].lower()
        return words[0] if too_large else value

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, kind),
        str_from_instance=lambda value: [str(value)],
    )


def _choice(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """tyro's rule for choices. A word that is not a choice is kept, for the check to refuse."""
    if info.type_origin is not Literal:
        return None
    choices = get_args(info.type)
    by_word = {str(choice): choice for choice in choices}
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(map(str, choices)) + "}",
        instance_from_str=lambda words: by_word.get(words[0], words[0]),
        is_instance=lambda value: value in choices,
        str_from_instance=lambda value: [str(value)],
    )
