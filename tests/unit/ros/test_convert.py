"""Conversion between numpy and messages, in both modes of ROS_PYTHON_CHECK_FIELDS."""

import os
import subprocess
import sys
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from wm_msgs.msg import ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import array_of, images_of
from wm_nodes.reward import RewardResult
from wm_nodes.ros import calls, convert
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand

N = 5


def spec(**changes: Any) -> EnvironmentSpec:
    values: dict[str, Any] = {
        "env_id": "test/reach", "task": "reach", "instruction": "reach", "source": 0, "num_envs": N, "height": 4,
        "width": 8, "cameras": ("front", "wrist"), "action_names": ("x", "y", "z"), "action_units": ("m",) * 3,
        "action_scale": (0.03, 0.02, 0.1), "state_names": ("x", "y", "z"), "state_units": ("m",) * 3,
        "ground_truth_names": ("a", "b"), "control_period_s": 0.1, "max_episode_steps": 50,
        "state_low": (0.3, -0.4, 0.01), "state_high": (0.9, 0.4, 0.5),
    }
    return EnvironmentSpec(**{**values, **changes})


def random_images(count: int = N) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(0).integers(0, 256, (count, 4, 8, 3), dtype=np.uint8)


def transition() -> LockStep:
    rng = np.random.default_rng(1)

    def f(*shape: int) -> np.ndarray[Any, np.dtype[np.float32]]:
        return rng.normal(size=shape).astype(np.float32)

    return LockStep(
        session=6, stamp_ns=3_100_000_000, next_stamp_ns=3_200_000_000, step_id=2**40, actions=f(N, 3), states=f(N, 3),
        next_states=f(N, 3), logprobs=f(N), values=f(N), terminated=f(N) > 0, truncated=f(N) > 0, valid=f(N) > 0,
        episode_ids=np.arange(N, dtype=np.uint64) + 2**50, episode_steps=np.arange(N, dtype=np.uint32),
        policy_versions=np.full(N, 7, np.uint64), success_probability=f(N), uncertainty=f(N), ground_truth=f(N, 2),
        source=1,
    )


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint8", "bool", "uint32", "uint64"])
def test_a_field_has_the_bytes_of_the_array_row_by_row(dtype: str) -> None:
    values = np.arange(12).reshape(3, 4).astype(dtype)
    for layout in (values, values.T, values[:, ::2]):
        field = convert.to_field(layout)
        assert isinstance(field, array)
        back = array_of(field, "uint8" if dtype == "bool" else dtype, (layout.size,), "field")
        np.testing.assert_array_equal(back, layout.reshape(-1))
    assert len(convert.to_field(np.empty((0, 3), dtype))) == 0


def test_a_dtype_without_a_message_array_is_refused() -> None:
    with pytest.raises(TypeError, match="int64"):
        convert.to_field(np.zeros(3, np.int64))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 16, 17])
def test_images_survive_the_mosaic(count: int) -> None:
    images = random_images(count)
    message = convert.mosaic_msg(images, 5, spec(num_envs=count))
    np.testing.assert_array_equal(images_of(message, spec(num_envs=count)), images)
    assert len(message.data) == message.height * message.step


def test_tile_i_lies_at_row_i_div_cols_and_missing_tiles_are_black() -> None:
    images = random_images()
    tiles = Tiles.of(N, 4, 8)
    mosaic = tiles.tile(images)
    for i in range(tiles.rows * tiles.cols):
        row, col = divmod(i, tiles.cols)
        found = mosaic[row * 4 : row * 4 + 4, col * 8 : col * 8 + 8]
        np.testing.assert_array_equal(found, images[i] if i < N else np.zeros_like(found))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("encoding", "bgr8", "encoding is 'bgr8', not 'rgb8'"),
        ("height", 9, "height is 9, not 8"),
        ("step", 1, "step is 1, not 72"),
        ("data", array("B", b"123"), "data has 3 bytes, not 576"),
    ],
)
def test_a_wrong_image_is_refused_with_value_and_remedy(field: str, value: Any, words: str) -> None:
    message = convert.mosaic_msg(random_images(), 0, spec())
    setattr(message, field, value)
    with pytest.raises(WireError, match=words) as refused:
        images_of(message, spec())
    assert refused.value.code == ErrorCode.BAD_SHAPE
    assert "send 5 tiles of 4 x 8 px" in str(refused.value)


