"""Command lines with a bad word, for every flag of every command, derived from the settings dataclasses.

New flags are covered automatically. They are expected to refuse nonsense for their type: words that are not
numbers, NaN, infinity, -1, 10**20, and 0 unless the flag is in ``ZERO_IS_FINE``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.__main__ import COMMANDS
from mgpo_jax import methods
from mgpo_jax.kinds import MULTI_GOAL

from .cases import BOTH, USAGE, Case, Expected, pick
from .grammar_json import NAMES

ZERO_IS_FINE = {
    "seed", "data-seed", "warmup-steps", "weight-decay", "dropout", "obs-noise", "action-noise", "c",
    "tasks", "goal-columns", "action-low", "action-high",
}  # fmt: skip
"""Flags of numbers for which 0 is valid."""

OF_THE_WORLD = {"head", "encoder"}
"""Flags with choices that only some worlds accept."""

FREE = {"name"}
"""Flags that take nearly any word, such as a name."""

OUTPUTS = {"out", "json"}
"""Flags that name output files."""

BASE: dict[str, tuple[str, tuple[str, ...]]] = {
    "list": ("", ()),
    "info": ("", ()),
    "collect": ("--env gridworld --trajectories 4 --out new", ()),
    "data": ("import flat.npz --goal-columns 0 --out new", ("flat.npz",)),
    "pretrain": (
        "--preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 --batch-size 8 "
        "--part-size 4 --bucket 64 --eval-tasks 2 --steps 4 --out new",
        ("data", "policy"),
    ),
    "adapt": (
        "--policy policy --tasks tasks.npz --seeds 1 --episodes 10 --eval-episodes 1 --no-figures "
        "--out new",
        ("policy", "tasks.npz"),
    ),
    "evaluate": ("result --obs-noise 0.1 --json new.json", ("result", "policy")),
    "check": ("result --out new.json", ("result", "policy")),
    "table": ("result", ("result",)),
    "compare": ("result result --csv new.csv", ("result",)),
    "plot": ("result --out new", ("result", "policy")),
    "report": ("result --out new.html", ("result",)),
    "playground": ("--policy policy --out new.html", ("policy",)),
    "export": ("--policy policy --out new.onnx", ("policy",)),
    "reproduce": ("table4 --seeds 1 --out new", ()),
    "release": ("run --out new", ("run",)),
    "bench": ("--quick --json new.json", ()),
    "completion": ("bash", ()),
}
"""A sound command line for each command, and the sound material in the current folder that it needs."""

MAY_WRITE = (
    "new", "new.json", "new.html", "new.csv", "report.html", "playground.html", "runs", "data", "figures",
    "new.onnx", "new_prefill.onnx", "policy.onnx", "policy_prefill.onnx",
)  # fmt: skip
"""Where commands that accept their input may write."""

CONTRADICTIONS: dict[str, tuple[tuple[str, str], ...]] = {
    "collect": (
        ("--env gridworld --env maze15", "--env"),
        ("--demonstrator astar4", "astar4"),
        ("--processes 2", "--distributed"),
    ),
    "pretrain": (
        ("--batch-size 10 --part-size 4", "--part-size"),
        ("--num-heads 3", "--num-heads"),
        ("--embed-dim 6", "--num-heads"),
        ("--num-heads 16", "--num-heads"),
        ("--holdout 40", "--holdout"),
        ("--holdout 100", "--holdout"),
        ("--head gaussian", "head"),
        ("--demonstrator nobody", "demonstrator"),
        ("--resume --out nothing --demonstrator nobody", "demonstrator"),
        ("--init policy --embed-dim 16", "--embed-dim"),
        ("--init policy --max-prompt-length 6", "--max-prompt-length"),
        ("--init policy --no-prompt-order", "--no-prompt-order"),
        ("--init policy --standardize-obs", "--standardize-obs"),
        ("--init policy --env gridworld", "policy"),
        ("--init policy --tokens-per-step 1", "--tokens-per-step"),
        ("--encoder cells", "--encoder"),
        ("--encoder cells --standardize-obs", "--standardize-obs"),
        ("--tokens-per-step 3", "--tokens-per-step"),
        ("--init result", "result"),
        ("--data nowhere", "nowhere"),
        ("--data policy", "policy"),
        ("--env none", "--data"),
        ("--coordinator here:1", "--distributed"),
        ("--distributed --coordinator here:1", "--processes"),
        ("--distributed --coordinator here --processes 2 --process 0", "--coordinator"),
        ("--distributed --coordinator here:1 --processes 2 --process 2", "--process"),
        ("--distributed --dry-run", "--distributed"),
    ),
    "data": (
        ("export nowhere --out new.npz", "nowhere"),
        ("check nowhere", "nowhere"),
        ("info policy", "policy"),
        ("--goal-columns 7", "--goal-columns"),
        ("--goal-columns 0 0", "--goal-columns"),
        ("--goal-array nothing --goal-columns 0", "--goal-columns"),
        ("--goal half", "--goal"),
        ("--action-low 0", "--action-low"),
        ("--action-low 1 --action-high 0", "--action-low"),
        ("--horizon 1", "horizon"),
        ("--num-actions 1", "--num-actions"),
    ),
    "adapt": (
        ("--validation", "--tasks"),
        ("--method bpe --c 2", "--c"),
        ("--bandit bbt --population-size 1", "--population-size"),
        ("--bandit bbt --num-edits 3", "--num-edits"),
        ("--method grips --no-keep-rewarded", "--keep-rewarded"),
        ("--method gcbc --max-goals 3", "--max-goals"),
        ("--max-goals 6", "max"),
        ("--method nowhere:METHOD", "nowhere"),
        ("--method mgpo_jax.methods:NOTHING", "NOTHING"),
        ("--method envs.maze:MAZE15", "MAZE15"),
        ("--env gridworld", "policy"),
        ("--action-noise 1.5", "--action-noise"),
        ("--sweep c", "c=0.1,1,10"),
        ("--sweep min-std=1,2", "min_std"),
        ("--process 0", "--distributed"),
    ),
    "evaluate": (
        ("--env gridworld", "gridworld"),
        ("--env mgpo_jax.methods:UCB", "UCB"),
        ("--obs-noise official", "official"),
        ("--processes 2", "--distributed"),
        ("nowhere", "nowhere"),
        ("policy", "policy"),
    ),
    "check": (
        ("--env gridworld", "gridworld"),
        ("nowhere", "nowhere"),
        ("policy", "policy"),
        ("gridworld", "not both at once"),
        ("nowhere:WORLD", "nowhere"),
    ),
    "table": (("nowhere", "nowhere"), ("result nowhere", "nowhere"), ("policy", "policy")),
    "compare": (
        ("nowhere result", "nowhere"),
        ("policy result", "policy"),
        ("--csv nowhere/new.csv", "nowhere"),
        ("--profile new.jpg", ".png"),
        ("--profile nowhere/new.png", "nowhere"),
    ),
    "plot": (
        ("--seed 1", "--seed"),
        ("--tasks 2", "--tasks"),
        ("--tasks 0 99", "--tasks"),
        ("nowhere", "nowhere"),
    ),
    "report": (
        ("nowhere", "nowhere"),
        ("policy", "policy"),
        ("result nowhere", "nowhere"),
        ("--out new.json", "--out"),
        ("--out nowhere/new.html", "nowhere"),
    ),
    "playground": (
        ("--env gridworld", "policy"),
        ("--env maze15 maze30", "--policy"),
        ("--policy result", "result"),
        ("--out new.txt", "--out"),
    ),
    "export": (
        ("--env gridworld", "policy"),
        ("--policy result", "result"),
        ("--out new.txt", "--out"),
        ("--out nowhere/new.onnx", "nowhere"),
    ),
    "reproduce": (
        ("--only nothing", "only"),
        ("table5 --only nothing", "nothing"),
        ("table5 --trajectories 40", "--trajectories"),
        ("heads", "heads"),
        ("table6", "table6"),
        ("--distributed", "--distributed"),
        ("table5 --env gridworld", "table5"),
    ),
    "release": (("policy", "policy"), ("nowhere", "nowhere")),
    "bench": (
        ("--demonstrator nobody", "demonstrator"),
        ("--layouts 2", "--layouts"),
        ("--layouts 1x0", "--layouts"),
        ("--layouts 2x1 --distributed", "--distributed"),
    ),
    "list": (("maze15", "maze15"),),
    "info": (("maze15", "maze15"),),
    "completion": (("bsh", "bash"), ("bash zsh", "zsh")),
}
"""Words that contradict each other or the sound input, and what the refusal must name."""

VALID: dict[str, tuple[str, ...]] = {
    "collect": ("--env maze15", "--demonstrator astar4 --env maze15", "--env=maze15"),
    "data": ("--goal-columns=1", "--reached changes", "--horizon 9 --skip-bad", "--name toy"),
    "pretrain": (
        "--head categorical",
        "--part-size 8",
        "--learning_rate 1e-2",
        "--warmup-steps 0",
        "--init policy",
        "--init=policy/ --embed-dim 8 --dropout 0.5",
    ),
    "adapt": (
        "--method bpe --min-std 0.1",
        "--bandit bbt",
        "--method=gcbc",
        "--c 0",
        "--c=1e-3",
        "--eval_every 5",
        "--max-goals 5",
        "--method mgpo_jax.methods:UCB",
        "--env envs.maze:MAZE15",
        "--seed 4294967295",
        "--figures",
        "--obs-noise 0.02 --action-noise 0.1",
        "--stop-at -0.5",
        "--sweep c=0.5,2",
    ),
    "evaluate": ("--obs-noise 0 --action-noise 0.5", "--episodes 1", "--env maze15"),
    "check": ("--env maze15", "--json"),
    "compare": ("--json",),
    "table": ("result", "result/"),
    "plot": ("--tasks 0", "--tasks 1 0", "--seed 0"),
    "report": ("result result/", "--env maze15"),
    "playground": ("--env=maze15", "--env maze15 maze15", "--env envs.maze:MAZE15"),
    "export": ("--env=maze15", "--env envs.maze:MAZE15"),
    "reproduce": ("table5 --only astar4", "--seeds 2", "figure8 --only 5 10"),
    "bench": ("--demonstrator astar4", "--trajectories 3"),
}
"""Valid words to add to the sound command lines, besides any flag with its default."""

WORDS_WRONG = (
    "many",
    "1,5",
    "",
    "--",
    "1e400",
    "nan",
    "0x10",
    "½",
    "\x1b[31m",
    "1\n2",
    "'1'",
    "1 2",
)
UNSURE_NUMBERS = ("１２", "1_0", " 3 ", "+3", "1000000000000", "1e9")  # noqa: RUF001 full width


@dataclasses.dataclass(frozen=True)
class Flag:
    """One flag of a command, as its dataclass declares it."""

    name: str
    """Name without leading hyphens; empty for positional words."""
    kinds: frozenset[Any]
    """The types of its values."""
    choices: tuple[str, ...]
    """The values of a ``Literal``."""
    many: bool
    """Whether it takes several values."""
    default: Any
    spellings: tuple[str, ...]
    """All spellings of the flag, aliases included."""


def _flatten(hint: Any) -> tuple[set[Any], tuple[str, ...], bool, list[Any]]:
    """The types in a type hint, its choices, whether it is a tuple, and its metadata."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        kinds, choices, many, metadata = _flatten(args[0])
        return kinds, choices, many, [*args[1:], *metadata]
    if origin is typing.Literal:
        return {str}, tuple(map(str, args)), False, []
    if origin is tuple:
        kinds, choices, _, metadata = _flatten(args[0])
        return kinds, choices, True, metadata
    if origin in (typing.Union, types.UnionType):
        parts = [_flatten(arg) for arg in args if arg is not type(None)]
        return (
            set().union(*(part[0] for part in parts)),
            tuple(choice for part in parts for choice in part[1]),
            any(part[2] for part in parts),
            [one for part in parts for one in part[3]],
        )
    return {hint}, (), False, []


