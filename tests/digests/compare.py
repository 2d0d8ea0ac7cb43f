"""Compare results digit by digit with recorded ones: ``python tests/digests/compare.py --tier quick``.

Floating-point results depend on the processor and on the versions of jax and XLA, so a digest is only
good for the machine that recorded it. Record on the commit to compare with, then check on the present
one:

    git worktree add /tmp/before COMMIT
    python tests/digests/compare.py --record --checkout /tmp/before --tier full
    python tests/digests/compare.py --tier full

``quick`` takes about two minutes, ``full`` half an hour on two cores. ``recorded.json`` beside this file
holds the digests, and the machine and the revision that they were recorded with.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
RECORDED = HERE / "recorded.json"
# Entries of a summary for which older versions recorded 0 or an empty interval with a single seed.
SPREADS = ("final_return_std_over_seeds", "final_return_iqm_95", "regret_std_over_seeds")
TIMES = ("cpu_seconds", "episodes_per_cpu_second")  # entries of a summary that differ in every run


class Case(NamedTuple):
    """A command and the tier that it belongs to."""

    command: str
    tier: str


def adapt(env: str, bandit: str, seeds: int, episodes: int, extra: str = "") -> str:
    return (
        f"experiments.adapt --env {env} --bandit {bandit} --seeds {seeds} --episodes {episodes} "
        f"--no-figures {extra}"
    ).strip()


def pretrain(env: str, steps: int, episodes: int, extra: str = "") -> str:
    return (
        f"experiments.pretrain --env {env} --steps {steps} --episodes {episodes} --holdout 32 "
        f"--eval-tasks 4 --eval-every {steps} --save-every {steps} {extra}"
    ).strip()


CASES = [
    *(Case(adapt("maze15", name, 1, 20), "quick") for name in ("ucb", "bpe", "grips", "bbt")),
    Case(adapt("gridworld", "ucb", 1, 12), "quick"),
    Case(pretrain("maze15", 20, 400), "quick"),
    *(
        Case(adapt("maze15", name, 3, 100), "full")
        for name in ("ucb", "bpe", "explore", "grips", "bbt")
    ),
    Case(adapt("gridworld", "ucb", 3, 100), "full"),
    Case(adapt("maze30", "ucb", 1, 100), "full"),
    Case(adapt("kitchen", "ucb", 1, 100, "--tasks TWO_TASKS"), "full"),
    Case(pretrain("maze15", 200, 4000), "full"),
    Case(pretrain("gridworld", 200, 4000), "full"),
    Case(pretrain("maze30", 200, 1000), "full"),
    Case(pretrain("kitchen", 200, 400), "full"),
]


def digest_of_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """A hash of names, types, shapes and bits."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        whole.update(f"{name} {array.dtype} {array.shape} ".encode())
        whole.update(array.tobytes())
    return whole.hexdigest()


def run_case(case: Case, checkout: Path, scratch: Path) -> dict[str, Any]:
    """Run the command of a case; returns its results as values and digests."""
    out = scratch / "out"
    shutil.rmtree(out, ignore_errors=True)
    words = case.command.split()
    if "TWO_TASKS" in words:
        words[words.index("TWO_TASKS")] = str(two_tasks(checkout, words[2], scratch))
    variables = {**os.environ, "MGPO_DATA": str(scratch / "data"), "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-m", *words, "--out", str(out)]
    done = subprocess.run(
        command, cwd=checkout, env=variables, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    if (out / "summary.json").is_file():
        summary = json.loads((out / "summary.json").read_text())
        return {name: value for name, value in summary.items() if name not in TIMES}
    with np.load(out / "policy" / "weights.npz") as weights:
        digest = digest_of_arrays(dict(weights))
    rows = [json.loads(row) for row in (out / "metrics.jsonl").read_text().splitlines()]
    del rows[-1]["cpu_seconds_per_step"]
    return {"weights": digest, **rows[-1]}


def two_tasks(checkout: Path, env: str, scratch: Path) -> Path:
    """The first two test tasks of a world, as a task file."""
    released = next(checkout.glob(f"**/pretrained/{env}/tasks.npz"))
    with np.load(released) as tasks:
        first = {name: array[:2] for name, array in tasks.items()}
    path = scratch / "two_tasks.npz"
    np.savez(path, allow_pickle=False, **first)
    return path


def differences(recorded: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """Entries that are missing or have another value; new entries are fine."""
    return [
        f"{name}: recorded {value}, found {found.get(name)}"
        for name, value in recorded.items()
        if found.get(name, ...) != value and not (name in SPREADS and found.get(name, ...) is None)
    ]


def machine() -> str:
    names = [
        line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    return names[0].split(":")[1].strip() if names else platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tier", choices=("quick", "full"), default="quick")
    parser.add_argument("--record", action="store_true", help="record instead of comparing")
    parser.add_argument("--checkout", type=Path, default=ROOT, help="the tree to run")
    parser.add_argument("--only", default="", help="run the commands that contain this text")
    options = parser.parse_args()
    store = json.loads(RECORDED.read_text()) if RECORDED.is_file() else {"results": {}}
    tiers = ("quick",) if options.tier == "quick" else ("quick", "full")
    failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        for case in CASES:
            if case.tier not in tiers or options.only not in case.command:
                continue
            start = time.time()
            found = run_case(case, options.checkout.absolute(), Path(scratch))
            if options.record:
                store["results"][case.command] = found
                store["machine"] = machine()
                store["revision"] = subprocess.run(
                    ["git", "describe", "--always", "--abbrev=12"],
                    cwd=options.checkout, capture_output=True, text=True, check=True,
                ).stdout.strip()  # fmt: skip
                RECORDED.write_text(json.dumps(store, indent=1) + "\n")
                verdict = ["recorded"]
            else:
                verdict = differences(store["results"][case.command], found) or ["equal"]
                failed += verdict != ["equal"]
            print(f"{time.time() - start:5.0f} s  {case.command}: {'; '.join(verdict)}", flush=True)
    if failed:
        raise SystemExit(f"{failed} commands gave other results than on {store['machine']}")


if __name__ == "__main__":
    main()
