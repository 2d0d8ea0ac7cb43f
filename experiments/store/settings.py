"""Settings of the main commands, and the presets that they start from. Nothing here imports jax.

``fast`` is our recipe, which trains on two cores in ten minutes to two hours; ``paper`` has the paper's
values (Table 6, or its code's where the text is silent); ``smoke`` only shows that everything runs.
Settings that differ between worlds are in their ``World`` records.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro
from pydantic import BaseModel

import envs
from envs.errors import DataError, UsageError, nearest, printable, shown
from experiments.joining import OF_PROCESSES, Joined
from experiments.store.layout import CONFIG
from mgpo_jax.kinds import KINDS, MULTI_GOAL
from mgpo_jax.manifest import read_facts
from mgpo_jax.methods import NoHyper
from mgpo_jax.schema import STRICT, Json, Sha256, read_document
from mgpo_jax.settings import (
    OF_WEIGHTS,
    RECIPE_NETWORK,
    Count,
    EncoderName,
    Finite,
    Head,
    Name,
    NotNegative,
    NumEpisodes,
    NumGoals,
    NumLayers,
    NumSeeds,
    NumTasks,
    NumTrajectories,
    Seed,
    Share,
    TokensPerStep,
    TrainConfig,
    Width,
    check_contradictions,
    flag,
    get_parts,
    setting_fault,
    types_of,
)

RUNS = Path("runs")
DEFAULT_WORLD = "maze15"
NO_WORLD = "none"
"""The value of ``--env`` when training on a dataset without a registered world."""


def data_root() -> Path:
    """The folder of all datasets: ``$MGPO_DATA``, or ``data`` if that is not set."""
    return Path(os.environ.get("MGPO_DATA", "data"))


@dataclass(frozen=True)
class CollectConfig(Joined):
    """Settings of ``experiments.collect``."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """The demonstrator; some take settings, as in ``expert,drop=0.3`` (default: the world's first
    demonstrator)."""
    trajectories: Annotated[NumTrajectories, tyro.conf.arg(aliases=("--episodes",))] = 10_000
    """Number of trajectories to collect."""
    seed: Seed = 0
    """Random seed of the tasks and the demonstrator."""
    out: Path | None = None
    """Output folder (default: data/ENV/DEMONSTRATOR-TRAJECTORIES-seedSEED, under $MGPO_DATA if set)."""
    resume: bool = False
    """Continue an interrupted collection; the dataset is the same as that of an uninterrupted one."""


def dataset_folder(config: CollectConfig, demonstrator: str) -> Path:
    """The folder of the dataset that a config describes."""
    name = f"{demonstrator}-{config.trajectories}-seed{config.seed}"
    return config.out or data_root() / envs.find(config.env).home / name


@dataclass(frozen=True)
class DataConfig:
    """The dataset to train on."""

    demonstrator: Annotated[Name | None, tyro.conf.arg(aliases=("--policy",))] = None
    """The demonstrator of the dataset; some take settings, as in ``expert,drop=0.3`` (default: the world's
    first demonstrator)."""
    trajectories: Annotated[NumTrajectories, tyro.conf.arg(aliases=("--episodes",))] = 10_000
    """Number of trajectories to train on; a dataset that does not exist yet is collected first."""
    data_seed: Seed = 0
    """Random seed of the dataset."""
    data_folder: Annotated[Path | None, tyro.conf.arg(aliases=("--data",))] = None
    """Folder of your own dataset (made by ``python -m experiments.data import``) to train on; needs no
    world."""


@dataclass(frozen=True)
class PretrainConfig(Joined):
    """Settings of ``experiments.pretrain``; values in brackets are the paper's."""

    env: Name = NO_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names). With
    ``--data`` it defaults to none, and the policy is not evaluated during training."""
    method: Name = MULTI_GOAL
    """What to train: mgpo, a policy that follows prompts; ptgm or spirl, the low-level policy of that
    method."""
    preset: Name = "fast"
    """Preset that the defaults below come from: fast, paper or smoke."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    init: Path | None = None
    """Folder of a policy to initialize the network and its weights from (default: random weights)."""
    max_prompt_length: NumGoals = 5
    """Maximum number of goals in a prompt, K [5]."""
    dropout: Share = RECIPE_NETWORK["dropout"]
    """Dropout rate [0.1]."""
    prompt_order: bool = True
    """Add position embeddings to the goals of a prompt [False]."""
    embed_dim: Width = 128
    """Embedding dimension of the transformer [128]."""
    num_layers: NumLayers = 3
    """Number of transformer blocks [3]."""
    num_heads: Width = RECIPE_NETWORK["num_heads"]
    """Number of attention heads; must divide the embedding dimension [1]."""
    tokens_per_step: TokensPerStep = 2
    """Tokens per time step: 2 for an observation token and an action token, 1 for the sum of the previous
    action and the observation [2]."""
    encoder: EncoderName = "linear"
    """Observation encoder [linear]; ``cells`` embeds the codes and counts of worlds that have them, and the
    others each serve the one world that defines them."""
    head: Head | None = None
    """Action distribution; discrete actions need categorical, continuous ones any other (default: the
    preset's, or else the first that fits) [fixed_gaussian in the authors' code]."""
    standardize_obs: bool = False
    """Standardize observations by their mean and standard deviation in the dataset [False]."""
    holdout: NumTrajectories = 200
    """Trajectories held out for the validation loss."""
    eval_tasks: NumTasks = 64
    """Tasks of an evaluation during training, one episode each; never test tasks."""
    eval_every: Count = 1_000
    """Gradient steps between evaluations."""
    save_every: Count = 500
    """Gradient steps between checkpoints."""
    out: Path | None = None
    """Run folder (default: runs/pretrain/ENV/PRESET-seedSEED; methods other than mgpo come before the
    preset)."""
    resume: bool = False
    """Continue an interrupted run from its latest checkpoint, bit for bit."""
    dry_run: bool = False
    """Print what would be done and roughly how much CPU time it would take, then exit."""
    tb: bool = False
    """Also log metrics to TensorBoard (extra: tb)."""
    wandb: bool = False
    """Also log metrics to Weights & Biases (extra: wandb)."""

    @property
    def folder(self) -> Path:
        method = "" if self.method == MULTI_GOAL else f"{file_name(self.method)}-"
        name = f"{method}{self.preset}-seed{self.train.seed}"
        data = self.data.data_folder
        place = data.absolute().name if data and self.env == NO_WORLD else file_name(self.env)
        return self.out or RUNS / "pretrain" / place / name