def flags_of(config_class: type) -> list[Flag]:
    """The flags of a settings dataclass, including those of nested dataclasses."""
    found = []
    hints = typing.get_type_hints(config_class, include_extras=True)
    for field in dataclasses.fields(config_class):
        kinds, choices, many, metadata = _flatten(hints[field.name])
        (kind, *_) = kinds
        if dataclasses.is_dataclass(kind):
            found += flags_of(typing.cast(type, kind))
            continue
        if kind is Any or not field.init:  # hyper-parameters, which depend on the method
            continue
        positional = any("POSITIONAL" in repr(one).upper() for one in metadata)
        aliases = [alias for one in metadata for alias in getattr(one, "aliases", None) or ()]
        name = "" if positional else field.name.replace("_", "-")
        own = () if positional else (f"--{name}", f"--{field.name}", f"--no-{name}")
        default = field.default if field.default is not dataclasses.MISSING else None
        found.append(Flag(name, frozenset(kinds), choices, many, default, (*own, *aliases)))
    return found


def config_class(command: str) -> type:
    """The settings of a command, by the convention that ``collect`` has a ``CollectConfig``."""
    module = importlib.import_module(f"experiments.{command}")
    if command == "data":  # its lines are imports
        return typing.cast(type, module.ImportConfig)
    return getattr(module, f"{command.capitalize()}Config")


