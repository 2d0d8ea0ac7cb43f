"""The baselines by name, with their hyper-parameters. Nothing here imports jax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from mgpo_jax.methods import Method
from mgpo_jax.settings import NotNegative, Positive, static

Rate = Annotated[float, Ge(0), Le(10)]
Share = Annotated[float, Ge(0), Le(1)]


@dataclass(frozen=True)
class FinetuneHyper:
    """Hyper-parameters of both policy gradients. The defaults are Table 7 where it says anything."""

    tune: Literal["all", "head", "lora"] = static("all")
    """What is trained: the whole network as in the paper, its last layers alone (``head``: the last norm
    and the layer that gives the distribution), or matrices of low rank beside those of the blocks
    (``lora``)."""
    rank: Annotated[int, Ge(1), Le(128)] = static(4)
    """Rank of those matrices."""
    round_episodes: Annotated[int, Ge(1), Le(1_000)] = static(5)
    """Episodes that one set of weights plays before the next update [5]."""
    learning_rate: Rate = 1e-4
    """Of AdamW [1e-4]."""
    weight_decay: Rate = 1e-4
    """Of AdamW, what Table 7 calls learning rate decay [1e-4]."""
    clip_norm: Positive = 0.25
    """Largest norm of a gradient (the paper does not say; the authors pre-train with 0.25)."""
    warmup_rounds: Annotated[int, Ge(0), Le(10_000)] = 0
    """Rounds over which the learning rate rises to its value."""
    discount: Share = 0.98
    """Discount factor of a step [0.98]."""
    kl: NotNegative = 0.0
    """Weight of the divergence KL(pi, pi_0) from the pre-trained policy in the loss."""


@dataclass(frozen=True)
class ReinforceHyper(FinetuneHyper):
    """Hyper-parameters of REINFORCE. The paper does not say which baseline it subtracts, if any."""

    baseline: bool = static(False)
    """Whether the mean return-to-go of the round's episodes at the same step is subtracted."""


@dataclass(frozen=True)
class CarefulReinforceHyper(ReinforceHyper):
    """REINFORCE that stays near the pre-trained policy; all changes are ours."""

    warmup_rounds: Annotated[int, Ge(0), Le(10_000)] = 5
    kl: NotNegative = 0.1
    baseline: bool = static(True)


@dataclass(frozen=True)
class PpoHyper(FinetuneHyper):
    """Hyper-parameters of PPO. Beyond Table 7 the paper gives none; the defaults are customary values."""

    clip: Positive = 0.2
    """How far the ratio of probabilities counts from 1."""
    epochs: Annotated[int, Ge(1), Le(1_000)] = static(4)
    """Gradient steps on the episodes of a round."""
    gae_lambda: Share = 0.95
    """Lambda of generalized advantage estimation."""
    value_weight: NotNegative = 0.5
    """Weight of the squared error of the values."""
    value_rate: Rate = 1e-4
    """Learning rate of the value head."""
    share_trunk: bool = static(True)
    """Whether the error of the values also trains the network below the value head."""
    value_rounds: Annotated[int, Ge(0), Le(10_000)] = 0
    """Rounds at the start in which the value head alone is trained."""
    max_kl: Positive | None = None
    """A round's remaining epochs are left out once the policy has moved farther than this (default:
    none are)."""


@dataclass(frozen=True)
class CarefulPpoHyper(PpoHyper):
    """PPO that stays near the pre-trained policy; all changes are ours."""

    warmup_rounds: Annotated[int, Ge(0), Le(10_000)] = 5
    kl: NotNegative = 0.1
    value_rate: Rate = 1e-3
    share_trunk: bool = static(False)
    value_rounds: Annotated[int, Ge(0), Le(10_000)] = 1
    max_kl: Positive | None = 0.02


@dataclass(frozen=True)
class PtgmHyper:
    """Hyper-parameters of PTGM's high level. Values in brackets are those of Table 10."""

    learning_rate: Rate = 1e-3
    """Of Adam [1e-3]."""
    batch_size: Annotated[int, Ge(1), Le(65_536)] = static(64)
    """Transitions in an update [64]."""
    discount: Share = 0.95
    """Discount factor of a decision [0.95]."""
    epsilon: Share = 0.1
    """How often the high level takes a random goal [0.1]."""
    kl: NotNegative = 0.5
    """Weight of the divergence from the goal prior in the reward of a decision [0.5]."""
    target_interval: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """Updates after which the target network is replaced [10]."""
    sees_goal: bool = static(False)
    """Whether the high level sees the task goal g^M; the paper does not say."""
    reads: Literal["observation", "history"] = static("observation")
    """What it sees of the episode: the embedded observation, or the low level's output at it, which knows
    the history."""


