"""The records of the baselines and their hyper-parameters. Nothing here imports jax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from mgpo_jax.methods import Method
from mgpo_jax.settings import NotNegative, Positive, static

Rate = Annotated[float, Ge(0), Le(10)]
Fraction = Annotated[float, Ge(0), Le(1)]


@dataclass(frozen=True)
class FinetuneHyper:
    """Hyper-parameters of both policy gradients. The defaults are those of Table 7, as far as it gives
    them."""

    tune: Literal["all", "head", "lora"] = static("all")
    """The trained weights: of the whole network as in the paper (``all``), of its last norm and its action
    head alone (``head``), or of low-rank matrices added to those of the blocks (``lora``)."""
    rank: Annotated[int, Ge(1), Le(128)] = static(4)
    """Rank of the matrices of ``lora``."""
    round_episodes: Annotated[int, Ge(1), Le(1_000)] = static(5)
    """Number of episodes between two updates of the weights [5]."""
    learning_rate: Rate = 1e-4
    """Learning rate of AdamW [1e-4]."""
    weight_decay: Rate = 1e-4
    """Weight decay of AdamW, which Table 7 calls learning rate decay [1e-4]."""
    clip_norm: Positive = 0.25
    """Largest global norm of a gradient (the paper does not say; the authors pre-train with 0.25)."""
    warmup_rounds: Annotated[int, Ge(0), Le(10_000)] = 0
    """Number of rounds over which the learning rate of the policy rises to its value, from the first round
    that trains the policy."""
    discount: Fraction = 0.98
    """Discount factor per step [0.98]."""
    kl: NotNegative = 0.0
    """Weight of the divergence KL(pi, pi_0) from the pre-trained policy in the loss."""


@dataclass(frozen=True)
class ReinforceHyper(FinetuneHyper):
    """Hyper-parameters of REINFORCE. The paper does not say which baseline it subtracts, if any."""

    baseline: bool = static(False)
    """Whether to subtract as a baseline the mean return-to-go at the same step of the round's episodes."""


@dataclass(frozen=True)
class CarefulReinforceHyper(ReinforceHyper):
    """REINFORCE that stays near the pre-trained policy; all changes are ours."""

    warmup_rounds: Annotated[int, Ge(0), Le(10_000)] = 5
    kl: NotNegative = 0.1
    baseline: bool = static(True)


@dataclass(frozen=True)
class ClipHyper:
    """Hyper-parameters of PPO's loss and of its estimates, with customary values."""

    clip: Positive = 0.2
    """Largest deviation from 1 of a probability ratio, which is clipped there."""
    epochs: Annotated[int, Ge(1), Le(1_000)] = static(4)
    """Number of gradient steps on the episodes of a round."""
    gae_lambda: Fraction = 0.95
    """Lambda of generalized advantage estimation."""
    value_weight: NotNegative = 0.5
    """Weight of the value loss, the squared error of the values."""


# A dataclass takes the fields of its last base first, so those of FinetuneHyper come before those of
# ClipHyper.
@dataclass(frozen=True)
class PpoHyper(ClipHyper, FinetuneHyper):
    """Hyper-parameters of PPO. Beyond Table 7 the paper gives none; the defaults are customary values."""

    value_rate: Rate = 1e-4
    """Learning rate of the value head."""
    share_trunk: bool = static(True)
    """Whether the value loss also trains the network below the value head."""
    value_rounds: Annotated[int, Ge(0), Le(10_000)] = 0
    """Number of rounds at the start in which only the value head is trained."""
    max_kl: Positive | None = None
    """Divergence of the policy, in nats, beyond which the remaining epochs of a round are skipped (default:
    no limit)."""


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
class HighLevelHyper:
    """Hyper-parameters of every high level that chooses goals. Values in brackets are those of Table 10."""

    learning_rate: Rate = 1e-3
    """Learning rate of Adam [1e-3]."""
    discount: Fraction = 0.95
    """Discount factor per decision [0.95]."""
    kl: NotNegative = 0.5
    """Weight of the divergence from the goal prior in the reward of a decision [0.5]."""
    sees_goal: bool = static(False)
    """Whether the high level sees the task goal g^M; the paper does not say."""
    reads: Literal["observation", "history"] = static("observation")
    """Input of the high level: the embedded observation, or the low level's output at it, which depends on
    the history, too."""


