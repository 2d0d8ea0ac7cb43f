"""Prompt optimizers by the name ``--bandit`` knows (paper, section 4.3, Table 2)."""

from __future__ import annotations

from collections.abc import Callable

from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.optimizers.bbt import bbt
from mgpo_jax.optimizers.bpe import bpe
from mgpo_jax.optimizers.explore import explore
from mgpo_jax.optimizers.grips import grips
from mgpo_jax.optimizers.ucb import ucb

__all__ = ["OPTIMIZERS", "PromptOptimizer", "SearchSpace", "bbt", "bpe", "explore", "grips", "ucb"]

OPTIMIZERS: dict[str, Callable[..., PromptOptimizer]] = {
    "ucb": ucb,
    "bpe": bpe,
    "explore": explore,
    "grips": grips,
    "bbt": bbt,
}