def test_a_spec_survives_the_wire_with_its_hash_and_a_changed_one_is_refused() -> None:
    message = convert.spec_msg(spec(), 1)
    assert convert.spec_from_msg(message) == spec()
    message.max_episode_steps += 1
    with pytest.raises(WireError, match="same version"):
        convert.spec_from_msg(message)


def test_transitions_steps_and_resets_survive_the_wire() -> None:
    sent = transition()
    message = convert.transition_msg(sent)
    message.session = 6
    found = convert.transition_of(message, spec())
    for name, value in vars(sent).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
    command = StepCommand(
        session=3, step_id=4, spec_hash="h", actions=sent.actions.reshape(-1), policy_version=9,
        logprobs=sent.logprobs, values=sent.values, reset_mask=sent.valid, reset_seeds=sent.episode_ids,
    )
    back = calls.step_command(calls.step_request(command), spec())
    for name, value in vars(command).items():
        np.testing.assert_array_equal(getattr(back, name), value, err_msg=name)
    assert calls.reset_command(calls.reset_request(ResetCommand()), spec()) == ResetCommand()


@pytest.mark.parametrize("shown_stamp_ns", [None, 2, 3])
def test_a_reply_survives_the_wire_and_takes_a_shown_mosaic_of_its_own_stamp_only(shown_stamp_ns: int | None) -> None:
    from wm_msgs.srv import StepBatch

    t = transition()
    reply = Reply(
        session=1, step_id=2, stamp_ns=3, images=random_images(), states=t.states, terminated=t.terminated,
        truncated=t.truncated, episode_ids=t.episode_ids, success_probability=t.values, uncertainty=t.values,
        step_s=0.5,
    )
    shown = None
    if shown_stamp_ns is not None:
        images = reply.images if shown_stamp_ns == reply.stamp_ns else np.zeros_like(reply.images)
        shown = convert.mosaic_msg(images, shown_stamp_ns, spec())
    response = calls.fill_response(StepBatch.Response(), reply, spec(), shown)
    assert (response.observation is shown) == (shown_stamp_ns == reply.stamp_ns)
    found = calls.reply_of(response, spec(), 1)
    for name, value in vars(reply).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)


def test_a_missing_reward_stays_missing() -> None:
    nan = np.full(N, np.nan, np.float32)
    result = RewardResult(nan, nan, nan, np.zeros(N, bool), np.full(N, 2, np.uint8), "no goal")
    rewards = convert.rewards_of(convert.reward_msg(transition(), result, name="rule", version=1, eval_s=0.0))
    assert not rewards.valid.any()
    assert np.isnan(rewards.total).all()
    assert rewards.invalid_reason == "no goal"


def test_the_same_tests_hold_with_checked_fields() -> None:
    if os.environ.get("ROS_PYTHON_CHECK_FIELDS") == "1":
        pytest.skip("this is the run with checked fields")
    command = [sys.executable, "-m", "pytest", "-q", "--rootdir", str(Path(__file__).parents[3]), __file__]
    done = subprocess.run(
        command, env={**os.environ, "ROS_PYTHON_CHECK_FIELDS": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:]


def test_no_code_of_the_package_assigns_anything_but_a_field_to_data() -> None:
    import wm_nodes

    package = Path(wm_nodes.__file__).parent
    offenders = [
        f"{path}:{number}: {line.strip()}"
        for folder in ("ros", "nodes")
        for path in sorted((package / folder).glob("*.py"))
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if ".data = " in line and not any(ok in line for ok in ("to_field(", "bytes_field(", "array("))
    ]
    assert not offenders