@dataclass(frozen=True)
class PtgmGoalHyper(PtgmHyper):
    """PTGM whose high level sees the task goal."""

    sees_goal: bool = static(True)


@dataclass(frozen=True)
class SpirlHyper:
    """Hyper-parameters of SPiRL's high level. Values in brackets are those of Table 9."""

    learning_rate: Rate = 1e-3
    """Of Adam, for actor, critics and alpha [1e-3]."""
    batch_size: Annotated[int, Ge(1), Le(65_536)] = static(256)
    """Transitions in an update [256]."""
    discount: Share = 0.95
    """Discount factor of a decision [0.95]."""
    target_interval: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """Updates after which the target critics are replaced [10]."""
    target_divergence: NotNegative = 1.0
    """Nats that the policy's divergence from the prior is to settle at (1 in mazes and 5 in the kitchen in
    SPiRL's code; the paper does not say)."""
    alpha: Positive = 1.0
    """Weight of the divergence at the start; it is learned."""
    warmup_episodes: Annotated[int, Ge(0), Le(100_000)] = 10
    """Episodes before the first update. They count, and the prior plays them."""


_HERE = "mgpo_jax.baselines.finetune"

REINFORCE = Method(
    name="reinforce",
    title="BC-finetune (REINFORCE)",
    summary="trains the network on the returns of the prompt (g^M) by REINFORCE (Table 8)",
    make=f"{_HERE}:make_reinforce",
    check=f"{_HERE}:check_finetune",
    hyper=ReinforceHyper,
)
REINFORCE_CAREFUL = Method(
    name="reinforce-careful",
    title="BC-finetune (REINFORCE, careful)",
    summary="REINFORCE with a baseline and a penalty for leaving the pre-trained policy",
    make=f"{_HERE}:make_reinforce",
    check=f"{_HERE}:check_finetune",
    hyper=CarefulReinforceHyper,
)
PPO = Method(
    name="ppo",
    title="BC-finetune (PPO)",
    summary="trains the network on the returns of the prompt (g^M) by PPO (Tables 1 and 8)",
    make=f"{_HERE}:make_ppo",
    check=f"{_HERE}:check_finetune",
    hyper=PpoHyper,
)
PPO_CAREFUL = Method(
    name="ppo-careful",
    title="BC-finetune (PPO, careful)",
    summary="PPO with a penalty for leaving the pre-trained policy and a value head of its own",
    make=f"{_HERE}:make_ppo",
    check=f"{_HERE}:check_finetune",
    hyper=CarefulPpoHyper,
)


_PTGM = "mgpo_jax.baselines.ptgm"

PTGM = Method(
    name="ptgm",
    title="PTGM",
    summary="DQN chooses goals for a commanded low level (Table 1), without seeing the task goal",
    make=f"{_PTGM}:make_ptgm",
    check=f"{_PTGM}:check_ptgm",
    hyper=PtgmHyper,
    policy="ptgm",
)
PTGM_GOAL = Method(
    name="ptgm-goal",
    title="PTGM (sees the task goal)",
    summary="PTGM whose high level sees the task goal g^M",
    make=f"{_PTGM}:make_ptgm",
    check=f"{_PTGM}:check_ptgm",
    hyper=PtgmGoalHyper,
    policy="ptgm",
)
PTGM_RANDOM = Method(
    name="ptgm-random",
    title="PTGM's low level, random goals",
    summary="reference of PTGM: any goal with the same probability",
    make=f"{_PTGM}:make_random",
    learns=False,
    policy="ptgm",
)
PTGM_PRIOR = Method(
    name="ptgm-prior",
    title="PTGM's low level, goals of the prior",
    summary="reference of PTGM: goals drawn from the prior",
    make=f"{_PTGM}:make_prior",
    learns=False,
    policy="ptgm",
)
PTGM_ORACLE = Method(
    name="ptgm-oracle",
    title="PTGM's low level, an expert's goals",
    summary="reference of PTGM: the goals that an expert tells who knows the task",
    make=f"{_PTGM}:make_oracle",
    learns=False,
    check=f"{_PTGM}:check_oracle",
    policy="ptgm",
)

_SPIRL = "mgpo_jax.baselines.spirl"

SPIRL = Method(
    name="spirl",
    title="SPiRL",
    summary="soft actor-critic over pre-trained skills, near their prior (Table 1)",
    make=f"{_SPIRL}:make_spirl",
    check=f"{_SPIRL}:check_spirl",
    hyper=SpirlHyper,
    policy="spirl",
)
SPIRL_PRIOR = Method(
    name="spirl-prior",
    title="SPiRL's skills, drawn from the prior",
    summary="reference of SPiRL: skills drawn from the prior in every episode",
    make=f"{_SPIRL}:make_prior",
    learns=False,
    policy="spirl",
)
