"""Datasets: files and damage to them, gathering, slices and the stream of batches."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from envs.errors import DataError
from envs.specs import ArraySpec, Box, Discrete, EnvSpec
from mgpo_jax.dataset import (
    ARRAYS,
    MANIFEST,
    Dataset,
    check_dataset,
    finish_dataset,
    hash_task,
    load_dataset,
    plan_batches,
    save_dataset,
    spec_of,
)
from mgpo_jax.files import hash_file
from mgpo_jax.manifest import hash_of_files, read_facts

SPEC = EnvSpec(
    name="toy",
    obs=ArraySpec((2,)),
    goal_dim=3,
    actions=Discrete(4),
    horizon=9,
    return_range=(0.0, 1.0),
    truncate_in_hindsight=True,
)
LENGTHS = [3, 1, 9, 4]


def make_dataset(lengths=LENGTHS):
    """``obs[:, 0]`` is the trajectory's index, ``obs[:, 1]`` counts its steps from 1."""
    rng = np.random.default_rng(0)
    lengths = np.array(lengths, np.int32)
    total = int(lengths.sum())
    index = np.repeat(np.arange(len(lengths)), lengths)
    step = np.concatenate([1 + np.arange(length) for length in lengths])
    return Dataset(
        obs=np.stack([index, step], axis=1).astype(np.float32),
        actions=rng.integers(SPEC.action_dim, size=total).astype(np.int32),
        achieved_goals=rng.normal(size=(total, SPEC.goal_dim)).astype(np.float32),
        goal_reached=rng.random(total) < 0.5,
        outcomes=rng.normal(size=(total, SPEC.goal_dim)).astype(np.float32),
        lengths=lengths,
        task_hashes=np.arange(len(lengths), dtype=np.uint64) + 100,
        rewards=rng.random(total).astype(np.float32),
        last_obs=np.stack([np.arange(len(lengths)), lengths + 1], axis=1).astype(np.float32),
    )


@pytest.fixture
def dataset():
    return make_dataset()


@pytest.fixture
def folder(tmp_path, dataset):
    save_dataset(tmp_path / "data", dataset, {"env": "toy"})
    return tmp_path / "data"


def assert_equal(a, b):
    assert a.arrays.keys() == b.arrays.keys()
    for name, array in a.arrays.items():
        np.testing.assert_array_equal(array, b.arrays[name])
        assert array.dtype == b.arrays[name].dtype


def test_save_and_load(folder, dataset):
    loaded, manifest = load_dataset(folder, SPEC)
    assert_equal(loaded, dataset)
    assert manifest["env"] == "toy"
    assert manifest["format"] == 2
    assert {"rewards", "last_obs"} <= set(np.load(folder / ARRAYS))
    assert manifest["num_trajectories"] == 4
    assert manifest["num_steps"] == 17
    assert sorted(path.name for path in folder.iterdir()) == [MANIFEST, ARRAYS]
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_an_existing_folder_is_kept(folder, dataset):
    before = hash_file(folder / ARRAYS)
    with pytest.raises(DataError, match=r"already exists; remove it or .* --out"):
        save_dataset(folder, make_dataset([1]), {})
    assert hash_file(folder / ARRAYS) == before


def test_gather_cuts_and_pads_with_zeros(dataset):
    part = dataset.gather(np.array([2, 0, 2]), np.array([5, 3, 1]), 6)
    np.testing.assert_array_equal(part.length, [5, 3, 1])
    for row, (index, length) in enumerate([(2, 5), (0, 3), (2, 1)]):
        start = [0, 3, 4, 13][index]
        for name, rows in part.steps.items():
            found, source = rows[row], getattr(dataset, name)
            assert found.dtype == source.dtype
            np.testing.assert_array_equal(found[:length], source[start : start + length])
            assert not found[length:].any()


def test_gather_of_a_continuous_dataset(dataset):
    actions = np.random.default_rng(1).normal(size=(17, 2)).astype(np.float32)
    part = replace(dataset, actions=actions).gather(np.array([3]), np.array([2]), 4)
    np.testing.assert_array_equal(part.actions[0, :2], actions[13:15])
    assert not part.actions[0, 2:].any()


