"""The cases of the fuzz suite, each a function of a seed and an index.

The suite is driven by tables, to which new commands and files must be added:

- A new command needs an entry in ``grammar_flags.BASE``: a sound command line, and the sound folders that
  it reads. Its flags are found in its dataclass. ``CONTRADICTIONS`` and ``VALID`` may add further lines,
  and ``work.PLACES`` says where its work begins.
- A new kind of file needs an entry in ``FILES`` below for each command that reads it: its path, the command
  line, and the traits of what must be refused. ``sound.make`` must make a sound file, whose content is then
  read to derive the damage.

``MADE_BY_HAND`` holds damage that no grammar would produce, such as a maze whose goal is too far away.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from .cases import BOTH, Case, Damage, Expected, pick, written
from .grammar_flags import MAY_WRITE, flag_case
from .grammar_json import JsonTraits, json_damage, json_variant
from .grammar_npz import NpzTraits, npz_damage, npz_variant, read, saved

VALID_SHARE = 0.12  # of the cases of files are sound ones in another spelling
FLAGS_SHARE = 0.35  # of all cases have a sound input and a command line that is not

NETWORK = (
    "network.obs_shape.*", "network.goal_dim", "network.action_dim", "network.horizon",
    "network.max_prompt_length", "network.embed_dim", "network.num_layers", "network.num_heads",
    "network.tokens_per_step",
)  # fmt: skip
POLICY = JsonTraits(
    checked=("format", "sha256", "network", "network.*", "made"),
    required=("format", "sha256", "network", "network.obs_shape", *NETWORK[1:-1]),
    positive=NETWORK,
    shares=("network.dropout",),
    names=("sha256", "network.head", "network.encoder", "network.obs_dtype"),
    closed=("network",),
)
WEIGHTS = NpzTraits(required=("*",), hash_in=("config.json", "sha256"))
# The place of a method, such as ``module:attribute``, is only shown: nothing is imported for it.
RESULT_CONFIG = JsonTraits(
    checked=("env", "policy"),
    required=("env",),
    names=("env",),
    texts=("policy",),
    nullable=("policy", "method"),
)
RESULT_ARRAYS = NpzTraits(
    required=("returns", "eval_episodes", "eval_returns", "best.prompt.*", "choice.prompt.*"),
    bounded=("eval_episodes", "eval_achieved", "reached_index", "reached_counts", "*returns"),
    free=("*.prompt.goals",),
)
MAZES = NpzTraits(required=("*",), bounded=("maze", "goal"))
NOTHING = JsonTraits(checked=(), document="either")
RUN_CONFIG = JsonTraits(
    checked=("*",),
    required=("data", "train", "env"),
    positive=(
        "train.steps", "train.batch_size", "train.part_size", "train.part_steps", "train.bucket",
        "data.trajectories", "embed_dim", "num_layers", "num_heads", "max_prompt_length",
        "tokens_per_step",
    ),
    names=("env", "train.optimizer", "train.schedule", "encoder"),
    closed=(".", "data", "train"),
    nullable=("out", "head", "data.demonstrator"),
    texts=("out", "preset", "head", "data.demonstrator"),
)  # fmt: skip
SUMMARY = JsonTraits(
    checked=("*",),
    required=("env", "num_tasks", "num_seeds", "num_episodes", "initial_return", "final_return"),
    positive=("num_tasks", "num_seeds", "num_episodes", "fresh.episodes"),
    shares=("solved_optimally", "achieved.*"),
    names=("env", "method"),
    closed=("fresh",),
    nullable=("optimal_return", "regret", "regret_*", "solved_optimally", "method", "optimizer",
              "policy_sha256", "final_return_std_over_seeds", "final_return_iqm*", "part_shares",
              "fresh.gain_95"),
    texts=("policy_sha256",),
)  # fmt: skip
MANIFEST = JsonTraits(
    checked=(
        "format",
        "sha256",
        "env",
        "policy",
        "seed",
        "num_trajectories",
        "num_steps",
        "settings",
    ),
    required=("format", "sha256"),
    positive=("num_trajectories", "num_steps"),
    names=("sha256", "env", "policy"),
)
TRAJECTORIES = NpzTraits(
    required=("obs", "actions", "achieved_goals", "goal_reached", "outcomes", "lengths"),
    bounded=("actions", "intended", "lengths", "obs", "achieved_goals", "outcomes"),
    hash_in=("manifest.json", "sha256"),
)


@dataclass(frozen=True)
class FileKind:
    """One file that one command reads."""

    command: str
    words: str
    folder: str
    """Sound material that the command reads; the damaged file lies in it, or is it."""
    file: str
    """Path of the file in the folder; empty where the folder is a file."""
    traits: JsonTraits | NpzTraits | None
    """None for a file that is neither JSON nor npz; then only ``MADE_BY_HAND`` has damage for it."""
    weight: int = 2
    also: Sequence[str] = ()
    """Further sound material."""
    partners: Sequence[str] = ()
    """Other files that a refusal may name: those that this one has to agree with."""

    @property
    def path(self) -> str:
        return f"{self.folder}/{self.file}" if self.file else self.folder

    @property
    def kind(self) -> str:
        return f"{self.path} of {self.command}"


ADAPT = (
    "--policy policy --tasks tasks.npz --seeds 1 --episodes 10 --eval-episodes 1 --no-figures "
    "--out new"
)
PRETRAIN = (
    "--preset smoke --trajectories 40 --holdout 8 --embed-dim 8 --num-layers 1 --batch-size 8 "
    "--part-size 4 --bucket 64 --eval-tasks 2 --steps 4 --save-every 2 --eval-every 2"
)
RESUME = f"{PRETRAIN} --out run --resume"
ON = f"{PRETRAIN} --init policy".replace("--embed-dim 8 --num-layers 1 ", "")
RESUME_ON = f"{ON} --out begun --resume"
PLOT = "result --out new"
CHECK = "result --out new.json"
REPORT = "result --out new.html"
PLAYGROUND = "--policy policy --out new.html"
OF_DATASET = ("trajectories.npz", "was collected by")
OF_SUMMARY = ("summary.json",)
OF_POLICY = ("weights.npz", "policy is not", "policy of", "no finished policy")
DATASET = "data/maze15/astar4-40-seed0"
FILES = (
    FileKind("adapt", ADAPT, "policy", "config.json", POLICY, 4, ("tasks.npz",), OF_POLICY),
    FileKind("adapt", ADAPT, "policy", "weights.npz", WEIGHTS, 3, ("tasks.npz",)),
    FileKind("adapt", ADAPT, "tasks.npz", "", MAZES, 4, ("policy",)),
    FileKind("evaluate", "result", "policy", "config.json", POLICY, 2, ("result",), OF_POLICY),
    FileKind("evaluate", "result", "result", "results.npz", RESULT_ARRAYS, 3, ("policy",)),
    FileKind("evaluate", "result", "result", "tasks.npz", MAZES, 2, ("policy",)),
    FileKind("evaluate", "result", "result", "config.json", RESULT_CONFIG, 2, ("policy",), ("weights",)),
    FileKind("evaluate", "result", "result", "summary.json", NOTHING, 1, ("policy",)),
    FileKind("evaluate", "result", "result", "meta.json", NOTHING, 1, ("policy",)),
    FileKind("check", CHECK, "policy", "config.json", POLICY, 1, ("result",), OF_POLICY),
    FileKind("check", CHECK, "result", "results.npz", RESULT_ARRAYS, 1, ("policy",)),
    FileKind("check", CHECK, "result", "config.json", RESULT_CONFIG, 1, ("policy",), ("weights",)),
    FileKind("plot", PLOT, "result", "results.npz", RESULT_ARRAYS, 4, ("policy",)),
    FileKind("plot", PLOT, "result", "tasks.npz", MAZES, 2, ("policy",)),
    FileKind("plot", PLOT, "result", "config.json", RESULT_CONFIG, 3, ("policy",), ("weights",)),
    FileKind("plot", PLOT, "result", "summary.json", NOTHING, 1, ("policy",)),
    FileKind("report", REPORT, "result", "results.npz", RESULT_ARRAYS, 3, (), OF_SUMMARY),
    FileKind("report", REPORT, "result", "tasks.npz", MAZES, 2),
    FileKind("report", REPORT, "result", "config.json", RESULT_CONFIG, 2, (), OF_SUMMARY),
    FileKind("report", REPORT, "result", "summary.json", SUMMARY, 2),
    FileKind("report", REPORT, "result", "meta.json", NOTHING, 1),
    FileKind("playground", PLAYGROUND, "policy", "config.json", POLICY, 2, (), OF_POLICY),
    FileKind("playground", PLAYGROUND, "policy", "weights.npz", WEIGHTS, 1),
    FileKind("table", "result", "result", "summary.json", SUMMARY, 6),
    FileKind("table", "result", "result", "config.json", NOTHING, 2),
    FileKind("table", "result", "result", "results.npz", NpzTraits(checked=()), 1),
    FileKind("table", "result", "result", "tasks.npz", NpzTraits(checked=()), 1),
    FileKind("pretrain", PRETRAIN, DATASET, "manifest.json", MANIFEST, 3, (), OF_DATASET),
    FileKind("pretrain", PRETRAIN, DATASET, "trajectories.npz", TRAJECTORIES, 5),
    FileKind("pretrain", RESUME, "run", "config.json", RUN_CONFIG, 2, ("data",), ("run",)),
    FileKind("pretrain", RESUME, "run", "meta.json", NOTHING, 1, ("data",), ("run",)),
    FileKind("pretrain", RESUME, "run", "metrics.jsonl", None, 2, ("data",)),
    FileKind("pretrain", RESUME, "run", "checkpoints", None, 2, ("data",)),
    FileKind("pretrain", ON, "policy", "config.json", POLICY, 2, ("data",), OF_POLICY),
    FileKind("pretrain", ON, "policy", "weights.npz", WEIGHTS, 2, ("data",), OF_POLICY),
    FileKind("pretrain", RESUME_ON, "begun", "init", None, 2, ("data", "policy"), ("begun/init",)),
    FileKind("reproduce", "table4 --seeds 1 --out old", "old", "maze15/table4/K1-1seeds", None, 2),
    FileKind("release", "run --out new", "run/policy", "config.json", POLICY, 2, ("run",), OF_POLICY),
    FileKind("release", "run --out new", "run/policy", "weights.npz", WEIGHTS, 1, ("run",), OF_POLICY),
    FileKind("release", "run --out new", "run", "meta.json", NOTHING, 1),
    FileKind("release", "run --out new", "run", "metrics.jsonl", None, 3),
)  # fmt: skip
"""Who reads what."""


def _rows(change: Callable[[list[Any]], None]) -> Callable[[bytes], bytes]:
    """Damage to the rows of ``metrics.jsonl``."""

    def do(data: bytes) -> bytes:
        rows = [json.loads(line) for line in data.splitlines()]
        change(rows)
        return "".join(json.dumps(row) + "\n" for row in rows).encode()

    return do


def _set(name: str, value: Any) -> Callable[[list[Any]], None]:
    return lambda rows: rows[-1].__setitem__(name, value)


METRICS: dict[str, tuple[Callable[[bytes], bytes], Expected]] = {
    "missing its last half row": (lambda data: data[:-40], "either"),
    "with zero bytes at its end": (lambda data: data + bytes(50), "either"),
    "with a row of no JSON in it": (lambda data: b"what\n" + data, "either"),
    "empty": (lambda data: b"", "refused"),
    "of random bytes": (lambda data: bytes(range(128, 256)) * 9, "refused"),
    "of lists": (_rows(lambda rows: rows.__setitem__(slice(None), [[1], [2]])), "refused"),
    "with a list at its end": (_rows(lambda rows: rows.append([1])), "either"),
    "with a step of null": (_rows(_set("step", None)), "refused"),
    "with a step of text": (_rows(_set("step", "x")), "refused"),
    "with a step of 2.5": (_rows(_set("step", 2.5)), "refused"),
    "with a negative step": (_rows(_set("step", -1)), "refused"),
    "lacking the step": (_rows(lambda rows: rows[-1].pop("step")), "refused"),
    "lacking the loss": (_rows(lambda rows: rows[-1].pop("val/loss")), "refused"),
    "lacking the CPU time": (_rows(lambda rows: rows[-1].pop("cpu_seconds_per_step")), "refused"),
    "with a loss of NaN": (_rows(_set("val/loss", float("nan"))), "refused"),
    "with a loss of text": (_rows(_set("val/loss", "\x1b[31m")), "refused"),
    "with a step twice": (_rows(lambda rows: rows.append(rows[-1])), "either"),
    "nested 5,000 deep": (lambda data: data + b"[" * 5_000 + b"]" * 5_000 + b"\n", "either"),
}


def _lines(rng: np.random.Generator, kind: FileKind, data: bytes) -> Damage:
    name = pick(rng, list(METRICS))
    change, expected = METRICS[name]
    if kind.command == "pretrain":  # goes on with the rows that are sound
        expected = "either"
    return Damage(name, expected, written(change(data)))


def _each_file(change: Callable[[Path], Any]) -> Callable[[Path], None]:
    def do(folder: Path) -> None:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            change(path)

    return do


def _halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _swap(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("no folder")


def _one_file(rng: np.random.Generator) -> Callable[[Path], None]:
    where, bit = rng.random(2), int(rng.integers(8))

    def do(folder: Path) -> None:
        files = sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size)
        path = files[int(where[0] * len(files))]
        data = bytearray(path.read_bytes())
        data[int(where[1] * len(data))] ^= 1 << bit
        path.write_bytes(bytes(data))

    return do


def _checkpoints(rng: np.random.Generator, kind: FileKind, data: bytes) -> Damage:
    """Damage checkpoints: the run must continue from a sound one, or refuse."""
    damages: dict[str, tuple[Callable[[Path], None], Expected]] = {
        "a file": (_swap, "refused"),
        "of empty files": (_each_file(lambda path: path.write_bytes(b"")), "either"),
        "of cut files": (_each_file(_halve), "either"),
        "without files": (_each_file(Path.unlink), "either"),
        "with one flipped bit": (_one_file(rng), "either"),
        "with a foreign folder": (lambda path: (path / "notes").mkdir(), "either"),
        "with a step of text": (lambda path: (path / "12x").mkdir(), "either"),
        "with a step of 10**30": (lambda path: (path / str(10**30)).mkdir(), "either"),
    }  # fmt: skip
    name = pick(rng, list(damages))
    do, expected = damages[name]
    return Damage(name, expected, do, BOTH)


def _other_weights_in(folder: Path) -> None:
    """Replace the weights by other sound ones, with their hash."""
    path = folder / "weights.npz"
    arrays = {name: 2 * array for name, array in read(path).items()}
    _mended(written(saved(arrays)), ("config.json", "sha256"))(path)


def _copied_policy(rng: np.random.Generator, kind: FileKind, data: bytes) -> Damage:
    """Damage the copy of the policy that a run started from; if it is missing, ``--init`` is read again."""
    damages: dict[str, tuple[Callable[[Path], None], Expected]] = {
        "a file": (_swap, "refused"),
        "of empty files": (_each_file(lambda path: path.write_bytes(b"")), "refused"),
        "of cut files": (_each_file(_halve), "refused"),
        "with other weights": (_other_weights_in, "refused"),
        "without weights.npz": (lambda folder: (folder / "weights.npz").unlink(), "refused"),
        "without config.json": (lambda folder: (folder / "config.json").unlink(), "accepted"),
        "without files": (_each_file(Path.unlink), "accepted"),
        "missing": (shutil.rmtree, "accepted"),
        "with one flipped bit": (_one_file(rng), "either"),
    }
    name = pick(rng, list(damages))
    do, expected = damages[name]
    return Damage(name, expected, do, BOTH)


def _old_result(rng: np.random.Generator, kind: FileKind, data: bytes) -> Damage:
    """Put a result that does not belong there in the place of a table's row."""
    damages: dict[str, Callable[[Path], None]] = {
        "found with other weights": lambda folder: None,
        "a file": _swap,
        "without files": _each_file(Path.unlink),
        "of empty files": _each_file(lambda path: path.write_bytes(b"")),
        "of cut files": _each_file(_halve),
        "without config.json": lambda folder: (folder / "config.json").unlink(),
        "without results.npz": lambda folder: (folder / "results.npz").unlink(),
    }
    name = pick(rng, list(damages))
    return Damage(name, "refused", damages[name], BOTH)


