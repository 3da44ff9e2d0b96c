import numpy as np
import pytest
import torch

from fake_worlds import FakeWorlds, fake_transitions
from rapid import checkpoint
from rapid.data.replay import OfflineSampler, ReplayBuffer, join_batches, n_step
from rapid.data.transitions import RANDOM, Transitions, concatenate, empty
from rapid.errors import RapidError
from rapid.scenarios import NUM_FEATURES, NUM_VEHICLES

GAMMA = 0.9


def slow_n_step(rows: Transitions, start: int, steps: int) -> tuple[float, int, float]:
    """Return reward, last row and bootstrap by walking along the episode."""
    total, row = 0.0, start
    for taken in range(steps):
        total += GAMMA**taken * float(rows.reward_N[row])
        end = rows.done_N[row] or row + 1 == len(rows) or taken + 1 == steps
        gap = not end and (rows.episode_N[row + 1], rows.step_N[row + 1]) != (rows.episode_N[row], rows.step_N[row] + 1)
        if end or gap:
            return total, row, 0.0 if rows.terminated_N[row] else GAMMA ** (taken + 1)
        row += 1
    raise AssertionError


@pytest.mark.parametrize("steps", [1, 2, 3, 20])
@pytest.mark.parametrize("thinned", [False, True])
def test_n_step_never_crosses_an_end_or_a_gap(steps, thinned):
    rows = fake_transitions()
    if thinned:
        rows = rows.select(np.sort(np.random.default_rng(3).choice(len(rows), 120, replace=False)))
    reward_N, last_N, bootstrap_N = n_step(rows, steps, GAMMA)
    for start in range(len(rows)):
        reward, last, bootstrap = slow_n_step(rows, start, steps)
        assert reward_N[start] == pytest.approx(reward, abs=1e-5)
        assert last_N[start] == last
        assert bootstrap_N[start] == pytest.approx(bootstrap)


def test_offline_batches_hold_the_dataset():
    rows = concatenate([fake_transitions(), fake_transitions(20, RANDOM, seed=1)])
    sampler = OfflineSampler(rows, GAMMA)
    batch = sampler.sample(5_000, np.random.default_rng(0))
    keys = {obs.tobytes(): row for row, obs in enumerate(rows.obs_NVF)}
    index = np.array([keys[obs.tobytes()] for obs in batch.obs_BVF.numpy()])
    assert len(set(index.tolist())) == len(rows)
    np.testing.assert_array_equal(batch.action_B, rows.action_N[index])
    np.testing.assert_array_equal(batch.reward_B, rows.reward_N[index])
    np.testing.assert_array_equal(batch.next_obs_BVF, rows.next_obs_NVF[index])
    np.testing.assert_array_equal(batch.teacher_B, rows.source_N[index] == 0)
    np.testing.assert_array_equal(batch.soft_BA, rows.probabilities_NA[index])
    np.testing.assert_allclose(batch.bootstrap_B, np.where(rows.terminated_N[index], 0, GAMMA), rtol=1e-6)


def test_rows_that_the_data_lacks_are_absent_and_those_not_wanted_left_out():
    rows = fake_transitions()
    plain, wide, short = (OfflineSampler(rows, GAMMA, vehicles=vehicles).store for vehicles in (15, 20, 8))
    assert torch.equal(short.obs_BVF, plain.obs_BVF[:, :8])
    for name in ("obs_BVF", "next_obs_BVF"):
        had, has = getattr(plain, name), getattr(wide, name)
        assert torch.equal(has[:, :15], had)
        assert not has[:, 15:].any()
        assert has.shape[1] == 20


def test_a_share_of_every_batch_comes_from_the_teacher():
    rows = concatenate([fake_transitions(), fake_transitions(20, RANDOM, seed=1)])
    sampler = OfflineSampler(rows, GAMMA, teacher_share=0.25)
    rng = np.random.default_rng(0)
    assert {int(sampler.sample(64, rng).teacher_B.sum()) for _ in range(20)} == {16}
    whole = OfflineSampler(rows, GAMMA, teacher_share=1.0)
    assert whole.sample(64, rng).teacher_B.all()
    with pytest.raises(RapidError, match="transitions of both sources"):
        OfflineSampler(fake_transitions(), GAMMA, teacher_share=0.25)
    with pytest.raises(RapidError, match="empty"):
        OfflineSampler(empty(), GAMMA)