def with_intended(dataset):
    """Every other action was meant to be another one."""
    turned = np.arange(len(dataset.actions)) % 2 == 0
    return replace(dataset, intended=((dataset.actions + turned) % 4).astype(np.int32))


def test_intended_actions_are_kept_beside_the_executed_ones(tmp_path, dataset):
    noisy = with_intended(dataset)
    save_dataset(tmp_path / "noisy", noisy, {})
    loaded, _ = load_dataset(tmp_path / "noisy", SPEC)
    assert_equal(loaded, noisy)
    assert_equal(loaded.slice(1, 3), with_intended(dataset).slice(1, 3))
    part = loaded.gather(np.array([3, 1]), np.array([2, 1]), 4)
    np.testing.assert_array_equal(part.intended[0, :2], noisy.intended[13:15])
    assert not part.intended[0, 2:].any()
    assert (part.labels[0] != part.actions[0]).any()


def test_a_dataset_without_intended_actions_has_the_same_bytes_as_ever(folder, dataset):
    assert dataset.gather(np.array([0]), np.array([1]), 1).intended is None
    assert list(np.load(folder / ARRAYS)) == [
        "obs", "actions", "achieved_goals", "goal_reached", "outcomes", "lengths", "task_hashes",
        "rewards", "last_obs",
    ]  # fmt: skip


def test_slice(dataset):
    part = dataset.slice(1, 3)
    assert len(part) == 2
    np.testing.assert_array_equal(part.lengths, [1, 9])
    np.testing.assert_array_equal(part.task_hashes, [101, 102])
    np.testing.assert_array_equal(part.obs[:, 0], [1] + [2] * 9)
    np.testing.assert_array_equal(part.rewards, dataset.rewards[3:13])
    np.testing.assert_array_equal(part.last_obs, [[1, 2], [2, 10]])
    assert_equal(dataset.slice(0, 4), dataset)
    gathered = part.gather(np.array([1]), np.array([9]), 9)
    np.testing.assert_array_equal(gathered.obs[0, :, 1], np.arange(1, 10))


def test_hash_task_depends_on_every_entry():
    fingerprint = np.arange(5)
    hashes = {int(hash_task(fingerprint + shift)) for shift in np.eye(5, dtype=int)}
    assert len(hashes | {int(hash_task(fingerprint))}) == 6
    assert hash_task(fingerprint.astype(np.int8)) == hash_task(fingerprint)


def plans(dataset, **changes):
    options = {"seed": 1, "batch_size": 6, "part_size": 3, "bucket": 4, "truncate": True}
    return plan_batches(dataset, **{**options, "pool_steps": 3, **changes})


@settings(max_examples=25, deadline=None)
@given(first=st.integers(0, 10), truncate=st.booleans(), seed=st.integers(0, 1000))
def test_the_stream_can_start_anywhere(first, truncate, seed):
    dataset = make_dataset()
    whole = list(islice(plans(dataset, truncate=truncate, seed=seed), first + 4))[first:]
    later = islice(plans(dataset, truncate=truncate, seed=seed, first_step=first), 4)
    for batch, other in zip(whole, later, strict=True):
        for part, other_part in zip(batch, other, strict=True):
            np.testing.assert_array_equal(part.indices, other_part.indices)
            np.testing.assert_array_equal(part.lengths, other_part.lengths)
            assert part.num_steps == other_part.num_steps


def test_every_batch_is_a_mix_of_all_lengths():
    """Parts hold similar lengths, and are not used in the order of these."""
    dataset = make_dataset([1, 2, 3, 4, 5, 6, 7, 8])
    stream = plans(dataset, truncate=False, batch_size=80, part_size=10, pool_steps=8)
    means = [np.mean([part.lengths.mean() for part in batch]) for batch in islice(stream, 8)]
    assert np.ptp(means) < 5  # in order, those of the first and the last batch would be 1 and 8
    assert (np.diff(means) < 0).any()