OTHERS: dict[str, Callable[[np.random.Generator, FileKind, bytes], Damage]] = {
    "metrics.jsonl": _lines,
    "checkpoints": _checkpoints,
    "K1-1seeds": _old_result,
    "init": _copied_policy,
}
"""Damage to files that are neither JSON nor npz, by their names."""


def _far_goal(arrays: dict[str, np.ndarray]) -> None:
    """A winding corridor whose goal is farther away than an episode has steps."""
    side = arrays["maze"].shape[-1]
    maze = np.ones((side, side), arrays["maze"].dtype)
    for row in range(1, side - 1, 2):
        maze[row, 1:-1] = 0
        if row + 1 < side - 1:
            maze[row + 1, side - 2 if row % 4 == 1 else 1] = 0
    arrays["maze"][0] = maze
    arrays["goal"][0] = (1, 1)  # episodes start in the row at the bottom


def _walls(arrays: dict[str, np.ndarray]) -> None:
    arrays["maze"][0] = 1


def _outside(arrays: dict[str, np.ndarray]) -> None:
    arrays["goal"][0] = arrays["maze"].shape[-1] + 3


def _no_border(arrays: dict[str, np.ndarray]) -> None:
    arrays["maze"][0] = 0


MADE_BY_HAND: Mapping[str, Mapping[str, Callable[[dict[str, np.ndarray]], None]]] = {
    "tasks.npz": {
        "a goal that is 90 steps away": _far_goal,
        "a maze of walls only": _walls,
        "a goal outside of the maze": _outside,
        "a maze without a border": _no_border,
    }
}
"""Sound arrays that make no sense, by the name of the file."""