def all_flags(command: str) -> list[tuple[Flag, tuple[str, ...]]]:
    """The flags of a command, each with the words that it needs beside it."""
    flags: list[tuple[Flag, tuple[str, ...]]] = [(f, ()) for f in flags_of(config_class(command))]
    if command == "adapt":
        # The sound policy follows prompts, so methods of other networks refuse it.
        for name in (n for n in methods.names() if methods.find(n).policy == MULTI_GOAL):
            words = ("--method", name)
            flags += [(flag, words) for flag in flags_of(methods.find(name).hyper)]
    return flags


def without_flag(words: Sequence[str], flag: Flag) -> list[str]:
    """The command line without a flag and its values."""
    kept: list[str] = []
    dropping = False
    for word in words:
        if word.startswith("--"):
            dropping = word.split("=", 1)[0] in flag.spellings
        if not dropping:
            kept.append(word)
    return kept


def _bad_values(flag: Flag) -> list[tuple[str, Expected]]:
    """Values of a flag, and how a command must treat them."""
    values: list[tuple[str, Expected]] = []
    numbers = flag.kinds & {int, float}
    if numbers:
        values += [(word, "refused") for word in (*WORDS_WRONG, "-1", "-inf", "inf")]
        values += [("0", "either" if flag.name in ZERO_IS_FINE else "refused")]
        values += [(word, "either") for word in UNSURE_NUMBERS]
    if int in numbers:
        values += [("1.5", "refused"), ("1e3", "either"), (str(10**20), "refused")]
        values += [("1" + "0" * 400, "refused")]
    if float in numbers:
        values += [("-0.5", "refused"), ("1e38", "either"), ("1e-400", "either")]
    if flag.choices:
        values += [
            ("nonsense", "refused"),
            (f"{flag.choices[0].upper()}X", "refused"),
            ("", "refused"),
        ]
    elif str in flag.kinds and not numbers:
        # What is named on the command line may be imported, and no word of it can hold a zero byte.
        names = [name for name in NAMES if ":" not in name and "\x00" not in name]
        values += [(name, "either" if flag.name in FREE else "refused") for name in names]
    if Path in flag.kinds:
        if flag.name in OUTPUTS:
            values += [
                ("file.txt/x", "refused"),
                ("/dev/null/x", "refused"),
                ("x" * 300, "refused"),
            ]
            values += [
                ("file.txt", "refused"),
                ("/proc", "either"),
                (".", "either"),
                ("", "either"),
            ]
            values += [("\x1b[31mred", "either"), ("a\nb", "either"), ("/proc/x/y", "refused")]
            values += [("/dev/full", "refused"), ("full", "either"), ("dangling", "refused")]
        else:
            values += [
                (name, "refused") for name in ("nowhere", "/dev/null", "/dev/zero", "file.txt")
            ]
            values += [
                (name, "refused") for name in ("x" * 300, "\x1b[31m", "a\nb", "dangling", "")
            ]
            values += [("/dev/stdin", "refused"), ("empty", "refused"), (".", "refused")]
    if bool in flag.kinds:
        values += [("maybe", "refused"), ("1", "refused"), ("None", "refused")]
    return values