@pytest.mark.parametrize("truncate", [True, False])
def test_batches_have_their_size_and_fit_their_padding(dataset, truncate):
    for batch in islice(plans(dataset, truncate=truncate), 20):
        assert len(batch) == 2
        for part in batch:
            assert part.indices.shape == part.lengths.shape == (3,)
            assert part.lengths.min() >= 1
            assert (part.lengths <= dataset.lengths[part.indices]).all()
            assert truncate or (part.lengths == dataset.lengths[part.indices]).all()
            assert part.lengths.max() <= part.num_steps <= 9
            assert part.num_steps % 4 == 0 or part.num_steps == 9
            assert part.num_steps - part.lengths.max() < 4


def test_parts_hold_trajectories_of_nearly_equal_length():
    dataset = make_dataset([1, 2, 3, 4, 5, 6, 7, 8])
    batches = islice(plans(dataset, truncate=False, batch_size=40, part_size=10), 3)
    spreads = [np.ptp(part.lengths) for batch in batches for part in batch]
    assert max(spreads) <= 2


@pytest.mark.parametrize("min_part", [1, 2])
def test_long_parts_are_halved_until_they_fit(min_part):
    """``part_steps`` bounds the padded steps of a part; the batches stay what they were."""
    dataset = make_dataset([1, 3, 9, 9])
    options = {"batch_size": 16, "part_size": 8, "bucket": 3}
    small = islice(plans(dataset, **options, part_steps=20, min_part=min_part), 6)
    for pieces, whole in zip(small, islice(plans(dataset, **options), 6), strict=True):
        for name in ("indices", "lengths"):
            rows = [np.concatenate([getattr(part, name) for part in batch])
                    for batch in (pieces, whole)]  # fmt: skip
            np.testing.assert_array_equal(*rows)
        for part in pieces:
            size = len(part.lengths)
            assert size % min_part == 0
            assert size * part.num_steps <= 20 or size == min_part
            # No smaller than needed.
            assert size == 8 or 2 * size * part.num_steps > 20


def test_seeds_differ(dataset):
    first, second = next(plans(dataset, seed=1)), next(plans(dataset, seed=2))
    assert any((a.indices != b.indices).any() for a, b in zip(first, second, strict=True))


def test_trajectories_and_cuts_are_uniform():
    dataset = make_dataset([7, 7, 7])
    batches = islice(plans(dataset, batch_size=60), 60)
    parts = [part for batch in batches for part in batch]
    indices = np.concatenate([part.indices for part in parts])
    lengths = np.concatenate([part.lengths for part in parts])
    cells = np.bincount(indices * 7 + lengths - 1, minlength=21)
    assert len(cells) == 21
    assert stats.chisquare(cells).pvalue > 1e-3


def test_part_size_must_divide_the_batch(dataset):
    with pytest.raises(ValueError, match="6 is not a multiple of part_size 4"):
        next(plans(dataset, part_size=4))


def rewrite(folder, change):
    """Change the arrays and give the manifest the new hash."""
    arrays = dict(np.load(folder / ARRAYS))
    change(arrays)
    np.savez_compressed(folder / ARRAYS, **arrays)
    sign(folder)


def sign(folder, **changes):
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest.update(sha256=hash_file(folder / ARRAYS), **changes)
    (folder / MANIFEST).write_text(json.dumps(manifest))


def flip_byte(folder):
    content = bytearray((folder / ARRAYS).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / ARRAYS).write_bytes(content)


