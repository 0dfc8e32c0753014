"""Nothing that arrives can break the graph: storms of odd messages on every topic, service and action of both loops.

WM_FUZZ_SEED=7 draws other messages; a node that ends or hangs is named with what it was sent last.
"""

import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from graph import toy
from graph.harness import Graph, Probe, wait_until
from graph.storm import Storm
from graph.test_environment import Client
from graph.test_training import train
from graph.video_loop import NAMES, VideoLoop, settings
from message_generator import MessageGenerator

from wm_msgs.action import Evaluate, Train
from wm_msgs.msg import ErrorCode
from wm_msgs.srv import InferAction, SetRubric, StopRecording
from wm_nodes.recording import Bag
from wm_nodes.ros import calls

pytestmark = [pytest.mark.graph, pytest.mark.alone]

SEED = int(os.environ.get("WM_FUZZ_SEED", "1"))
COUNT, LIMIT_S = 4000, 60.0
"""Messages of a storm on a loop, and the longest time that it may take."""


@pytest.fixture
def make_storm(probe: Probe) -> Iterator[Callable[..., Storm]]:
    made = list[Storm]()

    def make(*names: str) -> Storm:
        for name in names:
            wait_until(f"active {name}", lambda n=name: probe.value(n, "state") == "active")
        made.append(Storm(probe, list(names), MessageGenerator(SEED)))
        return made[0]

    print(f"WM_FUZZ_SEED={SEED}")
    yield make
    for storm in made:
        storm.close()


def test_loop_1_in_lock_step_counts_every_message_and_trains_the_same_weights(
    graph: Graph, probe: Probe, make_storm: Callable[..., Storm]
) -> None:
    graph.start("recorder", min_free_mib=16)
    graph.start_training_nodes()
    graph.start_environment(namespace="/wm/sim")
    graph.start("evaluation", policy__factory="toy:make_policy")
    graph.start("player")
    storm = make_storm(*graph.processes)
    client = Client(probe)
    assert train(probe, updates=1).termination_reason == Train.Result.FINISHED
    command = client.command(1, np.zeros((client.spec.num_envs, 3)))
    storm.learn(calls.step_request(command), Train.Impl.SendGoalService.Request(goal=Train.Goal(updates=1)))
    storm.blow(COUNT, LIMIT_S)
    storm.assert_counted()
    last = train(probe, updates=1)
    assert last.termination_reason == Train.Result.FINISHED
    assert last.updates >= 2, "odd goals that ask for updates are goals"
    newest = graph.folder / "policies" / f"policy_{last.policy_version:06d}.safetensors"
    toy.assert_trained_in_one_process(newest, updates=last.updates)
    _refuses_absurd_requests(probe)
    stopped = probe.call(StopRecording, "recorder/stop", StopRecording.Request())
    bags = list((graph.folder / "bags").iterdir())
    assert stopped.error_code in (ErrorCode.OK, ErrorCode.NOT_ACTIVE) and bags
    for path in bags:
        with Bag(path) as bag:
            kinds = {connection.topic: connection.msgtype for connection in bag.connections}
            for name, _, data in bag.messages():
                bag.decode(data, kinds[name])


def _refuses_absurd_requests(probe: Probe) -> None:
    goal = Evaluate.Goal(episodes=2**32 - 1, seed=2**64 - 1)
    result = probe.finish(probe.send(probe.action(Evaluate, "evaluate"), goal))
    assert result.termination_reason == Evaluate.Result.FAILED
    assert "episodes 4294967295 from seed 18446744073709551615: ask for 1 to" in result.message
    untiled = probe.call(InferAction, "policy/infer", InferAction.Request(state=[0.0] * 3))
    assert untiled.error_code == ErrorCode.BAD_SHAPE and "0 x 0 tiles" in untiled.message
    unknown = probe.call(InferAction, "policy/infer", InferAction.Request(state=[float("nan")] * 3))
    assert unknown.error_code == ErrorCode.NAN_INPUT


def test_loop_1_in_asynchronous_mode_counts_every_message_and_goes_on_acting(
    graph: Graph, probe: Probe, make_storm: Callable[..., Storm]
) -> None:
    graph.start_environment(mode="asynchronous", control_period_s=0.1, max_action_age_s=2.0)
    graph.start_policy(mode="asynchronous")
    graph.start_reward()
    graph.start("recorder", min_free_mib=16, topics="[env/spec,env/transition,action]")
    storm = make_storm(*graph.processes)
    actions = probe.listen("action")
    wait_until("actions", lambda: len(actions) > 5)
    storm.blow(COUNT, LIMIT_S)
    storm.assert_counted(quiet=False)
    storm.wait_for_more("/wm/environment", "action")


def test_loop_2_counts_every_message_and_trains_the_same_weights(
    graph: Graph, probe: Probe, make_storm: Callable[..., Storm]
) -> None:
    loop = VideoLoop(graph, probe, settings(**{"seed": 2, "grpo.micro_batch": 1}))
    for node in NAMES:
        loop.start(node)
    graph.start("recorder", min_free_mib=16, topics="[clips,clips/image,clips/scores,video/version]")
    loop.wait_active()
    storm = make_storm(*NAMES.values(), "/wm/recorder")
    loop.assert_undisturbed(loop.train(1))
    storm.blow(COUNT, LIMIT_S)
    storm.assert_counted()
    loop.assert_undisturbed(loop.train(1))


def test_the_reward_agent_counts_every_message_and_keeps_its_rubric(
    graph: Graph, probe: Probe, make_storm: Callable[..., Storm]
) -> None:
    graph.start("reward_evaluator", reward="agent", audit_dir="audit")
    storm = make_storm("/wm/reward_evaluator")
    before = probe.call(SetRubric, "reward/set_rubric", SetRubric.Request())
    storm.blow(COUNT // 4, LIMIT_S)
    storm.assert_counted()
    after = probe.call(SetRubric, "reward/set_rubric", SetRubric.Request())
    assert (after.error_code, after.pack, after.version) == (ErrorCode.OK, before.pack, before.version)