def file_name(name: str) -> str:
    """The folder name for a world or method, given by name or as module:attribute."""
    return name.replace(":", ".")


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {},
    "paper": {
        "optimizer": "adamw",
        "learning_rate": 1e-4,
        "warmup_steps": 10_000,
        "schedule": "constant",
        "clip_norm": 0.25,
        "dropout": 0.1,
        "prompt_order": False,
        "num_heads": 1,
    },
    "smoke": {
        "trajectories": 256,
        "steps": 40,
        "warmup_steps": 10,
        "embed_dim": 32,
        "num_layers": 2,
        "holdout": 32,
        "eval_tasks": 8,
        "eval_every": 20,
        "save_every": 20,
    },
}


def with_settings(config: PretrainConfig, changes: Mapping[str, Any]) -> PretrainConfig:
    """The config with some settings replaced, wherever they are nested.

    Args:
      config: the config.
      changes: new values by the names of the settings.

    Raises:
      UsageError: for an unknown setting, with the nearest known name.
    """
    groups: dict[str, dict[str, Any]] = {"": {}, "data": {}, "train": {}}
    known: dict[str, Any] = {"": config, "data": config.data, "train": config.train}
    for name, value in changes.items():
        for group, part in known.items():
            if name in {f.name for f in dataclasses.fields(part)}:
                groups[group][name] = value
                break
        else:
            names = [f.name for part in known.values() for f in dataclasses.fields(part)]
            raise nearest(name, names, "setting of a preset")
    data = replace(config.data, **groups["data"])
    train = replace(config.train, **groups["train"])
    return replace(config, data=data, train=train, **groups[""])