CONTRADICTIONS: Mapping[str, Mapping[str, Any]] = {
    "manifest.json": {
        "env": "gridworld",
        "policy": "random",
        "seed": 7,
        "num_trajectories": 5,
        "num_steps": 1,
        "format": 99,
        "format ": True,
        "settings": {"speed": 2},
    },
    "config.json": {"format": 99},
}
"""Entries that contradict the rest of a file."""


def _hash(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _mended(do: Callable[[Path], None], hash_in: tuple[str, str]) -> Callable[[Path], None]:
    """Damage that also updates the recorded hash, so that later checks are reached."""

    def both(path: Path) -> None:
        do(path)
        if path.is_file() and path.stat().st_size:
            document = path.with_name(hash_in[0])
            content = json.loads(document.read_text())
            content[hash_in[1]] = _hash(path)
            document.write_text(json.dumps(content))

    return both


def _npz(rng: np.random.Generator, kind: FileKind, traits: NpzTraits, sound: Path) -> Damage:
    arrays = read(sound)
    by_hand = MADE_BY_HAND.get(sound.name, {}) if kind.command == "adapt" else {}
    if rng.random() < VALID_SHARE:
        damage = npz_variant(rng, arrays)
    elif by_hand and rng.random() < 0.2:
        name = pick(rng, list(by_hand))
        copies = {name: array.copy() for name, array in arrays.items()}
        by_hand[name](copies)
        damage = Damage(name, "refused", written(saved(copies)))
    else:
        damage = npz_damage(rng, arrays, traits)
    if traits.hash_in is None:
        return damage
    if damage.expected == "accepted" or rng.random() < 0.85:
        both = Damage(
            damage.text, damage.expected, _mended(damage.do, traits.hash_in), damage.codes
        )
        return both
    expected: Expected = "refused"
    return Damage(f"{damage.text}, with another hash than noted", expected, damage.do, damage.codes)


def _json(rng: np.random.Generator, traits: JsonTraits, sound: Path) -> Damage:
    document = json.loads(sound.read_text())
    entries = {
        name.strip(): value
        for name, value in CONTRADICTIONS.get(sound.name, {}).items()
        if name.strip() in document
    }
    if rng.random() < VALID_SHARE:
        return json_variant(rng, document)
    if entries and traits.checked and rng.random() < 0.15:
        name = pick(rng, list(entries))
        data = json.dumps({**document, name: entries[name]}).encode()
        return Damage(f"{name} is {entries[name]!r}", "refused", written(data))
    return json_damage(rng, document, traits)


def _other_weights(here: Path, sound: Path) -> str:
    """Says if the policy of a finished run changed when the run was resumed; empty if it did not."""
    policy = here / "run/policy/weights.npz"
    if not policy.is_file():
        return ""  # the training goes on from an earlier step
    now, before = read(policy), read(sound)
    same = all(np.array_equal(now[name], before[name]) for name in before)
    return "" if same else "the policy has other weights than without the damage"


def file_case(rng: np.random.Generator, sound: Path) -> Case:
    """A sound command line with damage to one of its files.

    Args:
      rng: source of randomness.
      sound: the folder that ``sound.make`` made.
    """
    kind = pick(rng, [kind for kind in FILES for _ in range(kind.weight)])
    path = sound / kind.path
    if isinstance(kind.traits, JsonTraits):
        damage = _json(rng, kind.traits, path)
    elif isinstance(kind.traits, NpzTraits):
        damage = _npz(rng, kind, kind.traits, path)
    else:
        data = path.read_bytes() if path.is_file() else b""
        damage = OTHERS[path.name](rng, kind, data)
    hashed = (
        kind.traits.hash_in[0] if isinstance(kind.traits, NpzTraits) and kind.traits.hash_in else ""
    )
    resumed = (kind.folder,) if "--resume" in kind.words else ()
    weights = sound / "run/policy/weights.npz"
    needs = {name.split("/")[0] for name in (kind.folder, *kind.also)}
    return Case(
        command=kind.command,
        words=tuple(kind.words.split()),
        kind=kind.kind,
        change=damage.text,
        expected=damage.expected,
        codes=BOTH if resumed else damage.codes,  # other settings are a fault of the request
        needs=tuple(sorted(needs)),
        prepare=lambda here: damage.do(here / kind.path),
        names=(path.name, *kind.partners, *((hashed,) if hashed else ())),
        check=(lambda here: _other_weights(here, weights)) if resumed else None,
        outputs=(*MAY_WRITE, *resumed),
    )


def case(seed: int, index: int, sound: Path) -> Case:
    """The case with an index; it is the same as long as the tables and the sound material are."""
    rng = np.random.default_rng([seed, index])
    if rng.random() < FLAGS_SHARE:
        return flag_case(rng)
    return file_case(rng, sound)