@dataclass(frozen=True)
class PtgmHyper(HighLevelHyper):
    """Hyper-parameters of PTGM. Values in brackets are those of Table 10."""

    batch_size: Annotated[int, Ge(1), Le(65_536)] = static(64)
    """Number of transitions in an update [64]."""
    epsilon: Fraction = 0.1
    """Probability with which the high level chooses a random goal [0.1]."""
    target_interval: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """Number of updates between two replacements of the target network [10]."""
    kl_of: Literal["policy", "goal"] = static("policy")
    """Whose divergence from the prior is charged: that of the policy which chose, whatever it chose, or of
    the goal alone that was chosen, as if it were chosen always; the paper does not say."""


@dataclass(frozen=True)
class PtgmGoalHyper(PtgmHyper):
    """Hyper-parameters of PTGM whose high level sees the task goal."""

    sees_goal: bool = static(True)


@dataclass(frozen=True)
class PtgmPpoHyper(ClipHyper, HighLevelHyper):
    """Hyper-parameters of PTGM by PPO over clusters of goals.

    Values that Table 10 gives are those of Table 10. All others are those of PTGM's own code
    (PKU-RL/PTGM), except for the size of a round.
    """

    clusters: Annotated[int, Ge(1), Le(65_536)] | None = static(None)
    """Number of clusters of goals (default: 50 as in its kitchen, or all goals where there are fewer)."""
    round_episodes: Annotated[int, Ge(1), Le(1_000)] = static(5)
    """Number of episodes between two updates of the high level (its code: 40 decisions)."""
    epochs: Annotated[int, Ge(1), Le(1_000)] = static(5)
    value_weight: NotNegative = 1.0
    clip_norm: Positive = 0.5
    """Largest global norm of a gradient."""
    starts_as_prior: bool = static(True)
    """Whether the policy is the goal prior at first, as in PTGM's kitchen, or uniform."""


@dataclass(frozen=True)
class SpirlHyper:
    """Hyper-parameters of SPiRL's high level. Values in brackets are those of Table 9."""

    learning_rate: Rate = 1e-3
    """Learning rate of Adam for actor, critics and alpha [1e-3]."""
    batch_size: Annotated[int, Ge(1), Le(65_536)] = static(256)
    """Number of transitions in an update [256]."""
    discount: Fraction = 0.95
    """Discount factor per decision [0.95]."""
    target_interval: Annotated[int, Ge(1), Le(1_000_000)] = 10
    """Number of updates between two replacements of the target critics [10]."""
    target_divergence: NotNegative = 1.0
    """Target of the policy's divergence from the prior, in nats (SPiRL's code: 1 in mazes and 5 in the
    kitchen; the paper does not say)."""
    alpha: Positive = 1.0
    """Initial weight of the divergence, which is then learned."""
    warmup_episodes: Annotated[int, Ge(0), Le(100_000)] = 10
    """Number of episodes after which updates begin, in all of which the prior acts (0 means the same as
    1); they count against the budget."""
    judged_by: Literal["mean", "sample"] = static("mean")
    """How latents are chosen when the policy is judged: the mean of its distribution, or a sample, as
    in the episodes of the search and in ``spirl-prior``."""


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
PTGM_PPO = Method(
    name="ptgm-ppo",
    title="PTGM (PPO, clusters of goals)",
    summary="PPO chooses among clusters of goals for a commanded low level, as PTGM's own code does",
    make=f"{_PTGM}_ppo:make_ptgm_ppo",
    check=f"{_PTGM}_ppo:check_ptgm_ppo",
    hyper=PtgmPpoHyper,
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
    summary="reference for PTGM: goals chosen by an expert who knows the task",
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