def _shown(word: str) -> tuple[str, ...]:
    """How a message may show a word; empty where it has none to show."""
    if not word.strip() or len(word) > 60:
        return ()
    forms = [word, repr(word)[1:-1]]
    with contextlib.suppress(ValueError, OverflowError):
        forms += [repr(float(word)), str(int(float(word)))]
    return (*forms, "inf") if "e400" in word else tuple(forms)


def _case(
    command: str,
    words: Sequence[str],
    expected: Expected,
    names: Sequence[str] = (),
    found: Sequence[str] = (),
    codes: tuple[int, ...] = USAGE,
    outputs: Sequence[str] = (),
) -> Case:
    return Case(
        command=command,
        words=tuple(words),
        kind="flags",
        change="",
        expected=expected,
        codes=codes,
        needs=BASE[command][1],
        names=names,
        found=found,
        outputs=(*MAY_WRITE, *outputs),
    )


def base_words(command: str) -> list[str]:
    return BASE[command][0].split()


def _one_bad_value(rng: np.random.Generator, command: str) -> Case:
    flag, beside = pick(rng, all_flags(command))
    value, expected = pick(rng, _bad_values(flag))
    codes = BOTH if Path in flag.kinds else USAGE
    if not flag.name:
        words = [word for word in base_words(command) if word not in ("result", "run", "table4")]
        # A word that looks like a flag, or is missing, is another fault.
        words = [value, *words]
        shown = _shown(value)
        names = (*shown, "folder", "unknown") if shown else ()
        return _case(command, words, expected, names, shown, codes)
    words = without_flag([*base_words(command), *beside], flag)
    spelling = pick(rng, [s for s in flag.spellings if not s.startswith("--no-")])
    joined = value.startswith("-") or rng.random() < 0.3
    added = [f"{spelling}={value}"] if joined else [spelling, value]
    if bool in flag.kinds:
        added = [f"{spelling}={value}"]
    names = tuple(s for s in flag.spellings if not s.startswith("--no-"))
    if str in flag.kinds:
        names += ("unknown",)
    if flag.choices or str in flag.kinds or Path in flag.kinds:
        names += (
            flag.name,
            value.rpartition("/")[0] or flag.name,
            *_shown(value),
        )
    if Path in flag.kinds and not value:  # the current folder
        names = ()
    outputs = (value,) if flag.name in OUTPUTS else ()
    found = () if outputs or flag.name == "only" else _shown(value)
    return _case(command, [*words, *added], expected, names, found, codes, outputs)