def pretrain_preset(env: str, preset: str, method: str = MULTI_GOAL) -> PretrainConfig:
    """The default settings of a preset, in which the world's record and the kind of network have a say."""
    world, kind = envs.find(env), KINDS.find(method)
    if preset not in PRESETS:
        raise nearest(preset, PRESETS, "preset")
    config = PretrainConfig(env=env, preset=preset, method=method)
    own = world.presets.get(preset, {})
    smoke = preset == "smoke"
    if smoke or not own:  # start from the world's fast preset
        config = with_settings(config, world.presets.get("fast", {}))
    config = with_settings(config, kind.preset)
    config = with_settings(config, PRESETS[preset])
    if smoke:  # fewer padded lengths mean fewer compilations
        config = with_settings(config, {"bucket": 8 * config.train.bucket})
    return with_settings(config, own)


def pretrain_default(config: PretrainConfig, flags: Iterable[str] = ()) -> PretrainConfig:
    """The defaults that a config's world, its preset and the policy that it starts from imply.

    Raises:
      UsageError: if there is no such world, preset or policy.
      DataError: if the config of that policy, or of the run to resume, is damaged.
    """
    default = _preset_of(config)
    if config.init is None:
        return default
    if goes_on(config):
        run = saved_pretraining(config.folder / CONFIG)
        return with_settings(default, {name: getattr(run, name) for name in OF_INITIAL})
    return with_settings(default, read_initial(config).network)


def _preset_of(config: PretrainConfig) -> PretrainConfig:
    """The defaults for a world, or for a user's own dataset."""
    from experiments.store import recipes  # imports this module

    folder = config.data.data_folder
    if folder is None:
        env = DEFAULT_WORLD if config.env == NO_WORLD else config.env
        return pretrain_preset(env, config.preset, config.method)
    facts = read_facts(folder)
    if config.env != NO_WORLD:
        default = pretrain_preset(config.env, config.preset, config.method)
        return with_settings(default, recipes.of_data(facts, default.holdout))
    if config.preset not in PRESETS:
        raise nearest(config.preset, PRESETS, "preset")
    default = with_settings(
        PretrainConfig(preset=config.preset, method=config.method), recipes.recipe(facts)
    )
    default = with_settings(default, PRESETS[config.preset])
    return with_settings(default, recipes.of_data(facts, default.holdout))


INIT = "init"
"""Subfolder of a run with its copy of the policy that training started from."""
OF_INITIAL = (*OF_WEIGHTS, "standardize_obs")
"""Settings of a training that are fixed by the policy it starts from."""
MEND_INIT = "give the folder of another policy with --init, such as RUN/policy"


class Initial(NamedTuple):
    """What the config of an initial policy says, read without its weights."""

    network: dict[str, Any]
    """The settings that the policy fixes (``OF_INITIAL``), by name."""
    sha256: str
    """Hash of its weights."""


class _PolicyConfig(BaseModel):
    """The entries of a policy's ``config.json`` that are read here; others are ignored."""

    model_config = {**STRICT, "extra": "ignore"}

    sha256: Sha256
    network: dict[str, Json]


def goes_on(config: PretrainConfig) -> bool:
    """Whether a config resumes a run that already exists."""
    return config.resume and os.path.isfile(config.folder / CONFIG)


def initial_folder(config: PretrainConfig) -> Path:
    """The folder of the policy that a training starts from; a resumed run uses its own copy.

    The config must have ``init`` set.
    """
    assert config.init is not None
    kept = config.folder / INIT
    return kept if goes_on(config) and os.path.isfile(kept / CONFIG) else config.init


def mend_initial(config: PretrainConfig) -> str:
    """How to mend a damaged initial policy, as the end of an error message."""
    folder = initial_folder(config)
    return MEND_INIT if folder == config.init else f"remove {folder}, and --init is read again"


def read_initial(config: PretrainConfig) -> Initial:
    """The config of the policy that a training starts from; raises as ``initial_at`` does."""
    return initial_at(initial_folder(config), mend_initial(config))


def initial_at(folder: Path, mend: str = MEND_INIT) -> Initial:
    """The config of an initial policy.

    Args:
      folder: folder of the policy.
      mend: how to mend a damaged one, the end of the error message.

    Raises:
      UsageError: if there is no policy in the folder.
      DataError: if its config is damaged.
    """
    path = folder / CONFIG
    if not os.path.isfile(path):
        raise UsageError(f"no policy in {folder} ({CONFIG} is missing); {mend}")
    document: _PolicyConfig = read_document(path, _PolicyConfig, mend)
    general = PretrainConfig()  # older policies lack settings that were constants at the time
    network = {name: document.network.get(name, getattr(general, name)) for name in OF_WEIGHTS}
    types = types_of(PretrainConfig)
    for name, value in network.items():
        if said := setting_fault(types[name], value):
            raise DataError(f"{path}: network.{name} {said}; {mend}")
    network["standardize_obs"] = bool(document.network.get("obs_mean"))
    return Initial(network, document.sha256)