def drive(buffer: ReplayBuffer, worlds: FakeWorlds, steps: int, seed: int = 0) -> Transitions:
    """Fill the buffer from worlds; return the same steps, episode by episode."""
    rng = np.random.default_rng(seed)
    obs, _ = worlds.reset(list(range(worlds.num_envs)))
    rows = []
    for step in range(steps):
        action = rng.integers(0, 5, worlds.num_envs)
        after, reward, terminated, truncated, info = worlds.step(action)
        real = after.copy()
        for world in np.flatnonzero(terminated | truncated):
            real[world] = info["final_obs"][world]
        buffer.add(obs, action, reward, real, terminated, truncated)
        rows += [
            (world, step, obs[world], action[world], reward[world], real[world], terminated[world], truncated[world])
            for world in range(worlds.num_envs)
        ]
        obs = after
    rows.sort(key=lambda row: row[:2])
    world, _, obs, action, reward, real, terminated, truncated = map(np.array, zip(*rows, strict=True))
    count = len(rows)
    return Transitions(
        obs,
        action,
        reward.astype(np.float32),
        real,
        terminated,
        truncated,
        np.ones(count, np.int8),
        world.astype(np.int64),
        np.array([row[1] for row in rows]),
        np.zeros(count, np.int64),
        np.full((count, 5), np.nan, np.float32),
    ).validate()


@pytest.mark.parametrize("steps", [1, 3, 5])
@pytest.mark.parametrize("worlds", [1, 4])
def test_the_ring_holds_the_n_step_returns_of_every_world(steps, worlds):
    buffer = ReplayBuffer(10_000, worlds, GAMMA, steps)
    rows = drive(buffer, FakeWorlds(worlds, autoreset=True, duration=12), 60)
    reward_N, last_N, bootstrap_N = n_step(rows, steps, GAMMA)
    # What still waits for rewards at the very end is not in the ring.
    full = [row for row in range(len(rows)) if rows.done_N[last_N[row]] or last_N[row] - row + 1 == steps]
    stored = {obs.numpy().tobytes(): place for place, obs in enumerate(buffer._store.obs_BVF[: len(buffer)])}
    assert len(stored) == len(buffer) == len(full)
    for row in full:
        place = stored[rows.obs_NVF[row].tobytes()]
        assert buffer._store.action_B[place] == rows.action_N[row]
        assert float(buffer._store.reward_B[place]) == pytest.approx(float(reward_N[row]), abs=1e-5)
        assert float(buffer._store.bootstrap_B[place]) == pytest.approx(float(bootstrap_N[row]), abs=1e-6)
        np.testing.assert_array_equal(buffer._store.next_obs_BVF[place], rows.next_obs_NVF[last_N[row]])


@pytest.mark.parametrize("steps", [1, 3])
def test_without_a_future_only_the_next_reward_counts(steps):
    buffer = ReplayBuffer(8, 2, 0.0, steps)
    obs, no = np.zeros((2, NUM_VEHICLES, NUM_FEATURES), np.float32), np.zeros(2, np.bool_)
    with np.errstate(all="raise"):
        for reward in (1.0, 2.0, 3.0):
            buffer.add(obs, np.zeros(2, np.int64), np.full(2, reward), obs, no, no)
        buffer.add(obs, np.zeros(2, np.int64), np.full(2, 4.0), obs, no, ~no)
    batch = buffer.sample(200, np.random.default_rng(0))
    assert set(batch.reward_B.tolist()) == {1.0, 2.0, 3.0, 4.0}
    assert not batch.bootstrap_B.any()


def test_the_oldest_is_overwritten():
    buffer = ReplayBuffer(50, 4, GAMMA)
    rows = drive(buffer, FakeWorlds(4, autoreset=True), 30)
    assert len(buffer) == 50
    newest = {obs.tobytes() for obs in rows.obs_NVF[rows.step_N >= 18]}
    held = {obs.numpy().tobytes() for obs in buffer._store.obs_BVF}
    assert len(held) == 50
    assert newest <= held


def test_a_saved_buffer_goes_on_as_if_nothing_had_been(tmp_path):
    def fill(resume: bool) -> ReplayBuffer:
        buffer = ReplayBuffer(70, 2, GAMMA, 3)
        drive(buffer, FakeWorlds(2, autoreset=True), 25)
        if resume:
            checkpoint.save_state(tmp_path / "buffer", buffer.state_dict())
            buffer = ReplayBuffer(70, 2, GAMMA, 3)
            buffer.load_state_dict(checkpoint.load_state(tmp_path / "buffer"))
        drive(buffer, FakeWorlds(2, autoreset=True), 25, seed=1)
        return buffer

    one, other = (fill(resume).sample(500, np.random.default_rng(0)) for resume in (False, True))
    assert all(torch.equal(first, second) for first, second in zip(one[:6], other[:6], strict=True))
    with pytest.raises(RapidError, match="another size, number of worlds or n"):
        ReplayBuffer(70, 2, GAMMA, 2).load_state_dict(fill(False).state_dict())
    with pytest.raises(RapidError, match="is empty"):
        ReplayBuffer(70, 2, GAMMA).sample(1, np.random.default_rng(0))


def test_joined_batches_mark_missing_labels():
    soft = OfflineSampler(fake_transitions(), GAMMA).sample(4, np.random.default_rng(0))
    hard = soft._replace(soft_BA=None)
    both = join_batches(soft, hard)
    assert len(both.action_B) == 8
    assert both.soft_BA is not None
    assert both.soft_BA[4:].isnan().all()
    assert join_batches(hard, hard).soft_BA is None