def truncate_file(folder):
    content = (folder / ARRAYS).read_bytes()
    (folder / ARRAYS).write_bytes(content[: len(content) // 2])


def truncate_and_sign(folder):
    truncate_file(folder)
    sign(folder)


FILE_DAMAGE = {
    "changed byte": (flip_byte, "differs from the hash.*collect it again"),
    "truncated": (truncate_file, "differs from the hash.*collect it again"),
    "truncated and signed": (truncate_and_sign, "is not a readable npz file; .*collect it again"),
    "no arrays": (lambda f: (f / ARRAYS).unlink(), "is missing.*collect it again"),
    "no manifest": (
        lambda f: (f / MANIFEST).unlink(),
        "no dataset in .*manifest.json is missing.*collect it again",
    ),
    "manifest is no JSON": (
        lambda f: (f / MANIFEST).write_text("{"),
        "not readable JSON.*collect it again",
    ),
    "manifest is binary": (
        lambda f: (f / MANIFEST).write_bytes(b"\xff\xfe\x80"),
        "not readable JSON.*collect it again",
    ),
    "other format": (lambda f: sign(f, format=99), "has format 99, this version reads 1, 2 and 3"),
    "no format": (lambda f: sign(f, format=True), "format must be an integer, found True"),
    "another count": (
        lambda f: sign(f, num_trajectories=5),
        r"lengths has shape \[4\], wanted \[trajectory 5\]; .*collect it again",
    ),
    "another number of steps": (
        lambda f: sign(f, num_steps=1),
        r"obs has shape \[17, 2\], wanted \[step 1, 2\]; .*collect it again",
    ),
    "a path for a world": (
        lambda f: sign(f, env="../../x"),
        "env is not a name that is allowed here",
    ),
    "a seed in words": (lambda f: sign(f, seed="seven"), "seed must be an integer, found 'seven'"),
    "NaN among the facts": (
        lambda f: sign(f, at_horizon=float("nan")),
        "at_horizon must be a finite number, found nan",
    ),
    "nested without end": (
        lambda f: (f / MANIFEST).write_text("[" * 5000),
        "not readable JSON.*collect it again",
    ),
    "a list": (lambda f: (f / MANIFEST).write_text("[]"), "does not hold a JSON object"),
}


@pytest.mark.parametrize("damage", FILE_DAMAGE)
def test_damaged_files(folder, damage):
    act, message = FILE_DAMAGE[damage]
    act(folder)
    with pytest.raises(DataError, match=message):
        load_dataset(folder, SPEC)


def test_no_folder(tmp_path):
    with pytest.raises(DataError, match="no dataset in"):
        load_dataset(tmp_path / "nowhere")


NO_DATASET = {
    "nowhere": "no dataset in .*: there is no such folder; give the folder of a dataset",
    "logs.npz": "it is a file, and a dataset is a folder; import logs with `mgpo data import .*logs.npz ",
    "episodes": "so it was not imported; import logs with `mgpo data import .*episodes --out FOLDER`",
    "of arrays": "so it was not imported; import logs with",
}


@pytest.mark.parametrize("name", NO_DATASET)
@pytest.mark.parametrize("read", [load_dataset, read_facts])
def test_logs_that_were_not_imported_are_left_alone(tmp_path, name, read):
    np.savez(tmp_path / "logs.npz", observations=np.zeros((3, 2)))
    (tmp_path / "episodes").mkdir()
    np.savez(tmp_path / "episodes" / "0.npz", observations=np.zeros((3, 2)))
    (tmp_path / "of arrays").mkdir()
    np.save(tmp_path / "of arrays" / "actions.npy", np.zeros(3))
    with pytest.raises(DataError, match=NO_DATASET[name]) as error:
        read(tmp_path / name)
    assert "remove" not in str(error.value)


@pytest.mark.parametrize("as_files", [False, True])
def test_a_dataset_that_has_lost_its_manifest_is_collected_or_imported_again(
    tmp_path, dataset, as_files
):
    save_dataset(tmp_path / "data", dataset, {}, mapped=as_files)
    (tmp_path / "data" / MANIFEST).unlink()
    with pytest.raises(DataError, match=r"if it is a damaged dataset, remove .*data and collect"):
        load_dataset(tmp_path / "data", SPEC)


ARRAY_DAMAGE = {
    "missing array": (
        lambda a: a.pop("achieved_goals"),
        "lacks achieved_goals.*collect it again",
    ),
    "NaN": (lambda a: a["obs"].__setitem__((5, 1), np.nan), "obs holds NaN at step 5"),
    "infinity": (
        lambda a: a["achieved_goals"].__setitem__((2, 0), np.inf),
        "achieved_goals holds infinity at step 2",
    ),
    "too few steps": (
        lambda a: a.update(actions=a["actions"][:-1]),
        r"goal_reached has shape \[17\], wanted \[step 16\]|actions has shape \[16\], wanted \[step 17\]",
    ),
    "empty trajectory": (
        lambda a: a["lengths"].__setitem__(slice(2), [4, 0]),
        "lengths holds 0 at trajectory 1, must be from 1 to 9",
    ),
    "no trajectories": (
        lambda a: a.update({name: array[:0] for name, array in a.items()}),
        r"lengths has shape \[0\], wanted \[trajectory",
    ),
    "obs of another world": (
        lambda a: a.update(obs=a["obs"][:, :1]),
        r"obs has shape \[17, 1\], wanted \[step 17, 2\]",
    ),
    "goals of another world": (
        lambda a: a.update(achieved_goals=a["achieved_goals"][:, :2]),
        r"achieved_goals has shape \[17, 2\], wanted \[step 17, 3\]",
    ),
    "goals as in format 1": (
        lambda a: a.update(goals=a.pop("achieved_goals")),
        "lacks achieved_goals.*collect it again",
    ),
    "too few rewards": (
        lambda a: a.update(rewards=a["rewards"][1:]),
        r"rewards has shape \[16\], wanted \[step 17\]",
    ),
    "NaN after the last action": (
        lambda a: a["last_obs"].__setitem__((3, 0), np.nan),
        "last_obs holds NaN at trajectory 3",
    ),
    "a last observation for every step": (
        lambda a: a.update(last_obs=a["obs"]),
        r"last_obs has shape \[17, 2\], wanted \[trajectory 4, 2\]",
    ),
    "continuous actions": (
        lambda a: a.update(actions=a["actions"].astype(np.float32)),
        "actions must hold integers, found float32",
    ),
    "goal_reached as numbers": (
        lambda a: a.update(goal_reached=a["goal_reached"].astype(np.int32)),
        "goal_reached must hold booleans, found int32",
    ),
    "action too large": (
        lambda a: a["actions"].__setitem__(3, 4),
        "actions holds 4 at step 3, must be from 0 to 3",
    ),
    "intended action too large": (
        lambda a: a.update(intended=a["actions"] + 4),
        "intended holds [4-7] at step 0, must be from 0 to 3",
    ),
    "intended action of other steps": (
        lambda a: a.update(intended=a["actions"][1:]),
        r"intended has shape \[16\], wanted \[step 17\]",
    ),
    "continuous intended actions": (
        lambda a: a.update(intended=a["actions"] / 2),
        "intended must hold integers, found float64",
    ),
    "negative action": (lambda a: a["actions"].__setitem__(3, -1), "actions holds -1 at step 3"),
    "missing hashes": (
        lambda a: a.update(task_hashes=a["task_hashes"][:1]),
        r"task_hashes has shape \[1\], wanted \[trajectory 4\]",
    ),
    "fractional lengths": (
        lambda a: a.update(lengths=a["lengths"].astype(np.float32)),
        "lengths must hold integers, found float32",
    ),
    "too long": (
        lambda a: a.update(lengths=np.array([3, 10, 3, 1])),
        "lengths holds 10 at trajectory 1, must be from 1 to 9",
    ),
}


ARRAY_DAMAGE |= {
    "dates": (
        lambda a: a.update(actions=a["actions"].astype("m8[s]")),
        "actions must hold integers, found timedelta64",
    ),
    "numbers without sense": (
        lambda a: a["obs"].__setitem__((0, 1), 1e38),
        r"obs holds 1e\+38 at step 0, must be from -1e\+18 to 1e\+18; .*collect it again",
    ),
    "other lengths": (
        lambda a: a["lengths"].__setitem__(0, 4),
        "the lengths add up to 18 steps, found 17; .*collect it again",
    ),
}


@pytest.mark.parametrize("damage", ARRAY_DAMAGE)
def test_damaged_arrays(folder, damage):
    change, message = ARRAY_DAMAGE[damage]
    rewrite(folder, change)
    with pytest.raises(DataError, match=message):
        load_dataset(folder, SPEC)


def test_pickled_arrays_are_never_loaded(folder):
    rewrite(folder, lambda arrays: arrays.update(actions=np.array([{}] * 17, object)))
    with pytest.raises(DataError, match="actions must hold numbers, found object"):
        load_dataset(folder)


@pytest.mark.parametrize(
    ("manifest", "says"),
    [
        ({"env": "gridworld"}, "env is 'gridworld', wanted 'maze15'"),
        ({"env": None}, "env is None, wanted .maze15."),
        ({"env": "nowhere.such:WORLD"}, "env is 'nowhere.such:WORLD', wanted 'maze15'"),
        ({"policy": "random"}, "policy is 'random', wanted 'astar4'"),
        ({"seed": 7}, "seed is 7, wanted 0"),
    ],
)
def test_manifests_that_contradict_what_is_wanted(tmp_path, dataset, manifest, says):
    made = {"env": "maze15", "policy": "astar4", "seed": 0}
    save_dataset(tmp_path / "data", dataset, {**made, **manifest})
    with pytest.raises(DataError, match=f"manifest.json: {says}; remove .* and collect it again"):
        load_dataset(tmp_path / "data", SPEC, made)


def test_worlds_share_the_datasets_of_their_home(tmp_path, dataset):
    save_dataset(tmp_path / "data", dataset, {"env": "kitchen"})
    load_dataset(tmp_path / "data", SPEC, {"env": "kitchen-mjx", "seed": 3})


def test_datasets_of_foreign_tools_are_converted(folder, dataset):
    """Doubles, other orders of bytes and axes, and unsigned lengths are the same numbers."""

    def change(arrays):
        for name in ("obs", "rewards"):
            arrays[name] = np.asfortranarray(arrays[name].astype(">f8"))
        arrays["lengths"] = arrays["lengths"].astype(np.uint64)
        arrays["notes"] = np.array(["not read"])

    rewrite(folder, change)
    loaded, _ = load_dataset(folder, SPEC)
    assert_equal(loaded, dataset)
    assert all(array.flags.c_contiguous for array in loaded.arrays.values())


def test_continuous_actions_have_bounds(dataset):
    spec = replace(SPEC, actions=Box(4))
    actions = np.linspace(-1, 1, 17 * 4, dtype=np.float32).reshape(17, 4)
    check_dataset(replace(dataset, actions=actions), "here", spec)
    with pytest.raises(
        DataError, match=r"here: actions holds -1\.01 at step 0, must be from -1 to 1"
    ):
        check_dataset(replace(dataset, actions=1.01 * actions), "here", spec)


def test_check_without_a_world_accepts_any_sizes(dataset):
    check_dataset(replace(dataset, obs=dataset.obs[:, :1]), "here")


def write_format_1(folder):
    """Without rewards and last observations, and with another name for achieved goals."""

    def change(arrays):
        arrays["goals"] = arrays.pop("achieved_goals")
        del arrays["rewards"], arrays["last_obs"]

    rewrite(folder, change)
    sign(folder, format=1)


def test_datasets_of_format_1_are_read(folder, dataset):
    write_format_1(folder)
    loaded, manifest = load_dataset(folder, SPEC)
    assert manifest["format"] == 1
    assert_equal(loaded, replace(dataset, rewards=None, last_obs=None))
    part, whole = (d.gather(np.array([2, 0]), np.array([5, 3]), 6) for d in (loaded, dataset))
    for rows, others in zip(part, whole, strict=True):
        np.testing.assert_array_equal(rows, others)
    assert_equal(loaded.slice(1, 3), replace(dataset.slice(1, 3), rewards=None, last_obs=None))


def test_a_dataset_of_format_1_without_goals(folder):
    write_format_1(folder)
    rewrite(folder, lambda arrays: arrays.pop("goals"))
    with pytest.raises(DataError, match=r"lacks goals.*collect it again"):
        load_dataset(folder, SPEC)


@pytest.mark.parametrize("name", ["rewards", "last_obs", "task_hashes"])
def test_what_training_does_not_read_may_be_missing(folder, dataset, name):
    rewrite(folder, lambda arrays: arrays.pop(name))
    loaded, _ = load_dataset(folder, SPEC)
    assert_equal(loaded, replace(dataset, **{name: None}))


BYTES = replace(SPEC, obs=ArraySpec((3, 3), "uint8"))


def with_pictures(dataset, dtype=np.uint8):
    pictures = np.random.default_rng(2).integers(256, size=(17, 3, 3)).astype(dtype)
    return replace(dataset, obs=pictures, last_obs=pictures[:4])


def test_observations_keep_their_shape_and_dtype(tmp_path, dataset):
    pictures = with_pictures(dataset)
    save_dataset(tmp_path / "data", pictures, {})
    assert np.load(tmp_path / "data" / ARRAYS)["obs"].dtype == np.uint8
    loaded, _ = load_dataset(tmp_path / "data", BYTES)
    assert_equal(loaded, pictures)
    part = loaded.gather(np.array([3, 1]), np.array([2, 1]), 4)
    assert part.obs.dtype == np.uint8
    assert part.obs.shape == (2, 4, 3, 3)
    np.testing.assert_array_equal(part.obs[0, :2], pictures.obs[13:15])
    assert not part.obs[0, 2:].any()


@pytest.mark.parametrize(
    ("dtype", "spec", "says"),
    [
        (np.float32, BYTES, "obs must hold integers, found float32"),
        (np.uint8, SPEC, r"obs has shape \[17, 3, 3\], wanted \[step .*, 2\]"),
    ],
)
def test_observations_of_another_kind(dataset, dtype, spec, says):
    with pytest.raises(DataError, match=says):
        check_dataset(with_pictures(dataset, dtype), "here", spec)


# Datasets that are mapped into memory


@pytest.fixture
def mapped(tmp_path, dataset):
    whole = replace(dataset, terminated=np.array([1, 0, 0, 1], bool), truncated=np.ones(4, bool))
    save_dataset(tmp_path / "mapped", whole, {"env": "toy"}, mapped=True)
    return tmp_path / "mapped"


def test_a_mapped_dataset_is_what_was_written_and_is_not_read(mapped, dataset):
    loaded, manifest = load_dataset(mapped, SPEC)
    assert_equal(
        replace(loaded, terminated=None, truncated=None, lengths=np.array(loaded.lengths)), dataset
    )
    assert isinstance(loaded.obs, np.memmap)
    assert not loaded.obs.flags.writeable
    assert not isinstance(loaded.lengths, np.memmap)
    assert (manifest["format"], manifest["num_trajectories"], manifest["num_steps"]) == (3, 4, 17)
    assert loaded.terminated.tolist() == [True, False, False, True]
    assert loaded.slice(1, 3).truncated.tolist() == [True, True]


def test_batches_of_a_mapped_dataset_are_bit_for_bit_those_of_one_in_memory(mapped, folder):
    """Over several pools of draws, for both halves of a training's dataset."""
    there, _ = load_dataset(mapped, SPEC)
    here, _ = load_dataset(folder, SPEC)
    for begin, end in ((0, 3), (3, 4)):
        pairs = zip(plans(there.slice(begin, end)), plans(here.slice(begin, end)), strict=True)
        for batch, other in islice(pairs, 8):
            for part, other_part in zip(batch, other, strict=True):
                one = there.slice(begin, end).gather(*part)
                two = here.slice(begin, end).gather(*other_part)
                assert one.steps.keys() == two.steps.keys()
                for name, rows in one.steps.items():
                    assert rows.tobytes() == two.steps[name].tobytes()
                    assert type(rows) is np.ndarray
                assert one.length.tobytes() == two.length.tobytes()


@pytest.mark.parametrize("large", [False, True])
def test_arrays_in_files_become_a_packed_dataset_or_a_mapped_one_if_they_are_large(
    tmp_path, monkeypatch, dataset, large
):
    """The files of the arrays are gone from a packed dataset, and its hash is that of the same arrays in
    memory."""
    num_bytes = sum(array.nbytes for array in dataset.arrays.values())
    monkeypatch.setattr("mgpo_jax.dataset.LARGE", num_bytes - 1 if large else num_bytes)
    place = tmp_path / "place"
    place.mkdir()
    for name, array in dataset.arrays.items():
        np.save(place / f"{name}.npy", array)
    finish_dataset(place, {"env": "toy"})
    save_dataset(tmp_path / "memory", dataset, {"env": "toy"}, mapped=large)
    loaded, manifest = load_dataset(place, SPEC)
    _, wanted = load_dataset(tmp_path / "memory", SPEC)
    assert manifest == wanted
    assert isinstance(loaded.obs, np.memmap) == large
    assert sorted(path.name for path in place.iterdir()) == sorted(
        path.name for path in (tmp_path / "memory").iterdir()
    )
    assert_equal(replace(loaded, lengths=np.array(loaded.lengths)), dataset)


def test_what_was_let_go_is_read_again(tmp_path, monkeypatch):
    """Pages that were taken out of memory come back with what they held."""
    monkeypatch.setattr("mgpo_jax.mapped.RESIDENT", 0)
    big = make_dataset([9] * 200)
    save_dataset(tmp_path / "big", big, {}, mapped=True)
    loaded, _ = load_dataset(tmp_path / "big", SPEC)
    for _ in range(3):
        part = loaded.gather(np.arange(200), np.full(200, 9), 9)
        np.testing.assert_array_equal(part.obs.reshape(-1, 2), big.obs)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.unlink(), "obs.npy is missing or differs from the hash"),
        (lambda path: path.write_bytes(b"no array"), "obs.npy is missing or differs from the hash"),
        (
            lambda path: path.write_bytes(path.read_bytes()[:-4]),
            "obs.npy is missing or differs from the hash",
        ),
    ],
)
def test_damaged_files_of_a_mapped_dataset_are_refused(mapped, damage, says):
    damage(mapped / "obs.npy")
    with pytest.raises(
        DataError, match=rf"{says}.*; remove .*mapped and collect or import it again"
    ):
        load_dataset(mapped)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"no array", "obs.npy is not an array"),
        (np.zeros((17, 2), ">f4"), "wrong dtype or memory order, found >f4, expected float32 in C"),
        (
            np.asfortranarray(np.zeros((17, 2), np.float32)),
            "wrong .* order, found float32 in Fortran order, expected float32 in C",
        ),
        (np.zeros((16, 2), np.float32), r"obs has shape \[16, 2\], wanted \[step 17, 2\]"),
        (np.full((17, 2), np.nan, np.float32), "obs holds NaN at step 0"),
    ],
)
def test_files_with_a_sound_hash_and_wrong_arrays_are_refused(mapped, content, says):
    path, manifest = mapped / "obs.npy", mapped / MANIFEST
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    document = json.loads(manifest.read_text())
    document["files"]["obs"] = hash_file(path)
    document["sha256"] = hash_of_files(document["files"])
    manifest.write_text(json.dumps(document))
    with pytest.raises(DataError, match=says):
        load_dataset(mapped, SPEC)


def test_a_list_of_files_that_is_not_that_of_the_hash_is_refused(mapped):
    document = json.loads((mapped / MANIFEST).read_text())
    del document["files"]["rewards"]
    (mapped / MANIFEST).write_text(json.dumps(document))
    with pytest.raises(DataError, match="sha256 is not that of its list of files"):
        load_dataset(mapped)


@pytest.mark.parametrize("kind", ["mapped", "folder"])
def test_facts_are_read_without_the_steps(request, kind):
    facts = read_facts(request.getfixturevalue(kind))
    assert (facts.num_trajectories, facts.num_steps, facts.longest) == (4, 17, 9)
    assert (facts.obs_shape, facts.obs_dtype, facts.goal_dim) == ((2,), "float32", 3)
    assert facts.num_actions == facts.action_dim == 4
    assert facts.mean_length == 17 / 4
    spec = spec_of(facts)
    assert (spec.actions, spec.horizon, spec.obs) == (Discrete(4), 9, SPEC.obs)