def check_pretraining(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for training settings that are valid on their own but not in combination."""
    train, trajectories = config.train, config.data.trajectories
    _check_own_data(config)
    if train.batch_size % train.part_size:
        raise UsageError(
            f"--batch-size {train.batch_size} is not a multiple of --part-size {train.part_size}"
        )
    if config.init is not None and not goes_on(config):
        check_initial(config)
    if config.standardize_obs and config.encoder != "linear":
        raise UsageError(
            f"--standardize-obs does not apply to --encoder {config.encoder}, whose inputs are codes "
            "rather than quantities; leave it out"
        )
    if config.init is None and config.embed_dim % config.num_heads:
        raise UsageError(
            f"--embed-dim {config.embed_dim} is not a multiple of --num-heads {config.num_heads}"
        )
    if config.holdout >= trajectories:
        raise UsageError(
            f"--holdout {config.holdout} leaves nothing of {trajectories} trajectories to train on; "
            "lower it, or raise --trajectories"
        )


def _check_own_data(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for settings that make no sense with, or without, the user's own dataset."""
    data = config.data
    if data.data_folder is None:
        if config.env == NO_WORLD:
            raise UsageError(
                f"--env {NO_WORLD} is for data of your own; give its folder with --data, or name a world"
            )
        return
    if data.demonstrator is not None or data.data_seed:
        name = "--data-seed" if data.demonstrator is None else "--demonstrator"
        raise UsageError(
            f"--data is already collected, so {name} does not apply to it; leave {name} out"
        )
    if config.env == NO_WORLD and config.method != MULTI_GOAL:
        raise UsageError(
            f"--method {config.method} needs a world; name the one that the data is from with --env"
        )
    num = read_facts(data.data_folder).num_trajectories
    if data.trajectories > num:
        raise UsageError(
            f"--trajectories {data.trajectories} is more than the {num} in {data.data_folder}; lower it"
        )


def check_initial(config: PretrainConfig) -> None:
    """Raise ``UsageError`` for network settings that contradict those of the initial policy."""
    folder, network = initial_folder(config), read_initial(config).network
    given = {name: getattr(config, name) for name in network}
    mend = "leave it out" if folder == config.init else mend_initial(config)
    check_contradictions(given, network, f"the policy in {folder}", mend)


NO_SETTINGS = frozenset(
    {
        "preset", "init", "out", "resume", "debug", "quiet", "config", "dry_run", "tb", "wandb",
        "eval_every", "save_every", "data_folder", *OF_PROCESSES,
    }
)  # fmt: skip
"""Settings that may change when a run is resumed, because they do not affect its weights. Datasets and
initial policies are compared by hash instead of by path."""


def training_settings(config: PretrainConfig) -> dict[str, Any]:
    """The settings that determine the result of a training, by name, as JSON values."""
    settings = dataclasses.asdict(config)
    parts = {**settings, **settings["data"], **settings["train"]}
    return {k: v for k, v in parts.items() if k not in NO_SETTINGS | {"data", "train"}}


def saved_pretraining(path: Path) -> PretrainConfig:
    """The settings in the ``config.json`` of a run.

    Raises:
      DataError: if the file does not hold settings of a pre-training run.
    """
    return pretraining_from(read_document(path, dict[str, Json], MEND_RUN), path)


MEND_RUN = "restore the file, or start a new run with --out"


def pretraining_from(values: Mapping[str, Any], where: Path) -> PretrainConfig:
    """The settings of a run from JSON values, in which older names of settings are accepted.

    Args:
      values: the values; missing settings get their defaults.
      where: the file that they are from, for error messages.

    Raises:
      DataError: if they are not the settings of a pre-training run.
    """
    if "env" not in values:
        raise DataError(f"{where} lacks env; {MEND_RUN}")
    data = values.get("data")
    if isinstance(data, Mapping) and "episodes" in data:
        renamed = {{"episodes": "trajectories"}.get(k, k): v for k, v in data.items()}
        values = {**values, "data": renamed}
    return _from_json(PretrainConfig, values, where)


def _from_json(settings_class: type, values: Any, where: Path) -> Any:
    """A settings dataclass from JSON values; the ``DataError`` names the first invalid one."""
    if not isinstance(values, Mapping):
        raise DataError(f"{where} holds no settings of a pre-training run; {MEND_RUN}")
    types = types_of(settings_class)
    found = {}
    for name, value in values.items():
        if name not in types:
            raise DataError(f"{where} has the unknown setting {shown(name)}; {MEND_RUN}")
        parts = list(get_parts(types[name]))
        if group := [p for p in parts if isinstance(p, type) and dataclasses.is_dataclass(p)]:
            found[name] = _from_json(group[0], value, where)
            continue
        found[name] = Path(value) if Path in parts and isinstance(value, str) else value
        if said := setting_fault(types[name], found[name]):
            raise DataError(f"{where}: {name} {said}; {MEND_RUN}")
    return settings_class(**found)


@dataclass(frozen=True)
class AdaptConfig(Joined):
    """Settings of ``experiments.adapt``; values in brackets are the paper's."""

    env: Name = DEFAULT_WORLD
    """The world, by name or as module:attribute (``python -m experiments.list`` shows the names)."""
    method: Annotated[Name, tyro.conf.arg(aliases=("--bandit",))] = "ucb"
    """The adaptation method, by name or as module:attribute (``python -m experiments.list`` shows the
    names)."""
    policy: Path | None = None
    """Folder of a policy (default: the world's released policy)."""
    tasks: Path | None = None
    """Your own tasks, an npz file with one array for each field of the world's tasks (default: the world's
    test tasks)."""
    validation: bool = False
    """Adapt to validation tasks instead of the test tasks, to choose a method's settings."""
    validation_seed: Seed = 0
    """Random seed of the validation tasks; seed 0 gives those that trainings are evaluated on."""
    seeds: NumSeeds = 3
    """Number of independent adaptations to each task [3]."""
    episodes: NumEpisodes = 100
    """Episode budget per task, including the first episode, under the prompt (g^M) [100]."""
    seed: Seed = 0
    """Random seed of the adaptations."""
    eval_every: Count = 10
    """Episodes between evaluations of the best choice so far; they do not count toward the budget."""
    eval_episodes: NumEpisodes | None = None
    """Episodes averaged in an evaluation (default: from the world's record)."""
    stop_at: Finite | None = None
    """Stop searching on a task once its best choice so far reaches this return in an evaluation."""
    obs_noise: NotNegative = 0.0
    """Standard deviation of the noise on observations, in their units, during search and evaluation."""
    action_noise: NotNegative = 0.0
    """Standard deviation of the noise on continuous actions; the probability of a random action for
    discrete ones."""
    sweep: tuple[str, ...] = ()
    """Values of numeric hyper-parameters of the method to sweep over, such as ``c=0.1,1,10``; several
    hyper-parameters form a grid."""
    keep_actions: bool = False
    """Also store continuous actions in the results; discrete ones are always stored."""
    out: Path | None = None
    """Result folder (default: runs/adapt/ENV/METHOD-seedSEED, plus a suffix for noise or a sweep)."""
    figures: bool = True
    """Draw figures of the results."""
    json: bool = False
    """Print the summary as JSON."""
    dry_run: bool = False
    """Print what would be done and roughly how much CPU time it would take, then exit."""
    resume: bool = False
    """Continue an interrupted adaptation; the result is the same as that of an uninterrupted one."""
    hyper: Annotated[Any, tyro.conf.arg(name="")] = field(default_factory=NoHyper)
    """Hyper-parameters of the method."""

    @property
    def folder(self) -> Path:
        name = f"{file_name(self.method)}-seed{self.seed}"
        name += f"-obs{self.obs_noise:g}" if self.obs_noise else ""
        name += f"-action{self.action_noise:g}" if self.action_noise else ""
        name += "-sweep" if self.sweep else ""
        return self.out or RUNS / "adapt" / file_name(self.env) / name


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Joined):
    """Settings of ``experiments.reproduce``."""

    what: tyro.conf.Positional[str] = ""
    """What to make: table1, table2, table8 (methods in all worlds), figure6, figure7 (their learning
    curves), table3 (optimized prompts under noise), figure2, figure3, figure5, figure9, figure10 (prompts
    and the episodes under them), figure11 (the worlds at a glance), table4 (prompt length and c of UCB),
    table5 (datasets), figure8 (longer prompts), heads (distributions of continuous actions), plan (our
    optimizer without some of its parts), list (what exists of each, and the cost of the rest), or all
    (everything that is missing)."""
    env: tuple[Name, ...] = ()
    """The worlds, by name or as module:attribute (default: those of the paper's table or figure; maze15 for
    ablations; all for figure11)."""
    scale: Literal["smoke", "cpu", "paper"] = "cpu"
    """Scale of comparisons and of drawn adaptations: cpu uses the released networks and the paper's budget;
    smoke five tasks, one seed and 20 episodes; paper networks trained with the preset "paper"."""
    only: tuple[Name, ...] = ()
    """Names of the datasets (table5), prompt lengths (figure8) or heads to train, or of the methods to
    compare (default: all)."""
    steps: Count | None = None
    """Gradient steps of each training (default: from the world's preset "ablation")."""
    trajectories: Annotated[NumTrajectories | None, tyro.conf.arg(aliases=("--episodes",))] = None
    """Trajectories in each dataset (default: from the world's preset "ablation")."""
    seeds: NumSeeds = 3
    """Number of independent adaptations to each test task [3]."""
    out: Path = RUNS / "reproduce"
    """Folder of all trainings and results, which tables and figures share where they can."""

    @property
    def world(self) -> str:
        """The world of an ablation, which has only one."""
        return self.env[0] if self.env else DEFAULT_WORLD

    @property
    def folder(self) -> Path:
        return self.out / file_name(self.world)

    @property
    def num_steps(self) -> int:
        return self.steps or self._preset("steps", pretrain_preset(self.world, "fast").train.steps)

    @property
    def num_trajectories(self) -> int:
        default = pretrain_preset(self.world, "fast").data.trajectories
        return self.trajectories or self._preset("trajectories", default)

    def _preset(self, name: str, default: int) -> int:
        return envs.find(self.world).presets.get("ablation", {}).get(name, default)


