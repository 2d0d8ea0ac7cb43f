"""Prompt optimizers (paper, section 4.3, Table 2). ``methods.py`` turns them into methods."""

from __future__ import annotations

from mgpo_jax.optimizers.base import PromptOptimizer, SearchSpace
from mgpo_jax.optimizers.bbt import bbt
from mgpo_jax.optimizers.bpe import bpe
from mgpo_jax.optimizers.explore import explore
from mgpo_jax.optimizers.grips import grips
from mgpo_jax.optimizers.ucb import ucb

__all__ = ["PromptOptimizer", "SearchSpace", "bbt", "bpe", "explore", "grips", "ucb"]