def _odd_line(rng: np.random.Generator, command: str) -> Case:
    """Words that are no flag, flags without a value, flags twice, and abbreviations."""
    words = base_words(command)
    flag, beside = pick(rng, [pair for pair in all_flags(command) if pair[0].name])
    spelling = flag.spellings[0]
    valued = bool not in flag.kinds
    ways: list[tuple[list[str], Expected, str]] = [
        ([*words, "--nonsense"], "refused", "--nonsense"),
        ([*words, "--nonsense", "1"], "refused", "--nonsense"),
        ([*words, "-x"], "refused", "-x"),
        ([*words, "--=1"], "refused", "--"),
        ([*words, f"{spelling}x", "1"], "refused", f"{spelling}x"),
        ([*words, f"-{spelling}", "1"], "refused", spelling),
        ([*words, "--\x1b[31m"], "refused", "31m"),
    ]
    rest = without_flag([*words, *beside], flag)
    if len(flag.name) > 6:
        ways.append(([*rest, spelling[:-2], "1"], "refused", spelling[:-2]))
    if valued and not flag.many:
        ways.append(([*rest, spelling], "refused", spelling))
        ways.append(([*rest, spelling, "1", spelling, "2"], "either", spelling))
        ways.append(([*rest, f"{spelling}=x=y"], "refused", spelling))
    chosen, expected, name = pick(rng, ways)
    codes = BOTH if Path in flag.kinds and "=x=y" in chosen[-1] else USAGE
    if Path in flag.kinds and flag.name in OUTPUTS and "=x=y" in chosen[-1]:
        expected = "either"
    return _case(command, chosen, expected, (name, flag.name, "unknown"), (), codes, ("x=y",))