COMPARISONS = ("table1", "table2", "table3", "table8", "figure6", "figure7")
"""Tables and figures of ``experiments.reproduce`` that compare several methods in several worlds."""
PICTURES = ("figure2", "figure3", "figure5", "figure9", "figure10")
"""Figures that draw episodes of adaptations."""
ABLATIONS = ("table4", "table5", "figure8", "heads", "plan")
"""Studies that vary one factor in one world."""
TRAIN_NOTHING = ("table4", "plan")
"""Ablations that adapt the released policy instead of training policies of their own."""
GLANCE = "figure11"
"""The figure that shows all worlds."""
LIST, ALL = "list", "all"


def check_reproduction(config: ReproduceConfig) -> None:
    """Raise ``UsageError`` for settings of ``experiments.reproduce`` that do not apply to what is made."""
    if config.distributed and config.what not in COMPARISONS:
        raise UsageError(
            f"--distributed spreads the cells of a comparison; {config.what} is made by one process, leave "
            f"it out or name one of {', '.join(COMPARISONS)}"
        )
    if config.what not in ABLATIONS:
        useless = ["steps", "trajectories"]
        useless += ["only"] if config.what not in COMPARISONS else []
        _refuse(config, useless)
        return
    if config.scale != "cpu":
        raise UsageError(f"--scale {config.scale} does not apply to {config.what}; leave it out")
    if config.what in TRAIN_NOTHING:
        _refuse(config, (*(("only",) if config.what == "table4" else ()), "steps", "trajectories"))
    elif config.num_trajectories <= (kept := pretrain_preset(config.world, "fast").holdout):
        raise UsageError(
            f"--trajectories must be above {kept}, the trajectories kept out of training, found "
            f"{config.num_trajectories}"
        )


def _refuse(config: ReproduceConfig, names: Iterable[str]) -> None:
    """Raise ``UsageError`` for the first of some useless settings that is given."""
    for name in names:
        if value := getattr(config, name):
            text = printable(" ".join(value)) if isinstance(value, tuple) else shown(value)
            raise UsageError(f"{flag(name)} {text} does not apply to {config.what}; leave it out")
