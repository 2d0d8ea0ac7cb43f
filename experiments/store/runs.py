"""The folder of a pre-training run: when a run may start there, and what a resumed run must agree on.

It contains ``config.json`` (the settings), ``meta.json`` (provenance), ``init`` (a copy of the policy that
the run started from, if any), ``metrics.jsonl``, ``checkpoints`` and, when the run is finished, ``policy``
and ``training.png``. A start writes ``config.json`` last, so a run has begun if that exists. Nothing here
imports jax.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

from envs.errors import DataError, UsageError, shown
from experiments.store.initial import INIT, goes_on, initial_at, initial_folder, read_initial
from experiments.store.provenance import count_devices
from experiments.store.settings import (
    DEFAULT_WORLD,
    PretrainConfig,
    saved_pretraining,
    training_settings,
)
from mgpo_jax.claims import LOCK, check_place
from mgpo_jax.files import (
    TEMPORARY,
    hash_file,
    new_folder,
    remove_unfinished,
    write_json,
    written,
)
from mgpo_jax.schema import Json, read_document

CONFIG, META, CHECKPOINTS, POLICY = "config.json", "meta.json", "checkpoints", "policy"
PICTURE, WEIGHTS, GOALS = "training.png", "weights.npz", "goals.npz"
OLD_PARTIAL = "config.json.partial"  # left behind by older versions that were killed
PROLONGED = "prolonged_after"  # entry of META: the steps at which a finished run was prolonged
ROOM = 32 << 20  # bytes that must be free before a training starts, enough for small checkpoints


def has_begun(folder: Path) -> bool:
    """Whether a folder contains a run that has begun; one that was killed before that does not count."""
    return os.path.isfile(folder / CONFIG)


def is_finished(folder: Path) -> bool:
    """Whether a run has trained to its end and written its policy."""
    # The picture is written last.
    names = (f"{POLICY}/{CONFIG}", f"{POLICY}/{WEIGHTS}", PICTURE)
    return all(os.path.isfile(folder / name) for name in names)


def check_start(config: PretrainConfig) -> None:
    """Check that a run can be started, or resumed if its settings say so.

    Raises:
      UsageError: if its folder is taken or cannot be written to, or the settings of a resumed run differ.
      DataError: if there is a file in place of the folder of checkpoints.
    """
    folder = config.folder
    if has_begun(folder):
        if not config.resume:
            raise UsageError(
                f"{folder} already exists; continue it with --resume, or choose another folder with "
                "--out"
            )
        check_settings(config)
        if (folder / CHECKPOINTS).exists() and not (folder / CHECKPOINTS).is_dir():
            raise DataError(
                f"{folder / CHECKPOINTS} is not a folder; remove it to train from the first step"
            )
    elif os.path.lexists(folder) and not _holds_nothing(folder):
        raise UsageError(
            f"{folder} already exists and is not a training run; choose another folder with --out"
        )
    check_place(folder, num_bytes=ROOM)


def _holds_nothing(folder: Path) -> bool:
    """Whether a folder contains only leftovers of a run that was killed before it began."""
    own = {LOCK, META, OLD_PARTIAL}
    if (folder / META).is_file() and _holds_only(folder / INIT, {WEIGHTS, CONFIG, GOALS}):
        own.add(INIT)  # it is written after META
    return _holds_only(folder, own)


def _holds_only(folder: Path, names: Set[str]) -> bool:
    """Whether a folder contains nothing but entries with some names, and temporary files."""
    return folder.is_dir() and all(
        path.name in names or path.name.startswith(TEMPORARY) for path in folder.iterdir()
    )


def identity(config: PretrainConfig, dataset_sha256: str, init_sha256: str = "") -> str:
    """A hash of everything that determines the weights of a run, except for the machine.

    Args:
      config: settings of the run.
      dataset_sha256: hash of its dataset.
      init_sha256: hash of the weights that it starts from; empty for random weights.
    """
    usual = training_settings(PretrainConfig(env=DEFAULT_WORLD))
    # Defaults are left out, so that adding a setting later does not change the hash.
    settings = {k: v for k, v in training_settings(config).items() if v != usual[k]}
    hashes = [dataset_sha256, init_sha256] if init_sha256 else [dataset_sha256]
    text = json.dumps([settings, *hashes], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def begin(config: PretrainConfig, meta: dict[str, Any]) -> None:
    """Write the settings and provenance of a new run, and a copy of the policy that it starts from.

    Raises:
      DataError: if that policy was replaced since it was read.
    """
    (config.folder / OLD_PARTIAL).unlink(missing_ok=True)
    write_json(config.folder / META, meta)
    if config.init is None:  # remove what a killed start from a policy left behind
        shutil.rmtree(config.folder / INIT, ignore_errors=True)
    keep_initial(config, meta)
    write_json(config.folder / CONFIG, config)


def keep_initial(config: PretrainConfig, meta: Mapping[str, Any]) -> None:
    """Copy the policy that a run starts from into its folder, unless it was read from there.

    The run can then be resumed even if that policy is replaced, as by a release, or the run is moved.

    Raises:
      DataError: if the policy was replaced since it was read, or a file is in place of the copy.
    """
    if config.init is None or (source := initial_folder(config)) == config.folder / INIT:
        return
    place = config.folder / INIT
    if place.exists() and not place.is_dir():
        raise DataError(f"{place} is not a folder; remove it, and --init is read again")
    place.mkdir(exist_ok=True)
    remove_unfinished(place)
    for name in (WEIGHTS, CONFIG, GOALS):
        if name == GOALS and not (source / name).is_file():
            continue  # older policies have no goals
        with written(place / name) as partial:
            shutil.copyfile(source / name, partial)
    if hash_file(place / WEIGHTS) != meta["init_sha256"]:
        raise DataError(f"the policy in {source} was replaced just now; run the same command again")


def steps_trained(folder: Path) -> int:
    """The number of gradient steps that a finished run has taken; 0 if it is not finished.

    Raises:
      DataError: if the config of the policy is damaged.
    """
    if not is_finished(folder):
        return 0
    path = folder / POLICY / CONFIG
    document = read_document(path, dict[str, Json], "train it again")
    made = document.get("made")
    steps = made.get("steps") if isinstance(made, dict) else None
    return steps if isinstance(steps, int) else saved_pretraining(folder / CONFIG).train.steps


def prolonged(config: PretrainConfig) -> int | None:
    """The steps of a finished run that is resumed to take more; None for any other run."""
    folder = config.folder
    if not (goes_on(config) and (trained := steps_trained(folder))):
        return None
    return trained if trained < config.train.steps else None


def kept_policy(folder: Path, trained: int) -> Path:
    """The folder that keeps the policy after ``trained`` steps when a finished run is prolonged."""
    return folder / f"{POLICY}-{trained}"


def note_prolonged(config: PretrainConfig, trained: int) -> None:
    """Record that a finished run takes more steps, and keep a copy of its present policy.

    The new settings are written last, so that the prolongation can be repeated if the process is killed.
    """
    kept = kept_policy(config.folder, trained)
    if not kept.exists():
        with new_folder(kept) as place:
            shutil.copytree(config.folder / POLICY, place, dirs_exist_ok=True)
    meta = _saved_meta(config.folder)
    before = [steps for steps in meta.get(PROLONGED, []) if isinstance(steps, int)]
    write_json(config.folder / META, {**meta, PROLONGED: sorted({*before, trained})})
    write_json(config.folder / CONFIG, config)


def identities(config: PretrainConfig, dataset_sha256: str, init_sha256: str = "") -> list[str]:
    """The identities that checkpoints of a run may have: its own, and those before it was prolonged."""
    before = _saved_meta(config.folder).get(PROLONGED, []) if goes_on(config) else []
    runs = [replace(config, train=replace(config.train, steps=steps)) for steps in before]
    return [identity(one, dataset_sha256, init_sha256) for one in (config, *runs)]


def check_settings(config: PretrainConfig) -> None:
    """Raise ``UsageError`` if a resumed run was started with other settings or other weights.

    Only the steps of a finished run may be raised.
    """
    folder = config.folder
    saved = saved_pretraining(folder / CONFIG)
    before, now = training_settings(saved), training_settings(config)
    if prolonged(config) == saved.train.steps:
        before |= {"steps": config.train.steps}
    if starts_elsewhere(saved, config):
        before |= {"init": saved.init and str(saved.init)}
        now |= {"init": config.init and str(config.init)}
    if changed := changes(before, now):
        raise UsageError(
            f"{folder} was started with other settings: {changed}; give the same ones, or start a new run "
            "with --out"
        )


def starts_elsewhere(saved: PretrainConfig, config: PretrainConfig) -> bool:
    """Whether a resumed run was started from other weights than its settings now say.

    If the path is the same as at the start, its content does not matter, since the run has a copy.
    """
    if saved.init == config.init:
        return False
    if saved.init is None or config.init is None:
        return True
    return initial_at(config.init).sha256 != read_initial(config).sha256


def check_same(config: PretrainConfig, meta: dict[str, Any]) -> None:
    """Check that a resumed run is trained on the same dataset as before.

    Other devices or versions, which may change the last bits of the result, are reported on stderr.

    Raises:
      DataError: if it was started on another dataset.
    """
    folder = config.folder
    if not (saved := _saved_meta(folder)):
        write_json(folder / META, meta)
        return
    hash_before, hash_now = saved.get("dataset_sha256"), meta["dataset_sha256"]
    if hash_before not in (None, hash_now):
        if (place := saved.get("dataset")) != meta["dataset"]:
            raise DataError(
                f"{folder} was trained on {shown(place)} with the hash {shown(hash_before)[:13]}.., "
                f"{meta['dataset']} has {hash_now[:12]}..; give the same data, or start a new run with "
                "--out"
            )
        raise DataError(
            f"{folder} was trained on {meta['dataset']} with the hash {shown(hash_before)[:13]}.., which "
            f"now has {hash_now[:12]}..; collect it again as it was, or start a new run with --out"
        )
    say_what_differs(saved, meta, str(folder))


def check_same_start(config: PretrainConfig, init_sha256: str) -> None:
    """Check that a resumed run started from the weights with a given hash.

    Raises:
      DataError: if it started from other weights.
    """
    before = _saved_meta(config.folder).get("init_sha256") if goes_on(config) else None
    if before not in (None, init_sha256):
        raise DataError(
            f"{config.folder} was started from weights with the hash {shown(before)[:13]}.., those in "
            f"{initial_folder(config)} have {init_sha256[:12]}..; put the policy back there, or start a "
            "new run with --out"
        )


def _saved_meta(folder: Path) -> dict[str, Any]:
    """The ``meta.json`` of a run; empty if the file does not exist."""
    if not (folder / META).is_file():
        return {}
    mend = f"remove {folder / META}, and it is written again"
    return read_document(folder / META, dict[str, Json], mend)


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The differences between two sets of settings, in words; empty if there are none."""
    return "; ".join(
        f"{name} {shown(before.get(name))} -> {shown(now.get(name))}"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    )


def say_what_differs(saved: dict[str, Any], now: dict[str, Any], what: str) -> None:
    """Report on stderr if work was begun with other devices or other versions.

    Args:
      saved: the ``meta.json`` of the work.
      now: provenance of this process.
      what: what the message calls the work.
    """
    differs = []
    if isinstance(saved.get("devices"), list):
        devices, devices_now = count_devices(saved["devices"]), count_devices(now["devices"])
        if devices != devices_now:
            differs.append(f"{devices} (now {devices_now})")
    if isinstance(saved.get("versions"), dict):
        versions = now["versions"]
        differs += [
            f"{name} {shown(old)} (now {versions.get(name)})"
            for name, old in saved["versions"].items()
            if versions.get(name) != old
        ]
    if differs:
        text = f"{what} was begun with {', '.join(differs)}: the result may differ in its last bits"
        print(text, file=sys.stderr)