def _contradiction(rng: np.random.Generator, command: str) -> Case:
    text, name = pick(rng, CONTRADICTIONS[command])
    added = text.split()
    words = base_words(command)
    if command == "data" and not added[0].startswith("-"):
        words = added  # another command of it
    elif not added[0].startswith("-"):  # another word in place of the first
        words = words[1:] if words and not words[0].startswith("-") else words
        words = [*added, *words]
    else:
        given = {word.split("=")[0] for word in added if word.startswith("--")}
        for flag, _ in all_flags(command):
            if given & set(flag.spellings):
                words = without_flag(words, flag)
        words += added
    case = _case(command, words, "refused", (name,), (), BOTH)
    needs = (*case.needs, "policy") if "policy" in added else case.needs
    return dataclasses.replace(case, needs=needs)


def _valid(rng: np.random.Generator, command: str) -> Case:
    """A sound command line with further valid words."""
    words = base_words(command)
    expected: Expected = "accepted"
    texts = VALID.get(command, ())
    if texts and rng.random() < 0.5:
        added = pick(rng, texts).split()
        if not added[0].startswith("-"):
            words = [word for word in words if word not in ("result", "table4")]
            return _case(command, [*added, *words], "accepted")
    else:
        simple = [
            (flag, beside)
            for flag, beside in all_flags(command)
            if type(flag.default) in (int, float) or flag.choices
            if not any(word.split("=")[0] in flag.spellings for word in words)
        ]
        if not simple:
            return _case(command, words, "accepted")
        flag, beside = pick(rng, simple)
        value = pick(rng, flag.choices) if flag.choices else repr(flag.default)
        added = [*beside, pick(rng, flag.spellings[:2]), value]
        expected = "either" if flag.name in OF_THE_WORLD else "accepted"
    given = {word.split("=")[0] for word in added if word.startswith("--")}
    for flag, _ in all_flags(command):
        if given & set(flag.spellings):
            words = without_flag(words, flag)
    return _case(command, [*words, *added], expected)


WAYS = ((_one_bad_value, 7), (_odd_line, 2), (_contradiction, 2), (_valid, 2))


def flag_case(rng: np.random.Generator) -> Case:
    """A command line of any command; most have a single fault."""
    flags = {command: len(all_flags(command)) for command in COMMANDS}
    commands = [command for command, num in flags.items() for _ in range(2 + num // 6)]
    command = pick(rng, commands)
    ways = [way for way, weight in WAYS for _ in range(weight)]
    return pick(rng, ways)(rng, command)
