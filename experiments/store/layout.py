"""The file names in the result folder of an adaptation. Nothing here imports jax."""

from __future__ import annotations

ARRAYS, TASKS, CONFIG, META, SUMMARY = (
    "results.npz", "tasks.npz", "config.json", "meta.json", "summary.json"
)  # fmt: skip
